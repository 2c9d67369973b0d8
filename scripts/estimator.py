"""Estimators of normals from outside of torchrg, for the benchmarks and the report."""

import importlib
import sys
from collections.abc import Callable
from pathlib import Path

from torch import Tensor

Estimator = Callable[[Tensor], tuple[Tensor, Tensor]]
"""Function from points, shape ``(N, 3)``, to unit normals of the same shape, of any sign, and
curvature, shape ``(N,)``, smallest in planes."""


def load_estimator(target: str) -> Estimator:
    """Return the function ``module:function``; modules of the working directory come first.

    Its results are checked at each call.

    Raises:
        SystemExit: If there is no such function.
    """
    module, _, name = target.partition(":")
    sys.path.insert(0, str(Path.cwd()))
    try:
        function: Estimator = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise SystemExit(
            f"--estimator: expected module:function, got {target}: {error}; run the command in the "
            "folder of the module."
        ) from None

    def estimate(points: Tensor) -> tuple[Tensor, Tensor]:
        normals, curvature = function(points)
        shapes = tuple(normals.shape), tuple(curvature.shape)
        if shapes != (tuple(points.shape), tuple(points.shape[:1])):
            raise SystemExit(
                f"--estimator: expected normals {tuple(points.shape)} and curvature "
                f"{tuple(points.shape[:1])} from {target}, got {shapes[0]} and {shapes[1]}."
            )
        return normals, curvature

    return estimate
