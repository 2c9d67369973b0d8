"""C++ kernels for loops over neighborhoods.

A kernel computes the same as the torch function of its name, in one pass over memory. Kernels serve
plain float32 CPU tensors. The torch definition runs for gradients, ``vmap``, other devices and
dtypes, and without the library. Calls release the GIL.

``scripts/build_kernels.py`` builds the library with the package, once for any processor and once
for AVX2. Both are bit-identical.
"""

import ctypes
import math
import os
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrg._checks import is_concrete
from torchrg.errors import warn

MAX_NEIGHBORS = 512
"""Maximum number of values per row, ``MAX_WIDTH`` in ``plain.h``. Longer rows use the torch
definitions."""
SIGNATURES = {
    "majority_differences": "f[nk] l[n] -> f[n]",
    "may_have_flats": "f[KM] f[KM] f[KM] l[4S] f[M] -> b[M]",
    "lane_scales": "f[KM] -> f[M] f[M]",
    "smallest_points": "f[KM] n -> f[KM]",
    "deterministic_sets": "f[KM] f[KM] f[KM] f[KM] f[KM] f[KM] f[T] x n -> f[K6M] b[M]",
    "concentrate": "f[KM] f[KM] f[KM] f[KSM] f[M] n n n -> f[KSM] d[SM]",
    "are_coplanar": "f[3N] f[3N] i[nk] b[nk] x x -> b[nk] b[n]",
    "fit_normals_pca": "f[N3] i[nk] b[nk]? f[n] x x -> f[n3] f[n] f[n] b[n] b[n]",
    "survey": "f[N3] i[nk] b[nk]? f[n3] b[n] n n x x x n n -> f[n] f[n] f[n] f[n] b[n] f[n] f[n]",
    "broken_planes": "f[N3] i[nk] b[nk]? f[n] f[n3] l[p2] f[c] -> f[n3] f[n] f[n3] f[n] f[n]",
    "smooth_planes": "f[N8] i[Nk] b[Nk]? f[N] l[n] x x x x x -> f[n3] f[n]",
    "choose_planes": "f[N8] i[Nk] b[Nk]? f[N3] l[n] n x x x x -> f[n3] f[n]",
    "inliers": "f[N3] i[Nk] b[Nk]? f[N3] f[N] f[N] l[n] x -> f[n] f[n3]",
    "fit_paraboloids": "f[N3] i[Nk] b[Nk]? f[N3] l[n] x -> f[n3] f[n] f[n]",
    "morton_codes": "d[N3] x x x x -> l[N]",
    "sort_integers": "l[N] -> l[N] l[N] l[N] l[N]",
    "fill_cells": "d[N3] I[C] n n x x x x -> i[N] i[N]",
    "search_cells": "d[N3] i[N] i[C] I[N] l[N]? I[Mk] n n n n n x x x x -> ",
    "pass_edges": "f[3N] f[3N] b[N] f[N]? i[nk] b[nk]? x x n -> b[nk]",
    "neighbor_chords": "f[3N] i[nk] -> f[nk]",
    "grow_regions": "i[Nk] l[Nw] l[Nw]? b[N]? b[N] i[n] n I[N] I[N] -> ",
    "mark_boundary": "i[N] i[Nk] b[Nk]? i[n] n n -> b[n]",
    "crossing_edges": "i[N] i[Nk] b[Nk]? i[n] n n n -> i[nk] i[nk] i[nk] l[nk] l[1]",
    "line_cells": "f[N3] i[e] i[e] l[e] d[p3] d[p] x I[P] -> l[e] l[e] l[1]",
    "connected": "i[Nk] b[Nk]? b[nk] I[N] n n -> b[nk]",
    "find_links": "f[N3] f[N3] i[Nk] l[n] l[r] i[N]? x -> i[nr] i[nr] f[nr] f[nr] l[1]",
    "split_plates": "f[N3] l[n] l[n] f[M3] x x x -> b[n] b[M] d[n] d[M] d[M] l[M]",
    "free_gaps": "i[3C] n n n L[P] I[P] -> i[C] i[C]",
    "link_nodes": "i[L] i[L] b[L] I[N] B[N] B[N] -> ",
    "flatten_nodes": "I[N] B[N] B[N] -> ",
    "contact_differences": "f[N3] f[N3] l[N] l[n] i[nk] x x -> d[nk]",
    "aggregate_boundaries": "i[e] i[e] d[e]? d[e] L[r] L[r] -> l[e] i[e] i[e] d[e] d[e] l[1]",
    "merging_costs": "d[R] d[RF] d[Rc] d[Rc] i[E] i[E] d[E] d[E] x x -> d[E]",
    "cheapest_boundaries": "i[E] i[E] d[E] D[R] -> l[R]",
    "neighbor_quantiles": "f[Nc] i[nk] b[nk]? x n -> f[nc]",
    "fit_pixel_windows": "d[hw] b[hw] d[w] d[h] D[5hw] D[mpq] x x n n -> ",
    "fit_cell_windows": "d[mhw] D[5hw] D[mpq] x x n n -> ",
    "rate_windows": "D[9hw] d[pq] b[hw]? b[hw]? x x x x x x x x x n n n -> ",
    "offer_windows": "d[hw] b[hw] d[w] d[h] d[9pq] L[hw] B[hw] B[hw] n n n n -> ",
    "fit_narrow_windows": "d[hw] d[w] d[h] l[hw] l[n] x x D[52n] n n -> ",
    "choose_narrow": "d[hw] d[w] d[h] l[hw] l[n] d[92n] L[n] B[n] n n -> ",
    "describe_pixels": "d[hw] b[hw] d[w] d[h] d[w] d[h] l[hw] b[hw] d[N] d[M] l[n] D[hw3] D[hw] "
    "D[hw] B[hw] B[hw] B[hw] x x x x x x x x x n n -> ",
    "segment_rows": "l[n] n L[M] L[M] L[M] -> l[n]",
    "hull_candidates": "d[n] d[n] l[M] x -> b[n]",
    "segment_coordinates": "d[n] d[n] d[n] l[M] d[M3] d[MA3] -> d[An]",
    "segment_moments": "d[n] d[n] d[n] d[n] l[M] n -> d[M3] d[M33]",
    "reweigh_segments": "d[n] d[n] d[n] l[M] d[M3] d[M3] d[M] x x -> d[n] d[M] d[M]",
    "kth_values": "d[n] l[M] l[M] -> d[M] d[n]",
    "fit_pixel_regions": "d[hw] d[w] d[h] d[hw] l[n] l[M] n x x x -> d[4n] d[M3] d[M33] d[M3] d[M] "
    "d[M] d[M]",
    "connect_pixels": "b[hw] b[hw] b[hw] -> l[hw]",
    "assign_unlabeled_pixels": "d[hw] d[w] d[h] b[hw] L[hw] d[M3] d[M3] d[M] -> l[hw] l[hw] l[hw]",
    "move_to_creases": "d[hw] d[w] d[h] L[hw] d[M3] d[M2] d[M] n x -> l[hw] l[hw] l[hw]",
    "count_contacts": "l[hw] L[MM] -> ",
    "count_lines": "d[hw] d[w] d[h] b[hw] l[hw] d[M3] d[M3] d[M] l[p2] n x -> l[p] l[M] l[M]",
}
"""Arguments and results of each kernel.

One letter for the dtype (f float32, d float64, i int32, l int64, b bool; x is a float and n an
integer scalar), and one letter per axis; equal letters mean equal lengths. A question mark marks an
optional argument, a capital letter an argument that the kernel writes to. In C the lengths come
first, in the order of their letters.
"""
_DTYPES = {
    "f": torch.float32,
    "d": torch.float64,
    "i": torch.int32,
    "l": torch.int64,
    "b": torch.bool,
}
"""Dtypes by their letters in a signature."""
_NUMBERS: dict[str, Any] = {"n": (int, ctypes.c_int64), "x": (float, ctypes.c_double)}
"""Types of numbers in Python and C by their letters in a signature."""
_SERVED = torch.float32, torch.int32, torch.bool
"""Dtypes of the tensors that kernels process."""
_FIXED = {str(length): length for length in range(10)}
"""Lengths of axes that a signature fixes."""


