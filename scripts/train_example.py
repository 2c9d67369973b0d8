"""Effect of torchrg's normals, curvature and planes on a small segmentation model.

Trains a point network (edge convolutions on 12 neighbors, four voxel levels, plain torch) on
synthetic rooms with ten classes, and prints the mean IoU on unseen rooms over all points. All
variants have the same model and number of weights, and the same steps, order of rooms and
augmentation; inputs that a variant omits are zero. All settings were tuned on the variant with only
coordinates. Walls, doors, windows, boards, cabinets and pillars have the same normals. The last
line of the table is a lookup by height and ground-truth normal of a point.

    python scripts/train_example.py
    python scripts/train_example.py --train-rooms 2 --test-rooms 1 --num-points 3000 --steps 2
"""

import argparse
import sys
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import cross_entropy, gelu
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parents[1]))  # The scenes of tests.made.

from tests.made import CurvedLayout
from torchrg import segment_planes
from torchrg.neighbors import expand_to_points, sample_voxels, search_knn
from torchrg.scenes import Scene, make_room

CLASSES = {
    "floor": ["floor"],
    "ceiling": ["ceiling"],
    "wall": ["wall"],
    "door": ["door", "door frame"],
    "window": ["window", "window frame"],
    "board": ["shelf", "shelf edge", "panel", "panel edge"],
    "cabinet": ["cabinet"],
    "table": ["table top", "table underside", "table edge", "table post"],
    "box": ["box"],
    "pillar": ["pillar", "column"],
}
"""Classes and the kinds of surfaces in each."""
VOXELS = (0.15, 0.35, 0.8, 1.9)
"""Voxel sizes in meters, from the input of the model to a few cells per room."""
WIDTHS = (32, 64, 96, 128)
"""Features per point on each level."""
NUM_NEIGHBORS = 12
NOISE = 0.005
"""Standard deviation along the normal in meters, as of a good depth camera."""
LEARNING_RATE = 3e-3
TEST_SEED = 10_000
"""First seed of the test rooms."""


class Variant(NamedTuple):
    """Inputs of a model in addition to coordinates."""

    normals: bool
    planes: bool


VARIANTS = {
    "coordinates": Variant(normals=False, planes=False),
    "+ normals, curvature": Variant(normals=True, planes=False),
    "+ planes as superpoints": Variant(normals=False, planes=True),
    "+ both": Variant(normals=True, planes=True),
}


class Level(NamedTuple):
    """The points of one voxel size.

    Attributes:
        coord: Shape ``(N, 3)``, meters.
        near: Neighbors of each point, shape ``(N, K)``.
        coarser: Voxel of each point on the next level, shape ``(N,)``; empty on the last.
    """

    coord: Tensor
    near: Tensor
    coarser: Tensor


class Sample(NamedTuple):
    """A room, prepared once for all variants.

    Attributes:
        levels: From the finest to the coarsest; the finest has ``N`` points.
        normal: Into the room, shape ``(N, 3)``.
        curvature: Shape ``(N,)``.
        superpoint: Shape ``(N,)``; a point without a plane is a separate superpoint.
        target: Classes, shape ``(N,)``.
        inverse: Row in the finest level of each point of the scan, shape ``(P,)``.
        ground_truth: Classes of all points of the scan, shape ``(P,)``.
    """

    levels: list[Level]
    normal: Tensor
    curvature: Tensor
    superpoint: Tensor
    target: Tensor
    inverse: Tensor
    ground_truth: Tensor


def draw_room(seed: int, num_points: int) -> Scene:
    """Return a scan of a room of random size, heading and contents."""
    rng = np.random.default_rng(seed)
    length, width, height = rng.uniform((5.5, 4.8, 2.4), (7.0, 6.2, 3.3))
    layout = CurvedLayout(
        size=(float(length), float(width), float(height)),
        heading_deg=float(rng.uniform(0, 360)),
        num_doors=1,
        num_windows=1,
        num_cabinets=int(rng.integers(1, 3)),
        num_shelves=int(rng.integers(0, 2)),
        num_panels=1,
        num_tables=int(rng.integers(1, 3)),
        num_boxes=1,
        num_small_boxes=1,
        num_pillars=int(round_pillar := rng.random() < 0.5),
        num_columns=int(not round_pillar),
    )
    return make_room(num_points, NOISE, seed, layout=layout)


def classes_of(room: Scene) -> Tensor:
    """Return the class of each point."""
    number = {kind: row for row, kinds in enumerate(CLASSES.values()) for kind in kinds}
    return torch.tensor([number[kind] for kind in room.kinds])[room.labels]


def prepare(room: Scene) -> Sample:
    """Segment the scan, then downsample it to voxels."""
    seg = segment_planes(room.points)
    voxels = sample_voxels(room.points, VOXELS[0])
    rows, ground_truth = voxels.rows, classes_of(room)
    plane, singleton = seg.labels[rows], len(seg.planes) + torch.arange(len(rows))
    return Sample(
        make_levels(room.points[rows]),
        seg.normals[rows],
        seg.curvature[rows],
        torch.where(plane >= 0, plane, singleton).unique(return_inverse=True)[1],
        ground_truth[rows],
        voxels.inverse,
        ground_truth,
    )


