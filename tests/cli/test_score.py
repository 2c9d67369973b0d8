"""``torchrg score`` compares the same points: rows that agree, or the nearest where asked for."""

import json

import numpy as np
import pytest

from torchrg import Cloud, read_cloud, write_cloud
from torchrg.cli import main
from torchrg.metrics import score_labels, score_normals, score_partition

SIZE = 3000
ORDER = np.random.default_rng(1).permutation(SIZE)
NEAR = ("--match-distance", "0.0001")


@pytest.fixture(scope="module")
def folder(folder_of_clouds):
    """A room with its truth, and a result of it with errors: labels, normals, superpoints."""
    place = folder_of_clouds("truth.npz", num_points=SIZE)
    truth, rng = read_cloud(place / "truth.npz"), np.random.default_rng(0)
    labels = truth.fields["labels"].copy()
    labels[rng.random(SIZE) < 0.2] = -1
    fields = {
        "labels": labels,
        "normals": truth.fields["normals"] + rng.normal(0, 0.1, (SIZE, 3)).astype(np.float32),
        "superpoint": (truth.fields["labels"] * 2 + rng.integers(0, 2, SIZE)).astype(np.int32),
    }
    write_cloud(place / "ours.npz", Cloud(truth.coordinates, fields))
    return place


def changed(folder, name, rows=slice(None), shift=0.0):
    """Write some rows of the result, moved, and return the file."""
    cloud = read_cloud(folder / "ours.npz")
    fields = {field: values[rows] for field, values in cloud.fields.items()}
    write_cloud(folder / name, Cloud(cloud.coordinates[rows] + np.float32(shift), fields))
    return folder / name


@pytest.fixture
def score(run):
    """``score(ours, truth, ...)``: the scores that are printed."""
    return lambda *arguments: json.loads(run("score", *arguments, "--json").out)


@pytest.fixture
def refused(run):
    """``refused(ours, truth, ...)``: the one line of a command that is wrong."""

    def call(*arguments):
        done = run("score", *arguments)
        assert (done.code, done.out) == (2, "")
        return done.error

    return call


@pytest.mark.parametrize("suffix", [".npz", ".xyz", ".ply"])
def test_another_order_is_refused_and_nearest_points_score_as_rows_do(
    folder, score, refused, suffix
):
    shuffled = changed(folder, f"shuffled{suffix}", ORDER)
    line = refused(shuffled, folder / "truth.npz")
    num_moved = int((np.arange(SIZE) != ORDER).sum())
    assert f"got {num_moved:,} of 3,000 that differ (row 0: " in line
    assert line.endswith(
        "; to compare each point with the nearest one within D, pass --match-distance D.\n"
    )
    flags = ["--superpoints"] if suffix == ".npz" else []
    expected = score(folder / "ours.npz", folder / "truth.npz", *flags)
    scores = score(shuffled, folder / "truth.npz", *NEAR, *flags)
    assert scores.pop("match") == {"points": SIZE, "unmatched": 0, "unused": 0}
    for part, values in expected.items():
        assert scores[part] == pytest.approx(values, rel=1e-6), part
    assert set(expected) == {"labels", "normals", *(["superpoints"] if flags else [])}


@pytest.mark.parametrize("flags", [[], ["--superpoints"]])
def test_another_place_is_refused(folder, refused, flags):
    moved = changed(folder, "moved.npz", shift=1.0)
    line = refused(moved, folder / "truth.npz", *flags)
    assert "got 3,000 of 3,000 that differ (row 0: " in line
    assert "no points within the distance of" in refused(moved, folder / "truth.npz", *NEAR)


def test_one_wrong_row_is_named(folder, refused):
    cloud = read_cloud(folder / "ours.npz")
    points = cloud.coordinates.copy()
    points[17] = [1.5, 2.5, 0.25]
    write_cloud(folder / "one.npz", Cloud(points, cloud.fields))
    line = refused(folder / "one.npz", folder / "truth.npz")
    assert "1 of 3,000 that differ (row 17: 1.5 2.5 0.25 for" in line


