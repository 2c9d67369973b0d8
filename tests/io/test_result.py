"""What is written about a cloud is read back: from every format, with the table of its planes."""

import json
import re
from dataclasses import fields, replace

import numpy as np
import pytest
import torch

import torchrg
from tests.io.conftest import needs
from torchrg.config import PlanesConfig, load_config
from torchrg.datasets import write_pointcept_scene
from torchrg.datasets.pointcept import write_results
from torchrg.errors import FormatError, ShapeError
from torchrg.io import FORMATS
from torchrg.io.result import Result
from torchrg.neighbors.order import finite_rows
from torchrg.render.page import make_page
from torchrg.scenes import make_room
from torchrg.structures import Cloud, PlaneAdjacency, Planes
from torchrg.structures.planes import PLANE_COLUMNS
from torchrg.transforms import OrientNormals

CLASSIC = load_config("classic")
OUTLINED = replace(CLASSIC, planes=PlanesConfig(up="z", outline=True))


@pytest.fixture(scope="module")
def cloud():
    room = make_room(num_points=6000, noise=0.002, seed=3)
    color = np.arange(18000).reshape(-1, 3).astype(np.uint8)
    return Cloud(room.points.numpy(), {"color": color}, source="room.ply")


@pytest.fixture(scope="module")
def seg(cloud):
    pytest.importorskip("shapely", reason="needs the extra outline")
    return torchrg.segment_planes(cloud.points, OUTLINED)


@pytest.fixture(scope="module")
def parts(cloud, seg):
    return torchrg.make_superpoints(cloud.points, seg)


def assert_same_table(found, expected, tolerance=0.0):
    """Check all that tables hold; outlines ring by ring."""
    assert (found.adjacency is None) == (expected.adjacency is None)
    for name in PLANE_COLUMNS:
        ours, theirs = getattr(found, name), getattr(expected, name)
        assert ours.dtype == theirs.dtype, name
        torch.testing.assert_close(ours, theirs, rtol=0, atol=tolerance, msg=name)
    if expected.adjacency is not None:
        for ours, theirs in zip(found.adjacency, expected.adjacency, strict=True):
            torch.testing.assert_close(ours, theirs, rtol=0, atol=tolerance)


def assert_same_parts(found, expected, tolerance=0.0):
    """Check kinds and outlines, which files may leave out."""
    assert torch.equal(found.kind, expected.kind)
    assert list(map(len, found.outline)) == list(map(len, expected.outline))
    for ours, theirs in zip(sum(found.outline, ()), sum(expected.outline, ()), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=tolerance)


def assert_same_points(found, expected, names=("labels", "normals", "curvature", "sharp", "valid")):
    for name in names:
        ours, theirs = getattr(found, name), getattr(expected, name).flatten(0, -1)
        theirs = theirs.reshape(ours.shape)
        assert ours.dtype == theirs.dtype, name
        assert torch.equal(ours, theirs), name


def table_of_page(page):
    text = re.search(r'id="description">(.*?)</script>', page.html, re.DOTALL)[1]
    return json.loads(text)["clouds"][0]["planes"]


def pairs_of_page(planes):
    return sorted(
        {tuple(sorted((own, met[0]))) for own, p in enumerate(planes) for met in p["meets"]}
    )


def test_an_archive_holds_all_of_a_result(tmp_path, cloud, seg, parts):
    provenance = {"torchrg": "1", "config": {"k": 50}}
    torchrg.write_cloud(tmp_path / "a.npz", cloud, seg, superpoints=parts, provenance=provenance)
    result = torchrg.read_result(tmp_path / "a.npz")
    np.testing.assert_array_equal(result.cloud.coordinates, cloud.coordinates)
    assert_same_points(result.segmentation, seg)
    assert len(seg.planes.adjacency.pairs) == 10
    assert_same_table(result.segmentation.planes, seg.planes)
    assert_same_parts(result.segmentation.planes, seg.planes)
    assert torch.equal(result.segmentation.points, cloud.points)
    assert result.provenance == provenance
    assert torch.equal(result.superpoints.labels, parts.labels)
    assert torch.equal(result.superpoints.plane, parts.plane)
    for ours, theirs in zip(result.superpoints.levels, parts.levels, strict=True):
        assert torch.equal(ours, theirs)
    assert result.planes is result.table


