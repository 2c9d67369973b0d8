"""Kernels compiled by torch, ahead of time and once for all sizes, where that is asked for.

A kernel is a function of tensors to a tuple of tensors, made by :func:`kernel`. It runs as it is
written, or, within :func:`compiled`, as machine code that torch has made of it for this processor.
The code is kept in a folder and found by the digest of all that the kernel runs, constants
included. It is called without the interpreter's lock, works on one thread, and gives the same bits
for a row whatever rows there are beside it.
"""

import contextlib
import ctypes
import hashlib
import json
import multiprocessing
import os
import platform
import stat
import subprocess
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from functools import lru_cache, partial
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import torch
from torch import Tensor

from torchrg._parallel import CHILD_ENVIRONMENT, num_cores
from torchrg.version import __version__

Outputs = tuple[Tensor, ...]
Kind = str | float | None
"""Of an argument: the dtype of a tensor, or the value that is compiled in."""
Signature = tuple[Kind, ...]

ROWS = "n"
"""Letter of the axis of rows, of which there may be any number."""

_MOST_COMPILERS = 4
"""Kernels that are compiled at a time, at most, at half a gigabyte each."""

_EXAMPLE_LENGTH = 11
"""Length of the first axis that a kernel is traced with; the others are longer, all different."""

_LEAST_LENGTH = 3
"""Length of an axis other than that of rows, below which kernels run as they are written."""

_SETTINGS: dict[str, Any] = {"cpp.threads": 1, "assert_indirect_indexing": False}
"""Of torch's compiler: one thread inside, as ours are outside; and no check of every row number."""

_LONG = 300
"""Operations of a kernel, above which compiling takes half a minute as torch does it by default."""

_SETTINGS_OF_LONG: dict[str, Any] = {"realize_reads_threshold": 1}
"""What is used twice is a step of its own, not written out again in each formula with it: the same
results, compiled in a fifth of the time. Short kernels run up to a third faster without."""

_VARIABLES = {
    "TORCHINDUCTOR_COMPILE_THREADS": "1",
    "AOT_INDUCTOR_COMPILE_WRAPPER_OPT_LEVEL": "O0",
    "AOT_INDUCTOR_ENABLE_LINE_TABLES": "0",
}
"""Of the processes that compile: what calls a kernel need not be fast, and no debugger looks."""

_OURS = 0o755
"""Rights of the folder and its files: the user writes, whatever others may by default."""

_MAX_CALLS = 64
"""Threads that may be inside one kernel at a time; more wait."""

_DIGEST_BYTES = 32
"""Length of the digest behind the code in a file."""

is_active: ContextVar[bool] = ContextVar("is_active", default=False)
"""Whether kernels run compiled."""

_needed: ContextVar[dict[tuple["Kernel", Signature], None] | None] = ContextVar("needed")
"""The kernels of a rehearsal, in the order of their first calls; None where work is not one."""

_lock = threading.RLock()