def name_of_library() -> str | None:
    """Return the library in use, ``"base"`` or ``"avx2"``, or None without a library."""
    return None if _library() is None else _kind()


def serve(*tensors: Tensor | None, k: int = 1) -> bool:
    """Return whether kernels can process tensors with rows of ``k`` values.

    They must be concrete CPU tensors of 32-bit dtypes or bool that require no gradient.

    Example:
        >>> serve(torch.zeros(3, dtype=torch.float64))
        False
    """
    if _library() is None or not 0 < k <= MAX_NEIGHBORS:
        return False
    for tensor in tensors:
        if tensor is not None and (
            tensor.dtype not in _SERVED or not tensor.is_cpu or tensor.requires_grad
        ):
            return False
    return is_concrete(*tensors)


def call(name: str, *arguments: Tensor | float | None) -> tuple[Tensor, ...]:
    """Run a kernel and return its outputs in the order of its signature.

    Raises:
        ValueError: If the arguments do not match :data:`SIGNATURES`.
        IndexError: If a neighbor index is out of range.
    """
    (inputs, outputs), library = _signature(name), _library()
    if library is None or len(arguments) != len(inputs):
        raise ValueError(f"{name}: expected {len(inputs)} arguments and a library.")
    lengths, passed, copies = _FIXED.copy(), list[float | None](), list[Tensor]()
    for value, kind in zip(arguments, inputs, strict=True):
        if isinstance(value, Tensor) and kind.fits(value, lengths):
            if not value.is_contiguous():
                value = value.contiguous()
                copies.append(value)  # Stays referenced until the kernel has returned.
            passed.append(value.data_ptr())
        elif value is None and kind.is_optional:
            passed.append(None)
        elif kind.number and isinstance(value, (int, float)):
            passed.append(kind.number(value))
        else:
            got = tuple(value.shape) if isinstance(value, Tensor) else value
            raise ValueError(f"{name}: expected {kind.word}, got {got}, {lengths}.")
    # Separate lengths are parsed faster than a list.
    found = [kind.new_empty(*map(lengths.__getitem__, kind.axes)) for kind in outputs]
    passed += [tensor.data_ptr() for tensor in found]
    status = getattr(library, name)(*list(lengths.values())[len(_FIXED) :], *passed)
    if status == 1:
        raise IndexError(f"{name}: expected neighbor indices of existing rows, got others.")
    if status:
        raise ValueError(f"{name}: expected rows of 1 to {MAX_NEIGHBORS} values, got {lengths}.")
    return tuple(found)