def test_far_results_are_read_about_the_origin_of_their_cloud(tmp_path, cloud):
    far = Cloud(cloud.coordinates.astype(np.float64) + np.array([5e5, 5.4e6, 300.0]))
    assert far.origin.any()
    seg = torchrg.segment_planes(far.points, OUTLINED)
    torchrg.write_cloud(tmp_path / "far.npz", far, seg)
    result = torchrg.read_result(tmp_path / "far.npz")
    assert_same_table(result.planes, seg.planes, tolerance=1e-6)
    assert_same_parts(result.planes, seg.planes, tolerance=1e-6)


@pytest.mark.parametrize(
    "suffix", [kind for kind, row in FORMATS.items() if row.write and kind != ".npz"]
)
def test_other_formats_hold_fields_from_which_the_same_table_is_made(
    tmp_path, cloud, seg, parts, suffix
):
    needs(suffix)
    # A thousandth is the grid that LAS is written with, and exact in no binary number.
    bare = Cloud((cloud.coordinates * 1024).round() / 1024)
    torchrg.write_cloud(tmp_path / f"a{suffix}", bare, seg, superpoints=parts)
    result = torchrg.read_result(tmp_path / f"a{suffix}")
    found = result.segmentation
    assert torch.equal(found.labels, seg.labels)
    torch.testing.assert_close(found.normals.float(), seg.normals, rtol=0, atol=1e-6)
    torch.testing.assert_close(found.curvature.float(), seg.curvature, rtol=0, atol=1e-6)
    assert torch.equal(found.valid, seg.valid)
    assert torch.equal(result.superpoints.labels, parts.labels)
    assert torch.equal(result.superpoints.plane, parts.plane)
    rows = finite_rows(bare.points)
    points = bare.points[rows]
    neighbors = torchrg.search_knn(points, 50, canonical=True)
    expected = torchrg.regions.summarize_planes(
        points, seg.normals[rows], seg.labels[rows], neighbors=neighbors
    )
    assert torch.equal(found.planes.count, seg.planes.count)
    torch.testing.assert_close(found.planes.offset, expected.offset, rtol=0, atol=1e-3)
    torch.testing.assert_close(found.planes.area, expected.area, rtol=1e-2, atol=1e-3)
    if suffix in (".ply", ".pcd", ".npy"):  # The others write numbers in other ways.
        assert_same_table(found.planes, expected, tolerance=1e-6)


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (30.0, -70.0, 0.5)])
def test_a_folder_of_convert_is_read_back(tmp_path, cloud, parts, origin):
    moved = Cloud(cloud.coordinates + np.array(origin, dtype=np.float32))
    seg = torchrg.segment_planes(moved.points, OUTLINED)
    fields = {"color": cloud.fields["color"], "superpoint": parts.labels.numpy().astype(np.int32)}
    write_results(tmp_path, moved.coordinates, seg, fields=fields, origin=moved.origin.tolist())
    (tmp_path / "provenance.json").write_text('{"versions": {"torchrg": "1"}}')
    result = torchrg.read_result(tmp_path)
    assert_same_points(result.segmentation, seg, ("labels", "normals", "curvature", "valid"))
    assert_same_table(result.planes, seg.planes, tolerance=1e-6)
    assert_same_parts(result.planes, seg.planes, tolerance=1e-6)
    assert torch.equal(result.superpoints.labels, parts.labels)
    assert torch.equal(result.fields["color"], torch.from_numpy(cloud.fields["color"]))
    assert result.provenance == {"versions": {"torchrg": "1"}}