class Kernel:
    """A function of tensors that is compiled where that is asked for; see :func:`kernel`."""

    def __init__(self, function: Callable[..., Outputs], axes: Sequence[str]) -> None:
        self.function = function
        self.axes = [tuple(letters.split()) for letters in axes]
        self._code: dict[Signature, Callable[[list[Tensor]], Outputs]] = {}
        self.__doc__, self.__wrapped__ = function.__doc__, function

    def __call__(self, *arguments: Any) -> Outputs:  # noqa: ANN401
        """Return what the function returns."""
        if torch.compiler.is_compiling() or not is_active.get():
            return self.function(*arguments)
        signature = tuple(map(_kind, arguments))
        needed = _needed.get(None)
        num_rows = self._num_rows(arguments)
        if needed is not None and num_rows:
            needed[self, signature] = None
        if needed is not None or num_rows == 0:
            token = is_active.set(False)  # kernels within kernels are a part of them
            try:
                return self.function(*arguments)
            finally:
                is_active.reset(token)
        run = self._code.get(signature) or self.load(signature)
        tensors = [value.contiguous() for value in arguments if isinstance(value, Tensor)]
        if num_rows > 1:
            return run(tensors)
        # The code is for two rows and more.
        axes = [a for a, value in zip(self.axes, arguments, strict=True) if _is_tensor(value)]
        twice = [
            torch.cat([tensor] * 2, dim=own.index(ROWS)) if ROWS in own else tensor
            for tensor, own in zip(tensors, axes, strict=True)
        ]
        is_last = any(own[-1] == ROWS for own in axes if len(own) > 1)
        return tuple(found[..., :1] if is_last else found[:1] for found in run(twice))

    def _num_rows(self, arguments: Sequence[object]) -> int:
        """Return the number of rows, 0 where the code is not for tensors like these."""
        num_rows = 0
        if len(arguments) != len(self.axes):
            return 0
        for axes, value in zip(self.axes, arguments, strict=True):
            if not isinstance(value, Tensor):
                continue
            if value.device.type != "cpu" or value.requires_grad or value.dim() != len(axes):
                return 0
            for letter, length in zip(axes, value.shape, strict=True):
                if letter == ROWS:
                    num_rows = length
                    continue
                least = _length(letter, _LEAST_LENGTH)
                if length < least or (length > least and not _letter(letter)):
                    return 0
        return num_rows

    def load(self, signature: Signature) -> Callable[[list[Tensor]], Outputs]:
        """Return the code, or the function itself where there is none."""
        with _lock:
            if signature not in self._code:
                path, code = self.path(signature), None
                if compile_kernels([(self, signature)]) and path is not None:
                    try:
                        code = _open(path)
                    except (OSError, AttributeError, RuntimeError) as error:
                        _give_up(str(error))
                self._code[signature] = code or partial(self._run_eagerly, signature)
            return self._code[signature]

    def _run_eagerly(self, signature: Signature, tensors: Sequence[Tensor]) -> Outputs:
        left = iter(tensors)
        return self.function(*(next(left) if isinstance(kind, str) else kind for kind in signature))

    def path(self, signature: Signature) -> Path | None:
        """Return where the code for such arguments is kept; None without a folder."""
        folder = cache_folder()
        code = _digest(self.function)
        key = [_machine(), self.axes, signature, _SETTINGS, _LONG, _SETTINGS_OF_LONG, code]
        name = f"{self.function.__name__}-{hashlib.sha256(repr(key).encode()).hexdigest()[:24]}"
        return None if folder is None else folder / name

    def export(self, signature: Signature) -> Any:  # noqa: ANN401
        """Return torch's program of the function for tensors of all sizes."""
        lengths: dict[str, int] = {}
        tensors, sizes = [], []
        for kind, axes in zip(signature, self.axes, strict=True):
            if isinstance(kind, str):
                for axis in axes:
                    lengths.setdefault(_letter(axis), _EXAMPLE_LENGTH + 2 * len(lengths))
                shape = [_length(axis, lengths[_letter(axis)]) for axis in axes]
                tensors.append(torch.zeros(shape, dtype=getattr(torch, kind)))
                sizes.append(axes)
        least = {letter: 2 if letter == ROWS else _LEAST_LENGTH for letter in lengths if letter}
        dims = {letter: torch.export.Dim(letter, min=least[letter]) for letter in least}
        shapes = tuple(
            {
                place: _length(axis, dims[_letter(axis)])
                for place, axis in enumerate(axes)
                if _letter(axis)
            }
            for axes in sizes
        )
        run = partial(self._run_eagerly, signature)

        class Program(torch.nn.Module):
            def forward(self, *tensors: Tensor) -> Outputs:
                return run(tensors)

        return torch.export.export(Program(), tuple(tensors), dynamic_shapes=(shapes,))


