"""Estimators of normals from outside of torchrg, for the benchmarks and the report."""

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

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
    if not name:
        raise SystemExit(
            f"--estimator: expected module:function, got {target}; add the function, as in "
            f"{target.removesuffix(':')}:estimate."
        )
    sys.path.insert(0, str(Path.cwd()))
    try:
        function: Estimator = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise SystemExit(
            f"--estimator: expected module:function, got {target}: {error}; run the command in the "
            "folder of the module."
        ) from None

    def estimate(points: Tensor) -> tuple[Tensor, Tensor]:
        results: Any = function(points)
        values = results if isinstance(results, tuple | list) else [results]
        expected = [tuple(points.shape), tuple(points.shape[:1])]
        got = [tuple(v.shape) if isinstance(v, Tensor) else type(v).__name__ for v in values]
        if got != expected:
            raise SystemExit(
                f"--estimator: expected normals {expected[0]} and curvature {expected[1]} from "
                f"{target}, got {' and '.join(map(str, got))}; return both, as tensors."
            )
        return values[0], values[1]

    return estimate
