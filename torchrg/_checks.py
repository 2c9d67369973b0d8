"""Argument checks that never read tensor values, and so need no device synchronization."""

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import wraps
from numbers import Real
from typing import Any, NoReturn, ParamSpec, TypeGuard, TypeVar, get_args

import numpy as np
import torch
from torch import Tensor

from torchrg._parallel import sequential_operations
from torchrg.errors import ConfigError, ShapeError, shown
from torchrg.structures import AnyCloud, Cloud
from torchrg.structures.points import Points

Arguments = ParamSpec("Arguments")
Returned = TypeVar("Returned")
_POINTS = ("points", "vertices", "cloud")
"""Arguments that take a cloud or the path of a file, too; its points are relative to its origin."""


def as_tensor(caller: str, name: str, values: Any) -> Tensor:  # noqa: ANN401
    """Return a tensor unchanged, and a NumPy array as a tensor that shares its memory.

    Points can also be a cloud or the path of a file, in every function that takes them. Big-endian
    and read-only arrays are copied. In all checks, ``caller`` is the public function that starts
    the message. Invalid tensors raise ShapeError, invalid settings ConfigError.
    """
    if name in _POINTS and isinstance(values := as_cloud(values), Cloud):
        return values.points
    if isinstance(values, Tensor):
        return values
    if isinstance(values, np.ndarray) and values.dtype.kind in "fiub":
        native = values.astype(values.dtype.newbyteorder("="), copy=False)
        return torch.from_numpy(np.require(native, requirements=["C", "W"]))
    expected = "a tensor or a NumPy array" + (", a Cloud or a path" if name in _POINTS else "")
    kind = f"array of {values.dtype}" if isinstance(values, np.ndarray) else type(values).__name__
    from torchrg._synonyms import repair_of

    kind += repair_of(caller, name, values)
    raise ShapeError(f"{caller}: expected {name} to be {expected}, got {kind}.")


def as_cloud(points: AnyCloud) -> Points | Cloud:
    """Return the cloud of a path; return anything else unchanged."""
    if not isinstance(points, str | os.PathLike):
        return points
    from torchrg.io import read_cloud

    return read_cloud(points)


def to_cloud(caller: str, cloud: AnyCloud) -> Cloud:
    """Return a cloud of points or of the file of a path, and a cloud unchanged."""
    if isinstance(opened := as_cloud(cloud), Cloud):
        return opened
    points = as_tensor(caller, "cloud", opened)
    check_shapes(caller, cloud=(points, "N 3"))
    return Cloud(points.numpy(force=True))


def check_choices(caller: str, **arguments: tuple[str, Any]) -> None:
    """Check that settings are among the choices of types, as in ``x=(x, Literal["a", "b"])``."""
    for name, (value, kind) in arguments.items():
        if getattr(value, "ndim", 0) or value not in get_args(kind):
            choices = f"{', '.join(get_args(kind))}, got {shown(value)}"
            raise ConfigError(f"{caller}: expected {name} to be one of {choices}.")


def check_kinds(caller: str, repair: str, **arguments: tuple[object, Any]) -> None:
    """Check that arguments other than tensors are of a class; None is skipped."""
    for name, (value, kind) in arguments.items():
        if value is not None and not isinstance(value, kind):
            raise ConfigError(
                f"{caller}: expected {name} to be {getattr(kind, '__name__', 'a path')}, got "
                f"{type(value).__name__}; "
                f"{repair}."
            )


def is_positive(value: object) -> bool:
    """Return whether a setting is a positive, finite number."""
    return isinstance(value, Real) and 0 < float(value) < float("inf")


