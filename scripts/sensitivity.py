"""Sensitivity of scores to the constants of consensus normals.

Halves and doubles every number of ``torchrg/normals/consensus/constants.py``, one at a time. Tests
synthetic rooms and shapes with exact ground truth and, if given, a scan with labeled parts (a cloud
with ``labels``, 0 for points without a part). If a score changes too much, smaller factors are
tried. Takes about half an hour on one core with ``--quick``. ``sensitivity.json`` next to this file
is the result of the last run with ``--quick`` and parts:

    python scripts/sensitivity.py --quick --parts office_parts.pcd --out scripts/sensitivity.json
    python scripts/sensitivity.py --only FLAT_LIMIT CURVED_LIMIT
"""

import argparse
import ast
import inspect
import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import surroundings
import torch
from benchmarks.harness import markdown
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parents[1]))  # The scenes of tests.made.

from tests.made import CurvedLayout, make_shape
from torchrg import load_config
from torchrg.io import read_cloud
from torchrg.metrics import score_labels, score_normals
from torchrg.neighbors import search_knn
from torchrg.normals.consensus import constants, estimate_consensus
from torchrg.regions import grow_regions
from torchrg.scenes import RoomLayout, make_room
from torchrg.structures import Neighbors

TOLERANCES = {"ARI": 1.0, "mean": 0.05, "RMS": 0.25}
"""Tolerated changes: percentage points for labels, degrees for normals. F1 and mean best IoU are
means over surfaces; a change by one surface is tolerated as chance."""
NOTE = (
    "No change: F1 and mean best IoU by at most one surface, ARI by 1 point, angles by 0.05 "
    "degrees (mean) and 0.25 (RMS). The cloud with adaptive k is small: changes of 0.3 degrees "
    "are chance."
)
FACTORS = (2.0, 1.5, 1.25, 1.1)
"""Factors, tried in this order upwards and downwards until no score changes."""
MIN_SIZE = 50
"""Minimum region size for evaluation, in points, as in the paper."""
_CONFIG = load_config("consensus")
_CHUNK_SIZE = 16384


class Case(NamedTuple):
    """Cloud with ground truth."""

    name: str  # title in the table
    points: Tensor  # shape ``(N, 3)``
    neighbors: Neighbors  # of all points
    labels: Tensor | None  # ground-truth surfaces, ``(N,)``; None: labels are not evaluated
    normals: Tensor | None  # ground-truth normals, ``(N, 3)``; None: not evaluated
    num_faces: int = 0  # number of ground-truth surfaces
    ignore: int | None = None  # label of ignored points
    adaptive_k: int | None = None  # see :class:`torchrg.config.NormalsConfig`


class Constant(NamedTuple):
    """Number in ``constants``, or an element of a tuple there."""

    name: str
    index: int | None
    value: float
    unit: str

    @property
    def title(self) -> str:
        """Name in the table."""
        return self.name if self.index is None else f"{self.name}[{self.index}]"


@dataclass(frozen=True)
class Change:
    """Largest change of a score relative to its tolerance, over all clouds."""

    value: float
    score: str = ""
    cloud: str = ""
    change: float = 0.0

    def __str__(self) -> str:
        if not self.change:
            return "no change"
        unit = "deg" if self.score in ("mean", "RMS") else "pt"
        return f"{self.change:+.2f} {unit} {self.score}, {self.cloud}"


@dataclass(frozen=True)
class Finding:
    """Effect of a constant: half, double, and the factors between which no score changes."""

    constant: str
    value: float
    unit: str
    half: Change
    double: Change
    lowest: float
    highest: float


def read_table() -> list[Constant]:
    """Return all constants in file order, with the unit from their docstrings."""
    found = []
    lines = ast.parse(inspect.getsource(constants)).body
    for line, text in pairwise(lines):
        if isinstance(line, ast.Assign) and isinstance(line.targets[0], ast.Name):
            name = line.targets[0].id
            unit = ast.literal_eval(text.value).split(". ")[0]  # type: ignore[attr-defined]
            value = getattr(constants, name)
            several = enumerate(value) if isinstance(value, tuple) else [(None, value)]
            found += [Constant(name, index, number, unit) for index, number in several]
    return found