def make_levels(points: Tensor) -> list[Level]:
    """Return the voxel levels of points, relative to the center of the floor."""
    low, high = points.amin(dim=0), points.amax(dim=0)
    coord = points - torch.stack([*((low + high) / 2)[:2], low[2]])
    levels = []
    for size in (*VOXELS[1:], None):
        near = search_knn(coord, min(NUM_NEIGHBORS, len(coord))).indices
        if size is None:
            return [*levels, Level(coord, near, torch.empty(0, dtype=torch.long))]
        voxels = sample_voxels(coord, size)
        levels.append(Level(coord, near, voxels.inverse))
        coord = coord[voxels.rows]
    return levels


class EdgeConv(nn.Module):
    """Residual edge convolution with relative positions and maximum pooling."""

    def __init__(self, width: int, size: float) -> None:
        super().__init__()
        self.size = size
        self.norm = nn.LayerNorm(width)
        self.send, self.receive = nn.Linear(width, width), nn.Linear(width, width, bias=False)
        self.position, self.out = nn.Linear(3, width, bias=False), nn.Linear(width, width)

    def forward(self, features: Tensor, level: Level, coord: Tensor) -> Tensor:
        """Return new features of the points of a level at augmented positions ``coord``."""
        normed = self.norm(features)
        sent = self.send(normed) + self.position(coord / self.size)
        received = self.receive(normed) - self.position(coord / self.size)
        edges = gelu(sent[level.near] + received[:, None])
        return features + self.out(edges.amax(dim=1))


class PointUNet(nn.Module):
    """U-Net of edge convolutions on voxel levels."""

    def __init__(self) -> None:
        super().__init__()
        self.embed = nn.Linear(7, WIDTHS[0])
        pairs = list(zip(WIDTHS, VOXELS, strict=True))
        self.down = nn.ModuleList([EdgeConv(width, size) for width, size in pairs])
        self.up = nn.ModuleList([EdgeConv(width, size) for width, size in pairs])
        steps = list(pairwise(WIDTHS))
        self.widen = nn.ModuleList([nn.Linear(fine, coarse) for fine, coarse in steps])
        self.narrow = nn.ModuleList([nn.Linear(coarse, fine) for fine, coarse in steps])
        self.mix = nn.Linear(2 * WIDTHS[0], WIDTHS[0])
        self.classify = nn.Linear(WIDTHS[0], len(CLASSES))

    def forward(
        self, levels: Sequence[Level], coords: Sequence[Tensor], inputs: Tensor, superpoint: Tensor
    ) -> Tensor:
        """Return the logits of each point and class, shape ``(N, C)``."""
        features = self.embed(torch.cat([coords[0] / VOXELS[-1], inputs], dim=1))
        skipped = []
        for depth, (level, coord) in enumerate(zip(levels, coords, strict=True)):
            features = self.down[depth](features, level, coord)
            if depth + 1 < len(levels):
                skipped.append(features)
                features = mean_of(self.widen[depth](features), level.coarser)
        for depth in reversed(range(len(levels))):
            if depth + 1 < len(levels):
                coarse = self.narrow[depth](features)[levels[depth].coarser]
                features = skipped[depth] + coarse
            features = self.up[depth](features, levels[depth], coords[depth])
        pooled = mean_of(features, superpoint)[superpoint]
        return self.classify(gelu(self.mix(torch.cat([features, pooled], dim=1))))


def mean_of(values: Tensor, groups: Tensor) -> Tensor:
    """Return the mean of the values ``(N, F)`` of each group."""
    count = int(groups.max()) + 1
    sums = values.new_zeros(count, values.shape[1]).index_add(0, groups, values)
    return sums / groups.bincount(minlength=count)[:, None]


def predict(model: PointUNet, sample: Sample, variant: Variant, turn: Tensor) -> Tensor:
    """Return the logits of a room transformed by a matrix ``(3, 3)``."""
    coords = [level.coord @ turn.T for level in sample.levels]
    normal = sample.normal @ turn.T / turn[2, 2]
    inputs = torch.cat([normal, 3 * sample.curvature[:, None]], dim=1)  # all within [-1, 1]
    alone = torch.arange(len(normal))
    return model(
        sample.levels,
        coords,
        inputs * variant.normals,
        sample.superpoint if variant.planes else alone,
    )