def check_floating(caller: str, **arguments: Tensor | None) -> None:
    """Check that tensors are float32 or float64, and of one dtype; None is skipped."""
    tensors = {name: tensor for name, tensor in arguments.items() if tensor is not None}
    for name, tensor in tensors.items():
        if tensor.dtype not in (torch.float32, torch.float64):
            dtype = str(tensor.dtype).removeprefix("torch.")
            fix = "" if tensor.is_complex() else f"; pass {name}.float()"
            raise ShapeError(f"{caller}: expected {name} of float32 or float64, got {dtype}{fix}.")
        if tensor.is_nested:
            raise ShapeError(
                f"{caller}: expected dense {name}, got a nested tensor; pass "
                f"torch.nested.to_padded_tensor({name}, 0.0), and a mask of the valid entries."
            )
        if tensor.layout is not torch.strided:
            raise ShapeError(
                f"{caller}: expected dense {name}, got a sparse tensor; pass {name}.to_dense()."
            )
    kinds = [str(tensor.dtype).removeprefix("torch.") for tensor in tensors.values()]
    if len(set(kinds)) > 1:
        names = " and ".join(tensors)
        raise ShapeError(f"{caller}: expected {names} of one dtype, got {' and '.join(kinds)}.")


def check_points(caller: str, points: Tensor, name: str = "points") -> None:
    """Check that points are one cloud; suggest a fix for batches, images and extra columns."""
    loop = f"[{caller}(p) for p in {name}]" if caller.isidentifier() else f"{name}[i]"
    check_batch(caller, name, points, f"pass one cloud at a time, as {loop}")
    if points.ndim == 2 and points.shape[1] > 3:
        repair = f"{name}.T" if len(points) == 3 else f"{name}[:, :3]"
        raise ShapeError(
            f"{caller}: expected {name} of shape (N, 3), got {tuple(points.shape)}; pass {repair}."
        )
    check_shapes(caller, **{name: (points, "N 3")})
    check_floating(caller, **{name: points})


def check_batch(caller: str, name: str, points: Tensor, repair: str) -> None:
    """Refuse a batch of clouds ``(B, N, 3)``: its neighborhoods would cross between clouds."""
    if points.ndim == 3 and points.shape[2] == 3:
        raise ShapeError(
            f"{caller}: expected {name} of shape (N, 3), got {tuple(points.shape)}; {repair}, or "
            "the depth of an image to torchrg.transforms.SegmentDepth."
        )


def check_shapes(caller: str, **arguments: tuple[Tensor | None, str]) -> None:
    """Check that tensors are on one device, and their axes against patterns with shared letters.

    Arguments are a tensor and its pattern, as in ``x=(x, "* N 3")``. A letter stands for a length
    that is equal in all patterns, a number for a fixed length, and a leading ``*`` for any leading
    axes, equal in all patterns. None is skipped. A ``mask`` must be bool, too.
    """
    bound: dict[str, tuple[int, ...]] = {}
    first: tuple[str, Tensor] | None = None
    for name, (tensor, pattern) in arguments.items():
        if tensor is None:
            continue
        if name == "mask" and not (is_tensor(tensor) and tensor.dtype == torch.bool):
            kind = str(tensor.dtype) if is_tensor(tensor) else type(tensor).__name__
            raise ShapeError(
                f"{caller}: expected mask to be a tensor of bool, got "
                f"{kind.removeprefix('torch.')}; pass torch.as_tensor(mask).bool()."
            )
        shape, sizes = tuple(tensor.shape), dict(bound)
        if not _bind(shape, pattern.split(), bound):
            fixed = ", ".join(f"{k}={v if k == '*' else v[0]}" for k, v in sizes.items())
            expected = f"({', '.join(pattern.split())})" + (f" with {fixed}" if fixed else "")
            from torchrg._synonyms import repair_shape

            fix = repair_shape(name, shape, pattern.split())
            raise ShapeError(f"{caller}: expected {name} of shape {expected}, got {shape}{fix}.")
        first = first or (name, tensor)
        if tensor.device != first[1].device:
            raise ShapeError(
                f"{caller}: expected {first[0]} and {name} on one device, got {first[1].device} "
                f"and {tensor.device}; move one of them with .to(device)."
            )