def test_points_without_a_match_are_told_and_count_as_unlabelled(folder, run, refused):
    kept = np.sort(ORDER[: SIZE // 2])
    part = changed(folder, "part.npz", kept, shift=0.0004)
    assert "expected 3,000 points as in" in refused(part, folder / "truth.npz")
    flags = ["--match-distance", "0.001", "--superpoints", "--json"]
    done = run("score", part, folder / "truth.npz", *flags)
    lost = np.ones(SIZE, dtype=bool)
    lost[kept] = False
    message = f"{folder / 'truth.npz'}: 1,500 of 3,000 points have no match in {part} and count as"
    assert done.err == f"torchrg: warning: {message} unlabeled.\n"
    scores, truth = json.loads(done.out), read_cloud(folder / "truth.npz")
    assert scores["match"] == {"points": SIZE, "unmatched": SIZE // 2, "unused": 0}
    ours = {name: v.copy() for name, v in read_cloud(folder / "ours.npz").fields.items()}
    ours["labels"][lost] = ours["superpoint"][lost] = -1
    ours["normals"][lost] = 0
    labels = score_labels(ours["labels"], truth.fields["labels"])
    assert scores["labels"] == labels._asdict()
    normals = score_normals(ours["normals"], truth.fields["normals"])
    assert scores["normals"]["rms"] == normals.rms
    assert scores["normals"]["invalid"] == SIZE // 2
    parts = score_partition(ours["superpoint"], truth.fields["labels"], truth.points)
    assert scores["superpoints"] == parts._asdict()


def test_every_true_point_counts_once_and_predicted_ones_beyond_nowhere(folder, score):
    cloud, truth = read_cloud(folder / "truth.npz"), folder / "half.npz"
    fields = {name: values[:1000] for name, values in cloud.fields.items()}
    write_cloud(truth, Cloud(cloud.coordinates[:1000], fields))
    scores = score(folder / "ours.npz", truth, *NEAR)
    assert scores["match"] == {"points": 1000, "unmatched": 0, "unused": 2000}
    ours = read_cloud(folder / "ours.npz").fields["labels"][:1000]
    assert scores["labels"] == score_labels(ours, fields["labels"])._asdict()


@pytest.mark.parametrize(
    ("distance", "problem"),
    [("0", "> 0, got 0.0"), ("-1", "> 0, got -1.0"), ("nan", "to be a number or none, got 'nan'")],
)
def test_a_distance_is_positive(folder, refused, distance, problem):
    line = refused(folder / "ours.npz", folder / "truth.npz", "--match-distance", distance)
    assert f"expected --match-distance {problem}" in line


def test_points_that_are_not_finite_agree_with_each_other(folder, score, refused):
    for name in ("ours", "truth"):
        cloud = read_cloud(folder / f"{name}.npz")
        points = cloud.coordinates.copy()
        points[3], points[9] = np.nan, np.inf
        write_cloud(folder / f"holes_{name}.npz", Cloud(points, cloud.fields))
    score(folder / "holes_ours.npz", folder / "holes_truth.npz")
    line = refused(folder / "holes_ours.npz", folder / "truth.npz")
    assert "got 2 of 3,000 that differ (row 3: nan nan nan for" in line


def test_results_of_convert_are_scored_as_files_are(folder_of_clouds, tmp_path, score):
    truth, out = folder_of_clouds("hall.npz", "east/office.ply"), tmp_path / "out"
    flags = ["--workers", "1", "--preset", "classic", "--superpoints"]
    assert main(["convert", "folder", str(truth), str(out), *flags]) == 0
    scores = score(out, truth, "--superpoints")
    assert list(scores["scans"]) == ["east/office", "hall"]
    plane = np.load(out / "hall" / "plane.npy")
    labels = read_cloud(truth / "hall.npz").fields["labels"]
    assert scores["scans"]["hall"]["labels"] == score_labels(plane, labels)._asdict()
    assert set(scores["mean"]) == {"labels", "normals", "superpoints"}
    one = score(out / "hall", truth / "hall.npz")
    assert one["labels"] == scores["scans"]["hall"]["labels"]