@contextmanager
def moved(constant: Constant, factor: float) -> Iterator[float]:
    """Multiply a constant temporarily; counts stay integers >= 1, fractions <= 1."""
    before = getattr(constants, constant.name)
    value = constant.value * factor
    if isinstance(constant.value, int):
        value = max(round(value), 1)
    if constant.unit.startswith("Fraction"):
        value = min(value, 1.0)
    after = value
    if constant.index is not None:
        after = (*before[: constant.index], value, *before[constant.index + 1 :])
    setattr(constants, constant.name, after)
    try:
        yield value
    finally:
        setattr(constants, constant.name, before)


def score(case: Case) -> dict[str, float]:
    """Return the scores of a cloud with the current constants."""
    settings = replace(_CONFIG.normals, adaptive_k=case.adaptive_k)
    fit = estimate_consensus(case.points, case.neighbors, settings, _CHUNK_SIZE)
    scores = {}
    if case.labels is not None:
        found = grow_regions(
            case.points,
            fit.normals,
            fit.curvature,
            case.neighbors,
            _CONFIG.growing,
            valid=fit.valid,
            residual_rms=fit.residual_rms,
        )
        labels = score_labels(found, case.labels, min_size=MIN_SIZE, ignore=case.ignore)
        scores |= {"F1": labels.f1, "mIoU": 100 * labels.mean_best_iou, "ARI": 100 * labels.ari}
    if case.normals is not None:
        angles = score_normals(fit.normals, case.normals)
        scores |= {"mean": angles.mean, "RMS": angles.rms}
    return scores


def study(cases: Sequence[Case], table: Sequence[Constant]) -> Iterator[Finding]:
    """Yield the effect of each constant on the scores."""
    before = {case.name: score(case) for case in cases}

    def largest(
        constant: Constant, factor: float, subset: Sequence[Case]
    ) -> tuple[Change, list[Case]]:
        """Return the largest relative change, and the clouds with changes above tolerance."""
        with moved(constant, factor) as value:
            if value == constant.value:
                return Change(value), []
            worst, fraction, changed = Change(value), 0.0, []
            for case in subset:
                for name, after in score(case).items():
                    change = after - before[case.name][name]
                    relative = abs(change) / (TOLERANCES.get(name) or 100 / case.num_faces)
                    if relative > fraction:
                        worst, fraction = Change(value, name, case.name, change), relative
                    if relative > 1 and not (changed and changed[-1] is case):
                        changed.append(case)
        return worst, changed

    def furthest(constant: Constant, factors: Sequence[float]) -> tuple[Change, float]:
        """Return the change by the first factor, and the first factor without a change."""
        first, changed = largest(constant, factors[0], cases)
        if not changed:
            return first, factors[0]
        for factor in factors[1:]:
            if not largest(constant, factor, changed)[1]:
                return first, factor
        return first, 1.0

    for constant in table:
        half, lowest = furthest(constant, [1 / factor for factor in FACTORS])
        double, highest = furthest(constant, FACTORS)
        yield Finding(constant.title, constant.value, constant.unit, half, double, lowest, highest)


