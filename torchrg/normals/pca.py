"""Least-squares planes, and point-wise application of patch estimators."""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from torchrg import kernels
from torchrg._checks import check_floating, check_shapes, is_concrete
from torchrg._parallel import CHUNK_SIZE, map_chunks, nonzero_rows
from torchrg.config import NormalsConfig
from torchrg.linalg import covariance, eigh3
from torchrg.linalg.eigen import PrincipalFrame, principal_frame, smallest_eigenvector3
from torchrg.linalg.moments import covariance_of_columns, weighted_moments
from torchrg.linalg.precision import coordinate_resolution, rank_tolerance, rounded_sqrt, safe_sqrt
from torchrg.neighbors.knn import gather_patches
from torchrg.structures import Neighbors, NormalFit

FitPatches = Callable[..., NormalFit]
"""Patches ``(n, K, 3)``, mask ``(n, K)`` or None, keyword ``resolution`` ``(n,)`` -> fit."""
Estimator = Callable[[Tensor, Neighbors, NormalsConfig, int], NormalFit]
"""Points, neighbors, configuration, chunk size -> fit."""
_MIN_RATIO = 0.03
"""Minimum ratio of width to length of a patch resolved by its covariance; below it is rounding."""


def fit_normals_pca(
    patches: Tensor, mask: Tensor | None = None, *, resolution: Tensor | None = None
) -> NormalFit:
    """Fit a plane to each patch by least squares and return its normal.

    The normal is the eigenvector of the smallest eigenvalue ``l0`` of the covariance [1], eq. (1);
    the curvature is the surface variation ``l0 / (l0 + l1 + l2)`` [2], eq. (2).

    Convention:
        The sign of a normal is arbitrary. Gradients flow through normals, curvature and residual,
        and are finite if two eigenvalues are equal: the rotation between the two is omitted.
        ``torch.vmap`` requires ``out_dims=NormalFit(0, 0, 0, 0, None)``, since ``sharp`` is None.

    Args:
        patches: Points of each neighborhood, shape ``(*, K, 3)``.
        mask: Points that count, shape ``(*, K)``, bool; masked points may have any value, including
            NaN. Default: all.
        resolution: Size below which a coordinate difference is rounding, shape ``(*)``, in
            coordinate units. Default: rounding of the patch coordinates.

    Returns:
        The fit. A patch with fewer than three points or with collinear points has ``valid`` False,
        a zero normal and curvature 0.

    Raises:
        ShapeError: If a shape or dtype is not as above.

    References:
        [1] H. Hoppe et al. Surface reconstruction from unorganized points. SIGGRAPH, 1992.
        [2] M. Pauly, M. Gross, L. Kobbelt. Efficient simplification of point-sampled surfaces. IEEE
        Visualization, 2002.

    Example:
        >>> patches = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
        >>> fit_normals_pca(patches).normals.abs()
        tensor([0., 0., 1.])
    """
    check_patches("fit_normals_pca", patches, mask, resolution)
    return fit_plane(patches, mask, resolution)[0]


_Decomposition = tuple[Tensor, PrincipalFrame]
"""Covariances ``(*, 3, 3)``, and their principal frames."""


def _decompose(patches: Tensor, mask: Tensor | None) -> _Decomposition:
    _, matrix = covariance_of_columns(patches.unbind(dim=-1), mask)
    return matrix, principal_frame(matrix)


def _decompose_for_normals(patches: Tensor, mask: Tensor | None) -> _Decomposition:
    """Decompose bit-identically to the kernels if only values and normals are needed."""
    if patches.dtype != torch.float32 or patches.requires_grad or not is_concrete(patches, mask):
        return _decompose(patches, mask)
    columns = center_on_first(patches, mask)[1].unbind(dim=-1)
    counted = torch.ones_like(columns[0]) if mask is None else mask.to(patches.dtype)
    _, matrix = weighted_moments(columns, counted)
    values, normals = smallest_eigenvector3(matrix)
    return matrix, PrincipalFrame(normals, values[..., 0], values, normals[..., None])