def train(rooms: Sequence[Sample], variant: Variant, steps: int, seed: int) -> PointUNet:
    """Train a model; each step uses one room rotated about the vertical axis."""
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    model = PointUNet()
    optimizer = torch.optim.AdamW(model.parameters(), weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, LEARNING_RATE, total_steps=steps + 1)
    counts = torch.cat([room.target for room in rooms]).bincount(minlength=len(CLASSES))
    weight = (counts.clamp(min=1) / counts.sum()) ** -0.5
    for step in tqdm(range(steps), leave=False, disable=None):
        if step % len(rooms) == 0:
            order = rng.permutation(len(rooms))
        room = rooms[order[step % len(rooms)]]
        scores = predict(model, room, variant, draw_turn(rng))
        optimizer.zero_grad()
        cross_entropy(scores, room.target, weight).backward()
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        schedule.step()
    return model.eval()


def draw_turn(rng: np.random.Generator) -> Tensor:
    """Return a random rotation about z with a scale of 0.9 to 1.1 and a random reflection."""
    angle, scale = rng.uniform(0, 2 * np.pi), rng.uniform(0.9, 1.1)
    cos, sin, flip = np.cos(angle), np.sin(angle), rng.choice([-1.0, 1.0])
    turn = np.array([[flip * cos, -sin, 0], [flip * sin, cos, 0], [0, 0, 1]])
    return torch.from_numpy(scale * turn).float()


def class_ious(predicted: Sequence[Tensor], ground_truth: Sequence[Tensor]) -> Tensor:
    """Return the intersection over union of each class over all rooms, in percent."""
    size = len(CLASSES)
    pairs = torch.cat(list(ground_truth)) * size + torch.cat(list(predicted))
    counts = pairs.bincount(minlength=size * size).reshape(size, size).double()
    both = counts.diagonal()
    return 100 * both / (counts.sum(dim=0) + counts.sum(dim=1) - both).clamp(min=1)


@torch.no_grad()
def score(model: PointUNet, rooms: Sequence[Sample], variant: Variant) -> Tensor:
    """Return the IoU of each class over all points of the rooms."""
    labels = [predict(model, room, variant, torch.eye(3)).argmax(dim=1) for room in rooms]
    restored = [expand_to_points(of, room.inverse) for of, room in zip(labels, rooms, strict=True)]
    return class_ious(restored, [room.ground_truth for room in rooms])


def score_lookup(train_rooms: Sequence[Scene], test_rooms: Sequence[Scene]) -> Tensor:
    """Return the IoU of each class for a lookup by height and slope."""

    def cells(rooms: Sequence[Scene]) -> tuple[list[Tensor], list[Tensor]]:
        heights = [(room.points[:, 2] * 20).long().clamp(0, 79) for room in rooms]
        slopes = [((room.normals[:, 2] + 1) * 7.999).long() for room in rooms]
        indices = [height * 16 + slope for height, slope in zip(heights, slopes, strict=True)]
        return indices, [classes_of(room) for room in rooms]

    indices, classes = cells(train_rooms)
    votes = torch.zeros(80 * 16, len(CLASSES))
    votes.index_put_((torch.cat(indices), torch.cat(classes)), torch.ones(()), accumulate=True)
    votes *= votes.sum(dim=0).clamp(min=1) ** -0.5  # the weights of the loss
    indices, classes = cells(test_rooms)
    return class_ious([votes.argmax(dim=1)[index] for index in indices], classes)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a table of all variants."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--train-rooms", type=int, default=24)
    parser.add_argument("--test-rooms", type=int, default=12)
    parser.add_argument("--num-points", type=int, default=40_000, help="of each scan")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--only", nargs="+", choices=VARIANTS, default=list(VARIANTS))
    options = parser.parse_args(arguments)
    seeds = [*range(options.train_rooms), *range(TEST_SEED, TEST_SEED + options.test_rooms)]
    scans = [draw_room(seed, options.num_points) for seed in seeds]
    rooms = [prepare(scan) for scan in tqdm(scans, desc="planes", leave=False, disable=None)]
    training, unseen = rooms[: options.train_rooms], rooms[options.train_rooms :]
    print(
        f"{options.train_rooms} rooms, {options.steps} steps; mean IoU (%) on {options.test_rooms} "
        f"unseen rooms, mean and standard deviation of {len(options.seeds)} seeds\n"
    )
    print(f"| input | mean IoU | {' | '.join(CLASSES)} |")
    print(f"| --- |{' --: |' * (len(CLASSES) + 1)}", flush=True)
    for name in options.only:
        variant = VARIANTS[name]
        models = [train(training, variant, options.steps, seed) for seed in options.seeds]
        ious = torch.stack([score(model, unseen, variant) for model in models])
        means = ious.mean(dim=1)
        print_row(name, f"{means.mean():.1f} ± {means.std(correction=0):.1f}", ious.mean(dim=0))
    known = score_lookup(scans[: options.train_rooms], scans[options.train_rooms :])
    print_row("height and ground-truth normal of a point, no model", f"{known.mean():.1f}", known)


def print_row(name: str, mean: str, ious: Tensor) -> None:
    """Print a row of the table immediately."""
    print(f"| {name} | {mean} | {' | '.join(f'{iou:.0f}' for iou in ious)} |", flush=True)


if __name__ == "__main__":
    main()
