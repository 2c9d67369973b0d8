"""Compare the public functions on a device with the CPU.

    python scripts/compare_devices.py cuda
    python scripts/compare_devices.py pretend    # the device of tests/pretend
    python scripts/compare_devices.py cuda --only segment_planes

Integers and masks must be equal, floats within ``TOLERANCE``, and results on the device of the
input. Normals without an orientation have any sign. Prints one line for each difference, and fails
if there is one.
"""

import argparse
import functools
import itertools
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

import torchrg
from torchrg import depth, linalg, metrics, neighbors, nn, normals, regions, robust, transforms
from torchrg.config import preset_names
from torchrg.structures import Neighbors

Call = Callable[[Callable[[Any], Any]], Any]
"""A call, given the function that moves its arguments to a device."""

TOLERANCE = 1e-4
"""Absolute tolerance, in units of the largest finite value: sums run in another order, and kernels
of the CPU compute in float32."""

ITERATED = {"fastmcd": 2e-3, "dets": 1e-3, "detmm": 1e-3, "irls": 1e-3}
"""Tolerances of methods that iterate, whose steps amplify rounding."""

MIN_EQUAL = 0.99
"""Minimum fraction of equal entries where rounding may decide between equally good sets."""

ON_CPU = ("find_intrinsics",)
"""Calls with results on the CPU by design."""

ROOM = torchrg.scenes.make_room(num_points=1000, noise=0.003, seed=0)
POINTS, NORMALS = ROOM.points, ROOM.normals
LABELS = torch.unique(ROOM.labels, return_inverse=True)[1]
GENERATOR = torch.Generator().manual_seed(0)
PATCHES = torch.randn(60, 30, 3, generator=GENERATOR) * torch.tensor([1.0, 0.7, 0.05])
BROKEN = POINTS.clone()
BROKEN[::7] = torch.nan
BROKEN[1::7] = BROKEN[8]
CLOUDS = {
    "": POINTS,
    "float64": POINTS.double(),
    "far": POINTS.double() + 500_000,
    "broken": BROKEN,
    "two points": POINTS[:2],
    "none": POINTS[:0],
}
CAMERA = torch.tensor([[100.0, 0, 40], [0, 100, 30], [0, 0, 1]])
DEPTH = torch.full((60, 80), 2.0)
DEPTH[:, 40:] = 3.0
DEPTH[:5] = 0
OFFSET = torch.tensor([400, 1000])
COLORS = (POINTS[:, :1] > 0).expand(-1, 3).to(torch.uint8) * 200


def calls() -> Iterator[tuple[str, Call]]:
    """Yield the calls by name."""
    options: dict[str, dict[str, Any]] = {
        "voxel": {"voxel": 0.1},
        "within": {"within": (POINTS[:, 0] > 2).long()},
        "viewpoint": {"orient": "viewpoint", "viewpoint": POINTS.mean(dim=0)},
        "consistent": {"orient": "consistent"},
        "by area": {"sort": "area", "min_area": 0.2},
        "neighbors": {"keep_neighbors": True},
    }
    for preset in preset_names():
        for kind, cloud in CLOUDS.items():
            yield (
                f"segment_planes {preset} {kind}",
                lambda move, c=cloud, p=preset: torchrg.segment_planes(move(c), p),
            )
        for kind, option in options.items():
            yield (
                f"segment_planes {preset} {kind}",
                lambda move, o=option, p=preset: torchrg.segment_planes(move(POINTS), p, **move(o)),
            )
    for method, (kind, cloud) in itertools.product(sorted(normals.ESTIMATORS), CLOUDS.items()):
        yield (
            f"estimate_normals {method} {kind}",
            lambda move, c=cloud, m=method: torchrg.estimate_normals(move(c), method=m, k=15),
        )
    yield from _robust_calls()
    yield from _region_calls()
    yield from _other_calls()


