"""Normals and plane labels as modules."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import torch
from torch import nn

from torchrg._checks import as_tensor
from torchrg.config import DEFAULT_PRESET, GrowingConfig, NormalsConfig, PipelineConfig, load_config
from torchrg.errors import ConfigError
from torchrg.neighbors import finite_rows, restore_rows, search_knn
from torchrg.normals import estimate_normals
from torchrg.pipeline import segment_planes
from torchrg.regions import grow_regions
from torchrg.structures import UNLABELED

KEYS = {"coord": "coord", "normal": "normal", "curvature": "curvature", "plane": "plane"}
"""Names of the keys in a sample (Pointcept's, and ours)."""


class SampleTransform(nn.Module):
    """Base of the transforms: holds the names of the keys, never changes a sample.

    Args:
        keys: Other names for some of :data:`KEYS`, as in ``{"coord": "pos"}``.
    """

    def __init__(self, *, keys: Mapping[str, str] | None = None) -> None:
        super().__init__()
        unknown = set(keys or {}) - set(KEYS)
        if unknown:
            raise ConfigError(
                f"{type(self).__name__}: expected keys to rename {', '.join(KEYS)}, got "
                f"{', '.join(sorted(unknown))}."
            )
        self.keys = {**KEYS, **(keys or {})}

    def read(self, sample: Mapping[str, Any], name: str) -> torch.Tensor:
        """Return an entry of a sample as a tensor.

        Raises:
            ConfigError: If the sample lacks it.
        """
        key = self.keys[name]
        if key not in sample:
            raise ConfigError(
                f"{type(self).__name__}: expected a sample with {key!r}, got "
                f"{', '.join(map(str, sample))}; rename it with keys={{{name!r}: ...}}."
            )
        return as_tensor(type(self).__name__, key, sample[key])


class EstimateNormals(SampleTransform):
    """Add unit normals and curvature; see :func:`torchrg.estimate_normals`.

    Reads ``coord`` ``(N, 3)``; adds ``normal`` ``(N, 3)`` and ``curvature`` ``(N,)``.

    Args:
        config: Settings of the estimator. Default: :class:`torchrg.config.NormalsConfig`.
        keys: Other names for the keys.
        **changes: Single settings, as in ``method="pca", k=30``.

    Example:
        >>> floor = torch.cartesian_prod(torch.arange(8.0), torch.arange(8.0), torch.zeros(1))
        >>> EstimateNormals(method="pca", k=9)({"coord": floor})["normal"][0].abs()
        tensor([0., 0., 1.])
    """

    def __init__(
        self,
        config: NormalsConfig | None = None,
        *,
        keys: Mapping[str, str] | None = None,
        **changes: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(keys=keys)
        self.config = dataclasses.replace(config or NormalsConfig(), **changes)

    def forward(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        """Return a new sample with normals and curvature."""
        fit = estimate_normals(self.read(sample, "coord"), config=self.config)
        return {
            **sample,
            self.keys["normal"]: fit.normals,
            self.keys["curvature"]: fit.curvature,
        }

    def extra_repr(self) -> str:
        """Return the settings."""
        return repr(self.config)


class GrowRegions(SampleTransform):
    """Add plane labels grown on the normals that a sample has; see :func:`torchrg.grow_regions`.

    Reads ``coord``, ``normal`` ``(N, 3)`` and ``curvature`` ``(N,)``; adds ``plane`` ``(N,)``,
    int64, -1 for none. A point with a zero normal joins no region.

    Args:
        config: Settings of the growth. Default: :class:`torchrg.config.GrowingConfig`.
        k: Number of neighbours, the point itself included.
        keys: Other names for the keys.
        **changes: Single settings, as in ``max_angle_deg=7``.

    Example:
        >>> floor = torch.cartesian_prod(torch.arange(8.0), torch.arange(8.0), torch.zeros(1))
        >>> sample = EstimateNormals(method="pca", k=9)({"coord": floor})
        >>> GrowRegions(k=9, connectivity=None)(sample)["plane"].unique()
        tensor([0])
    """

    def __init__(
        self,
        config: GrowingConfig | None = None,
        *,
        k: int = NormalsConfig.k,
        keys: Mapping[str, str] | None = None,
        **changes: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(keys=keys)
        self.config = dataclasses.replace(config or GrowingConfig(), **changes)
        self.k = k

    def forward(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        """Return a new sample with plane labels."""
        points = self.read(sample, "coord")
        normals = self.read(sample, "normal").to(points.dtype)
        curvature = self.read(sample, "curvature").to(points.dtype)
        rows = finite_rows(points)
        cloud = points[rows]
        if len(cloud) == 0:
            labels = torch.full((len(points),), UNLABELED, device=points.device)
            return {**sample, self.keys["plane"]: labels}
        grown = grow_regions(
            cloud,
            normals[rows],
            curvature[rows],
            search_knn(cloud, min(self.k, len(cloud)), canonical=True),
            self.config,
            valid=(normals[rows] != 0).any(dim=-1),
            canonical=True,
        )
        labels = restore_rows(grown, rows, len(points), fill=UNLABELED)
        return {**sample, self.keys["plane"]: labels}

    def extra_repr(self) -> str:
        """Return the settings."""
        return f"k={self.k}, {self.config!r}"


class SegmentPlanes(SampleTransform):
    """Add plane labels, normals and curvature; see :func:`torchrg.segment_planes`.

    Reads ``coord`` ``(N, 3)``; adds ``plane`` ``(N,)``, int64, -1 for none, ``normal`` ``(N, 3)``
    and ``curvature`` ``(N,)``.

    Args:
        config: Settings, or the name of a preset.
        keys: Other names for the keys.

    Example:
        >>> floor = torch.cartesian_prod(torch.arange(8.0), torch.arange(8.0), torch.zeros(1))
        >>> SegmentPlanes("classic")({"coord": floor})["plane"].unique()
        tensor([0])
    """

    def __init__(
        self,
        config: PipelineConfig | str = DEFAULT_PRESET,
        *,
        keys: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(keys=keys)
        self.config = load_config(config) if isinstance(config, str) else config

    def forward(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        """Return a new sample with plane labels, normals and curvature."""
        seg = segment_planes(self.read(sample, "coord"), self.config)
        return {
            **sample,
            self.keys["plane"]: seg.labels,
            self.keys["normal"]: seg.normals,
            self.keys["curvature"]: seg.curvature,
        }

    def extra_repr(self) -> str:
        """Return the settings."""
        return repr(self.config)
