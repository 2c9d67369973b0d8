"""Classes of planes in rooms whose floors, ceilings and walls are known, and in a real scan."""

import gc
import math
import pickle
import warnings
import weakref
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.made import make_storey
from torchrg import segment_planes
from torchrg.batch.memory import peak_memory, reset_peak_memory
from torchrg.io.result import read_result
from torchrg.regions import classes as module
from torchrg.regions import summarize_planes
from torchrg.regions.classes import _find_slabs, classify_planes
from torchrg.scenes import RoomLayout, make_room
from torchrg.structures import PLANE_KINDS

SHELL = ("floor", "ceiling", "wall")
SPACING = 0.08
UP = torch.tensor([0.0, 0, 1])


def surface(kind, corner, first, second, spacing=SPACING):
    """A parallelogram: what it is, its points, and its normal."""
    corner, first, second = (np.array(vector, dtype=float) for vector in (corner, first, second))
    steps = [np.linspace(0, 1, int(np.linalg.norm(side) / spacing) + 2) for side in (first, second)]
    a, b = (values.reshape(-1, 1) for values in np.meshgrid(*steps))
    normal = np.cross(first, second)
    return kind, corner + a * first + b * second, normal / np.linalg.norm(normal)


def box(corner, size, names, leave_out=()):
    """Six sides: bottom, top and four upright ones, named by ``names``."""
    (x, y, z), (length, width, height) = corner, size
    along, across, up = (length, 0, 0), (0, width, 0), (0, 0, height)
    sides = [
        surface(names[0], (x, y, z), along, across),
        surface(names[1], (x, y, z + height), along, across),
        surface(names[2], (x, y, z), along, up),
        surface(names[2], (x, y + width, z), along, up),
        surface(names[2], (x, y, z), across, up),
        surface(names[2], (x + length, y, z), across, up),
    ]
    return [side for side in sides if side[0] not in leave_out]


def room(corner, size, leave_out=()):
    """A room with a cabinet and a bed at its walls, and a table."""
    x, y, z = corner
    middle = (x + size[0] / 2 - 0.8, y + size[1] / 2 - 0.4, z + 0.75)
    return [
        *box(corner, size, SHELL, leave_out),
        *box((x + 0.1, y + 0.1, z), (1.2, 0.6, 2.0), ["", "cabinet", "cabinet"], [""]),
        *box((x + size[0] - 2.1, y + 0.1, z), (2.0, 1.8, 0.5), ["", "bed", "bed"], [""]),
        surface("table", middle, (1.6, 0, 0), (0, 0.8, 0)),
    ]


def assemble(surfaces):
    """Points, normals, labels and the names of the labels."""
    points = [torch.from_numpy(points) for _, points, _ in surfaces]
    sizes = torch.tensor([len(part) for part in points])
    normals = torch.tensor(np.array([normal for _, _, normal in surfaces]))
    labels = torch.arange(len(points)).repeat_interleave(sizes)
    return torch.cat(points), normals[labels], labels, [name for name, _, _ in surfaces]


def joined(*clouds):
    """Clouds of one frame as one, from points, normals, labels and names of labels."""
    points, normals, labels, names = zip(*clouds, strict=True)
    starts = np.cumsum([0, *map(len, names)])
    labels = [
        torch.where(part < 0, -1, part + start) for part, start in zip(labels, starts, strict=False)
    ]
    return (
        torch.cat(points),
        torch.cat(normals),
        torch.cat(labels),
        [name for part in names for name in part],
    )


def of_scene(scene, shift=(0.0, 0.0, 0.0), leave_out=()):
    """A made room: its points, normals, labels and the names of the labels."""
    is_kept = torch.tensor([kind not in leave_out for kind in scene.kinds])[scene.labels]
    faces, labels = torch.unique(scene.labels[is_kept], return_inverse=True)
    points = scene.points[is_kept].double() + torch.tensor(shift).double()
    names = [scene.kinds[face] for face in faces]
    return points, scene.normals[is_kept].double(), labels, names


def classes(cloud, up="z"):
    points, normals, labels, _ = cloud
    return [PLANE_KINDS[kind] for kind in summarize_planes(points, normals, labels, up=up).kind]


def shell(names):
    """Names of floors, ceilings and walls, and None of all others."""
    return [name if name in SHELL else None for name in names]


