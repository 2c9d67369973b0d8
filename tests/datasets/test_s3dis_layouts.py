"""Programs read classes and objects of S3DIS from its layouts as the release has them.

The reading is that of the programs in our own words; each function names whose it is. They know
classes by numbers, so that the names they give to the numbers are compared.
"""

import warnings

import numpy as np
import pytest
import torch
import yaml

from tests.datasets.s3dis_tree import write_clean_room
from torchrg import load_config
from torchrg.batch.run import list_jobs
from torchrg.batch.scans import convert_scan
from torchrg.batch.sources import CloudSource
from torchrg.cli import main
from torchrg.datasets import S3DIS

CLASSIC = load_config("classic")
NAMES = (
    "ceiling", "floor", "wall", "beam", "column", "window", "door",
    "table", "chair", "sofa", "bookcase", "board", "clutter",
)  # fmt: skip
"""``class_names.txt`` of MMDetection3D, ``class_map`` of Mask3D, ``ID2NAME`` of ISBNet."""
OFFICE = {
    "bookcase_1": 90, "ceiling_1": 70, "chair_1": 60, "chair_2": 50, "floor_1": 80, "sofa_1": 40,
    "stairs_1": 30, "table_1": 60,
}  # fmt: skip
"""Objects in natural order, with their numbers of points; stairs are clutter."""
HALLWAY = {"ceiling_1": 120, "floor_1": 140}


class Room:
    """What a room of the release holds, in the order of its objects."""

    def __init__(self, folder, seed, counts):
        rows = np.vstack([*write_clean_room(folder, seed, counts).values()])
        self.coord, self.color = rows[:, :3], rows[:, 3:]
        numbers = [*counts.values()]
        names = [name.partition("_")[0].replace("stairs", "clutter") for name in counts]
        self.names, self.objects = np.repeat(names, numbers), np.repeat(range(len(names)), numbers)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return tmp_path_factory.mktemp("s3dis")


@pytest.fixture(scope="module")
def rooms(root):
    return {
        "Area_1_hallway_2": Room(root / "Area_1" / "hallway_2", 1, HALLWAY),
        "Area_5_office_1": Room(root / "Area_5" / "office_1", 2, OFFICE),
    }


@pytest.fixture(scope="module")
def converted(root, rooms, tmp_path_factory):
    """The output in each layout that S3DIS has."""
    folders = {}
    for layout in ("isbnet", "mmdet3d", "mask3d", "npy"):
        out = folders[layout] = tmp_path_factory.mktemp(layout)
        with warnings.catch_warnings():
            # The areas have fewer rooms than the release.
            warnings.simplefilter("ignore")
            source = CloudSource(S3DIS(root, (1, 5)), CLASSIC, layout=layout)
            reports = [convert_scan(job) for job in list_jobs(source, out)]
        assert [report.status for report in reports] == ["converted"] * 2, reports
        source.write_lists(out)
    return folders


def test_isbnet(converted, rooms):
    """``S3DISDataset.get_filenames`` by the area, ``load``; classes by ``prepare_s3dis.py``."""
    for name, room in rooms.items():
        (path,) = converted["isbnet"].glob(f"preprocess/{name[:6]}*_inst_nostuff.pth")
        scan = path.name.replace("_inst_nostuff.pth", "")
        assert scan == name
        coord, color, segment, instance = torch.load(path, weights_only=False)
        superpoint = torch.load(
            converted["isbnet"] / "superpoints" / f"{scan}.pth", weights_only=False
        )
        assert np.array_equal(np.array(NAMES)[segment], room.names)
        assert np.array_equal(instance, room.objects)
        assert coord.dtype == color.dtype == np.float32
        assert np.allclose(coord, room.coord, atol=1e-5)
        assert np.array_equal(color, room.color)
        assert superpoint.shape == segment.shape


