"""``--table``: the plane table next to any result; ``--within``: planes of objects."""

import csv
import json

import numpy as np
import pytest
import torch

from torchrg.cli import flags
from torchrg.config import load_config
from torchrg.io import read_cloud, write_cloud
from torchrg.io.result import read_result
from torchrg.pipeline import segment_planes
from torchrg.structures import PLANE_KINDS, Cloud

UTM = np.array([651_234.125, 5_412_345.5, 417.75])
CLASSIC = ("--preset", "classic")


@pytest.fixture(scope="module")
def scans(room, tmp_path_factory):
    """A folder with a room at UTM coordinates and fields of objects; its objects ``(N,)``."""
    made, folder = room(5000), tmp_path_factory.mktemp("scans")
    objects = (made.points[:, 0] / 2.5).long().numpy()
    fields = {
        "instance": objects.astype(np.int32),
        "height": made.points[:, 2].float().numpy(),
        "few": objects[:100],
    }
    np.savez(folder / "room.npz", points=made.points.double().numpy() + UTM, **fields)
    return folder, objects


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def files(folder):
    return sorted(path.name for path in folder.rglob("*") if path.is_file())


@pytest.mark.parametrize("suffix", [".npz", ".ply", ".laz", ".xyz"])
def test_a_table_goes_beside_any_result_and_keeps_coordinates(scans, tmp_path, run, suffix):
    if suffix == ".laz":
        pytest.importorskip("laspy", reason="needs the extra las")
    source, out, table = scans[0] / "room.npz", tmp_path / f"out{suffix}", tmp_path / "planes.csv"
    if suffix == ".laz":
        cloud = read_cloud(source)
        source = tmp_path / "in.laz"
        write_cloud(source, Cloud(cloud.coordinates))
    assert run("segment", source, *CLASSIC, "--out", out, "--table", table).code == 0
    rows, coordinates = rows_of(table), read_cloud(source).coordinates
    assert {row["kind"] for row in rows} >= {"floor", "wall"}
    labels = read_result(out).labels.numpy() if suffix != ".xyz" else None
    for row in rows if labels is not None else ():
        own = coordinates[labels == int(row["id"])]
        assert len(own) == int(row["count"])
        centroid = [float(row[f"centroid_{x}_m"]) for x in "xyz"]
        np.testing.assert_allclose(centroid, own.mean(axis=0), atol=1e-4)
        away = own @ [float(row[f"normal_{x}"]) for x in "xyz"] - float(row["offset_m"])
        assert np.sqrt((away**2).mean()) == pytest.approx(float(row["rms_m"]), abs=1e-4)


def test_outlines_and_roles_need_no_flag_and_a_flag_wins(scans, tmp_path, run, monkeypatch):
    places = (scans[0] / "room.npz", *CLASSIC, "--out", tmp_path / "out.npz", "--table")
    pytest.importorskip("shapely", reason="needs the extra outline")
    assert run("segment", *places, tmp_path / "1.csv").code == 0
    assert all(row["outline"].startswith("POLYGON Z ((6") for row in rows_of(tmp_path / "1.csv"))
    assert run("segment", *places, tmp_path / "2.csv", "--up=-z").code == 0
    first, second = ([row["kind"] for row in rows_of(tmp_path / f"{i}.csv")] for i in (1, 2))
    swapped = {"floor": "ceiling", "ceiling": "floor"}
    assert [swapped.get(kind, kind) for kind in first] == second
    monkeypatch.setattr(flags, "find_spec", lambda name: None)
    assert run("segment", *places, tmp_path / "3.csv").code == 0
    assert {row["outline"] for row in rows_of(tmp_path / "3.csv")} == {""}


def test_several_inputs_have_a_table_each(scans, folder_of_clouds, tmp_path, run):
    rooms = folder_of_clouds("a.ply", "b.ply")
    places = ("--out", tmp_path / "out", "--table", tmp_path / "tables")
    assert run("segment", rooms / "a.ply", rooms / "b.ply", *CLASSIC, *places).code == 0
    assert files(tmp_path / "tables") == ["a.csv", "b.csv"]