def in_room(part):
    """A room of 5 by 4 by 3 meters, without two of its walls, and a part."""
    return assemble(
        [
            surface("floor", (0, 0, 0), (5, 0, 0), (0, 4, 0)),
            surface("ceiling", (0, 0, 3), (5, 0, 0), (0, 4, 0)),
            surface("wall", (0, 0, 0), (5, 0, 0), (0, 0, 3)),
            surface("wall", (0, 0, 0), (0, 4, 0), (0, 0, 3)),
            part,
        ]
    )


def lying(sides, height, tilt_deg=0.0):
    """A rectangle across the room, its middle at a height."""
    tilt = math.radians(tilt_deg)
    second = sides[1] * np.array([0, math.cos(tilt), math.sin(tilt)])
    return surface("", np.array([1, 2, height]) - second / 2, (sides[0], 0, 0), second)


def standing(width, bottom, top, tilt_deg=0.0):
    """A rectangle that stands in the room, turned about its lower side."""
    tilt = math.radians(tilt_deg)
    second = (top - bottom) * np.array([0, math.sin(tilt), math.cos(tilt)])
    return surface("", (2, 2, bottom), (width, 0, 0), second)


@pytest.mark.parametrize(
    ("part", "expected"),
    [
        (lying((3, 3), 1, tilt_deg=14), "horizontal"),
        (lying((3, 3), 1, tilt_deg=16), "oblique"),
        (standing(1, 0, 1, tilt_deg=14), "vertical"),
        (standing(1, 0, 1, tilt_deg=16), "oblique"),
        (lying((3, 3), 0.35), "floor"),
        (lying((3, 3), 0.55), "horizontal"),
        (lying((3, 3), 2.65), "ceiling"),
        (lying((3, 3), 2.45), "horizontal"),
        (lying((1.2, 0.85), 0.2), "floor"),
        (lying((1.2, 0.65), 0.2), "horizontal"),
        (lying((3, 0.65), 2.8), "ceiling"),
        (lying((3, 0.55), 2.8), "horizontal"),
        (standing(1, 1.85, 3), "wall"),
        (standing(1, 2.15, 3), "vertical"),
        (standing(0.65, 0, 3), "wall"),
        (standing(0.55, 0, 3), "vertical"),
        (standing(1, 0, 2.8), "wall"),
        (standing(1, 0, 2.6), "vertical"),
        (standing(2.6, 0, 1.65), "wall"),
        (standing(2.6, 0, 1.35), "vertical"),
        (standing(3, 0, 1.35), "vertical"),
        (standing(1.65, 0, 2.5), "wall"),
        (standing(1.35, 0, 2.5), "vertical"),
    ],
)
def test_classes_end_where_the_documentation_says(part, expected):
    assert classes(in_room(part)) == ["floor", "ceiling", "wall", "wall", expected]


@pytest.mark.parametrize(("bend", "expected"), [(0.019, "wall"), (0.021, "other")])
def test_a_wall_may_bend_a_little(bend, expected):
    points, normals, labels, _ = in_room(standing(2, 0, 3))
    planes = summarize_planes(points, normals, labels)
    is_last = torch.arange(5) == 4
    rms = torch.where(is_last, 2 * bend, planes.rms)
    kind = classify_planes(replace(planes, rms=rms, curved=is_last), points, labels, UP)
    assert PLANE_KINDS[kind[4]] == expected


@pytest.mark.parametrize("seed", range(3))
def test_shells_of_made_rooms(seed):
    cloud = of_scene(make_room(num_points=6000, noise=0.003, seed=seed))
    found = classes(cloud)
    assert shell(found) == shell(cloud[3])
    assert {a for a, b in zip(found, cloud[3], strict=True) if b in ("table top", "shelf")} == {
        "horizontal"
    }
    assert "vertical" in {a for a, b in zip(found, cloud[3], strict=True) if b == "cabinet"}