def test_a_scene_in_the_layout_of_pointcept_is_read_back(tmp_path, cloud, seg):
    write_pointcept_scene(tmp_path, {"coord": cloud.coordinates}, seg)
    result = torchrg.read_result(tmp_path)
    assert_same_points(result.segmentation, seg, ("labels", "normals", "curvature", "valid"))
    assert_same_table(result.planes, seg.planes)
    assert_same_parts(result.planes, seg.planes)


def depth_image():
    """A corner of three walls, seen from within."""
    v, u = torch.meshgrid(torch.arange(48.0), torch.arange(64.0), indexing="ij")
    rays = torch.stack([(u - 31.5) / 60, (v - 23.5) / 60, torch.ones_like(u)], dim=-1)
    walls = torch.tensor([[0.0, 0.8, 0.6], [0.8, 0.0, 0.6], [-0.8, 0.0, 0.6]])
    return (2 / (rays @ walls.T)).where(rays @ walls.T > 0, torch.inf).amin(dim=-1)


def test_a_frame_of_convert_is_read_back_with_its_grid(tmp_path):
    depth = depth_image()
    intrinsics = torch.tensor([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]])
    seg = torchrg.depth.segment_depth(depth, intrinsics)
    points = torchrg.depth.depth_to_points(depth[None], intrinsics[None])[0]
    write_results(tmp_path, points.numpy(), seg)
    result = torchrg.read_result(tmp_path)
    assert result.cloud.grid_shape == (48, 64)
    assert len(result.names) == 3
    assert_same_points(result.segmentation, seg, ("labels", "normals", "curvature"))
    assert torch.equal(result.table.count, seg.planes.count)
    torch.testing.assert_close(result.table.offset.double(), seg.planes.offset.double())
    assert result.table.adjacency is None
    assert result.planes.adjacency.pairs.tolist() == [[0, 1], [0, 2], [1, 2]]
    in_memory = Result.from_segmentation(
        Cloud(points.reshape(-1, 3).numpy(), grid_shape=(48, 64)), seg
    )
    assert torch.equal(in_memory.labels, result.labels)


def test_the_page_shows_the_table_of_the_result():
    pytest.importorskip("pydeck", reason="needs the extra view")
    points = make_room(num_points=20_000, noise=0.004, seed=3).points
    seg = torchrg.segment_planes(points, replace(CLASSIC, planes=PlanesConfig(up="z")))
    result = Result.from_segmentation(Cloud(points.numpy()), seg)
    shown = table_of_page(make_page(result))
    assert pairs_of_page(shown) == [tuple(p) for p in seg.planes.adjacency.pairs.tolist()]
    for name in ("count", "area", "rms", "extent", "normal", "offset", "kind", "curved"):
        assert [plane[name] for plane in shown] == getattr(seg.planes, name).tolist(), name
    few = table_of_page(make_page(result, max_points=2000))
    assert pairs_of_page(few) == pairs_of_page(shown)


def test_a_page_draws_the_outlines_of_the_result(cloud, seg):
    pytest.importorskip("pydeck", reason="needs the extra view")
    shown = table_of_page(make_page(Result.from_segmentation(cloud, seg)))
    sizes = [[len(ring) for ring in rings] or [4] for rings in seg.planes.outline]
    assert [[len(ring) for ring in plane["rings"]] for plane in shown] == sizes