def test_json_is_the_planes_json_of_convert(scans, tmp_path, run):
    table, out = tmp_path / "planes.json", tmp_path / "out"
    command = ("segment", scans[0] / "room.npz", *CLASSIC, "--out", tmp_path / "o.npz")
    assert run(*command, "--table", table).code == 0
    assert run("convert", "folder", scans[0], out, *CLASSIC, "--table", "planes.csv").code == 0
    written = json.loads((out / "room" / "planes.json").read_text())
    assert json.loads(table.read_text()) == written
    rows = rows_of(out / "room" / "planes.csv")
    offsets = [row["offset"] for row in written["planes"]]
    np.testing.assert_allclose([float(row["offset_m"]) for row in rows], offsets, atol=1e-4)


@pytest.mark.parametrize("flags", [(), ("--preset", "classic")])
def test_up_is_z_in_every_command_without_a_flag(scans, tmp_path, run, flags):
    source, out = scans[0] / "room.npz", tmp_path / "out"
    assert run("segment", source, *flags, "--out", tmp_path / "o.npz").code == 0
    assert run("align", source, *flags, "--segment", "--out", tmp_path / "a.npz").code == 0
    assert run("convert", "folder", scans[0], out, *flags).code == 0
    config = load_config(flags[1] if flags else "consensus", **{"planes.up": "z"})
    kinds = segment_planes(read_cloud(source), config).planes.kind
    assert PLANE_KINDS.index("floor") in kinds.tolist()
    for path in (tmp_path / "o.npz", tmp_path / "a.npz", out / "room"):
        assert torch.equal(read_result(path).planes.kind, kinds)


def test_convert_keeps_its_tables_and_never_replaces_those_of_others(scans, tmp_path, run):
    out, command = tmp_path / "out", ("convert", "folder", scans[0], tmp_path / "out", *CLASSIC)
    assert run(*command, "--table", "planes.csv").code == 0
    assert run(*command, "--table", "planes.csv").out.startswith("nothing to do")
    before = files(out)
    assert run(*command).code == 0
    assert files(out) == [name for name in before if name != "planes.csv"]
    (out / "room" / "planes.csv").write_text("mine")
    reported = run(*command, "--table", "planes.csv")
    assert (reported.code, "was not written by torchrg" in reported.err) == (3, True)
    assert (out / "room" / "planes.csv").read_text() == "mine"


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("planes.txt", "planes.txt: expected a file ending in .csv or .json or .dxf, got '.txt'"),
        ("no/planes.csv", "not found; create it first"),
        ("out.npz", "expected a file ending in .csv or .json or .dxf, got '."),
        ("room.xyz", "expected a file ending in .csv or .json or .dxf, got '."),
    ],
)
def test_a_table_without_a_place_is_refused_before_the_work(scans, tmp_path, run, table, message):
    source = scans[0] / "room.npz"
    refused = run("segment", source, "--out", tmp_path / "out.npz", "--table", tmp_path / table)
    assert message in refused.error
    assert files(tmp_path) == []


@pytest.mark.parametrize(
    "table", ["../planes.csv", "planes.txt", "provenance.json", ".csv", "a/b.csv"]
)
def test_convert_refuses_a_table_outside_the_folder_of_a_scan(scans, tmp_path, run, table):
    reported = run("convert", "folder", scans[0], tmp_path / "out", "--table", table)
    assert "expected --table to be a name ending in .csv or .json or .dxf" in reported.error
    assert not (tmp_path / "out").exists()


def test_no_plane_of_a_file_has_points_of_two_objects(scans, tmp_path, run):
    folder, objects = scans
    out, table = tmp_path / "out.npz", tmp_path / "planes.csv"
    command = ("segment", folder / "room.npz", "--out", out, "--table", table)
    assert run(*command, "--within", "instance").code == 0
    result = read_result(out)
    for row, own in zip(rows_of(table), result.planes.object.tolist(), strict=True):
        assert np.unique(objects[result.labels == int(row["id"])]).tolist() == [own]
        assert int(row["object"]) == own
    assert result.provenance["within"] == "instance"


def test_objects_of_other_files_are_found(scans, tmp_path, run):
    """Numbers in text, and in the scalar fields of CloudCompare's PLY, are floats."""
    cloud = read_cloud(scans[0] / "room.npz")
    few = Cloud(cloud.coordinates - UTM, {"instance": cloud.fields["instance"].astype(np.float32)})
    for name in ("room.ply", "room.txt", "room.npy"):
        write_cloud(tmp_path / name, few)
        out = tmp_path / f"{name}.npz"
        columns = ("--columns", "x,y,z,instance") if name.endswith("txt") else ()
        command = ("segment", tmp_path / name, *CLASSIC, "--out", out, *columns)
        reported = run(*command, "--within", "instance")
        assert reported.code == 0, reported.err
        assert set(read_result(out).planes.object.tolist()) <= set(scans[1].tolist())