HALL = RoomLayout(size=(20.0, 12.0, 5.0), num_tables=12, num_windows=0)
SMALL = RoomLayout(
    size=(5.5, 4.5, 2.5), num_tables=2, num_boxes=1, num_small_boxes=1, num_windows=1, num_pillars=0
)
CLOUDS = {
    "one room": lambda: assemble(room((0, 0, 0), (5, 4, 2.6))),
    "no ceiling": lambda: assemble(room((0, 0, 0), (5, 4, 2.6), ["ceiling"])),
    "no floor": lambda: assemble(room((0, 0, 0), (5, 4, 2.6), ["floor"])),
    "walls only": lambda: assemble(room((0, 0, 0), (5, 4, 2.6), ["floor", "ceiling"])),
    "large, no ceiling": lambda: assemble(room((0, 0, 0), (12, 9, 2.6), ["ceiling"])),
    "floors at two heights": lambda: assemble(
        [*room((0, 0, 0), (5, 4, 3.0)), *room((5.1, 0, 0.5), (4, 4, 2.5))]
    ),
    "rooms of other heights, one floor": lambda: assemble(
        [
            surface("floor", (0, 0, 0), (10, 0, 0), (0, 8, 0)),
            *room((0, 0, 0), (6, 5, 2.6), ["floor"]),
            *room((6.1, 0, 0), (3.9, 5, 2.6), ["floor"]),
            *box((0, 5.1, 0), (1.6, 1.8, 2.3), SHELL, ["floor"]),
            *box((1.7, 5.1, 0), (8.3, 2.9, 2.4), SHELL, ["floor"]),
        ]
    ),
    "ceiling that slopes": lambda: assemble(
        [
            *box((0, 0, 0), (6, 8, 2.5), SHELL, ["ceiling"]),
            surface("ceiling", (0, 0, 2.5), (6, 0, 0), (0, 8, 8 * math.tan(math.radians(10)))),
            surface("table", (2, 3, 0.75), (1.6, 0, 0), (0, 0.8, 0)),
        ]
    ),
    "storey": lambda: of_scene(make_storey(24_000)),
    "two storeys": lambda: joined(
        of_scene(make_storey(24_000)), of_scene(make_storey(24_000, seed=1), (0, 0, 3.1))
    ),
    "thin slab": lambda: joined(
        of_scene(make_room(5000)), of_scene(make_room(5000, seed=1), (0, 0, 2.95))
    ),
    "storeys without ceilings": lambda: joined(
        *(of_scene(make_room(5000, seed=n), (0, 0, 3.1 * n), ["ceiling"]) for n in range(3))
    ),
    "storeys without floors": lambda: joined(
        *(of_scene(make_room(5000, seed=n), (0, 0, 3.1 * n), ["floor"]) for n in range(2))
    ),
    "rooms 1.5 m apart in height": lambda: joined(
        of_scene(make_room(5000)), of_scene(make_room(5000, seed=1), (9.3, 0, 1.5))
    ),
    "hall and small rooms": lambda: joined(
        of_scene(make_room(15_000, layout=HALL)),
        of_scene(make_room(5000, layout=SMALL, seed=1), (20.3, 0, 0)),
        of_scene(make_room(5000, layout=SMALL, seed=2), (20.3, 5, 0)),
    ),
}


@pytest.mark.parametrize("name", CLOUDS)
def test_floors_ceilings_and_walls_of_several_rooms(name):
    cloud = CLOUDS[name]()
    areas = summarize_planes(*cloud[:3]).area
    wrong = [a != b for a, b in zip(shell(classes(cloud)), shell(cloud[3]), strict=True)]
    is_shell = torch.tensor([name in SHELL for name in cloud[3]])
    # The windows and cabinets of a hall are as large as walls of small rooms.
    assert areas[torch.tensor(wrong)].sum() <= 0.02 * areas[is_shell].sum()


def outside():
    """What a scanner sees through windows: a facade, the street, and mirrored planes."""
    return assemble(
        [
            surface("facade", (-10, 20, -6), (30, 0, 0), (0, 0, 19), spacing=0.4),
            surface("street", (-10, 8, -6), (30, 0, 0), (0, 9, 0), spacing=0.4),
            surface("mirrored", (1, -0.2, -1.6), (1.5, 0, 0), (0, 0, 1)),
            surface("mirrored", (2, 1, -2.5), (1, 0, 0), (0, 0.5, 0)),
        ]
    )


def test_the_outside_decides_nothing():
    inside = CLOUDS["one room"]()
    expected = classes(inside)
    assert shell(expected) == shell(inside[3])
    points = torch.tensor([[1.0, 1, 50], [1, 1, -30], [500, 2, 2]]).double()
    outliers = points, torch.zeros(3, 3).double(), torch.full((3,), -1), []
    found = classes(joined(inside, outside(), outliers))
    assert found[: len(expected)] == expected


