"""Tables of planes for other programs: CSV, WKT, data frames, dip and dip direction."""

import csv
import io
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from torchrg import segment_planes
from torchrg.config import load_config
from torchrg.io.plane_table import (
    CSV_COLUMNS,
    describe_planes,
    encode_csv,
    simplify_table,
    tabulate_planes,
)
from torchrg.regions import summarize_planes
from torchrg.structures import PLANE_KINDS

UTM = [651_234.125, 5_412_345.5, 417.75]


@pytest.fixture(scope="module")
def square():
    """A square frame with a square hole, about an origin at UTM coordinates, tilted."""
    pytest.importorskip("shapely", reason="needs the extra outline")
    ticks = torch.linspace(-1, 1, 81, dtype=torch.float64)
    u, v = torch.cartesian_prod(ticks, ticks).unbind(1)
    kept = torch.maximum(u.abs(), v.abs()) > 0.4
    first, second = torch.tensor([[1.0, 0, 0], [0, 0.8, -0.6]], dtype=torch.float64)
    points = u[kept, None] * first + v[kept, None] * second
    normals = torch.linalg.cross(first, second).expand_as(points)
    labels = torch.zeros(len(points), dtype=torch.int64)
    return summarize_planes(points, normals, labels, outline=True, up="z")


def rows_of(content):
    return list(csv.DictReader(io.StringIO(content.decode())))


@pytest.mark.parametrize(
    ("normal", "dip", "direction"),
    [
        # A roof that falls to the north, east, south, west; the side of its normal does not matter.
        ((0, 1, 1), 45, 0),
        ((1, 0, 1), 45, 90),
        ((0, -1, 1), 45, 180),
        ((-1, 0, 1), 45, 270),
        ((1, 1, math.sqrt(6)), 30, 45),
        ((0, 0, 1), 0, 0),
        ((1, 0, 0), 90, 90),
        ((0, 1, 0), 90, 0),
    ],
)
def test_dip_is_that_of_a_compass(normal, dip, direction):
    normal = np.array(normal, dtype=float)
    x, y = np.linalg.svd(normal[None])[2][1:]
    grid = torch.cartesian_prod(*[torch.linspace(-1, 1, 9, dtype=torch.float64)] * 2)
    points = grid @ torch.from_numpy(np.stack([x, y]))
    normals = torch.from_numpy(normal / np.linalg.norm(normal)).expand_as(points)
    planes = summarize_planes(points, normals, torch.zeros(len(points), dtype=torch.int64))
    # Normals of depth images look at the camera, those of ceilings down.
    turned = replace(planes, normal=-planes.normal, offset=-planes.offset)
    for table in (planes, turned):
        (row,) = describe_planes(table)["planes"]
        assert row["dip_deg"] == pytest.approx(dip, abs=1e-6)
        assert (row["dip_direction_deg"] is None) == (dip == 0)
        if dip:
            turn = (row["dip_direction_deg"] - direction + 180) % 360 - 180
            assert turn == pytest.approx(0, abs=1e-6)


def test_the_outline_is_a_polygon_that_shapely_reads(square):
    shapely = pytest.importorskip("shapely")
    (row,) = rows_of(encode_csv(describe_planes(square, origin=UTM)))
    polygon = shapely.from_wkt(row["outline"])
    assert polygon.geom_type == "Polygon"
    assert polygon.has_z
    assert len(polygon.interiors) == 1
    # Seen from above the frame is foreshortened along y.
    assert polygon.area == pytest.approx(0.8 * (4 - 0.64), rel=0.1)
    places = shapely.get_coordinates(polygon, include_z=True)
    rings = simplify_table(describe_planes(square, origin=UTM))["planes"][0]["outline"]
    assert len(rings[0]) == 4
    expected = np.concatenate([[*ring, ring[0]] for ring in rings])
    np.testing.assert_array_equal(places, expected)
    normal, offset = [float(row[f"normal_{x}"]) for x in "xyz"], float(row["offset"])
    # Doubles have steps of 1e-9 there; float32 would have some of half a meter.
    np.testing.assert_allclose(places @ normal, offset, atol=5e-9)


def test_parts_that_do_not_touch_are_one_line(square):
    shapely = pytest.importorskip("shapely")
    far = tuple(ring + torch.tensor([9.0, 0, 0]) for ring in square.outline[0])
    two = replace(square, outline=((*square.outline[0], *far),))
    (row,) = rows_of(encode_csv(describe_planes(two)))
    polygons = shapely.from_wkt(row["outline"])
    assert polygons.geom_type == "MultiPolygon"
    assert [len(part.interiors) for part in polygons.geoms] == [1, 1]
    (row,) = rows_of(encode_csv(describe_planes(replace(square, outline=((),)))))
    assert shapely.from_wkt(row["outline"]).is_empty