def fit_plane(
    patches: Tensor,
    mask: Tensor | None,
    resolution: Tensor | None,
    decompose: Callable[[Tensor, Tensor | None], _Decomposition] = _decompose,
) -> tuple[NormalFit, PrincipalFrame]:
    """Return the fit of :func:`fit_normals_pca` and its principal frame."""
    matrix, frame = decompose(patches, mask)
    total = matrix[..., 0, 0] + matrix[..., 1, 1] + matrix[..., 2, 2]
    with torch.no_grad():
        valid = _spans_plane(patches, mask, frame.values, resolution)
    normals, smallest = frame.normals, frame.smallest
    curvature = (smallest / torch.where(total > 0, total, 1.0)).clamp(max=1 / 3)
    fit = NormalFit(
        torch.where(valid[..., None], normals, 0.0),
        torch.where(valid, curvature, 0.0),
        valid,
        residual_rms=torch.where(valid, safe_sqrt(smallest), 0.0),
    )
    return fit, frame


def _fit_normals(patches: Tensor, mask: Tensor | None, *, resolution: Tensor) -> NormalFit:
    """Apply :func:`fit_normals_pca`, bit-identical to its kernel."""
    return fit_plane(patches, mask, resolution, _decompose_for_normals)[0]


def fit_points_pca(
    points: Tensor, neighbors: Neighbors, *, chunk_size: int = CHUNK_SIZE
) -> NormalFit:
    """Fit planes to the neighborhoods of a cloud ``(N, 3)``; see :func:`fit_points`."""
    num_neighbors = neighbors.indices.shape[1]
    if not kernels.serve(points, *neighbors, k=num_neighbors):
        return fit_points(points, neighbors, _fit_normals, chunk_size=chunk_size)
    positions, tolerance = points.contiguous(), rank_tolerance(num_neighbors, points.dtype)

    def work(rows: slice) -> tuple[Tensor, ...]:
        resolution = coordinate_resolution(points[rows])
        near = neighbors.select(rows)
        return kernels.call("fit_normals_pca", positions, *near, resolution, tolerance, _MIN_RATIO)

    parts = map_chunks(work, len(points), chunk_size, points.device)
    normals, curvature, rms, valid, narrow = map(torch.cat, zip(*parts, strict=True))
    fit = NormalFit(normals, curvature, valid, rms)
    rows = nonzero_rows(narrow)
    if len(rows) == 0:
        return fit
    refitted = fit_points(points, neighbors, _fit_normals, rows=rows, chunk_size=chunk_size)
    return replace_rows(fit, rows, refitted)


def check_patches(
    caller: str, patches: Tensor, mask: Tensor | None, resolution: Tensor | None
) -> None:
    """Validate the arguments of a patch estimator; raise ShapeError if one is wrong."""
    check_shapes(caller, patches=(patches, "* K 3"), mask=(mask, "* K"))
    check_shapes(caller, patches=(patches[..., 0, 0], "*"), resolution=(resolution, "*"))
    check_floating(caller, patches=patches, resolution=resolution)


def _spans_plane(
    patches: Tensor, mask: Tensor | None, values: Tensor, resolution: Tensor | None
) -> Tensor:
    """Return whether the second principal width of each patch exceeds rounding.

    A covariance holds squares, so its rounding hides widths below the root of its precision. Such
    narrow patches are few and are recomputed; all patches are when a compiler cannot select them.
    """
    if resolution is None:
        resolution = patch_resolution(patches, mask)
    lengths, widths = (rounded_sqrt(values[..., axis].clamp(min=0)) for axis in (2, 1))
    flat = torch.maximum(rank_tolerance(patches.shape[-2], patches.dtype) * lengths, resolution)
    narrow = widths < _MIN_RATIO * lengths
    if not is_concrete(patches, mask, values):
        widths = torch.where(narrow, _width(patches, mask), widths)
    elif bool(narrow.any()):
        widths = widths.double()
        widths[narrow] = _width(patches[narrow], None if mask is None else mask[narrow])
    return widths > flat