def test_order_density_copies_units_and_axes_decide_nothing():
    cloud = CLOUDS["floors at two heights"]()
    points, normals, labels, names = cloud
    expected = classes(cloud)
    generator = torch.Generator().manual_seed(0)
    order = torch.randperm(len(points), generator=generator)
    near = (points - torch.tensor([2.0, 2, 1])).norm(dim=1) < 2
    crowd = points[near].repeat(20, 1) + 1e-4 * torch.randn(
        20 * int(near.sum()), 3, generator=generator
    )
    crowded = crowd, normals[near].repeat(20, 1), labels[near].repeat(20), names
    for rows in (order, torch.cat([order, order[:5000]])):
        assert classes((points[rows], normals[rows], labels[rows], names)) == expected
    dense = (torch.cat(pair) for pair in zip(cloud[:3], crowded[:3], strict=True))
    assert classes((*dense, names)) == expected
    for unit, shift in ((1000.0, 0), (0.003, 0), (1.0, 5e5)):
        assert classes((points * unit + shift, normals, labels, names)) == expected
    for up, turn in (("x", [2, 0, 1]), ("y", [1, 2, 0])):
        assert classes((points[:, turn], normals[:, turn], labels, names), up) == expected
    assert classes((-points, -normals, labels, names), "-z") == expected


@pytest.mark.parametrize("tilt_deg", [0.5, 3.0])
def test_storeys_that_lean_a_little(tilt_deg):
    cloud = CLOUDS["thin slab"]()
    up = (math.sin(math.radians(tilt_deg)), 0, math.cos(math.radians(tilt_deg)))
    assert shell(classes(cloud, up)) == shell(cloud[3])


def test_clouds_without_walls_or_without_points():
    floor = surface("floor", (0, 0, 0), (3, 0, 0), (0, 2, 0))
    assert classes(assemble([floor])) == ["floor"]
    ceiling = surface("ceiling", (0, 0, 2.6), (3, 0, 0), (0, 2, 0))
    assert classes(assemble([floor, ceiling])) == ["floor", "ceiling"]
    nothing = torch.zeros(0, 3).double()
    assert classes((nothing, nothing, torch.zeros(0, dtype=torch.int64), [])) == []
    one = torch.tensor([[1.0, 2, 3]]).double()
    assert len(classes((one, torch.eye(3)[:1].double(), torch.zeros(1).long(), []))) == 1


def test_a_real_room_has_a_ceiling_a_floor_and_nine_walls(scan, run, tmp_path):
    path = tmp_path / "planes.npz"
    run("segment", scan("room_scan1.pcd"), "--out", path, "--up", "z")
    planes = read_result(path).planes
    kinds = [plane.kind for plane in planes]
    assert {kinds[row] for row in planes.area.topk(2).indices.tolist()} == {"floor", "ceiling"}
    assert planes.area[torch.tensor([kind == "floor" for kind in kinds])].sum() > 20
    assert kinds.count("wall") >= 9
    # Of what is not high or not wide in the scan, nothing is a ceiling or a wall.
    for plane in planes:
        if plane.kind == "ceiling":
            assert plane.center[2] > 1
        if plane.kind in SHELL:
            assert plane.area > 0.5


@pytest.mark.parametrize(
    ("gap", "level", "slabs"),
    [
        ((48, 57), 47, [52.5]),  # 6 of 10 walls end below a slab of 9 voxels, next to a ceiling
        ((48, 57), 58, [52.5]),  # next to a floor
        ((48, 57), 30, []),  # a table
        ((48, 57), None, []),  # a band of windows
        ((48, 72), 47, []),  # a hall between galleries
    ],
)
def test_slabs_are_thin_gaps_of_walls_beside_a_broad_plane(gap, level, slabs):
    bottom, top = torch.tensor([0.0, gap[1]]), torch.tensor([gap[0] - 1.0, gap[1] + 47])
    levels = torch.tensor([] if level is None else [float(level)])
    found = _find_slabs(bottom, top, torch.full((2,), 100.0), levels)
    assert found.tolist() == slabs