def _bind(shape: tuple[int, ...], axes: list[str], bound: dict[str, tuple[int, ...]]) -> bool:
    """Match a shape against axes, and add new lengths to ``bound``."""
    fixed = axes[1:] if axes[0] == "*" else axes
    split = len(shape) - len(fixed)
    if split < 0 or (split > 0 and axes[0] != "*"):
        return False
    lengths = [(axis, (length,)) for axis, length in zip(fixed, shape[split:], strict=True)]
    leading = [("*", shape[:split])] if axes[0] == "*" else []
    return all(
        length == ((int(axis),) if axis.isdigit() else bound.setdefault(axis, length))
        for axis, length in [*leading, *lengths]
    )


def is_tensor(value: object) -> TypeGuard[Tensor]:
    """Return whether a value is a tensor."""
    return isinstance(value, Tensor)


def is_jit_traced() -> bool:
    """Return whether :func:`torch.jit.trace` records operations."""
    traced: bool = torch.jit.is_tracing()  # type: ignore[attr-defined, no-untyped-call]
    return traced


def is_concrete(*tensors: Tensor | None) -> bool:
    """Return whether tensors have concrete data: not traced, vmapped or on the meta device."""
    if torch.compiler.is_compiling() or is_jit_traced():
        return False
    try:
        strided = [t for t in tensors if t is not None and t.layout is torch.strided]
        return all(tensor.data_ptr() >= 0 and not tensor.is_meta for tensor in strided)
    except RuntimeError:  # A tensor wrapper without storage.
        return False


def raise_forward_mode(caller: str) -> NoReturn:
    """Raise for ``jvp``, ``jacfwd`` and ``hessian`` of torch.func."""
    raise NotImplementedError(
        f"{caller}: supports reverse mode only; use jacrev, vjp or grad of torch.func."
    )


def _plain(value: object) -> object:
    """Convert tensor subclasses to plain tensors, so that results are plain too."""
    return value.as_subclass(Tensor) if is_tensor(value) and type(value) is not Tensor else value


@contextmanager
def default_device_cpu() -> Iterator[None]:
    """Create tensors on the CPU, ignoring ``torch.set_default_device``."""
    if torch.empty(0).device.type == "cpu":
        yield
        return
    with torch.device("cpu"):
        yield


def eager_only(function: Callable[Arguments, Returned]) -> Callable[Arguments, Returned]:
    """Exclude a function of clouds from compilation, and reject tensors without data.

    A compiler breaks its graph there and compiles the remaining model. Tensors are created on the
    CPU, as by :func:`default_device_cpu`, tensor subclasses become plain tensors, and each
    operation runs on one thread; see :func:`torchrg._parallel.sequential_operations`.
    """

    @wraps(function)
    def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Returned:
        if torch.compiler.is_compiling():
            uncompiled = torch.compiler.disable(function)  # type: ignore[no-untyped-call]
            result: Returned = uncompiled(*args, **kwargs)
            return result
        if not is_concrete(*(value for value in (*args, *kwargs.values()) if is_tensor(value))):
            raise ShapeError(
                f"{function.__name__}: expected points with values, got a tensor of vmap, "
                "torch.func or the meta device; call it outside of them."
            )
        with default_device_cpu(), sequential_operations():
            plain: Callable[..., Returned] = function
            return plain(*map(_plain, args), **{name: _plain(kwargs[name]) for name in kwargs})

    return call


def disable_autocast(function: Callable[Arguments, Returned]) -> Callable[Arguments, Returned]:
    """Disable ``torch.autocast`` in a function that multiplies matrices."""

    @wraps(function)
    def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Returned:
        kinds = {value.device.type for value in (*args, *kwargs.values()) if is_tensor(value)}
        with ExitStack() as stack:
            for kind in kinds:
                if torch.amp.is_autocast_available(kind) and torch.is_autocast_enabled(kind):
                    stack.enter_context(torch.autocast(kind, enabled=False))
            return function(*args, **kwargs)

    return call