def kernel(*axes: str) -> Callable[[Callable[..., Outputs]], Kernel]:
    """Make a function of tensors, at the top of a module, one that can be compiled.

    It must not branch on data, write to its arguments or return one of them as it is; operations in
    place on its own tensors do no harm. Numbers among the arguments are compiled in.

    Args:
        axes: For each argument the letters of its axes, equal letters for equal lengths, ``n`` for
            rows, which are the first or the last axis, also of what is returned; any other for a
            length of three and more; a number for an axis of that length, and such as ``3L+1`` for
            one that follows from another.

    Example:
        >>> @kernel("n K", "n")
        ... def scaled(values, factors):
        ...     return (values * factors[:, None],)
        >>> scaled(torch.ones(2, 3), torch.tensor([1.0, 2.0]))[0].sum()
        tensor(9.)
    """
    return lambda function: Kernel(function, axes)


@contextlib.contextmanager
def compiled(active: bool = True) -> Iterator[None]:
    """Let kernels run compiled, or leave all as it is.

    Example:
        >>> with compiled(False):
        ...     pass
    """
    token = is_active.set(active or is_active.get())
    try:
        yield
    finally:
        is_active.reset(token)


def prepare(
    work: str, rehearse: Callable[[], object], announce: Callable[[str], None] = lambda text: None
) -> bool:
    """Compile all kernels that some work needs, and tell whether that can be done.

    Args:
        work: What tells this work from other work: it is rehearsed once in a process.
        rehearse: Does the work on little data.
        announce: Called with a line of text where kernels have to be compiled first.

    Returns:
        False, after a warning that says why, if there is no compiler, no place for the code that
        nobody else can write to, or the system does not load it.
    """
    with _lock:
        if work not in _prepared:
            found: dict[tuple[Kernel, Signature], None] = {}
            token = _needed.set(found)
            try:
                with compiled():
                    rehearse()
            finally:
                _needed.reset(token)
            _prepared[work] = compile_kernels(list(found), announce) and not any(
                isinstance(one.load(signature), partial) for one, signature in found
            )
        return _prepared[work]


_prepared: dict[str, bool] = {}


def compile_kernels(
    wanted: Sequence[tuple[Kernel, Signature]],
    announce: Callable[[str], None] = lambda text: None,
) -> bool:
    """Compile those kernels that are not there yet; False, after a warning, if that fails."""
    paths = [one.path(signature) for one, signature in wanted]
    folder = cache_folder()
    if folder is not None and not _is_safe(folder):
        return _give_up(f"others can write to {folder}, set TORCHRG_CACHE_DIR to a folder of yours")
    missing = [path for path in paths if path is not None and not _is_whole(path)]
    if folder is not None and not missing:
        return True
    if folder is None or not os.access(folder, os.W_OK):
        return _give_up("no folder for them can be written, set TORCHRG_CACHE_DIR to one")
    announce(f"compiling kernels, {len(missing)} in all, which the next run will find done")
    try:
        return _compile_in(folder, wanted, paths)
    except OSError as error:
        return _give_up(f"{error.filename or folder}: {error.strerror or error}")


def _compile_in(
    folder: Path, wanted: Sequence[tuple[Kernel, Signature]], paths: Sequence[Path | None]
) -> bool:
    """Compile kernels to those paths in a folder that are not there when no other process does."""
    import filelock  # torch needs it too

    with filelock.FileLock(folder / "lock"):
        jobs = [
            (one.function.__module__, one.function.__name__, signature, str(path))
            for path, (one, signature) in zip(paths, wanted, strict=True)
            if path is not None and not _is_whole(path)
        ]
        if not jobs:
            return True
        with tempfile.TemporaryDirectory(prefix="torchrg-") as place:
            folders = {"TMPDIR": place, "TORCHINDUCTOR_CACHE_DIR": place}
            modules = sorted({"torch._inductor.compile_fx", *(module for module, *_ in jobs)})
            script = f"import {', '.join(modules)}; from torchrg import _compile; _compile.serve()"
            done = subprocess.run(  # noqa: S603
                [sys.executable, "-c", script],
                input=json.dumps(jobs),
                capture_output=True,
                text=True,
                check=False,
                env=os.environ | CHILD_ENVIRONMENT | _VARIABLES | folders,
            )
    if done.returncode:
        return _give_up((done.stderr.strip().splitlines() or ["the compiler failed"])[-1])
    return True


