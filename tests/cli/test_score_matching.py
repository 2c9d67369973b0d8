"""``torchrg score`` compares the same points: rows that agree, or the nearest where asked for."""

import json

import numpy as np
import pytest

from torchrg import Cloud, read_cloud, write_cloud
from torchrg.cli import main
from torchrg.metrics import score_labels, score_normals, score_partition

SIZE = 3000


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A room with its truth, and a result of it with errors: labels, normals, superpoints."""
    folder = tmp_path_factory.mktemp("room")
    assert main(["sample", str(folder / "truth.npz"), "--num-points", str(SIZE)]) == 0
    truth, rng = read_cloud(folder / "truth.npz"), np.random.default_rng(0)
    labels = truth.fields["labels"].copy()
    labels[rng.random(SIZE) < 0.2] = -1
    fields = {
        "labels": labels,
        "normals": truth.fields["normals"] + rng.normal(0, 0.1, (SIZE, 3)).astype(np.float32),
        "superpoints": (truth.fields["labels"] * 2 + rng.integers(0, 2, SIZE)).astype(np.int32),
    }
    write_cloud(folder / "ours.npz", Cloud(truth.coordinates, fields))
    return folder


def changed(room, name, rows=slice(None), shift=0.0):
    """Write some rows of the result, moved, and return the file."""
    cloud = read_cloud(room / "ours.npz")
    fields = {field: values[rows] for field, values in cloud.fields.items()}
    write_cloud(room / name, Cloud(cloud.coordinates[rows] + np.float32(shift), fields))
    return room / name


def scores_of(capsys, *arguments):
    assert main(["score", *map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def refused(capsys, *arguments):
    """Return the one line of a command that was wrong."""
    assert main(["score", *map(str, arguments)]) == 2
    captured = capsys.readouterr()
    assert (captured.err.count("\n"), captured.out) == (1, "")
    return captured.err


ORDER = np.random.default_rng(1).permutation(SIZE)


NEAR = ("--match-distance", "0.0001")


@pytest.mark.parametrize("suffix", [".npz", ".xyz", ".ply"])
def test_another_order_is_refused_and_nearest_points_score_as_rows_do(room, capsys, suffix):
    shuffled = changed(room, f"shuffled{suffix}", ORDER)
    line = refused(capsys, shuffled, room / "truth.npz")
    num_moved = int((np.arange(SIZE) != ORDER).sum())
    assert f"got others ({num_moved:,} of 3,000 rows, the first 0: " in line
    assert line.endswith("; add --match-distance D to take the nearest points within D.\n")
    flags = ["--superpoints"] if suffix == ".npz" else []
    expected = scores_of(capsys, room / "ours.npz", room / "truth.npz", *flags)
    found = scores_of(capsys, shuffled, room / "truth.npz", *NEAR, *flags)
    assert found.pop("match") == {"points": SIZE, "unmatched": 0, "unused": 0}
    for part, values in expected.items():
        assert found[part] == pytest.approx(values, rel=1e-6), part
    assert set(expected) == {"labels", "normals", *(["superpoints"] if flags else [])}


@pytest.mark.parametrize("flags", [[], ["--superpoints"]])
def test_another_place_is_refused(room, capsys, flags):
    line = refused(capsys, changed(room, "moved.npz", shift=1.0), room / "truth.npz", *flags)
    assert "got others (3,000 of 3,000 rows, the first 0: " in line
    line = refused(capsys, room / "moved.npz", room / "truth.npz", *NEAR)
    assert "expected points near those of" in line


def test_one_wrong_row_is_named(room, capsys):
    cloud = read_cloud(room / "ours.npz")
    points = cloud.coordinates.copy()
    points[17] = [1.5, 2.5, 0.25]
    write_cloud(room / "one.npz", Cloud(points, cloud.fields))
    assert "(1 of 3,000 rows, the first 17: 1.5 2.5 0.25 for" in refused(
        capsys, room / "one.npz", room / "truth.npz"
    )


def test_points_without_a_match_are_told_and_count_as_unlabelled(room, capsys):
    kept = np.sort(ORDER[: SIZE // 2])
    part = changed(room, "part.npz", kept, shift=0.0004)
    assert "expected as many points as" in refused(capsys, part, room / "truth.npz")
    flags = ["--match-distance", "0.001", "--superpoints", "--json"]
    assert main(["score", str(part), str(room / "truth.npz"), *flags]) == 0
    captured = capsys.readouterr()
    lost = np.ones(SIZE, dtype=bool)
    lost[kept] = False
    told = f"{room / 'truth.npz'}: 1,500 of 3,000 points have no match in {part} and count as"
    assert captured.err == f"torchrg: warning: {told} unlabelled.\n"
    found, truth = json.loads(captured.out), read_cloud(room / "truth.npz")
    assert found["match"] == {"points": SIZE, "unmatched": SIZE // 2, "unused": 0}
    ours = {name: v.copy() for name, v in read_cloud(room / "ours.npz").fields.items()}
    ours["labels"][lost] = ours["superpoints"][lost] = -1
    ours["normals"][lost] = 0
    labels = score_labels(ours["labels"], truth.fields["labels"])
    assert found["labels"] == labels._asdict()
    normals = score_normals(ours["normals"], truth.fields["normals"])
    assert found["normals"]["rms"] == normals.rms
    assert found["normals"]["invalid"] == SIZE // 2
    parts = score_partition(ours["superpoints"], truth.fields["labels"], truth.points)
    assert found["superpoints"] == parts._asdict()


def test_every_true_point_counts_once_and_predicted_ones_beyond_nowhere(room, capsys):
    cloud, truth = read_cloud(room / "truth.npz"), room / "half.npz"
    fields = {name: values[:1000] for name, values in cloud.fields.items()}
    write_cloud(truth, Cloud(cloud.coordinates[:1000], fields))
    found = scores_of(capsys, room / "ours.npz", truth, *NEAR)
    assert found["match"] == {"points": 1000, "unmatched": 0, "unused": 2000}
    ours = read_cloud(room / "ours.npz").fields["labels"][:1000]
    assert found["labels"] == score_labels(ours, fields["labels"])._asdict()


@pytest.mark.parametrize("distance", ["0", "-1", "nan"])
def test_a_distance_is_positive(room, capsys, distance):
    line = refused(capsys, room / "ours.npz", room / "truth.npz", "--match-distance", distance)
    assert f"expected --match-distance > 0, got {float(distance)}" in line


def test_points_that_are_not_finite_agree_with_each_other(room, capsys):
    for name in ("ours", "truth"):
        cloud = read_cloud(room / f"{name}.npz")
        points = cloud.coordinates.copy()
        points[3], points[9] = np.nan, np.inf
        write_cloud(room / f"holes_{name}.npz", Cloud(points, cloud.fields))
    scores_of(capsys, room / "holes_ours.npz", room / "holes_truth.npz")
    line = refused(capsys, room / "holes_ours.npz", room / "truth.npz")
    assert "got others (2 of 3,000 rows, the first 3: nan nan nan for" in line


@pytest.fixture(scope="module")
def converted(tmp_path_factory):
    """Two rooms with truth, one below another folder, and what ``convert`` made of them."""
    root = tmp_path_factory.mktemp("converted")
    (root / "truth" / "east").mkdir(parents=True)
    for seed, name in enumerate(("hall.npz", "east/office.ply")):
        path = str(root / "truth" / name)
        assert main(["sample", path, "--num-points", "2000", "--seed", str(seed)]) == 0
    command = ["convert", "folder", str(root / "truth"), str(root / "out"), "--workers", "1"]
    assert main([*command, "--preset", "classic", "--superpoint"]) == 0
    return root


def test_results_of_convert_are_scored_as_files_are(converted, tmp_path, capsys):
    capsys.readouterr()
    found = scores_of(capsys, converted / "out", converted / "truth", "--superpoints")
    assert list(found["scans"]) == ["east/office", "hall"]
    plane = np.load(converted / "out" / "hall" / "plane.npy")
    truth = read_cloud(converted / "truth" / "hall.npz").fields["labels"]
    assert found["scans"]["hall"]["labels"] == score_labels(plane, truth)._asdict()
    assert set(found["mean"]) == {"labels", "normals", "superpoints"}
    one = scores_of(capsys, converted / "out" / "hall", converted / "truth" / "hall.npz")
    assert one["labels"] == found["scans"]["hall"]["labels"]