def _robust_calls() -> Iterator[tuple[str, Call]]:
    mask = PATCHES[..., 0] < 0.8
    fits = [robust.fit_detmcd, robust.fit_fastmcd, robust.fit_mve, robust.fit_dets]
    for fit, kind in itertools.product([*fits, robust.fit_detmm], ("", "masked", "float64")):
        x = PATCHES.double() if kind == "float64" else PATCHES
        chosen = mask if kind == "masked" else None
        name = fit.__name__.removeprefix("fit_")
        yield f"fit {name} {kind}", lambda move, f=fit, x=x, m=chosen: f(move(x), move(m))
    for starts in ("robustbase", "planes", "more"):
        yield (
            f"fit detmcd {starts}",
            lambda move, s=starts: robust.fit_detmcd(move(PATCHES), starts=s),
        )
    scales = [robust.qn, robust.mad, robust.tau, robust.median]
    for scale, kind in itertools.product(scales, ("", "float64")):
        x = PATCHES[..., 0].double() if kind else PATCHES[..., 0]
        yield f"{scale.__name__} {kind}", lambda move, s=scale, x=x: s(move(x))
    for name in ("DetMCD", "FastMCD", "MVE", "DetS", "DetMM", "Covariance", "Eigh"):
        module = getattr(nn, name)()
        x = linalg.covariance(PATCHES)[1] if name == "Eigh" else PATCHES
        yield f"nn.{name.lower()}", lambda move, m=module, x=x: m(move(x))
    yield "covariance", lambda move: linalg.covariance(move(PATCHES), move(mask))
    yield "eigh3 values", lambda move: linalg.eigh3(move(linalg.covariance(PATCHES)[1]))[0]


def _region_calls() -> Iterator[tuple[str, Call]]:
    near = torchrg.search_knn(POINTS, 20)
    fit = torchrg.estimate_normals(POINTS, k=20)
    for preset in preset_names():
        yield f"grow_regions {preset}", lambda move, p=preset: torchrg.grow_regions(
            move(POINTS), move(fit.normals), move(fit.curvature), move(near), p,
            valid=move(fit.valid), residual_rms=move(fit.residual_rms),
        )  # fmt: skip
    yield (
        "summarize_planes",
        lambda move: regions.summarize_planes(
            move(POINTS), move(NORMALS), move(LABELS), neighbors=move(near), up=(0, 0, 1)
        ),
    )
    yield "find_sharp_points", lambda move: normals.find_sharp_points(move(NORMALS), move(near))
    for side in ("interior", "consistent", "up"):
        yield (
            f"orient_normals {side}",
            lambda move, s=side: normals.orient_normals(move(POINTS), move(NORMALS), orient=s),
        )
    yield "make_superpoints", lambda move: torchrg.make_superpoints(move(POINTS))
    yield (
        "make_superpoints colors",
        lambda move: torchrg.make_superpoints(move(POINTS), colors=move(COLORS)),
    )
    yield "make_superpoints voxel", lambda move: torchrg.make_superpoints(move(POINTS), voxel=0.1)
    yield "segment_mesh", lambda move: torchrg.segment_mesh(move(POINTS))
    for k, (kind, cloud) in itertools.product((1, 2), CLOUDS.items()):
        if kind not in ("broken", "none"):
            yield (
                f"search_knn {k} {kind}",
                lambda move, c=cloud, k=k: torchrg.search_knn(move(c), k),
            )
    for kind, cloud in CLOUDS.items():
        yield f"sample_voxels {kind}", lambda move, c=cloud: transforms.sample_voxels(move(c), 0.2)
        yield f"canonical_order {kind}", lambda move, c=cloud: neighbors.canonical_order(move(c))


def _other_calls() -> Iterator[tuple[str, Call]]:
    yield "segment_depth", lambda move: depth.segment_depth(move(DEPTH), move(CAMERA))
    yield (
        "segment_depth, camera on the CPU",
        lambda move: depth.segment_depth(move(DEPTH), CAMERA),
    )
    yield (
        "depth_to_points",
        lambda move: depth.depth_to_points(move(DEPTH[None]), move(CAMERA[None])),
    )
    steps: list[Any] = [
        transforms.AlignAxes(), transforms.CenterCloud(), transforms.KeepFinite(),
        transforms.SampleVoxels(0.2), transforms.EstimateNormals(k=15),
        transforms.SegmentPlanes("classic"),
        torch.nn.Sequential(transforms.SegmentPlanes("classic"), transforms.MakeSuperpoints()),
    ]  # fmt: skip
    for step, offset in itertools.product(steps, (None, OFFSET)):
        sample = {"coord": POINTS} if offset is None else {"coord": POINTS, "offset": offset}
        yield (
            f"{type(step).__name__} {'' if offset is None else 'of a batch'}",
            (lambda move, t=step, s=sample: t(move(s))),
        )
    yield (
        "SegmentDepth",
        lambda move: transforms.SegmentDepth()(move({"depth": DEPTH[None], "intrinsics": CAMERA})),
    )
    numbers = POINTS[:, 1].floor().long().clamp(min=-1)
    yield "score_labels", lambda move: metrics.score_labels(move(numbers), move(LABELS))
    yield "score_clusters", lambda move: metrics.score_clusters(move(NORMALS), move(LABELS))
    yield "score_normals", lambda move: metrics.score_normals(move(NORMALS), move(-NORMALS))
    yield (
        "score_partition",
        lambda move: metrics.score_partition(move(numbers), move(LABELS), move(POINTS)),
    )
    yield "contingency_table", lambda move: metrics.contingency_table(move(numbers), move(LABELS))


