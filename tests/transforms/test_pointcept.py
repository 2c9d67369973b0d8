"""The data pipeline of Pointcept itself, unchanged: our entries stay with their points all the way.

What a point's label must be is looked up by its coordinates in a table of the whole room.
"""

import importlib
import os
import random
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from tests.transforms import pointcept_clone
from torchrg.config import load_config
from torchrg.datasets import write_pointcept_scene
from torchrg.errors import MissingDependencyError
from torchrg.pipeline import segment_planes
from torchrg.scenes import make_room

if "TORCHRG_POINTCEPT" not in os.environ:
    pytest.skip(
        "needs TORCHRG_POINTCEPT, a clone of https://github.com/Pointcept/Pointcept (d74c646)",
        allow_module_level=True,
    )

OURS = "torchrg.transforms.pointcept"
SIZES = {"office_1": 2500, "office_2": 2000, "office_3": 1500}
GRID = {"type": "GridSample", "grid_size": 0.1, "mode": "train", "return_grid_coord": True}
CROP = {"type": "SphereCrop", "sample_rate": 0.6, "mode": "random"}
PLANES = {"type": "SegmentPlanes", "config": {"base": "classic", "normals": {"k": 50}}}
KEYS = ("coord", "segment", "plane")
TAIL = [
    {"type": "ToTensor"},
    {"type": "Collect", "keys": KEYS, "feat_keys": ("coord", "normal", "curvature")},
]


