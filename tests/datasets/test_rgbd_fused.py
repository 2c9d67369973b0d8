"""Recordings of depth frames that are fused into one cloud."""

import json

import numpy as np
import pytest
import torch

from tests.datasets.captures_tree import (
    FRAMES,
    SIZE,
    UNSURE,
    WRITERS,
    write_polycam,
    write_record3d,
    write_stray,
)
from torchrg.datasets import RGBDFrames
from torchrg.datasets.rgbd import FusedRecordings
from torchrg.errors import FormatError
from torchrg.transforms import fuse_depth

VOXEL = 0.05
FUSE = ("--fuse", VOXEL, "--workers", "1")


def fused_of(data):
    return FusedRecordings(data, VOXEL)


def test_labels_of_frames_are_the_ids_of_the_map(tmp_path, run):
    root = write_stray(tmp_path / "capture")
    assert run("convert", "rgbd", root, tmp_path / "out", *FUSE).code == 0
    folder = tmp_path / "out" / "capture"
    planes = json.loads((folder / "planes.json").read_text())["planes"]
    coord, plane = np.load(folder / "coord.npy"), np.load(folder / "plane.npy")
    assert coord.shape == (*plane.shape, 3)
    normals = np.array([entry["normal"] for entry in planes])
    offsets = np.array([entry["offset"] for entry in planes])
    axes = np.abs(normals).argmax(axis=1)
    places = offsets * normals[np.arange(len(axes)), axes]
    assert np.minimum(np.abs(places), np.abs(places - SIZE[axes])).max() < 0.001
    shared = []
    for name, frame in zip(("000000", "000005"), FRAMES, strict=True):
        image = np.load(folder / name / "plane.npy")
        assert image.shape == UNSURE.shape
        assert (image[UNSURE] < 0).all()
        seen = image >= 0
        assert seen[~UNSURE].mean() > 0.95
        # A voxel at a corner belongs to one of its walls.
        distances = (frame.points[seen] * normals[image[seen]]).sum(axis=1) - offsets[image[seen]]
        assert np.abs(distances).max() < np.sqrt(3) * VOXEL
        assert (np.abs(distances) < 0.002).mean() > 0.95
        shared.append({*image[seen].tolist()})
    assert shared[0] & shared[1]
    assert shared[0] | shared[1] == {entry["id"] for entry in planes}
    # Normals face the cameras.
    normal = np.load(folder / "normal.npy")
    inward = (normal * (SIZE / 2 - coord)).sum(axis=1)[plane >= 0]
    assert (inward > 0).mean() > 0.99


@pytest.mark.parametrize("name", WRITERS)
def test_recordings_of_all_layouts_are_fused(tmp_path, name):
    data = RGBDFrames.from_folder(WRITERS[name](tmp_path / "capture"))
    recordings = fused_of(data)
    (scene,) = recordings.scenes
    assert recordings.count_points(scene) == 2 * UNSURE.size
    cloud, expected = recordings.read_cloud(0), fuse_depth([*data], voxel_size=VOXEL)
    assert np.array_equal(cloud.coordinates, expected.coord.numpy())
    labels = torch.arange(len(cloud), dtype=torch.int32)
    images = [image for _, image in cloud.header["images"](labels)]
    for image, other in zip(images, expected.to_frames(labels), strict=True):
        assert torch.equal(image, other)


def test_each_recording_is_a_scan(tmp_path, run):
    for name in ("first", "second"):
        write_stray(tmp_path / "all" / name)
    out = tmp_path / "out"
    assert run("convert", "rgbd", tmp_path / "all", out, *FUSE).code == 0
    assert "nothing to do" in run("convert", "rgbd", tmp_path / "all", out, *FUSE).out
    for name in ("first", "second"):
        record = json.loads((out / name / "provenance.json").read_text())
        assert {f"{frame}/plane.npy" for frame in ("000000", "000005")} <= record["outputs"].keys()
        assert record["source"]["voxel_size"] == VOXEL
    plan = run("convert", "rgbd", tmp_path / "all", out, "--fuse", 0.1, "--dry-run").out
    assert "options changed" in plan
    error = run("convert", "rgbd", tmp_path / "all", out, "--workers", "1").error
    assert "expected results of convert rgbd, got rgbd-fused; choose another directory" in error


def test_frames_without_a_pose_are_left_out(tmp_path, run):
    root = write_polycam(tmp_path / "capture")
    next((root / "keyframes" / "corrected_cameras").iterdir()).unlink()
    done = run("convert", "rgbd", root, tmp_path / "out", *FUSE)
    assert "1 of 2 frames have no pose" in done.err
    assert done.code == 0
    assert len([*(tmp_path / "out" / "capture").glob("*/plane.npy")]) == 1
    scan = write_record3d(tmp_path / "other") / "EXR_RGBD" / "metadata.json"
    scan.write_text(json.dumps({**json.loads(scan.read_text()), "poses": []}))
    with pytest.warns(UserWarning, match="2 of 2 frames have no pose"):
        recordings = fused_of(RGBDFrames.from_folder(tmp_path / "other"))
    with pytest.raises(FormatError, match="EXR_RGBD: expected frames with poses, got none; omit"):
        recordings.read_cloud(0)


def test_settings_of_planes_apply_to_the_map(tmp_path, run):
    root, out = write_stray(tmp_path / "capture"), tmp_path / "out"
    flags = ("--up", "z", "--kinds", "wall", "--depth.max-depth", "3", "--orient", "viewpoint")
    assert run("convert", "rgbd", root, out, *FUSE, *flags).code == 0
    planes = json.loads((out / "capture" / "planes.json").read_text())["planes"]
    assert {entry["kind"] for entry in planes} == {"wall"}
    image = np.load(out / "capture" / "000000" / "plane.npy")
    assert (image[FRAMES[0].depth > 3.001] < 0).all()
    for wrong in (("--fuse", 0), ("--fuse", VOXEL, "--depth.min-size", "5")):
        error = run("convert", "rgbd", root, out, *wrong).error
        assert "expected --fuse > 0 without --depth.noise, max-angle-deg, max-step or min" in error


def test_a_voxel_size_in_another_unit_is_told(tmp_path, run):
    root = write_stray(tmp_path / "capture")
    done = run("convert", "rgbd", root, tmp_path / "out", "--fuse", 20, "--workers", "1")
    assert "voxel 20 leaves 1 of" in done.out