def _give_up(reason: str) -> bool:
    warnings.warn(f"kernels are not compiled, all runs as without: {reason}.", stacklevel=4)
    return False


def serve() -> None:
    """Compile the kernels that the standard input names, in several processes."""
    jobs = json.load(sys.stdin)
    if "fork" in multiprocessing.get_all_start_methods():
        # What has been imported is there in each of them.
        processes = min(_MOST_COMPILERS, num_cores(), len(jobs))
        with multiprocessing.get_context("fork").Pool(processes) as pool:
            errors = pool.map(_build, jobs, chunksize=1)
    else:
        errors = list(map(_build, jobs))
    if any(errors):
        sys.exit(max(errors))


def _build(job: tuple[str, str, Sequence[Kind], str]) -> str:
    """Compile a kernel to its file; return why that failed, or nothing."""
    module, name, signature, target = job
    one: Kernel = getattr(sys.modules[module], name)
    try:
        program = one.export(tuple(signature))
        model, inputs = program.module(), program.example_inputs[0]
        is_long = len(program.graph.nodes) > _LONG
        options = _SETTINGS | _SETTINGS_OF_LONG if is_long else _SETTINGS
        made = torch._inductor.aot_compile(model, inputs, options=options)  # noqa: SLF001
    except Exception as error:  # noqa: BLE001
        return f"{name}: {type(error).__name__}: {str(error).strip().splitlines()[0]}"
    code = Path(str(made)).read_bytes()
    part = Path(f"{target}.{os.getpid()}")
    part.write_bytes(code + hashlib.sha256(code).digest())
    part.chmod(_OURS)
    part.replace(target)
    return ""


def _is_whole(path: Path) -> bool:
    """Tell whether a file of code is there, as it was written, and nobody else can change it."""
    try:
        content = path.read_bytes() if _is_safe(path) else b""
    except OSError:
        return False
    code = content[:-_DIGEST_BYTES]
    return hashlib.sha256(code).digest() == content[-_DIGEST_BYTES:]


def _is_safe(path: Path) -> bool:
    """Tell whether only this user and the system's can write to a file or folder."""
    status = path.stat()
    return status.st_uid in (os.geteuid(), 0) and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _open(path: Path) -> Callable[[list[Tensor]], Outputs]:
    """Return the code of a kernel as a function of its tensors.

    It is called through the C interface of torch's compiled models, and not by torch's own loader,
    which keeps the interpreter's lock.
    """
    library = ctypes.CDLL(str(path))
    model, count = ctypes.c_void_p(), ctypes.c_size_t()
    check = partial(_check, path.name)
    models = ctypes.c_size_t(_MAX_CALLS)
    create = library.AOTInductorModelContainerCreateWithDevice
    check(create(ctypes.byref(model), models, b"cpu", None))
    check(library.AOTInductorModelContainerGetNumOutputs(model, ctypes.byref(count)))
    num_outputs, execute = count.value, library.AOTInductorModelContainerRun
    to_handles = torch._C._aoti.unsafe_alloc_void_ptrs_from_tensors  # noqa: SLF001
    to_tensors = torch._C._aoti.alloc_tensors_by_stealing_from_void_ptrs  # noqa: SLF001
    address, capsule = _capsules()

    def run(tensors: list[Tensor]) -> Outputs:
        handles = (ctypes.c_void_p * len(tensors))(
            *(address(handle, None) for handle in to_handles(tensors))
        )
        found = (ctypes.c_void_p * num_outputs)()
        inputs, outputs = ctypes.c_size_t(len(tensors)), ctypes.c_size_t(num_outputs)
        check(execute(model, handles, inputs, found, outputs, None, None))
        return tuple(to_tensors([capsule(handle, None, None) for handle in found]))

    return run