class _Argument:
    """Argument in a signature: its axes, the dtype or the type of a number, and its role."""

    def __init__(self, word: str) -> None:
        self.word, self.axes = word, word[1:].strip("[]?")
        self.dtype = _DTYPES.get(word[0].lower())
        self.number, self.type = _NUMBERS.get(word[0], (None, ctypes.c_void_p))
        self.is_optional, self.is_written = word.endswith("?"), word[0].isupper()
        self.new_empty = torch.empty(0, dtype=self.dtype, device="cpu").new_empty

    def fits(self, tensor: Tensor, lengths: dict[str, int]) -> bool:
        """Return whether a tensor can be the argument; record the lengths of its axes."""
        shape = tensor.shape
        return (
            tensor.dtype is self.dtype
            and tensor.is_cpu
            and len(shape) == len(self.axes)
            and tuple(map(lengths.setdefault, self.axes, shape)) == shape
            and (not self.is_written or tensor.is_contiguous())
        )


@cache
def _signature(name: str) -> tuple[list[_Argument], list[_Argument]]:
    """Return the inputs and outputs of a kernel."""
    inputs, outputs = (side.split() for side in SIGNATURES[name].split("->"))
    return [_Argument(word) for word in inputs], [_Argument(word) for word in outputs]


def _types(name: str) -> list[Any]:
    """Return the types of the arguments of a kernel in C: the lengths of axes come first."""
    inputs, outputs = _signature(name)
    lengths = {axis for kind in inputs for axis in kind.axes if axis not in _FIXED}
    return [ctypes.c_int64] * len(lengths) + [kind.type for kind in inputs + outputs]


def _kind() -> str:
    """Return the name of the library for this processor, as torch detects it."""
    is_wide = torch.backends.cpu.get_cpu_capability().startswith("AVX")
    return "avx2" if is_wide else "base"


def _is_stale(library: Path) -> bool:
    """Return whether the sources, present in an editable install, are newer than the library."""
    sources = [*library.parent.glob("*.cpp"), *library.parent.glob("*.h")]
    built = library.stat().st_mtime if library.exists() else math.inf
    return any(source.stat().st_mtime > built for source in sources)


@lru_cache(maxsize=1)
def _library() -> ctypes.CDLL | None:
    """Load the library, or warn once if it is missing."""
    if os.environ.get("TORCHRG_NO_KERNELS", "0") not in ("", "0"):
        return None
    path = Path(__file__).parent / f"libkernels-{_kind()}.library"
    if _is_stale(path):
        warn(
            "torchrg runs without its kernels, which are older than their sources; run "
            "pip install -e . again."
        )
        return None
    if path.exists():
        try:
            library = ctypes.CDLL(str(path))
        except OSError as error:
            warn(f"torchrg cannot load its kernels: {error}")
            return None
        if all(hasattr(library, name) for name in SIGNATURES):
            for name in SIGNATURES:
                getattr(library, name).restype = ctypes.c_int64
                getattr(library, name).argtypes = _types(name)
            return library
        warn("torchrg runs without its kernels, which are of another version; install it again.")
        return None
    warn(
        "torchrg runs without its kernels, several times slower; install a C++ compiler and "
        "reinstall torchrg, or set TORCHRG_KERNELS (see the guide Install)."
    )
    return None
