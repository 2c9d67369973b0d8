"""Programs that look their scans up in files of the whole data set find those that are there.

The reading is that of the programs in our own words; each function names whose it is.
"""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.datasets.scannet_tree import write_scan, write_tables
from torchrg import load_config
from torchrg.batch.run import list_jobs
from torchrg.batch.scans import convert_scan, reason_to_convert
from torchrg.batch.sources import CloudSource
from torchrg.datasets import ScanNet
from torchrg.datasets.lists import check_lists, write_lists
from torchrg.errors import FormatError
from torchrg.scenes import make_room

CLASSIC = load_config("classic", **{"planes.up": "z"})
SPLITS = {
    "train": ["scene0009_00", "scene0010_00"],
    "val": ["scene0011_00"],
    "test": ["scene0799_00"],
}
NYU = (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 14, 16, 24, 28, 33, 34, 36, 39)
"""``classes_SemVoxLabel-nyu40id.txt`` of ScanNet."""
MODES = {"train": "train", "validation": "val", "test": "test"}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Scans of 600 points, each of its own color, the faces of a room as objects."""
    root = tmp_path_factory.mktemp("scannet")
    made = make_room(num_points=600, seed=1)
    coord, faces = made.points.float().numpy(), made.labels.numpy()
    words = ("wall", "floor", "office chair", "table")
    objects = [(words[i % 4], [face]) for i, face in enumerate(np.unique(faces))]
    for number, name in enumerate([*SPLITS["train"], *SPLITS["val"], *SPLITS["test"]]):
        color = np.full(coord.shape, 20 * number, np.uint8)
        color[: 100 * (number + 1)] += 100
        truth = None if name in SPLITS["test"] else objects
        write_scan(root / "scans", name, coord, color, faces, truth)
    write_tables(root, SPLITS["train"], SPLITS["val"])
    return root


def convert(root, out, layout, only=None):
    """What the command does with scans, without the lists at its end."""
    source = CloudSource(ScanNet(root), CLASSIC, layout=layout)
    for job in list_jobs(source, out, only=only):
        if reason_to_convert(job):
            assert convert_scan(job).status == "converted"
    return source


def lists_in(out):
    """The contents of the lists by name."""
    found = [*out.glob("*.yaml"), *out.glob("meta_data/*.txt")]
    return {str(path.relative_to(out)): path.read_bytes() for path in found}


@pytest.fixture(scope="module")
def converted(root, tmp_path_factory):
    folders = {layout: tmp_path_factory.mktemp(layout) for layout in ("mask3d", "mmdet3d")}
    for layout, out in folders.items():
        convert(root, out, layout).write_lists(out)
    return folders


def load_mask3d(folder, mode):
    """``SemanticSegmentationDataset``, ``eval_instance_epoch_end``; labels by their own numbers."""
    labels = yaml.safe_load((folder / "label_database.yaml").read_text())
    valid = [number for number, label in labels.items() if label["validation"]]
    samples = {}
    for row in yaml.safe_load((folder / f"{mode}_database.yaml").read_text()):
        points = np.load(row["filepath"].replace("../../", ""))
        scene, truth = row["raw_filepath"].split("/")[-2], None
        if mode != "test":
            truth = np.loadtxt(folder / "instance_gt" / mode / f"{scene}.txt", dtype=int)
            assert np.array_equal(truth, np.loadtxt(row["instance_gt_filepath"], dtype=int))
        assert row["file_len"] == len(points)
        samples[scene] = points, truth
    return samples, valid


def test_mask3d_has_its_databases(converted):
    out = converted["mask3d"]
    for mode, split in MODES.items():
        samples, valid = load_mask3d(out, mode)
        assert tuple(valid) == NYU
        assert [*samples] == SPLITS[split]
        for points, truth in samples.values():
            assert points.shape == (600, 10 if mode == "test" else 12)
            if truth is not None:
                assert np.array_equal(truth, points[:, 10] * 1000 + points[:, 11] + 1)
    both = yaml.safe_load((out / "train_validation_database.yaml").read_text())
    assert [row["scene"] for row in both] == SPLITS["train"] + SPLITS["val"]
    colors = yaml.safe_load((out / "color_mean_std.yaml").read_text())
    train = np.vstack([points[:, 3:6] for points, _ in load_mask3d(out, "train")[0].values()])
    assert np.allclose(colors["mean"], (train / 255).mean(axis=0))
    assert np.allclose(colors["std"], (train / 255).std(axis=0))


def test_mmdet3d_has_the_names_of_each_split(converted):
    """``ScanNetData.__init__`` by ``list_from_file``, and the files it asks for then."""
    out = converted["mmdet3d"]
    for split, names in SPLITS.items():
        assert (out / "meta_data" / f"scannetv2_{split}.txt").read_text().split("\n") == [
            *names,
            "",
        ]
        parts = ["vert", "sp_label"] + (["aligned_bbox", "sem_label"] if split != "test" else [])
        for name in names:
            for part in parts:
                assert (out / "scannet_instance_data" / f"{name}_{part}.npy").is_file()


@pytest.mark.parametrize("layout", ["mask3d", "mmdet3d"])
def test_lists_are_the_same_whichever_runs_made_them(root, converted, tmp_path, layout):
    out = tmp_path / "out"
    shutil.copytree(converted[layout], out)
    write_lists(layout, "ScanNet", out)
    expected = lists_in(out)
    assert len(expected) == (6 if layout == "mask3d" else 3)
    shutil.rmtree(out)
    for only in ("val/*", "*10_00", "*"):
        convert(root, out, layout, only)
        write_lists(layout, "ScanNet", out)
        if only == "val/*":
            assert "scene0011_00" in "".join(map(bytes.decode, lists_in(out).values()))
    assert lists_in(out) == expected


def test_a_command_that_was_killed_before_its_lists_has_them_the_next_time(root, tmp_path, run):
    out = tmp_path / "out"
    convert(root, out, "mask3d")
    assert not lists_in(out)
    command = ("convert", "scannet", root, out, "--preset", "classic", "--layout", "mask3d")
    assert "nothing to do" in run(*command).out
    assert [*load_mask3d(out, "train")[0]] == SPLITS["train"]


@pytest.mark.parametrize("flags", [[], ["--dry-run"]])
def test_databases_of_others_are_refused_before_any_work(root, tmp_path, run, flags):
    out = tmp_path / "out"
    out.mkdir()
    (out / "train_database.yaml").write_text("- theirs\n")
    done = run("convert", "scannet", root, out, "--layout", "mask3d", *flags)
    assert "train_database.yaml: is of another data set or program; move it" in done.error
    assert (done.code, done.out) == (2, "")
    assert [path.name for path in out.iterdir()] == ["train_database.yaml"]


def test_data_sets_with_other_classes_share_no_directory(converted):
    with pytest.raises(
        FormatError, match=r"label_database\.yaml: is of another data set or program"
    ):
        check_lists("mask3d", "S3DIS", converted["mask3d"])
    check_lists("mask3d", "ScanNet", converted["mask3d"])
    check_lists("mmdet3d", "S3DIS", converted["mask3d"])


def test_lists_that_a_program_brings_stay_and_get_what_they_lack(converted, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(converted["mmdet3d"] / "meta_data", out / "meta_data")
    whole = "scene0700_00\r\nscene0010_00\r\nscene0009_00\r\n"
    (out / "meta_data" / "scannetv2_train.txt").write_bytes(whole.encode())
    (out / "meta_data" / "scannetv2_val.txt").write_text("scene0700_00")
    write_lists("mmdet3d", "ScanNet", out)
    assert (out / "meta_data" / "scannetv2_train.txt").read_bytes() == whole.encode()
    found = (out / "meta_data" / "scannetv2_val.txt").read_text()
    assert found == "scene0700_00\nscene0011_00\n"


def test_scans_without_labels_are_on_no_list_of_training(root, tmp_path):
    bare = tmp_path / "scannet"
    for name in SPLITS["train"]:
        folder = bare / "scans" / name
        folder.mkdir(parents=True)
        shutil.copy(root / "scans" / name / f"{name}_vh_clean_2.ply", folder)
    write_tables(bare, SPLITS["train"], [])
    for layout in ("mask3d", "mmdet3d"):
        out = tmp_path / layout
        convert(bare, out, layout).write_lists(out)
        assert not lists_in(out)


def test_a_damaged_entry_is_named(converted, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(converted["mask3d"] / "train_database", out / "train_database")
    (out / "train_database" / "0010_00.json").write_text("{")
    with pytest.raises(FormatError, match=r"0010_00\.json: expected an entry of a list, got: "):
        write_lists("mask3d", "ScanNet", out)


def test_one_scan_after_the_other_is_on_the_list_of_the_test(root, tmp_path, run, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = ("convert", "folder", "in", "out", "--layout", "mask3d", "--preset", "classic")
    for name in SPLITS["val"] + SPLITS["test"]:
        Path("in").mkdir(exist_ok=True)
        shutil.copy(root / "scans" / name / f"{name}_vh_clean_2.ply", "in")
        assert run(*command).code == 0
    monkeypatch.chdir("/")
    samples, _ = load_mask3d(tmp_path / "out", "test")
    assert [*samples] == ["scene0011_00_vh_clean_2", "scene0799_00_vh_clean_2"]


def test_names_that_are_not_utf8_are_listed_by_their_bytes(tmp_path):
    name = os.fsdecode(b"bad\xff")
    folder = tmp_path / "meta_data" / "scannetv2_train"
    folder.mkdir(parents=True)
    (folder / f"{name}.json").write_text(json.dumps({"name": name}))
    for _ in range(2):
        write_lists("mmdet3d", "ScanNet", tmp_path)
    assert (tmp_path / "meta_data" / "scannetv2_train.txt").read_bytes() == b"bad\xff\n"