@pytest.fixture(scope="module")
def datasets():
    """Pointcept's ``datasets`` with our transforms registered; the test removes it again."""
    folder = Path(os.environ["TORCHRG_POINTCEPT"]).absolute()
    ours = sys.modules.pop(OURS, None)
    imported = pointcept_clone.import_datasets(folder)
    importlib.import_module(OURS)
    yield imported
    for name in [name for name in sys.modules if name.startswith((*pointcept_clone.NAMES, OURS))]:
        if name.startswith("pointcept") or getattr(sys.modules[name], "__file__", None) is None:
            del sys.modules[name]
    sys.path.remove(str(folder))
    sys.modules.pop(OURS, None)
    if ours is not None:
        sys.modules[OURS] = ours


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Three rooms as ``torchrg convert s3dis`` writes them; ``segment`` is the row of a point."""
    root = tmp_path_factory.mktemp("OUT")
    for seed, (name, size) in enumerate(SIZES.items()):
        room = make_room(size, 0.003, seed)
        sample = {
            "coord": room.points,
            "color": torch.zeros(size, 3, dtype=torch.uint8),
            "segment": torch.arange(size),
        }
        seg = segment_planes(room.points, load_config("classic"))
        write_pointcept_scene(root / "Area_1" / name, sample, seg)
    return root


@pytest.fixture(autouse=True)
def seeds():
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002 - what Pointcept draws from


def written(root, name, array):
    return np.load(root / "Area_1" / name / f"{array}.npy")


def room_of(root, sample):
    """Return the room that a sample is of, by the coordinates of its first point."""
    first = np.asarray(sample["coord"][0])
    row = int(sample["segment"][0])
    return next(
        name
        for name, size in SIZES.items()
        if row < size and np.array_equal(written(root, name, "coord")[row], first)
    )


def build(datasets, root, steps, **more):
    config = {"type": "DefaultDataset", "split": "Area_1", "data_root": str(root)}
    return datasets.build_dataset({**config, "transform": steps, **more})


@pytest.mark.parametrize(
    "steps", [[PLANES, GRID, CROP], [PLANES, CROP, GRID], [GRID, CROP]], ids=["fly", "fly2", "file"]
)
def test_labels_of_a_room_stay_with_their_points(datasets, root, steps):
    data = build(datasets, root, steps + TAIL)
    for i in range(len(data)):
        sample = data[i]
        name, rows = room_of(root, sample), sample["segment"]
        assert 100 < len(rows) < 0.7 * SIZES[name]
        assert {len(sample[key]) for key in (*KEYS, "feat")} == {len(rows)}
        assert sample["plane"].tolist() == written(root, name, "plane")[rows].tolist()
        features = ("coord", "normal", "curvature")
        expected = np.hstack([written(root, name, key)[rows] for key in features])
        assert np.array_equal(sample["feat"], expected)


def test_labels_of_what_is_left_of_a_room_are_those_of_its_points(datasets, root):
    sample = build(datasets, root, [GRID, CROP, PLANES, CROP, *TAIL[:1]])[0]
    before = build(datasets, root, [GRID, CROP])
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002
    left = before[0]
    seg = segment_planes(torch.from_numpy(left["coord"]), load_config("classic"))
    place = {row: i for i, row in enumerate(left["segment"].tolist())}
    rows = [place[row] for row in sample["segment"].tolist()]
    assert len(rows) == int(0.6 * len(left["coord"]))
    assert sample["plane"].tolist() == seg.labels[rows].tolist()
    assert torch.equal(sample["curvature"], seg.curvature[rows][:, None])
    assert torch.equal(sample["normal"], seg.normals[rows])


@pytest.mark.parametrize("kind", [list, tuple])
def test_a_list_in_the_config_is_used_and_not_changed(datasets, root, kind):
    names = kind(["coord", "segment"])
    update = {"type": "Update", "keys_dict": {"index_valid_keys": names}}
    drop = {"type": "Update", "keys_dict": {"color": None, "instance": None}}
    for order in ([drop, update, PLANES, CROP], [drop, PLANES, update, CROP]):
        data = build(datasets, root, order)
        for i in (0, 1, 0):
            sample = data[i]
            assert sample["plane"].shape == sample["segment"].shape
            assert sample["curvature"].shape == (len(sample["coord"]), 1)
    assert names == kind(["coord", "segment"])


def test_what_a_data_set_adds_stays_with_its_points_too(datasets, root):
    transforms = sys.modules["pointcept.datasets.transform"].TRANSFORMS
    sample = build(datasets, root, [])[0]
    sample["row"] = np.stack([sample["segment"]] * 2, axis=1)
    sample["origin_segment"] = whole = sample["segment"]
    for step in (PLANES, GRID, CROP):
        sample = transforms.build(step)(sample)
    assert sample["row"][:, 1].tolist() == sample["segment"].tolist()
    assert sample["origin_segment"] is whole


class Halves:
    """A crop for the test path that gives several parts of a fragment, as Pointcept asks."""

    def __call__(self, fragment):
        take = sys.modules["pointcept.datasets.transform"].index_operator
        rows = np.arange(len(fragment["coord"]))
        parts = [take(fragment, half, duplicate=True) for half in np.array_split(rows, 2)]
        for part, half in zip(parts, np.array_split(rows, 2), strict=True):
            part["index"] = fragment["index"][half]
        return parts


@pytest.mark.parametrize("crop", [None, {"type": "Halves"}], ids=["whole", "halves"])
@pytest.mark.parametrize("planes", [[], [PLANES]], ids=["file", "fly"])
def test_fragments_of_the_test_path_are_in_step(datasets, root, crop, planes):
    registry = sys.modules["pointcept.datasets.transform"].TRANSFORMS
    registry.register_module(module=Halves, force=True)
    keys = ("coord", "grid_coord", "index", "plane", "segment_of")
    test_cfg = SimpleNamespace(
        voxelize={**GRID, "mode": "test", "grid_size": 0.2},
        crop=crop,
        post_transform=[
            {"type": "ToTensor"},
            {"type": "Collect", "keys": keys, "feat_keys": ("coord", "normal", "curvature")},
        ],
        aug_transform=[[], [{"type": "RandomFlip", "p": 1.0}]],
    )
    steps = [
        *planes,
        {"type": "Copy", "keys_dict": {"segment": "origin_segment"}},
        {"type": "GridSample", "grid_size": 0.1, "mode": "train", "return_inverse": True},
        {"type": "Copy", "keys_dict": {"segment": "segment_of"}},
        {"type": "Update", "keys_dict": {"index_valid_keys": ["coord", "normal", "segment_of"]}},
    ]
    result = build(datasets, root, steps, test_mode=True, test_cfg=test_cfg)[0]
    name = "office_1" if len(result["origin_segment"]) == SIZES["office_1"] else None
    name = name or {size: name for name, size in SIZES.items()}[len(result["origin_segment"])]
    assert result["origin_segment"].tolist() == list(range(SIZES[name]))
    assert len(result["inverse"]) == SIZES[name]
    labels = written(root, name, "plane")
    seen = np.zeros(len(result["segment"]), dtype=int)
    for part in result["fragment_list"]:
        rows = result["segment"][part["index"]]
        assert part["segment_of"].tolist() == rows.tolist()
        assert part["plane"].tolist() == labels[rows].tolist()
        assert part["feat"].shape == (len(rows), 7)
        seen[part["index"]] += 1
    assert (seen >= 2).all()


def test_transforms_of_ours_take_points_out_of_fragments(datasets, root):
    keys = ("coord", "index", "plane", "inverse")
    test_cfg = SimpleNamespace(
        voxelize={**GRID, "mode": "test"},
        crop=None,
        post_transform=[
            {"type": "SampleVoxels", "size": 0.4},
            {"type": "ToTensor"},
            {"type": "Collect", "keys": keys, "feat_keys": ("curvature",)},
        ],
        aug_transform=[[]],
    )
    result = build(datasets, root, [PLANES], test_mode=True, test_cfg=test_cfg)[0]
    rows_of_fragment = result["segment"]
    for part in result["fragment_list"]:
        labels = {2500: "office_1", 2000: "office_2", 1500: "office_3"}[len(rows_of_fragment)]
        expected = written(root, labels, "plane")[part["index"]]
        assert part["plane"].tolist() == expected.tolist()
        assert len(part["feat"]) == len(part["coord"]) == int(part["inverse"].max()) + 1


def test_joined_data_sets_and_forked_workers_give_what_one_process_gives(datasets, root):
    scenes = {"type": "DefaultDataset", "split": "Area_1", "data_root": str(root)}
    parts = [{**scenes, "transform": [PLANES, *TAIL]}, {**scenes, "transform": TAIL}]
    data = datasets.build_dataset({"type": "ConcatDataset", "datasets": parts})
    expected = [data[i] for i in range(len(data))]
    assert len(expected) == 6
    for made, read in zip(expected[:3], expected[3:], strict=True):
        assert all(torch.equal(made[key], read[key]) for key in made)
    loader = DataLoader(
        data,
        batch_size=2,
        num_workers=2,
        multiprocessing_context="fork",
        collate_fn=partial(datasets.point_collate_fn, mix_prob=0),
    )
    for i, batch in enumerate(loader):
        for key in ("coord", "plane", "feat"):
            pair = [sample[key] for sample in expected[2 * i : 2 * i + 2]]
            assert torch.equal(batch[key], torch.cat(pair))


@pytest.mark.parametrize("num_rooms", [1, 2, 3])
def test_mixed_rooms_keep_planes_of_their_own(datasets, root, num_rooms):
    data = build(datasets, root, [PLANES, *TAIL])
    samples = [data[i] for i in range(num_rooms)]
    samples = [{**sample, "superpoint": sample["plane"].clone()} for sample in samples]
    plain = datasets.point_collate_fn(samples, mix_prob=0)
    mixed = datasets.point_collate_fn(samples, mix_prob=1)
    assert torch.equal(plain["plane"], torch.cat([sample["plane"] for sample in samples]))
    assert len(mixed["offset"]) == (num_rooms + 1) // 2
    assert torch.equal(mixed["coord"], plain["coord"])
    expected = [sample["plane"].tolist() for sample in samples]
    for first, second in zip(expected[::2], expected[1::2], strict=False):
        second[:] = [label if label < 0 else label + max(first) + 1 for label in second]
    assert mixed["plane"].tolist() == [label for labels in expected for label in labels]
    assert torch.equal(mixed["superpoint"], mixed["plane"])


def test_every_data_set_loads_our_files_and_importing_again_changes_nothing(datasets):
    before = datasets.ScanNetPPDataset.VALID_ASSETS
    assert {"plane", "curvature", "superpoint"} <= set(before) & set(
        datasets.S3DISDataset.VALID_ASSETS
    )
    importlib.reload(sys.modules[OURS])
    assert before == datasets.ScanNetPPDataset.VALID_ASSETS
    sample = {"coord": np.zeros((30, 3)), "plane": np.arange(30)}
    operator = sys.modules["pointcept.datasets.transform"].index_operator
    assert operator(sample, np.arange(5))["plane"].tolist() == list(range(5))


def test_a_pointcept_without_the_function_is_named(datasets, monkeypatch):
    monkeypatch.delattr(sys.modules["pointcept.datasets.transform"], "index_operator")
    with pytest.raises(MissingDependencyError, match="expected a Pointcept version with"):
        importlib.reload(sys.modules[OURS])
    monkeypatch.undo()
    importlib.reload(sys.modules[OURS])