def make_cases(parts: Path | None, *, quick: bool) -> list[Case]:
    """Return the clouds: rooms (one in quick runs), optional parts, and shapes."""
    fraction = 0.6 if quick else 1.0
    cases = []
    for name, (layout, noise) in list(_ROOMS.items())[: 1 if quick else None]:
        room = make_room(round(_ROOM_POINTS * fraction), noise=noise, seed=3, layout=layout)
        neighbors = search_knn(room.points, _CONFIG.normals.k)
        faces = len(room.labels.unique())
        cases.append(Case(name, room.points, neighbors, room.labels, room.normals, faces))
    if parts is not None:
        cases.append(_read_parts(parts, round(_PART_POINTS * fraction)))
    for name, (shape, noise, k, adaptive_k) in _SHAPES.items():
        num_points = round((_SHAPE_POINTS if adaptive_k is None else _SHAPE_POINTS // 4) * fraction)
        scene = make_shape(shape, num_points, noise, seed=1)
        neighbors = search_knn(scene.points, k)
        cases.append(
            Case(name, scene.points, neighbors, None, scene.normals, adaptive_k=adaptive_k)
        )
    return cases


def _read_parts(path: Path, num_points: int) -> Case:
    """Return the points of a file closest to its center, at full density."""
    cloud = read_cloud(path)
    distances = (cloud.points - cloud.points.median(dim=0).values).square().sum(dim=1)
    kept = distances.argsort(stable=True)[:num_points].sort().values
    points = cloud.points[kept].contiguous()
    labels = torch.from_numpy(cloud.fields["labels"])[kept]
    neighbors = search_knn(points, _CONFIG.normals.k)
    return Case("office parts", points, neighbors, labels, None, len(labels.unique()) - 1, ignore=0)


def _small(layout: RoomLayout, **counts: int) -> RoomLayout:
    """Return the layout for a small room with few objects, dense at 50,000 points."""
    nothing = {field.name: 0 for field in fields(layout) if field.name.startswith("num_")}
    return replace(layout, size=(4.4, 3.4, 2.4), **{**nothing, **counts})


_ROOM_POINTS = 30_000
_PART_POINTS = 30_000
_SHAPE_POINTS = 10_000
_ROOMS = {
    "room": (
        _small(
            RoomLayout(), num_doors=1, num_windows=1, num_cabinets=1, num_shelves=1, num_tables=1
        ),
        0.003,
    ),
    "thin plates": (
        _small(RoomLayout(plate_thickness=0.02), num_shelves=2, num_panels=2, num_tables=1),
        0.002,
    ),
    "curved room": (
        _small(CurvedLayout(), num_round_tables=1, num_bent_walls=2, num_windows=1),
        0.003,
    ),
    "bent walls, exact": (_small(CurvedLayout(), num_bent_walls=4, num_tables=1), 0.0),
}
_SHAPES = {
    "cube, exact": ("cube", 0.0, 50, None),
    "cube": ("cube", 0.0025, 50, None),
    "bracket": ("bracket", 0.0025, 50, None),
    "plate, exact": ("thin_plate", 0.0, 50, None),
    "cylinder": ("cylinder", 0.0025, 50, None),
    "rounded box": ("rounded_box", 0.001, 50, None),
    "torus": ("torus", 0.0025, 50, None),
    "ball, exact": ("sphere", 0.0, 50, None),
    "cube, k = 16": ("cube", 0.001, 16, None),
    "torus, adaptive k": ("torus", 0.012, 50, 300),
}
"""Shape, noise relative to its diagonal, k, and maximum k."""


def main() -> None:
    """Measure, print and write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--parts", type=Path, help="cloud of scanned parts with labels")
    parser.add_argument("--quick", action="store_true", help="one room and fewer points")
    parser.add_argument("--only", nargs="+", help="names of constants")
    parser.add_argument("--out", type=Path, help="JSON file for the result")
    arguments = parser.parse_args()
    if arguments.parts is not None and not arguments.parts.is_file():
        print(f"{arguments.parts}: file not found; skipping scanned parts", file=sys.stderr)
        arguments.parts = None
    torch.set_num_threads(1)
    cases = make_cases(arguments.parts, quick=arguments.quick)
    table = [one for one in read_table() if not arguments.only or one.name in arguments.only]
    findings = list(study(cases, table))
    scores = {case.name: {"points": len(case.points), **score(case)} for case in cases}
    record = {"made_with": surroundings.describe(1), "clouds": scores}
    record["findings"] = [asdict(finding) for finding in findings]
    if arguments.out is not None:
        arguments.out.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    print(markdown(["cloud", "scores"], scores.items()), f"\n{NOTE}\n", sep="\n")
    rows = [
        (one.constant, one.value, one.half, one.double, f"x{one.lowest:.2g} to x{one.highest:.2g}")
        for one in findings
    ]
    print(markdown(["constant", "value", "half", "double", "no change"], rows))


if __name__ == "__main__":
    main()
