"""Scene folders have Pointcept's types, and those of others are completed, never changed."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.datasets.s3dis_tree import digest
from torchrg.config import load_config
from torchrg.datasets import read_pointcept_scene, write_pointcept_scene
from torchrg.errors import FormatError
from torchrg.io.result import describe_planes
from torchrg.pipeline import segment_planes
from torchrg.scenes import make_room

CLASSIC = load_config("classic")


@pytest.fixture(scope="module")
def sample():
    room = make_room(3000, 0.002, 4)
    return {
        "coord": room.points,
        "color": torch.randint(0, 256, (3000, 3), dtype=torch.uint8),
        "segment": torch.arange(3000) % 13,
        "instance": room.labels,
        "name": "Area_1/office_1",
    }


@pytest.fixture(scope="module")
def seg(sample):
    return segment_planes(sample["coord"], CLASSIC)


@pytest.fixture
def foreign(sample, tmp_path):
    """A folder as Pointcept writes it."""
    folder = tmp_path / "processed" / "Area_1" / "office_1"
    folder.mkdir(parents=True)
    np.save(folder / "coord.npy", sample["coord"].numpy())
    np.save(folder / "color.npy", sample["color"].numpy())
    np.save(folder / "normal.npy", np.full((3000, 3), 0.5, np.float32))
    np.save(folder / "segment.npy", sample["segment"].numpy().astype(np.int16)[:, None])
    np.save(folder / "instance.npy", sample["instance"].numpy().astype(np.int16)[:, None])
    return folder


def test_types_and_shapes_are_pointcepts(sample, seg, tmp_path):
    folder = tmp_path / "Area_1" / "office_1"
    written = write_pointcept_scene(folder, sample, seg, superpoint=seg.labels)
    expected = {
        "coord": ("<f4", (3000, 3)),
        "color": ("|u1", (3000, 3)),
        "normal": ("<f4", (3000, 3)),
        "segment": ("<i2", (3000, 1)),
        "instance": ("<i2", (3000, 1)),
        "superpoint": ("<i4", (3000,)),
        "plane": ("<i4", (3000,)),
        "curvature": ("<f4", (3000, 1)),
    }
    found = {name: np.load(folder / f"{name}.npy", allow_pickle=False) for name in expected}
    assert {name: (a.dtype.str, a.shape) for name, a in found.items()} == expected
    assert sorted(written) == sorted([*(f"{name}.npy" for name in expected), "planes.json"])
    assert sorted(path.name for path in folder.iterdir()) == sorted([*written, "provenance.json"])
    assert np.array_equal(found["coord"], sample["coord"])
    assert np.array_equal(found["plane"], seg.labels)
    assert np.array_equal(found["superpoint"], seg.labels)
    assert np.array_equal(found["normal"], seg.normals)
    assert np.array_equal(found["instance"][:, 0], sample["instance"])


def test_a_scene_reads_as_it_was_written(sample, seg, tmp_path):
    write_pointcept_scene(tmp_path, sample, seg)
    found = read_pointcept_scene(tmp_path)
    for name in ("coord", "color", "segment", "instance"):
        assert found[name].dtype == sample[name].dtype
        assert torch.equal(found[name], sample[name])
    assert torch.equal(found["plane"], seg.labels)
    assert torch.equal(found["curvature"], seg.curvature)


def test_labels_keep_their_values_in_the_least_type_that_holds_them(sample, seg, tmp_path):
    for largest, dtype in ((2**15 - 1, "<i2"), (2**15, "<i4")):
        instance = torch.arange(3000) - 2999 + largest
        write_pointcept_scene(tmp_path, {**sample, "instance": instance}, seg)
        assert np.load(tmp_path / "instance.npy").dtype.str == dtype
        assert torch.equal(read_pointcept_scene(tmp_path)["instance"], instance)
    # With labels of ScanNet, objects have its type.
    scannet = {**sample, "segment20": sample["segment"], "instance": instance}
    write_pointcept_scene(tmp_path, scannet, seg)
    assert np.load(tmp_path / "instance.npy").dtype.str == "<i8"
    assert torch.equal(read_pointcept_scene(tmp_path)["instance"], instance)


def test_of_several_labels_the_first_counts(tmp_path):
    np.save(tmp_path / "coord.npy", np.eye(3, dtype=np.float32))
    np.save(tmp_path / "segment.npy", np.array([[4, 1, -1], [5, -1, -1], [6, 2, 3]], np.int16))
    assert read_pointcept_scene(tmp_path)["segment"].tolist() == [4, 5, 6]


def test_the_table_describes_the_labels(sample, seg, tmp_path):
    write_pointcept_scene(tmp_path, sample, seg)
    table = json.loads((tmp_path / "planes.json").read_text())
    labels = np.load(tmp_path / "plane.npy")
    assert len(table["planes"]) == labels.max() + 1 > 5
    for row in table["planes"]:
        points = sample["coord"].double().numpy()[labels == row["id"]]
        assert row["count"] == len(points)
        assert np.allclose(points.mean(axis=0), row["centroid"], atol=1e-5)
        distances = points @ np.array(row["normal"]) - row["offset"]
        assert np.sqrt((distances**2).mean()) == pytest.approx(row["rms"], rel=1e-2)


def test_optional_columns_are_described(sample):
    config = load_config("classic")
    seg = segment_planes(sample["coord"], config)
    bare = replace(seg.planes, kind=None, outline=None, adjacency=None)
    assert set(describe_planes(bare)) == {"unit", "planes"}
    assert not {"kind", "outline"} & set(describe_planes(bare)["planes"][0])
    ring = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    full = replace(
        bare,
        kind=torch.ones(len(seg.planes), dtype=torch.int64),
        outline=tuple((ring,) for _ in seg.planes.count),
    )
    row = describe_planes(full, origin=[1, 1, 1])["planes"][0]
    assert row["kind"] == "floor"
    assert row["outline"] == [[[1, 1, 1], [2, 1, 1], [1, 2, 1]]]


def test_a_folder_of_pointcept_is_completed_and_not_changed(foreign):
    before = {path.name: path.read_bytes() for path in foreign.iterdir()}
    found = read_pointcept_scene(foreign)
    seg = segment_planes(found["coord"], CLASSIC)
    for superpoint in (seg.labels, None, seg.labels):
        written = write_pointcept_scene(foreign, found, seg, superpoint=superpoint)
        extra = ["superpoint.npy"] if superpoint is not None else []
        assert sorted(written) == sorted(["curvature.npy", "plane.npy", "planes.json", *extra])
        assert {name: (foreign / name).read_bytes() for name in before} == before


def test_what_torchrg_wrote_is_replaced(sample, seg, tmp_path):
    write_pointcept_scene(tmp_path, sample, seg, superpoint=seg.labels)
    flipped = replace(seg, normals=-seg.normals, labels=seg.labels.clone().fill_(-1))
    moved = {**sample, "coord": sample["coord"] + 1}
    write_pointcept_scene(tmp_path, moved, flipped)
    assert np.array_equal(np.load(tmp_path / "normal.npy"), flipped.normals)
    assert np.array_equal(np.load(tmp_path / "coord.npy"), moved["coord"])
    assert (np.load(tmp_path / "plane.npy") == -1).all()
    assert not (tmp_path / "superpoint.npy").exists()


def test_a_run_that_was_cut_off_is_repeated_like_a_new_one(foreign, sample, seg, monkeypatch):
    """A process that dies between two files leaves a claim on all of them."""
    replace = Path.replace

    def dying(self, target):
        if target.name == "plane.npy":
            raise KeyboardInterrupt
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", dying)
    with pytest.raises(KeyboardInterrupt):
        write_pointcept_scene(foreign, sample, seg)
    monkeypatch.undo()
    assert {"plane.npy", "curvature.npy"} <= set(write_pointcept_scene(foreign, sample, seg))


def test_normals_of_the_sample_are_written(sample, seg, tmp_path):
    write_pointcept_scene(tmp_path, {**sample, "normal": -seg.normals}, seg)
    assert np.array_equal(np.load(tmp_path / "normal.npy"), -seg.normals)


def test_other_points_are_refused(foreign, sample, seg):
    before = digest(foreign)
    with pytest.raises(FormatError, match="expected the same points, got others"):
        write_pointcept_scene(foreign, {**sample, "coord": sample["coord"] + 1e-3}, seg)
    few = segment_planes(sample["coord"][:100], CLASSIC)
    with pytest.raises(FormatError, match="expected 100 rows, got shape"):
        write_pointcept_scene(foreign, {"coord": sample["coord"][:100]}, few)
    with pytest.raises(FormatError, match="expected 100 rows, got shape"):
        write_pointcept_scene(foreign, sample, few)
    assert digest(foreign) == before


@pytest.mark.parametrize("name", ["plane.npy", "curvature.npy", "superpoint.npy", "planes.json"])
@pytest.mark.parametrize("content", [b"[", b'{"written": [[1]]}'])
def test_files_from_elsewhere_are_not_touched(foreign, sample, seg, name, content):
    (foreign / name).write_bytes(content)
    before = digest(foreign)
    with pytest.raises(FormatError, match=f"{name}: was not written by torchrg"):
        write_pointcept_scene(foreign, sample, seg, superpoint=seg.labels)
    assert digest(foreign) == before


def test_pickles_and_wrong_sizes_are_never_loaded(foreign):
    class Trap:
        def __reduce__(self):
            return pytest.fail, ("a pickle was loaded",)

    np.save(foreign / "color.npy", np.array([Trap()], dtype=object), allow_pickle=True)
    with pytest.raises(FormatError, match="pickled Python objects, which are not loaded"):
        read_pointcept_scene(foreign)
    header = b"\x93NUMPY\1\0v\0{'descr': '|u1', 'fortran_order': False, 'shape': (10**15, 3), }"
    (foreign / "color.npy").write_bytes(header.replace(b"10**15", b"1" + b"0" * 15).ljust(128))
    with pytest.raises(FormatError, match=r"color\.npy: byte"):
        read_pointcept_scene(foreign)
    np.save(foreign / "color.npy", np.zeros((2999, 3), np.uint8))
    with pytest.raises(FormatError, match="expected 3000 rows"):
        read_pointcept_scene(foreign)
    np.save(foreign / "coord.npy", np.zeros((2999, 4), np.float32))
    with pytest.raises(FormatError, match=r"coord\.npy: expected shape \(N, 3\)"):
        read_pointcept_scene(foreign)
    (foreign / "coord.npy").unlink()
    with pytest.raises(FormatError, match=r"expected coord\.npy, got none"):
        read_pointcept_scene(foreign)