def heights_by_counting(voxels):
    """The heights of the room around each column (story, x, y) of voxels (story, x, y, z).

    Voxel by voxel, as the constants of the module say: the neighborhood is two columns wide on each
    side, 2 % of its voxels may lie outside, and columns double until the room is 24 voxels high.
    """
    found, scale = {}, 1
    while True:
        around = {}
        for story, x, y, z in voxels:
            for a in range(-2, 3):
                for b in range(-2, 3):
                    key = story, x // scale + a, y // scale + b
                    around.setdefault(key, Counter())[z] += 1
        for story, x, y in {voxel[:3] for voxel in voxels}:
            low, high = found.get((story, x, y), (0, 0))
            if high - low < 24:
                held = sorted(around[story, x // scale, y // scale].elements())
                # The smallest heights with more than 2 % at or below, and with at least 98 %.
                num_outside = 0.02 * len(held)
                low = held[math.floor(num_outside)]
                high = held[math.ceil(len(held) - num_outside) - 1]
                found[story, x, y] = low, high
        is_one = len({(s, x // scale, y // scale) for s, x, y, _ in voxels}) == len(
            {voxel[0] for voxel in voxels}
        )
        if is_one or all(high - low >= 24 for low, high in found.values()):
            return found
        scale *= 2


@pytest.mark.parametrize("at_once", [2**18, 30])
@pytest.mark.parametrize("seed", range(4))
def test_heights_of_rooms_are_those_of_counting(monkeypatch, seed, at_once):
    monkeypatch.setattr(module, "_VOXELS_AT_ONCE", at_once)
    rng = np.random.default_rng(seed)
    sides = [rng.integers(1, 4), *rng.choice([3, 20, 2000], 2), rng.choice([5, 30, 300])]
    voxels = np.unique(rng.integers(0, sides, (rng.integers(1, 400), 4)), axis=0)
    bits = 20
    keys = torch.from_numpy((voxels[:, 0] << 2 * bits) | (voxels[:, 1] << bits) | voxels[:, 2])
    columns, column = torch.unique(keys, return_inverse=True)
    low, high = module._room_heights(columns, column, torch.from_numpy(voxels[:, 3]))
    expected = heights_by_counting([tuple(voxel) for voxel in voxels.tolist()])
    for row, key in zip(*np.unique(column, return_index=True), strict=True):
        assert expected[tuple(voxels[key, :3].tolist())] == (low[row], high[row])


def test_memory_does_not_depend_on_the_extent():
    # Every point is a column and a level of its own: a table of both has 64 million entries.
    positions = np.random.default_rng(0).uniform(0, 500, (8000, 3))
    cloud = joined(
        assemble([("slope", positions, np.array([0, 0.6, 0.8]))]),
        assemble([surface("wall", (0, 0, 0), (2, 0, 0), (0, 0, 1))]),
    )
    classes(cloud)
    reset_peak_memory()
    before = peak_memory()
    classes(cloud)
    assert peak_memory() - before < 1e8


def test_classes_in_parts(monkeypatch):
    points, normals, labels, names = assemble(room((0, 0, 0), (5, 4, 3)))
    labels[::7] = -1
    expected = classes((points, normals, labels, names))
    monkeypatch.setattr(module, "_POINTS_AT_ONCE", 1000)
    assert classes((points, normals, labels, names)) == expected


def test_points_are_held_no_longer_than_needed():
    points = make_room(4000, noise=0.003, seed=0).points
    planes, held = segment_planes(points, "classic").planes, weakref.ref(points)
    del points
    assert len(pickle.dumps(planes)) < 8000
    gc.collect()
    assert held() is None


def test_another_axis_that_is_up_is_told():
    points = make_room(4000, noise=0.003, seed=0).points
    turned = torch.stack([points[:, 0], points[:, 2], -points[:, 1]], dim=1)
    yawed = turned @ torch.tensor([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]])
    with pytest.warns(UserWarning, match=r"largest floor and ceiling face y.*--up y .*up='y'"):
        assert segment_planes(turned, "classic").planes.kind is not None
    with pytest.warns(UserWarning, match="face y"):
        assert segment_planes(yawed, "classic").planes.kind is not None
    with pytest.warns(UserWarning, match="face z"):
        segment_planes(points, "classic", **{"planes.up": "y"})


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("size", [(6, 5, 2.7), (2, 12, 3), (12, 2.2, 2.5)])
def test_rooms_and_corridors_with_z_up_are_not_told(seed, size):
    generator = torch.Generator().manual_seed(seed)
    points, faces = torch.rand(12_000, 3, generator=generator), torch.tensor([*size]).double()
    areas = faces.prod() / faces
    face = torch.multinomial(areas.repeat(2), len(points), True, generator=generator)
    points[torch.arange(len(points)), face % 3] = (face // 3).float()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert segment_planes(points * faces.float(), "classic").planes.kind is not None
