"""Custom operations for data-dependent functions under compilers, ``vmap`` and ``torch.func``.

These transforms trace functions without concrete values. A function that sorts with NumPy, or
iterates until convergence, is therefore an opaque operation to them, with a batching rule and a
gradient rule. On ordinary tensors it is called directly.
"""

import ast
import inspect
from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor
from functools import wraps
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrg._checks import (
    Arguments,
    Returned,
    is_concrete,
    is_jit_traced,
    is_tensor,
    raise_forward_mode,
)
from torchrg.errors import ConfigError


class _Function(NamedTuple):
    """A function of patches, its outputs without values, and the differentiable ones."""

    run: Callable[..., Any]
    outputs: Callable[[Tensor], Any]
    differentiable: Collection[int]


_FUNCTIONS: dict[str, _Function] = {}


def opaque(
    outputs: Callable[[Tensor], Any], *, differentiable: Collection[int] = (0,)
) -> Callable[[Callable[Arguments, Returned]], Callable[Arguments, Returned]]:
    """Return a decorator for a function of patches with shared leading axes.

    The first argument is a tensor, the only differentiable one; the others are tensors or literals.
    ``outputs`` makes tensors of the right shape and dtype from the first, as a tuple of the same
    kind as the result, or as one tensor; ``differentiable`` are the differentiable ones.
    """

    def decorate(function: Callable[Arguments, Returned]) -> Callable[Arguments, Returned]:
        name = function.__name__
        parameters = tuple(inspect.signature(function).parameters)
        kind: Any = inspect.signature(function).return_annotation
        make = kind if kind is not Tensor else (lambda outputs_of_call: outputs_of_call)
        _FUNCTIONS[name] = _Function(function, outputs, differentiable)

        @wraps(function)
        def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Returned:
            for key in kwargs:
                if key not in parameters:
                    from torchrg._synonyms import describe_keyword

                    raise TypeError(f"{name}() {describe_keyword(key, parameters)}")
            # Compilers of torch 2.5 support neither a zip of unequal lengths nor a union of dicts.
            arguments: dict[str, Any] = {parameters[i]: value for i, value in enumerate(args)}
            arguments = {**arguments, **kwargs}
            tensors = {key: arguments[key] for key in parameters if is_tensor(arguments.get(key))}
            if is_concrete(*tensors.values()):
                return function(*args, **kwargs)
            parts = [name, ",".join(tensors)]
            for key, value in arguments.items():
                if key not in tensors and value is not None:
                    _check_literal(name, key, value)
                    parts.append(f"{key}={value!r}")
            outputs_of_call = _apply("|".join(parts), list(tensors.values()))
            result: Returned = make(*outputs_of_call)
            return result

        return call

    return decorate


def _check_literal(name: str, key: str, value: object) -> None:
    """Raise if a setting cannot be an argument of an operation."""
    if not isinstance(value, bool | int | float | str):
        raise ConfigError(
            f"{name}: expected no {key} in a compiler or under vmap and torch.func, got "
            f"{type(value).__name__}; call it outside, or omit {key}."
        )


def _apply(call: str, tensors: list[Tensor]) -> list[Tensor]:
    """Run an opaque function, with gradients if the first tensor may need them."""
    is_traced = torch.compiler.is_compiling() or is_jit_traced()
    if is_traced and not tensors[0].requires_grad:
        outputs: list[Tensor] = _forward(tensors, call)
        return outputs
    return list(_operation().apply(call, *tensors))  # type: ignore[no-untyped-call]


def _parse(call: str, tensors: list[Tensor]) -> tuple[_Function, dict[str, Any]]:
    """Return the function of an encoded call, and its arguments by name."""
    name, keys, *settings = call.split("|")
    pairs = (setting.split("=", 1) for setting in settings)
    arguments = dict(zip(keys.split(","), tensors, strict=False))
    return _FUNCTIONS[name], arguments | {key: ast.literal_eval(text) for key, text in pairs}


def _as_list(outputs: Any) -> list[Tensor]:  # noqa: ANN401
    tensors = [outputs] if isinstance(outputs, Tensor) else outputs
    return [tensor for tensor in tensors if tensor is not None]


# Explicit schemas, because torch 2.5 infers none from list[Tensor].
@torch.library.custom_op(
    "torchrg::patchwise", mutates_args=(), schema="(Tensor[] tensors, str call) -> Tensor[]"
)
def _forward(tensors: list[Tensor], call: str) -> list[Tensor]:
    function, arguments = _parse(call, tensors)
    return _as_list(function.run(**arguments))