def test_csv_has_the_numbers_of_the_json_to_a_hundredth_of_their_error(room):
    planes = segment_planes(room(4000).points.double(), load_config("classic")).planes
    described = describe_planes(planes, origin=UTM)
    step = 0.01 * float(planes.rms.median())
    found = rows_of(encode_csv(describe_planes(planes, origin=UTM)))
    for row, expected in zip(found, described["planes"], strict=True):
        assert int(row["id"]) == expected["id"]
        centroid = [float(row[f"centroid_{x}_m"]) for x in "xyz"]
        assert centroid == pytest.approx(expected["centroid"], rel=0, abs=step)
        normal = [float(row[f"normal_{x}"]) for x in "xyz"]
        assert normal == pytest.approx(expected["normal"], rel=0, abs=1e-12)
        for name in ("offset_m", "area_m2", "rms_m"):
            value = expected[name.partition("_")[0]]
            assert float(row[name]) == pytest.approx(value, rel=0, abs=step)
            assert len(row[name].partition(".")[2]) <= 2 - math.log10(step)
        assert int(row["count"]) == expected["count"]
        assert float(row["dip_deg"]) == pytest.approx(expected["dip_deg"], abs=1e-5)
        assert (row["dip_direction_deg"] == "") == (expected["dip_direction_deg"] is None)
        assert row["curved"] == str(expected["curved"])
        assert row["kind"] == expected["kind"] in PLANE_KINDS
        assert row["object"] == row["outline"] == ""
    # The offset is that of the plane as it stands in the file.
    moved = planes.normal.numpy() @ UTM
    own = [float(row["offset_m"]) for row in found] - moved
    np.testing.assert_allclose(own, planes.offset.numpy(), rtol=0, atol=step)


def test_the_columns_are_the_same_without_planes_and_with_all(square):
    plain = {name for name in CSV_COLUMNS if name not in ("normal", "centroid")}
    expected = plain | {f"{name}_{x}" for name in ("normal", "centroid") for x in "xyz"}
    none = segment_planes(torch.zeros(5, 3)).planes
    for planes in (none, square, replace(square, object=torch.tensor([4]))):
        header = encode_csv(describe_planes(planes)).decode().splitlines()[0].split(",")
        assert set(header) == expected
        assert list(tabulate_planes(describe_planes(planes))) == header
    assert encode_csv(describe_planes(none)).count(b"\n") == 1
    assert tabulate_planes(describe_planes(replace(square, object=torch.tensor([4]))))[
        "object"
    ] == [4]
    assert tabulate_planes(describe_planes(square))["kind"] == ["oblique"]


def test_a_data_frame_has_the_columns_of_the_table(room):
    pytest.importorskip("pandas", reason="needs the extra report")
    seg = segment_planes(room(4000).points, load_config("classic"))
    frame = seg.planes.to_pandas()
    assert list(frame) == list(tabulate_planes(describe_planes(seg.planes)))
    assert frame["count"].tolist() == seg.planes.count.tolist()
    assert frame["normal_z"].tolist() == seg.planes.normal[:, 2].tolist()
    assert len(segment_planes(torch.zeros(5, 3)).planes.to_pandas()) == 0


def test_a_dip_below_its_error_has_no_direction(rng):
    """Slopes of a thousandth are seen through 3 mm of noise by 10,000 points, not by 20."""
    for count, is_seen in ((10_000, True), (20, False)):
        flat = 4 * torch.rand(count, 2, generator=rng, dtype=torch.float64)
        noise = 0.003 * torch.randn(count, generator=rng, dtype=torch.float64)
        points = torch.stack([*flat.T, 0.001 * flat[:, 0] + noise], dim=1)
        labels, normals = torch.zeros(count, dtype=torch.int64), torch.eye(3)[[2] * count].double()
        (row,) = describe_planes(summarize_planes(points, normals, labels))["planes"]
        assert (row["dip_direction_deg"] is not None) == is_seen
        if is_seen:
            assert row["dip_direction_deg"] == pytest.approx(270, abs=10)


@pytest.mark.parametrize(("scale", "unit"), [(1.0, "m"), (1000.0, ""), (0.1, "")])
def test_the_unit_is_known_from_the_height_of_the_walls(room, scale, unit):
    planes = segment_planes(room(4000).points * scale, load_config("classic")).planes
    described = describe_planes(planes)
    assert described["unit"] == unit
    header = encode_csv(described).decode().splitlines()[0]
    assert ("area_m2" in header) == ("rms_m" in header) == (unit == "m")
