"""What float32, or a coarse scale, has taken from coordinates is reported once, where it is so."""

import warnings

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree

from torchrg import Cloud, estimate_normals, load_config, read_cloud, segment_planes, write_cloud
from torchrg.batch.scans import Job, convert_scan
from torchrg.batch.sources import CloudSource
from torchrg.datasets import FolderOfClouds
from torchrg.errors import PrecisionWarning
from torchrg.pipeline.clouds import check_finite
from torchrg.structures.precision import describe_placeholders, describe_steps, is_fine_step
from torchrg.transforms import SegmentPlanes

UTM = np.array([500_000.0, 5_400_000.0, 300.0])
LINE = "coordinates have steps of 0.5 for a spacing of about 0.09"


@pytest.fixture
def places(room):
    return room(4000, 0.003, 0).points.double().numpy()


def moved(places, offset):
    return (places + offset).astype(np.float32)


@pytest.mark.parametrize("num_points", [500, 4000, 20_000])
@pytest.mark.parametrize("offset", [0.0, 1e3, 1e4, 1e5, 3e5, 1e6, UTM])
def test_the_line_comes_where_steps_are_a_tenth_of_the_spacing(num_points, offset, room):
    places = room(num_points, 0.003, 0).points.double().numpy()
    spacing = np.median(KDTree(places).query(places, k=2)[0][:, 1])
    step = np.spacing(np.float32(np.max(offset)))
    found = describe_steps(moved(places, offset))
    if not 0.07 < step / spacing < 0.15:
        assert bool(found) == (step > 0.1 * spacing)
    if found:
        assert f"steps of {step:.2g} for" in found
        message = float(found.split("about ")[1].split(";")[0])
        assert spacing / 2 < message < 2 * spacing


def test_the_line_does_not_depend_on_the_order_of_the_points(places):
    random = np.random.default_rng(0)
    for offset in (3e5, UTM):
        points = moved(places, offset)
        found = {describe_steps(points[random.permutation(len(points))]) for _ in range(5)}
        assert len(found) == 1
        assert found != {""}


def test_dense_parts_of_a_cloud_count_though_the_whole_is_wide():
    random = np.random.default_rng(1)
    dense = random.random((9000, 3)) * [1, 1, 0]
    wide = random.random((11_000, 3)) * [200, 200, 0]
    points = np.concatenate([dense * 2, wide[:2000], dense * 0.5 + 1, wide[2000:]]) + 5e4
    nearest = KDTree(points).query(points, k=2)[0][:, 1]
    step = np.spacing(np.float32(points.max()))
    even = np.subtract(*np.quantile(points, [0.75, 0.25], axis=0)).max() / len(points) ** 0.5
    assert step < 0.1 * even
    assert step > 0.1 * np.median(nearest)
    assert f"steps of {step:.2g} for" in describe_steps(points.astype(np.float32))


def test_single_points_far_off_do_not_decide(places):
    near, far = moved(places, 0), moved(places, UTM)
    near[:5], far[:5] = 1e7, 0
    assert describe_steps(near) == ""
    assert LINE in describe_steps(far)


@pytest.mark.parametrize("value", [np.nan, np.inf, np.finfo(np.float32).max])
def test_missing_points_do_not_count(places, value):
    points = moved(places, UTM)
    points[::3] = value
    assert "steps of 0.5" in Cloud(points).precision_note


def test_what_cannot_be_told_is_not_told(places):
    assert describe_steps(moved(places, UTM)[:2]) == ""
    assert describe_steps(np.full((50, 3), 5.4e6, np.float32)) == ""
    assert describe_steps(np.zeros((0, 3), np.float32)) == ""
    assert describe_steps(np.full((9, 3), np.nan, np.float32)) == ""
    assert describe_steps(places + UTM) == ""


@pytest.mark.parametrize(
    "call",
    [
        lambda points: segment_planes(points, "classic"),
        lambda points: estimate_normals(points, method="pca"),
        lambda points: SegmentPlanes("classic")({"coord": torch.from_numpy(points)}),
    ],
    ids=["segment_planes", "estimate_normals", "SegmentPlanes"],
)
def test_the_library_warns_once_a_call(places, call):
    with pytest.warns(PrecisionWarning, match=f"{LINE}; pass float64, or subtract") as caught:
        call(moved(places, UTM))
    assert [warning.filename for warning in caught] == [__file__]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        call(moved(places, 0))