def _check(name: str, status: int) -> None:
    if status:
        raise RuntimeError(f"{name}: the compiled kernel failed; see the message above.")


@lru_cache(maxsize=1)
def _capsules() -> tuple[Any, Any]:
    """Return what takes an address out of the interpreter's wrapper, and puts one in."""
    address, capsule = ctypes.pythonapi.PyCapsule_GetPointer, ctypes.pythonapi.PyCapsule_New
    address.restype, address.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    capsule.restype = ctypes.py_object
    capsule.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    return address, capsule


def cache_folder() -> Path | None:
    """Return the folder of compiled kernels; None if there is none and none can be made.

    It is ``$TORCHRG_CACHE_DIR``, by default ``torchrg`` in the user's folder for such files.
    Machines of one kind may share it. One that other users own or can write to is not used, as
    its code would run as this user's.
    """
    given = os.environ.get("TORCHRG_CACHE_DIR")
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    folder = Path(given) if given else home / "torchrg"
    try:
        folder.mkdir(_OURS, parents=True, exist_ok=True)
    except OSError:
        return folder if folder.is_dir() else None
    return folder


@lru_cache(maxsize=1)
def _machine() -> str:
    """Return what code depends on beside the kernel: versions and the processor."""
    listing = Path("/proc/cpuinfo")
    text = listing.read_text(encoding="utf-8") if listing.exists() else platform.processor()
    kept = ("vendor_id", "cpu family", "model", "flags", "Features", "CPU part")
    lines = {line for line in text.splitlines() if line.startswith(kept)} or {text}
    return repr((__version__, torch.__version__, sys.platform, platform.machine(), sorted(lines)))


def _kind(value: object) -> Kind:
    """Return what code depends on of an argument."""
    if isinstance(value, Tensor):
        return str(value.dtype).removeprefix("torch.")
    assert value is None or isinstance(value, int | float)  # noqa: S101
    return value


def _letter(axis: str) -> str:
    """Return the letter of an axis, nothing for one of a fixed length."""
    return "".join(filter(str.isalpha, axis))


def _length(axis: str, of_letter: Any) -> Any:  # noqa: ANN401 - a number, or torch's symbol for one
    """Return the length of an axis, such as ``n``, ``3`` or ``3L+1``, from that of its letter."""
    letter = _letter(axis)
    if not letter:
        return int(axis)
    factor, offset = axis.split(letter)
    length = int(factor) * of_letter if factor else of_letter
    return length + int(offset) if offset else length


def _is_tensor(value: object) -> bool:
    return isinstance(value, Tensor)


def _digest(function: Callable[..., object]) -> str:
    """Return the digest of what a function runs: its code, what that calls, and all constants."""
    done: set[object] = set()
    parts: list[str] = []

    def add(value: object, names: set[str]) -> None:
        if isinstance(value, Kernel):
            value = value.function
        if isinstance(value, ModuleType) and value.__name__.startswith("torchrg"):
            for name in sorted(names & vars(value).keys()):
                parts.append(name)
                add(getattr(value, name), names)
        elif isinstance(value, FunctionType) and value not in done:
            if value.__module__.startswith("torchrg"):
                done.add(value)
                add_code(value.__code__, value.__globals__)
        elif isinstance(value, int | float | str | tuple):
            parts.append(repr(value))

    def add_code(code: CodeType, scope: dict[str, Any]) -> None:
        parts.append(repr((code.co_code, code.co_names, code.co_varnames)))
        for constant in code.co_consts:
            if isinstance(constant, CodeType):
                add_code(constant, scope)
            else:
                parts.append(repr(constant))
        for name in code.co_names:
            if name in scope:
                add(scope[name], set(code.co_names))

    add(function, set())
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()