def test_mmdet3d_oneformer3d_unidet3d(converted, rooms):
    """``S3DISData``: rooms by folders of the release, masks, a box of each piece of furniture."""
    root = converted["mmdet3d"]
    found = {}
    for area in ("Area_1", "Area_5"):
        for folder in (root / "Stanford3dDataset_v1.2_Aligned_Version" / area).iterdir():
            assert folder.is_dir()
            found[f"{area}_{folder.name}"] = {
                part: np.load(root / "s3dis_data" / f"{area}_{folder.name}_{part}.npy")
                for part in ("point", "sem_label", "ins_label")
            }
    assert found.keys() == rooms.keys()
    for name, room in rooms.items():
        points, segment, instance = found[name].values()
        for part, values in (("points", points), ("semantic_mask", segment)):
            assert (root / part / f"{name}.bin").read_bytes() == values.tobytes()
        assert (root / "instance_mask" / f"{name}.bin").read_bytes() == instance.tobytes()
        assert (points.dtype, segment.dtype, instance.dtype) == (np.float32, np.int64, np.int64)
        assert np.allclose(points[:, :3], room.coord - room.coord.min(axis=0), atol=1e-5)
        assert np.array_equal(points[:, 3:], room.color)
        assert np.array_equal(np.array(NAMES)[segment], room.names)
        assert np.array_equal(instance, room.objects + 1)
        furniture = []
        for number in range(1, instance.max() + 1):
            kinds = segment[instance == number]
            assert kinds.min() == kinds.max()
            furniture += [NAMES[kinds[0]]] if kinds[0] in (7, 8, 9, 10, 11) else []
        if name == "Area_5_office_1":
            assert furniture == ["bookcase", "chair", "chair", "sofa", "table"]
        superpoint = np.fromfile(root / "super_points" / f"{name}.bin", dtype=np.int64)
        assert np.array_equal(np.unique(superpoint), np.arange(superpoint.max() + 1))
        assert superpoint.shape == segment.shape


def load_mask3d(folder, mode, area):
    """``SemanticSegmentationDataset`` of S3DIS; ``evaluate`` for the ground truth."""
    mode = f"Area_{area}" if mode == "validation" else f"train_Area_{area}"
    labels = yaml.safe_load((folder / "label_database.yaml").read_text())
    assert sum(label["validation"] for label in labels.values()) == len(labels) == 13
    colors = yaml.safe_load((folder / f"Area_{area}_color_mean_std.yaml").read_text())
    samples = {}
    for row in yaml.safe_load((folder / f"{mode}_database.yaml").read_text()):
        points = np.load(row["filepath"])
        assert len(row["raw_filepath"].split("/")) == 2
        truth = np.loadtxt(folder / "instance_gt" / row["area"] / f"{row['scene']}.txt", dtype=int)
        samples[f"{row['area']}_{row['scene']}"] = points, truth
    return samples, [labels[number]["name"] for number in sorted(labels)], colors


def test_mask3d(converted, rooms):
    for mode, area, name in (
        ("validation", 5, "Area_5_office_1"),
        ("validation", 1, "Area_1_hallway_2"),
        ("train", 1, "Area_5_office_1"),
        ("train", 5, "Area_1_hallway_2"),
    ):
        samples, names, colors = load_mask3d(converted["mask3d"], mode, area)
        assert [*samples] == [name]
        (points, truth), room = samples[name], rooms[name]
        assert points.dtype == np.float32
        assert np.allclose(points[:, :3], room.coord, atol=1e-5)
        assert np.array_equal(points[:, 3:6], room.color)
        assert np.array_equal(np.array(names)[points[:, 10].astype(int)], room.names)
        assert np.array_equal(points[:, 11], room.objects)
        assert np.array_equal(np.array(names)[truth // 1000 - 1], room.names)
        assert np.array_equal(truth % 1000 - 1, room.objects)
        # What is trained on the other areas is normalized by them.
        other = rooms[name if mode == "train" else next(n for n in rooms if n != name)]
        assert np.allclose(colors["mean"], (other.color / 255).mean(axis=0))
        assert np.allclose(colors["std"], (other.color / 255).std(axis=0))


def test_databases_have_an_area_without_rooms_as_an_empty_one(converted):
    samples, _, _ = load_mask3d(converted["mask3d"], "validation", 3)
    assert not samples
    samples, _, _ = load_mask3d(converted["mask3d"], "train", 3)
    assert [*samples] == ["Area_1_hallway_2", "Area_5_office_1"]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (
            ["--layout", "spformer"],
            "pointcept, mmdet3d, isbnet, mask3d, nag, npy for S3DIS, got spf",
        ),
        (
            ["--layout", "scannet"],
            "pointcept, mmdet3d, isbnet, mask3d, nag, npy for S3DIS, got scannet",
        ),
    ],
)
@pytest.mark.parametrize("more", [[], ["--dry-run"]])
def test_what_no_program_reads_is_refused_in_one_line(
    root, rooms, tmp_path, capsys, flags, message, more
):
    assert main(["convert", "s3dis", str(root), str(tmp_path / "out"), *flags, *more]) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert (captured.err.count("\n"), captured.out) == (1, "")
    assert not (tmp_path / "out").exists()