def test_labels_from_elsewhere_get_one_table(monkeypatch, cloud, seg):
    pytest.importorskip("pydeck", reason="needs the extra view")
    calls = []

    def counted(*arguments, **settings):
        calls.append(arguments)
        return torchrg.regions.summarize_planes(*arguments, **settings)

    monkeypatch.setattr("torchrg.io.result.summarize_planes", counted)
    # Numbers with gaps, in the opposite order, and a point that is nowhere.
    labels = torch.where(seg.labels >= 0, 1000 - 7 * seg.labels, -1).numpy()
    coordinates = np.concatenate([cloud.coordinates, [[np.nan, 0, 0]]]).astype(np.float32)
    fields = {
        "labels": np.append(labels, 5),
        "normals": np.concatenate([seg.normals.numpy(), np.zeros((1, 3), np.float32)]),
    }
    result = Result(Cloud(coordinates, fields))
    shown = table_of_page(make_page(result))
    assert table_of_page(make_page(result)) == shown
    assert len(calls) == 1
    assert [plane["name"] for plane in shown] == sorted(set(labels.tolist()) - {-1})
    assert result.planes.count.flip(0).tolist() == seg.planes.count.tolist()
    torch.testing.assert_close(result.planes.normal.flip(0), seg.planes.normal)
    torch.testing.assert_close(result.planes.area.flip(0), seg.planes.area)
    last = len(shown) - 1
    mirrored = sorted(
        tuple(sorted((last - a, last - b))) for a, b in seg.planes.adjacency.pairs.tolist()
    )
    assert pairs_of_page(shown) == mirrored
    assert torch.equal(
        result.segmentation.labels[:-1], torch.where(seg.labels >= 0, last - seg.labels, -1)
    )


def test_neighbors_of_the_segmentation_are_not_searched_again(monkeypatch, cloud, seg):
    bare = replace(seg, planes=replace(seg.planes, adjacency=None))
    searched = Result.from_segmentation(cloud, bare).planes
    rows = finite_rows(cloud.points)
    known = replace(bare, neighbors=torchrg.search_knn(cloud.points[rows], 50, canonical=True))
    monkeypatch.setattr("torchrg.io.result.search_knn", None)
    result = Result.from_segmentation(cloud, known)
    assert_same_table(result.planes, searched)
    assert result.segmentation.neighbors is known.neighbors
    with pytest.raises(TypeError, match="not callable"):
        _ = Result.from_segmentation(cloud, bare).planes


def test_a_result_is_a_sample_of_transforms(cloud, seg, parts):
    sample = Result.from_segmentation(cloud, seg, parts).to_dict()
    assert torch.equal(sample["coord"], cloud.points)
    assert torch.equal(sample["plane"], seg.labels)
    assert torch.equal(sample["superpoint"].long(), parts.labels)
    assert np.array_equal(sample["origin"][0], cloud.origin)
    assert len(sample["planes"]) == len(seg.planes)
    turned = OrientNormals("+z")(sample)["normal"]
    assert torch.equal(turned.abs(), seg.normals.abs())


def test_without_labels_there_is_no_table(tmp_path, cloud):
    torchrg.write_cloud(tmp_path / "a.ply", cloud)
    result = torchrg.read_result(tmp_path / "a.ply")
    assert result.planes is result.segmentation is result.superpoints is None
    assert len(result.names) == 0


@pytest.mark.parametrize(
    "change", ["labels", "moved", "huge", "shape", "kind", "pairs", "number", "missing"]
)
def test_a_table_that_is_not_of_the_labels_is_left_out(tmp_path, cloud, seg, change):
    torchrg.write_cloud(tmp_path / "a.npz", cloud, seg)
    arrays = dict(np.load(tmp_path / "a.npz"))
    if change == "labels":
        arrays["labels"][arrays["labels"] == 0] = -1
    elif change == "moved":
        arrays["labels"][np.flatnonzero(arrays["labels"] == 1)[:5]] = 0
    elif change == "huge":
        arrays["labels"] = np.where(arrays["labels"] < 0, -7, arrays["labels"] * 10**15)
    elif change == "number":
        arrays["plane_count"] = np.array(7)
        arrays["plane_of_superpoint"] = np.array(["a"])
    elif change == "shape":
        arrays["plane_axes"] = arrays["plane_axes"][:, 0]
    elif change == "kind":
        arrays["plane_kind"] = np.full(len(arrays["plane_kind"]), "roof")
    elif change == "pairs":
        arrays["adjacency_pairs"][0, 1] = 999
    else:
        del arrays["plane_rms"]
    np.savez(tmp_path / "b.npz", **arrays)
    result = torchrg.read_result(tmp_path / "b.npz")
    assert result.table is None
    assert result.cloud.notes == ("plane table left out, because it does not match the labels",)
    counts = np.unique(arrays["labels"][arrays["labels"] >= 0], return_counts=True)[1]
    assert result.planes.count.tolist() == counts.tolist()