def moved(value: Any, device: str) -> Any:  # noqa: ANN401
    """Return a value with its tensors on a device."""
    if isinstance(value, Tensor):
        return value.to(device)
    if isinstance(value, Neighbors):
        return Neighbors(*(moved(item, device) for item in value))
    if isinstance(value, Mapping):
        return {name: moved(item, device) for name, item in value.items()}
    return value


def leaves(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:  # noqa: ANN401
    """Yield the tensors and numbers of a result by their path."""
    if isinstance(value, Tensor | int | float):
        yield path, value
    elif isinstance(value, Mapping):
        for name, item in value.items():
            yield from leaves(item, f"{path}.{name}")
    elif isinstance(value, tuple | list):
        for i, item in enumerate(value):
            yield from leaves(item, f"{path}.{i}")
    elif hasattr(value, "__dict__"):
        yield from leaves({k: v for k, v in vars(value).items() if k[0] != "_"}, path)


def difference(name: str, found: Any, expected: Any, device: str) -> str:  # noqa: ANN401
    """Return how a leaf differs from that of the CPU, otherwise ""."""
    if not isinstance(expected, Tensor):
        close = found == expected or abs(found - expected) <= 1e-6 * abs(expected) or (
            found != found and expected != expected
        )  # fmt: skip
        return "" if close else f"{found} instead of {expected}"
    if found.device.type != torch.device(device).type:
        return f"on {found.device}"
    found = found.cpu()
    if (found.dtype, found.shape) != (expected.dtype, expected.shape):
        return f"{found.dtype} {tuple(found.shape)} instead of {tuple(expected.shape)}"
    if not found.is_floating_point():
        equal = (found == expected).double().mean().item() if found.numel() else 1.0
        is_set = any(method in name for method in ("mve", "fastmcd")) and equal >= MIN_EQUAL
        return "" if equal == 1 or is_set else f"{1 - equal:.2%} of the entries differ"
    finite = expected[expected.isfinite()].abs()
    size = max(finite.max().item(), 1.0) if finite.numel() else 1.0
    iterated = [limit for method, limit in ITERATED.items() if method in name]
    limit = max([TOLERANCE, *iterated]) * size
    if name.startswith("estimate_normals") and found.shape[1:] == (3,):
        found = found * (found * expected).sum(dim=1, keepdim=True).sign()
    close = torch.isclose(found, expected, rtol=0, atol=limit, equal_nan=True)
    if bool(close.all()) or (iterated and close.double().mean() >= MIN_EQUAL):
        return ""
    return f"largest difference {(found - expected).abs().nan_to_num().max().item():.1e}"


def main() -> None:
    """Run all calls, and print the differences."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("device")
    parser.add_argument("--only", default="", help="part of the names of calls to run")
    arguments = parser.parse_args()
    if arguments.device == "pretend":
        from tests import pretend

        pretend.load()
    warnings.simplefilter("ignore")
    to_device = functools.partial(moved, device=arguments.device)
    count = num_different = 0
    for name, call in calls():
        if arguments.only not in name:
            continue
        count += 1
        expected = list(leaves(call(lambda value: value)))
        device = "cpu" if name.startswith(ON_CPU) else arguments.device
        try:
            found = list(leaves(call(to_device)))
            faults = [
                f"{path[1:]}: {text}"
                for (path, one), (_, other) in zip(found, expected, strict=True)
                if (text := difference(name, one, other, device))
            ]
        except Exception as error:  # noqa: BLE001 - the next call is compared, too.
            faults = [f"{type(error).__name__}: {str(error).splitlines()[0]}"]
        num_different += bool(faults)
        for fault in faults:
            print(f"{name}: {fault}")
    print(f"{count} calls, {count - num_different} as on the CPU")
    sys.exit(num_different > 0)


if __name__ == "__main__":
    main()
