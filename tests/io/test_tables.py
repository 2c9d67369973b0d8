"""Tables without names: which are no clouds, and what their columns mean."""

import warnings

import numpy as np
import pytest

import torchrg
from torchrg.errors import FormatError
from torchrg.io import read_cloud
from torchrg.io.tables import guess_column_names

RNG = np.random.default_rng(0)
POINTS = RNG.normal(size=(40, 3))
UNITS = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)
COLORS = RNG.integers(0, 256, (40, 3))
FOURS = RNG.normal(size=(40, 4))
FOURS /= np.linalg.norm(FOURS, axis=1, keepdims=True)
CAMERA = np.array([[525.0, 0, 319.5], [0, 525, 239.5], [0, 0, 1]])
ROTATIONS = np.linalg.qr(RNG.normal(size=(40, 3, 3)))[0]
POSES = np.concatenate([ROTATIONS, POINTS[:, :, None]], axis=2)
STILL = np.tile([0.0, 0, 0, 1], (40, 1))
TIMES = np.arange(40)[:, None] * 0.033


@pytest.mark.parametrize("kind", [".npy", ".txt", ".xyz", ".pts"])
@pytest.mark.parametrize(
    ("table", "what"),
    [
        (CAMERA, "a 3 x 3 camera matrix"),
        (np.hstack([CAMERA, np.zeros((3, 1))]), "a 3 x 4 camera matrix"),
        (POSES[0], "a 3 x 4 pose matrix"),
        (np.eye(4), "a 4 x 4 pose matrix"),
        (POSES.reshape(40, 12), "poses"),
        (np.tile(np.eye(4)[:3].ravel(), (30, 1)), "poses"),
        (np.hstack([TIMES, POSES.reshape(40, 12)]), "poses"),
        (np.hstack([TIMES, POINTS, FOURS]), "poses"),
        (np.hstack([TIMES, POINTS, STILL]), "poses"),
        (np.hstack([FOURS, POINTS]), "poses"),
        (RNG.normal(size=(40, 17)), "40 rows of 17 numbers"),
    ],
)
def test_cameras_and_poses_are_no_clouds(tmp_path, kind, table, what):
    path = tmp_path / f"table{kind}"
    np.save(path, table) if kind == ".npy" else np.savetxt(path, table)
    with pytest.raises(FormatError, match=rf"table\{kind}: expected .*, got {what}"):
        torchrg.segment_planes(path)
    assert len(read_cloud(path, columns=["x", "y", "z", *map(str, range(3, table.shape[1]))]))


@pytest.mark.parametrize(
    "table",
    [
        np.eye(3),
        POINTS[:3],
        np.hstack([POINTS, POINTS, POINTS]),
        np.hstack([POINTS, UNITS, np.zeros((40, 1))]),
        np.hstack([POINTS, np.eye(4)[RNG.integers(0, 4, 40)]]),
        np.hstack([UNITS, np.zeros((40, 4))]),
    ],
)
def test_clouds_stay_clouds(tmp_path, table):
    np.savetxt(tmp_path / "a.txt", table)
    np.testing.assert_allclose(read_cloud(tmp_path / "a.txt").coordinates, table[:, :3])


ALPHA = np.full((40, 1), 255)


@pytest.mark.parametrize(
    ("columns", "names"),
    [
        ([COLORS, UNITS], "red green blue nx ny nz"),
        ([UNITS, COLORS], "nx ny nz red green blue"),
        ([COLORS, ALPHA], "red green blue column_7"),
        ([POINTS[:, :1], COLORS, UNITS], "intensity red green blue nx ny nz"),
        ([UNITS, POINTS[:, :1], ALPHA], "nx ny nz column_7 column_8"),
        ([COLORS, COLORS], "column_4 column_5 column_6 column_7 column_8 column_9"),
        ([COLORS * 257, UNITS], "red green blue nx ny nz"),
        ([], ""),
        ([[0.5]], "intensity"),
        ([[0.5, 0.5]], "column_4 column_5"),
        ([[255.0, 0, 7]], "red green blue"),
        ([[0.6, 0, -0.8]], "nx ny nz"),
        ([[0.0, 0, 1]], "nx ny nz"),
        ([[0.0, 0, 0]], "red green blue"),
        ([[1e200, 1e200, 1e200]], "column_4 column_5 column_6"),
        ([[0.3, 0.3, 0.3]], "column_4 column_5 column_6"),
        ([[255.0, 0, 7, 0.5]], "red green blue column_7"),
        ([[256.0, 0, 7, 3]], "intensity red green blue"),
        ([[-1640.0, 0, 7, 3]], "intensity red green blue"),
        ([[0.5, 0.6, 0, -0.8]], "column_4 nx ny nz"),
        ([[0.6, 0, -0.8, 3]], "nx ny nz column_7"),
        # Intensity and color, or color and label: values do not tell.
        ([[255.0, 0, 7, 3]], "column_4 column_5 column_6 column_7"),
        ([[0.5, 0, 7, 0.5]], "column_4 column_5 column_6 column_7"),
    ],
)
def test_columns_are_named_by_their_values(tmp_path, columns, names):
    rows = (np.broadcast_to(values, (40, np.shape(values)[-1])) for values in columns)
    table = np.hstack([POINTS, *rows])
    with np.errstate(over="ignore"):
        assert guess_column_names(table) == ["x", "y", "z", *names.split()]
    np.save(tmp_path / "a.npy", table)
    np.savetxt(tmp_path / "a.txt", table)
    grouped = names.replace("red green blue", "color").replace("nx ny nz", "normals")
    for kind in ("npy", "txt"):
        cloud = read_cloud(tmp_path / f"a.{kind}")
        np.testing.assert_allclose(cloud.coordinates, POINTS)
        assert cloud.fields.keys() == {*grouped.split()}


GRID = np.stack(np.meshgrid(np.arange(8), np.arange(5), indexing="ij"), -1).reshape(40, 2)


@pytest.mark.parametrize(
    ("columns", "counting"),
    [
        ([np.arange(40)[:, None], POINTS], "1"),
        ([GRID, POINTS, COLORS], "1 and 2"),
        ([TIMES, POINTS], "1"),
        ([POINTS, COLORS], ""),
        ([GRID, POINTS[:, :1]], ""),
        ([GRID, POINTS[:, :1], COLORS], ""),
        ([np.sort(POINTS[:, :1], axis=0), POINTS[:, 1:], UNITS], ""),
    ],
)
def test_columns_that_only_count_are_told(tmp_path, columns, counting):
    np.save(tmp_path / "a.npy", np.hstack(columns))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        read_cloud(tmp_path / "a.npy")
    found = [str(warning.message) for warning in caught]
    assert len(found) == bool(counting)
    assert all(f"a.npy: values only count up in column {counting}, as" in text for text in found)
    assert all(warning.filename == __file__ for warning in caught)