@pytest.mark.parametrize(
    "content",
    ["{", "[]", '{"planes": 5}', '{"planes": [{"id": 0}]}', pytest.param("[" * 200_000, id="deep")],
)
def test_a_table_of_others_in_a_folder_is_left_out(tmp_path, cloud, seg, content):
    write_pointcept_scene(tmp_path, {"coord": cloud.coordinates}, seg)
    (tmp_path / "planes.json").write_text(content)
    (tmp_path / "provenance.json").write_bytes(b"\xff[]" if len(content) < 99 else b"[" * 200_000)
    result = torchrg.read_result(tmp_path)
    assert result.provenance == {}
    assert result.table is None
    assert "plane table left out" in result.cloud.notes[0]
    assert torch.equal(result.planes.count, seg.planes.count)


def test_planes_of_points_anywhere_are_found(tmp_path, cloud, seg):
    path = tmp_path / "a.ply"
    torchrg.write_cloud(path, cloud, seg)
    content = path.read_bytes()
    # A lost byte makes any number of each field.
    path.write_bytes(content[: len(content) // 2] + content[len(content) // 2 + 1 :] + b"\0")
    planes = torchrg.read_result(path).planes
    assert len(planes) > len(seg.planes)
    assert (planes.adjacency.boundary_length >= 0).all()


def test_no_planes_are_read_back_too(tmp_path):
    points = np.random.default_rng(0).random((40, 3)).astype(np.float32)
    cloud = Cloud(points)
    seg = torchrg.segment_planes(cloud.points, CLASSIC)
    assert len(seg.planes) == 0
    torchrg.write_cloud(tmp_path / "a.npz", cloud, seg)
    write_results(tmp_path, points, seg)
    for path in (tmp_path / "a.npz", tmp_path):
        result = torchrg.read_result(path)
        assert result.table is not None
        assert_same_table(result.segmentation.planes, seg.planes)


def test_columns_of_files_are_those_of_the_table():
    names = [part.name for part in fields(Planes)]
    assert names == [*PLANE_COLUMNS, "kind", "outline", "adjacency", "object"]
    assert PlaneAdjacency._fields[0] == "pairs"


def test_segmentations_of_other_points_and_other_files_are_refused(tmp_path, cloud, seg):
    with pytest.raises(ShapeError, match="expected a segmentation of 3 points, got 6,000"):
        Result.from_segmentation(Cloud(np.eye(3)), seg)
    with pytest.raises(FormatError, match=r"file not found"):
        torchrg.read_result(tmp_path / "gone.npz")
    with pytest.raises(FormatError, match=r"expected coord\.npy, got none"):
        torchrg.read_result(tmp_path)


def test_superpoints_of_numbers_beyond_that_of_points_are_numbered_anew(tmp_path, cloud, parts):
    numbers = parts.labels.numpy()
    far = numbers * 100_000_000_000 + 2**31
    torchrg.write_cloud(tmp_path / "a.npz", replace(cloud, fields={"superpoint": far}))
    found = torchrg.read_result(tmp_path / "a.npz").superpoints
    assert found.labels.tolist() == numbers.tolist()
    assert len(found.plane) == numbers.max() + 1


def test_planes_of_labels_without_normals_are_flat():
    cloud = Cloud(
        np.random.default_rng(0).random((60, 3)) * [1, 0, 1], {"labels": np.zeros(60, int)}
    )
    assert Result(cloud).planes.curved.tolist() == [False]
