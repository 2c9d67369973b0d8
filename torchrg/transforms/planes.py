"""Transforms that add normals, plane labels and superpoints.

``config`` is a configuration object, a dictionary, a complete configuration, or the name of a
preset. Default: see :func:`torchrg.load_config`. ``changes`` override single parameters, as in
``k=30``; a dictionary overrides those in a section, as in ``{"normals.k": 30}``. Points with equal
coordinates are treated as one and get the same result, as in :func:`torchrg.segment_planes`.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchrg._checks import check_choices
from torchrg._parallel import CHUNK_SIZE
from torchrg.config import (
    AnyConfig,
    GrowingConfig,
    NormalsConfig,
    PipelineConfig,
    SuperpointsConfig,
    settings_of,
)
from torchrg.errors import ConfigError
from torchrg.neighbors import distinct_points
from torchrg.normals import estimate_normals, orient_normals
from torchrg.normals.orient import Orientation
from torchrg.pipeline import segment_planes
from torchrg.regions import align_axes, grow_regions, partition_points
from torchrg.regions.growth import rank_by_count
from torchrg.structures import UNLABELED
from torchrg.structures.colors import find_white
from torchrg.transforms.rows import Sample, cloud_rows
from torchrg.transforms.sample import CloudTransform, NeighborSearch, SampleTransform


class OrientedTransform(CloudTransform):
    """Base class of transforms that orient normals.

    Reads ``coord`` and, if present, ``front``, both ``(N, 3)``: the direction from each point to
    the sensor. ``orient="viewpoint"`` reads ``viewpoint`` unless it is passed here: the scanner
    position, of shape ``(3,)``, ``(B, 3)`` for the clouds of a batch, or ``(N, 3)``.

    Args:
        orient: Orientation of normals; see :func:`torchrg.normals.orient_normals`. Default:
            towards ``front`` if the sample has it, else into the free space of rooms.
        viewpoint: Scanner position of all samples. Default: read from the sample.

    Raises:
        ConfigError: If ``orient`` is unknown, or does not match ``viewpoint``.
    """

    optional_reads: tuple[str, ...] = ("front",)

    def __init__(
        self,
        orient: Orientation = "auto",
        viewpoint: Sequence[float] | None = None,
        *,
        keep_neighbors: bool = False,
        keys: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(keep_neighbors=keep_neighbors, keys=keys)
        caller = type(self).__name__
        check_choices(caller, orient=(orient, Orientation))
        if viewpoint is not None and (orient != "viewpoint" or len(viewpoint) != 3):
            raise ConfigError(
                f"{caller}: viewpoint must be three numbers and needs orient='viewpoint', got "
                f"{viewpoint!r} with {orient!r}."
            )
        self.orient: Orientation = orient
        self.viewpoint = None if viewpoint is None else tuple(map(float, viewpoint))
        if orient == "viewpoint":
            self.optional_reads = ()
            if viewpoint is None:
                self.reads = (*self.reads, "viewpoint")

    def read(self, sample: Sample, name: str) -> Tensor:
        """Return an entry of a sample; a viewpoint is expanded to one row per point."""
        values = super().read(sample, name)
        if name != "viewpoint":
            return values
        parts = cloud_rows(sample, len(super().read(sample, "coord")))
        positions = values[None] if values.ndim == 1 else values
        if len(positions) not in (1, len(parts)):
            return positions
        per_cloud = positions.expand(len(parts), -1)
        counts = [rows.stop - rows.start for rows in parts]
        return per_cloud.repeat_interleave(torch.tensor(counts, device=positions.device), dim=0)

    def side(self, cloud: Mapping[str, Tensor]) -> dict[str, Any]:
        """Return the keyword arguments for orienting the normals of a cloud."""
        viewpoint = self.viewpoint if self.viewpoint is not None else cloud.get("viewpoint")
        return {"orient": self.orient, "viewpoint": viewpoint, "front": cloud.get("front")}


class EstimateNormals(OrientedTransform):
    """Add unit normals and curvature; see :func:`torchrg.estimate_normals`.

    Reads the entries of :class:`OrientedTransform`; adds ``normal`` ``(N, 3)``, ``curvature`` and
    ``residual`` ``(N,)``.

    Args:
        config: Configuration of the estimator.
        residual: Whether to add ``residual`` ``(N,)``, the RMS distance of the neighbors to the
            plane, which ``GrowRegions`` reads if ``plane_reach`` is set.
        chunk_size: Points processed at a time; bounds the memory, does not change results.
        **changes: Single parameters, as in ``method="pca", k=30``.

    Example:
        >>> floor = torch.cartesian_prod(torch.arange(8.0), torch.arange(8.0), torch.zeros(1))
        >>> EstimateNormals(method="pca", k=9)({"coord": floor})["normal"][0].abs()
        tensor([0., 0., 1.])
    """

    def __init__(
        self,
        config: NormalsConfig | AnyConfig | None = None,
        *,
        orient: Orientation = "auto",
        viewpoint: Sequence[float] | None = None,
        residual: bool = True,
        chunk_size: int = CHUNK_SIZE,
        keep_neighbors: bool = False,
        keys: Mapping[str, str] | None = None,
        **changes: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(orient, viewpoint, keep_neighbors=keep_neighbors, keys=keys)
        self.config = settings_of("EstimateNormals", NormalsConfig, config, changes)
        self.residual, self.chunk_size = residual, chunk_size

    def add(self, cloud: Mapping[str, Tensor], search: NeighborSearch) -> dict[str, Tensor]:
        """Return normals and curvature of a cloud."""
        options = self.side(cloud) | {"neighbors": search, "chunk_size": self.chunk_size}
        fit = estimate_normals(cloud["coord"], self.config, **options)
        added = {"normal": fit.normals, "curvature": fit.curvature}
        return {**added, "residual": fit.residual_rms} if self.residual else added


class OrientNormals(OrientedTransform):
    """Orient the normals of a sample; see :func:`torchrg.normals.orient_normals`.

    Reads ``normal`` ``(N, 3)`` and the entries of :class:`OrientedTransform`; changes ``normal``.
    Each cloud of a batch is oriented separately. :class:`SegmentPlanes` and
    :class:`EstimateNormals` already orient the normals that they add.

    Example:
        >>> floor = torch.cartesian_prod(torch.arange(8.0), torch.arange(8.0), torch.zeros(1))
        >>> sample = {"coord": floor, "normal": torch.tensor([[0.0, 0, 1]]).expand(64, 3)}
        >>> OrientNormals("viewpoint", (4, 4, -1))(sample)["normal"][0] + 0
        tensor([ 0.,  0., -1.])
    """

    reads = ("coord", "normal")

    def add(self, cloud: Mapping[str, Tensor], search: NeighborSearch) -> dict[str, Tensor]:
        """Return the oriented normals of a cloud."""
        side = self.side(cloud)
        return {"normal": orient_normals(cloud["coord"], cloud["normal"], neighbors=search, **side)}


class GrowRegions(CloudTransform):
    """Add plane labels grown from the normals of a sample; see :func:`torchrg.grow_regions`.

    Reads ``coord``, ``normal`` ``(N, 3)``, ``curvature`` ``(N,)`` and, if ``plane_reach`` is set
    (as in the preset ``consensus``), ``residual`` ``(N,)``; adds ``plane`` ``(N,)``, int64, -1 for
    none. A point with a zero normal joins no region.

    Args:
        config: Configuration of region growing.
        k: Number of neighbors, including the point itself.
        **changes: Single parameters, as in ``max_angle_deg=7``.

    Example:
        >>> floor = torch.cartesian_prod(torch.arange(8.0), torch.arange(8.0), torch.zeros(1))
        >>> sample = EstimateNormals(method="pca", k=9)({"coord": floor})
        >>> GrowRegions(k=9)(sample)["plane"].unique()
        tensor([0])
    """

    def __init__(
        self,
        config: GrowingConfig | AnyConfig | None = None,
        *,
        k: int = NormalsConfig.k,
        keep_neighbors: bool = False,
        keys: Mapping[str, str] | None = None,
        **changes: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(keep_neighbors=keep_neighbors, keys=keys)
        self.config = settings_of("GrowRegions", GrowingConfig, config, changes)
        self.k = k
        with_residual = self.config.plane_reach is not None
        self.reads = ("coord", "normal", "curvature", *["residual"] * with_residual)

    def add(self, cloud: Mapping[str, Tensor], search: NeighborSearch) -> dict[str, Tensor]:
        """Return the plane labels of a cloud."""
        distinct = distinct_points(cloud["coord"], cloud["normal"].unbind(dim=1))
        points = distinct.points
        if len(points) == 0:
            return {"plane": torch.full_like(distinct.inverse, UNLABELED)}
        read = {name: values[distinct.rows].to(points.dtype) for name, values in cloud.items()}
        grown = grow_regions(
            points,
            read["normal"],
            read["curvature"],
            search(points, self.k),
            self.config,
            valid=(read["normal"] != 0).any(dim=-1),
            residual_rms=read.get("residual"),
            canonical=True,
        )
        plane = distinct.restore(grown, fill=UNLABELED)
        return {"plane": rank_by_count(plane)[plane]}


class SegmentPlanes(OrientedTransform):
    """Add plane labels, normals and curvature; see :func:`torchrg.segment_planes`.

    Reads the entries of :class:`OrientedTransform`; adds ``plane`` ``(N,)``, int64, -1 for none,
    ``normal`` ``(N, 3)`` and ``curvature`` ``(N,)``.

    Args:
        config: Configuration, as in ``{"normals.k": 30}``. Default: the preset ``consensus``.
        **changes: Single parameters, as in ``min_area=0.5``.

    Example:
        >>> floor = torch.cartesian_prod(torch.arange(8.0), torch.arange(8.0), torch.zeros(1))
        >>> SegmentPlanes({"base": "classic", "normals.k": 9})({"coord": floor})["plane"].unique()
        tensor([0])
    """

    def __init__(
        self,
        config: AnyConfig | None = None,
        *,
        orient: Orientation = "auto",
        viewpoint: Sequence[float] | None = None,
        keep_neighbors: bool = False,
        keys: Mapping[str, str] | None = None,
        **changes: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(orient, viewpoint, keep_neighbors=keep_neighbors, keys=keys)
        self.config = settings_of("SegmentPlanes", PipelineConfig, config, changes)

    def add(self, cloud: Mapping[str, Tensor], search: NeighborSearch) -> dict[str, Tensor]:
        """Return plane labels, normals and curvature of a cloud."""
        seg = segment_planes(
            cloud["coord"], self.config, keep_neighbors=self.keep_neighbors, **self.side(cloud)
        )
        if seg.neighbors is not None:
            search.remember(distinct_points(cloud["coord"]).points, seg.neighbors)
        return {"plane": seg.labels, "normal": seg.normals, "curvature": seg.curvature}


class MakeSuperpoints(CloudTransform):
    """Add superpoints, a partition of all points; see :func:`torchrg.make_superpoints`.

    Reads ``coord``, ``normal`` ``(N, 3)`` and ``plane`` ``(N,)``, as :class:`SegmentPlanes` adds
    them; adds ``superpoint`` ``(N,)``, int64, for the first strength.

    Args:
        config: Configuration. Default: :class:`torchrg.config.SuperpointsConfig`.
        white: Maximum of ``color`` ``(N, 3)``, 255 or 1. Default: colors are not used.
        **changes: Single parameters, as in ``strengths=2.0``.

    Example:
        >>> x, y = torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0)).unbind(1)
        >>> sample = SegmentPlanes()({"coord": torch.stack([x, y, 10 * (x > 9)], dim=1)})
        >>> MakeSuperpoints()(sample)["superpoint"].unique(return_counts=True)[1]
        tensor([200, 200])
    """

    def __init__(
        self,
        config: SuperpointsConfig | Mapping[str, Any] | None = None,
        *,
        white: float | None = None,
        keys: Mapping[str, str] | None = None,
        **changes: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(keys=keys)
        if white is not None and not white > 0:
            raise ConfigError(f"MakeSuperpoints: expected white > 0 or None, got {white!r}.")
        self.config = settings_of("MakeSuperpoints", SuperpointsConfig, config, changes)
        self.white = white
        self.reads = ("coord", "normal", "plane", *["color"] * (white is not None))

    def add(self, cloud: Mapping[str, Tensor], search: NeighborSearch) -> dict[str, Tensor]:
        """Return the superpoints of a cloud."""
        colors = None
        if self.white is not None:
            colors = cloud["color"].double().nan_to_num(0, 0, 0)
            maximum = find_white(colors.numpy(force=True))
            if maximum > self.white:
                raise ConfigError(
                    f"MakeSuperpoints: expected color in 0..{self.white:g}, got 0..{maximum}; pass "
                    f"white={maximum}."
                )
            colors = colors / self.white
        points, plane = cloud["coord"], cloud["plane"].reshape(-1)
        near = search.recall(distinct_points(points).points) if search.known else None
        partition = partition_points(
            points, cloud["normal"], plane, self.config, colors, neighbors=near
        )
        return {"superpoint": partition.labels}


class AlignAxes(SampleTransform):
    """Align each cloud, with up along z and walls along x and y; see :func:`torchrg.align_axes`.

    Reads ``coord`` ``(N, 3)``; changes it, and ``normal`` and ``front`` if present; adds
    ``axis_align_matrix`` ``(B, 4, 4)``, float64, the rigid transform of each cloud.

    Args:
        config: Configuration for detecting the planes of floor and walls.
        up: Up direction, accurate to 30 degrees.

    Raises:
        ConfigError: On a call, if a cloud has neither floor nor walls.

    Example:
        >>> from torchrg.scenes import make_room
        >>> room = make_room(num_points=4_000, seed=0)
        >>> turn = torch.tensor([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
        >>> found = AlignAxes("classic")({"coord": room.points.float() @ turn.T})
        >>> (found["axis_align_matrix"][0, :3, :3].float() @ turn).round(decimals=2).abs().tolist()
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """

    def __init__(
        self,
        config: AnyConfig | None = None,
        *,
        up: Sequence[float] = (0.0, 0.0, 1.0),
        keys: Mapping[str, str] | None = None,
        **changes: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(keys=keys)
        self.config = settings_of("AlignAxes", PipelineConfig, config, changes)
        self.up = tuple(up)

    def transform(self, sample: Sample) -> Sample:
        """Return a new sample with transformed coordinates and normals."""
        coord = self.read(sample, "coord")
        parts = cloud_rows(sample, len(coord))
        clouds = (segment_planes(coord[rows], self.config, orient="none") for rows in parts)
        transforms = [align_axes(cloud, up=self.up).to(coord.device) for cloud in clouds]
        moved = {"coord": _transform(coord, parts, transforms, shifted=True)}
        for name in ("normal", "front"):
            if self.key(sample, name) in sample:
                moved[name] = _transform(self.read(sample, name), parts, transforms, shifted=False)
        changes = {self.key(sample, name): values for name, values in moved.items()}
        changes[self.key(sample, "axis_align_matrix")] = torch.stack(transforms)
        return self.replace(sample, changes)


def _transform(
    vectors: Tensor, parts: Sequence[slice], transforms: list[Tensor], *, shifted: bool
) -> Tensor:
    """Apply the transform of their cloud to vectors, without translation unless ``shifted``."""
    moved = [
        vectors[rows].double() @ transform[:3, :3].T + transform[:3, 3] * shifted
        for rows, transform in zip(parts, transforms, strict=True)
    ]
    return torch.cat(moved).to(vectors.dtype)