def test_convert_keeps_planes_within_objects_in_every_kind_of_folder(scans, tmp_path, run):
    root, out = tmp_path / "root", tmp_path / "out"
    scene = root / "scene"
    scene.mkdir(parents=True)
    cloud = read_cloud(scans[0] / "room.npz")
    np.save(scene / "coord.npy", (cloud.coordinates - UTM).astype(np.float32))
    # ScanNet++ has three numbers a point, of which the first counts.
    np.save(scene / "instance.npy", np.stack([scans[1], scans[1] * 0 - 1], axis=1).astype(np.int16))
    np.save(scene / "segment20.npy", scans[1] % 2)
    for name, place in (("instance", out), ("segment", tmp_path / "out2"), ("instance", root)):
        reported = run("convert", "folder", root, place, *CLASSIC, "--within", name)
        assert reported.code == 0, reported.err
        planes = json.loads((place / "scene" / "planes.json").read_text())["planes"]
        labels = np.load(place / "scene" / "plane.npy")
        objects = scans[1] if name == "instance" else scans[1] % 2
        assert len(planes) > 3
        for row in planes:
            assert np.unique(objects[labels == row["id"]]).tolist() == [row["object"]]
    # Other objects give other planes, also in place.
    np.save(scene / "instance.npy", scans[1][:, None].astype(np.int16) // 2)
    reported = run("convert", "folder", root, root, *CLASSIC, "--within", "instance")
    assert "nothing to do" not in reported.out


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ("object", "room.npz: expected the field object of --within, got height, instance; choose"),
        ("height", "each of 5,000 points, got float32 of shape (5000,); number the objects."),
        ("few", "got height, instance (few skipped: not 5,000 rows); choose one of these"),
    ],
)
@pytest.mark.parametrize("command", ["segment", "convert"])
def test_what_are_no_objects_is_refused_in_one_line(scans, tmp_path, run, command, field, message):
    if command == "segment":
        reported = run(
            "segment", scans[0] / "room.npz", "--out", tmp_path / "o.npz", "--within", field
        )
        assert message in reported.error
        assert files(tmp_path) == []
        return
    reported = run("convert", "folder", scans[0], tmp_path / "out", "--within", field)
    assert reported.code == 3
    assert message in reported.err
    assert set(files(tmp_path)) == {".torchrg.lock", "report.json"}


def test_frames_have_tables_too(tmp_path, run):
    depth = torch.full((60, 80), 2.0)
    depth[:, 50:] = 2.5
    np.save(tmp_path / "frame.npy", depth.numpy())
    camera = ("--intrinsics", "50,50,39.5,29.5", "--depth-scale", "1")
    assert run("depth", tmp_path / "frame.npy", *camera, "--out", tmp_path / "labels.png").code == 0
    rows = json.loads((tmp_path / "labels.json").read_text())["planes"]
    assert [row["id"] for row in rows] == [0, 1]
    np.testing.assert_allclose([row["normal"] for row in rows], [[0, 0, 1]] * 2, atol=1e-6)
    np.testing.assert_allclose([row["offset"] for row in rows], [2, 2.5], atol=1e-6)
    places = ("--out", tmp_path / "cloud.ply", "--table", tmp_path / "planes.csv")
    assert run("depth", tmp_path / "frame.npy", *camera, *places).code == 0
    assert [row["count"] for row in rows_of(tmp_path / "planes.csv")] == ["3000", "1800"]
    (tmp_path / "in").mkdir()
    (tmp_path / "frame.npy").rename(tmp_path / "in" / "frame.npy")
    done = run("convert", "rgbd", tmp_path / "in", tmp_path / "out", *camera, "--table", "p.csv")
    assert done.code == 0
    assert (tmp_path / "out" / "frame" / "p.csv").read_text() == (
        tmp_path / "planes.csv"
    ).read_text()
    written = json.loads((tmp_path / "out" / "frame" / "planes.json").read_text())
    assert written["planes"][0].keys() == rows[0].keys()