def test_the_warning_of_a_cloud_is_where_its_points_were_taken(places):
    points = moved(places, UTM)
    with pytest.warns(PrecisionWarning, match=r"^scan.ply: coordinates have steps") as caught:
        _ = Cloud(points, source="scan.ply").points
    assert caught[0].filename == __file__


def test_points_of_a_file_warn_once_with_its_name(places, tmp_path):
    for dtype in (np.float32, np.float64):
        write_cloud(tmp_path / f"{dtype.__name__}.ply", Cloud((places + UTM).astype(dtype)))
    cloud = read_cloud(tmp_path / "float32.ply")
    with pytest.warns(PrecisionWarning, match=r"float32\.ply: coordinates have steps") as caught:
        segment_planes(cloud.points, "classic")
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        segment_planes(cloud.points, "classic")
        segment_planes(read_cloud(tmp_path / "float64.ply").points, "classic")


def test_a_point_so_far_off_that_float32_is_too_coarse_for_all_others_is_told(places):
    cloud = Cloud(np.concatenate([places + UTM, [[0, 0, 0]]]))
    assert cloud.precision_note.startswith(LINE)
    assert "leave out points that are far off, or cut the cloud" in cloud.precision_note


def test_a_coarse_scale_of_las_is_told(places, tmp_path):
    laspy = pytest.importorskip("laspy")
    for scale in (0.01, 0.1):
        header = laspy.LasHeader(point_format=0, version="1.2")
        header.scales, header.offsets = [scale] * 3, UTM
        data = laspy.LasData(header)
        data.x, data.y, data.z = (places + UTM).T
        data.write(str(tmp_path / f"{scale}.las"))
    assert read_cloud(tmp_path / "0.01.las").precision_note == ""
    expected = (
        "coordinates have steps of 0.1 for a spacing of about 0.09; write it with a finer scale"
    )
    assert read_cloud(tmp_path / "0.1.las").precision_note == expected


@pytest.mark.parametrize(
    "command",
    [
        ["segment", "--preset", "classic"],
        ["normals", "--method", "pca"],
        ["align", "--preset", "classic"],
    ],
    ids=lambda words: words[0],
)
def test_commands_say_it_once_a_file(places, tmp_path, run, command):
    np.save(tmp_path / "single.npy", moved(places, UTM))
    np.save(tmp_path / "double.npy", places + UTM)
    (name, *flags), lines = command, []
    for kind in ("single", "double"):
        path = tmp_path / f"{kind}.npy"
        done = run(name, path, "--out", tmp_path / "out.npz", *flags)
        assert done.code == 0
        lines += [line for line in done.err.splitlines() if "steps" in line]
    fix = "write float64, or subtract an offset before saving"
    assert lines == [f"torchrg: warning: {tmp_path / 'single.npy'}: {LINE}; {fix}."]


def test_reports_of_convert_and_info_say_it_too(places, tmp_path, run):
    (tmp_path / "scans").mkdir()
    np.save(tmp_path / "scans" / "hall.npy", moved(places, UTM))
    source = CloudSource(FolderOfClouds(tmp_path / "scans"), load_config("classic"))
    report = convert_scan(Job(source, source.list_scans(tmp_path / "out")[0], tmp_path / "out"))
    assert [LINE in warning for warning in report.warnings] == [True]
    assert run("info", tmp_path / "scans" / "hall.npy").out.count(LINE) == 1


@pytest.mark.parametrize(("count", "is_said"), [(0, False), (9, False), (10, True), (100, False)])
def test_points_that_stand_for_missing_pixels_are_said(count, is_said):
    points = np.random.default_rng(0).normal(size=(100, 3)) + 5
    points[:count] = 0
    points[-1, 0] = np.nan if count < 100 else 0
    note = describe_placeholders(points)
    assert note.startswith(f"{count} of 100 points lie at 0 0 0, as pixels") == is_said
    assert bool(note) == is_said
    notes = check_finite(Cloud(points))
    assert sum("0 0 0" in text for text in notes) == is_said
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        segment_planes(torch.from_numpy(points))
    said = [str(warning.message) for warning in caught if "0 0 0" in str(warning.message)]
    assert len(said) == is_said


def test_is_fine_step_by_example():
    points = np.arange(12.0).reshape(4, 3)
    assert (is_fine_step(1e-6, points), is_fine_step(1.0, points)) == (True, False)