def _width(patches: Tensor, mask: Tensor | None) -> Tensor:
    """Return the RMS extent of long patches perpendicular to their length, shape ``(n,)``."""
    mean, matrix = covariance(patches.double(), mask)
    direction = eigh3(matrix)[1][..., 2]
    offsets = patches - mean[..., None, :]
    along = (offsets * direction[..., None, :]).sum(dim=-1, keepdim=True)
    across = offsets - along * direction[..., None, :]
    _, matrix = covariance(across, mask)
    return eigh3(matrix)[0][..., 2].clamp(min=0).sqrt()


def patch_resolution(patches: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the rounding of coordinate differences in each patch, shape ``(*)``."""
    counted = patches if mask is None else torch.where(mask[..., None], patches, 0.0)
    return coordinate_resolution(counted.detach().flatten(-2))


def fit_points(
    points: Tensor,
    neighbors: Neighbors,
    fit: FitPatches,
    *,
    rows: Tensor | None = None,
    chunk_size: int = CHUNK_SIZE,
    **point_arguments: Tensor,
) -> NormalFit:
    """Fit the neighborhoods of the given points of a cloud ``(N, 3)``, default all.

    At most ``chunk_size`` patches are in memory at a time, which does not change the result. Other
    keywords are per-point arguments of ``fit``, shape ``(N,)``. Returns the fit of the given rows,
    without ``sharp``.
    """

    def fit_chunk(chunk: slice) -> NormalFit:
        chosen = chunk if rows is None else rows[chunk]
        indices, mask = neighbors.select(chosen)
        patches = gather_patches(points, indices)
        extra = {name: values[chosen] for name, values in point_arguments.items()}
        return fit(patches, mask, resolution=coordinate_resolution(points[chosen]), **extra)

    num_rows = len(points) if rows is None else len(rows)
    parts = list(zip(*map_chunks(fit_chunk, num_rows, chunk_size, points.device), strict=True))
    return NormalFit(*(torch.cat(columns) for columns in parts[:4]))


def at_all_points(fit: FitPatches, **settings: str) -> Estimator:
    """Return the estimator that applies ``fit`` to every neighborhood.

    ``settings`` maps keywords of the fit to fields of :class:`torchrg.config.NormalsConfig`.
    """

    def estimate(
        points: Tensor, neighbors: Neighbors, config: NormalsConfig, chunk_size: int
    ) -> NormalFit:
        chosen = {keyword: getattr(config, field) for keyword, field in settings.items()}
        return fit_points(points, neighbors, partial(fit, **chosen), chunk_size=chunk_size)

    return estimate


def center_on_first(patches: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the first counted point of each patch, and all points relative to it.

    Zero if no point counts, and for masked points, which may be NaN.
    """
    if mask is None:
        return patches[..., 0, :], patches - patches[..., :1, :]
    first = mask.to(torch.uint8).argmax(dim=-1)[..., None, None]
    origin = patches.gather(-2, first.expand(*first.shape[:-1], 3))
    origin = torch.where(mask.any(dim=-1)[..., None, None], origin, 0.0)
    return origin.squeeze(-2), torch.where(mask[..., None], patches - origin, 0.0)


def replace_rows(fit: NormalFit, rows: Tensor, refined: NormalFit) -> NormalFit:
    """Return a fit with some rows replaced; ``sharp`` is kept."""
    merged = [old.index_copy(0, rows, new) for old, new in zip(fit[:4], refined[:4], strict=True)]
    normals, curvature, valid, residual_rms = merged
    return NormalFit(normals, curvature, valid, residual_rms, fit.sharp)