@torch.library.custom_op(
    "torchrg::patchwise_gradient", mutates_args=(), schema="(Tensor[] tensors, str call) -> Tensor"
)
def _backward(tensors: list[Tensor], call: str) -> Tensor:
    """Return the gradient of the first tensor; the output gradients follow the inputs."""
    function, arguments = _parse(call, tensors)
    gradients = tensors[call.split("|")[1].count(",") + 1 :]
    name = next(iter(arguments))

    def differentiate() -> Tensor:
        values = arguments[name].detach().clone().requires_grad_()
        outputs = _as_list(function.run(**{**arguments, name: values}))
        chosen = [outputs[index] for index in function.differentiable]
        # On a device, autograd would give the work to the thread of the device, which waits here.
        with torch.autograd.set_multithreading_enabled(False):
            (gradient,) = torch.autograd.grad(chosen, values, gradients)
        copied: Tensor = gradient.clone()
        return copied

    # Autograd is off within a custom operation, but not in another thread.
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(differentiate).result()


@_forward.register_fake
def _(tensors: list[Tensor], call: str) -> list[Tensor]:
    return _as_list(_FUNCTIONS[call.split("|")[0]].outputs(tensors[0]))


@_backward.register_fake
def _(tensors: list[Tensor], call: str) -> Tensor:
    return torch.empty_like(tensors[0])


def _with_batch_first(size: int, in_dims: list[int | None], tensors: list[Tensor]) -> list[Tensor]:
    """Move the batch axis of each tensor to the front."""
    return [
        tensor.expand(size, *tensor.shape) if dim is None else tensor.movedim(dim, 0)
        for tensor, dim in zip(tensors, in_dims, strict=True)
    ]


@_forward.register_vmap
def _(info: Any, in_dims: Any, tensors: list[Tensor], call: str) -> Any:  # noqa: ANN401
    outputs = _forward(_with_batch_first(info.batch_size, in_dims[0], tensors), call)
    return outputs, [0] * len(outputs)


@_backward.register_vmap
def _(info: Any, in_dims: Any, tensors: list[Tensor], call: str) -> Any:  # noqa: ANN401
    return _backward(_with_batch_first(info.batch_size, in_dims[0], tensors), call), 0


class _Differentiable(torch.autograd.Function):
    """An opaque function with its gradient, itself an opaque operation."""

    @staticmethod
    def forward(call: str, *tensors: Tensor) -> tuple[Tensor, ...]:
        return tuple(_forward(list(tensors), call))

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:  # noqa: ANN401
        ctx.call, *tensors = inputs
        ctx.save_for_backward(*tensors)
        indices = _FUNCTIONS[ctx.call.split("|")[0]].differentiable
        ctx.mark_non_differentiable(*(o for i, o in enumerate(output) if i not in indices))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:  # noqa: ANN401
        indices = _FUNCTIONS[ctx.call.split("|")[0]].differentiable
        tensors = [*ctx.saved_tensors, *(gradients[index].contiguous() for index in indices)]
        if torch.compiler.is_compiling():
            first = _backward(tensors, ctx.call)
        else:
            first = _Gradient.apply(ctx.call, *tensors)  # type: ignore[no-untyped-call]
        return None, first, *[None] * (len(ctx.saved_tensors) - 1)

    @staticmethod
    def vmap(info: Any, in_dims: Any, call: str, *tensors: Tensor) -> Any:  # noqa: ANN401
        first = _with_batch_first(info.batch_size, in_dims[1:], list(tensors))
        outputs = _operation().apply(call, *first)  # type: ignore[no-untyped-call]
        return outputs, (0,) * len(outputs)


class _ReverseOnly(_Differentiable):
    """The same outside of compilers, which reject operations with a rule for forward mode."""

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:  # noqa: ANN401
        raise_forward_mode(ctx.call.split("|")[0])


def _operation() -> type[_Differentiable]:
    return _Differentiable if torch.compiler.is_compiling() else _ReverseOnly


class _Gradient(torch.autograd.Function):
    """Gradient of an opaque function, without second derivatives."""

    @staticmethod
    def forward(call: str, *tensors: Tensor) -> Tensor:
        gradient: Tensor = _backward(list(tensors), call)
        return gradient

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:  # noqa: ANN401
        ctx.name = inputs[0].split("|")[0]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:  # noqa: ANN401
        raise NotImplementedError(f"{ctx.name}: has no second derivatives under torch.func.")

    jvp = backward

    @staticmethod
    def vmap(info: Any, in_dims: Any, call: str, *tensors: Tensor) -> Any:  # noqa: ANN401
        first = _with_batch_first(info.batch_size, in_dims[1:], list(tensors))
        return _Gradient.apply(call, *first), 0  # type: ignore[no-untyped-call]
