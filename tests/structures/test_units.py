"""Units of axes and the axis that is up are judged by the data."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

import torchrg
from torchrg import Cloud, read_cloud, segment_planes, write_cloud
from torchrg.errors import UnitWarning
from torchrg.pipeline.clouds import check_finite
from torchrg.scenes import make_room
from torchrg.structures.precision import describe_units

ROOM = make_room(4000, noise=0.003, seed=1).points.double().numpy()
DEGREES = ROOM * [1e-5, 1e-5, 1] + [8.5, 47.4, 400]
RNG = np.random.default_rng(0)


def landscape(width, height):
    x, y = width * RNG.random((2, 5000))
    z = height * (np.sin(5 * x / width) + np.sin(7 * y / width)) + RNG.normal(0, 0.03, 5000)
    return np.column_stack([x, y, z])


@pytest.mark.parametrize(
    "points",
    [DEGREES, ROOM * [1000, 1000, 1], landscape(1e3, 20) * [1e3, 1e3, 1], ROOM * [1, 1, 1000]],
)
def test_spans_that_cannot_be_of_one_unit_are_told(points):
    assert "one unit is unlikely" in describe_units(points)
    assert "one unit is unlikely" in check_finite(Cloud(points))[0]


@pytest.mark.parametrize(
    "points",
    [
        ROOM,
        ROOM * 1000,
        landscape(1e4, 10),
        landscape(1e3, 300),
        RNG.random((5000, 3)) * [30, 30, 0.01],
        RNG.random((5000, 3)) * [30, 30, 0],
        RNG.random((5000, 3)) * [0.3, 0.3, 12],
        RNG.random((5000, 3)) * [5000, 10, 5],
        ROOM[:50] * [1e-5, 1e-5, 1],
        np.full((200, 3), np.nan),
    ],
)
def test_spans_of_one_unit_are_not(points):
    assert describe_units(points) == ""


@pytest.mark.filterwarnings("ignore::torchrg.errors.PrecisionWarning")
def test_units_are_told_through_every_door(tmp_path):
    write_cloud(tmp_path / "a.ply", Cloud(DEGREES))
    calls = {
        "Cloud": lambda: Cloud(DEGREES).points,
        "file": lambda: segment_planes(tmp_path / "a.ply", "classic", orient="none"),
        "tensor": lambda: segment_planes(torch.from_numpy(DEGREES), "classic", orient="none"),
        "loader": lambda: torchrg.datasets.FolderOfClouds(tmp_path)[0],
    }
    for call in calls.values():
        with pytest.warns(UnitWarning, match="x and y span .* one unit is unlikely") as caught:
            call()
        assert len([w for w in caught if w.category is UnitWarning]) == 1


GEOGRAPHIC = 'GEOGCS["WGS 84",DATUM["WGS_1984"],UNIT["degree",0.0174532925199433]]'
PROJECTED = f'PROJCS["zone",{GEOGRAPHIC},UNIT["{{}}",{{}}]]'
HEIGHT = 'COMPD_CS["both",{},VERT_CS["height",UNIT["meter",1.0]]]'


@pytest.mark.parametrize(
    ("wkt", "note"),
    [
        (GEOGRAPHIC, "degrees by its header"),
        (HEIGHT.format(GEOGRAPHIC), "degrees by its header"),
        (PROJECTED.format("meter", 1), ""),
        (HEIGHT.format(PROJECTED.format("meter", 1)), ""),
        (HEIGHT.format(PROJECTED.format("foot", 0.3048)), "units of 0.3048 m, z of 1 m"),
        ('GEODCRS["earth",CS[Cartesian,3],LENGTHUNIT["meter",1]]', ""),
    ],
)
def test_the_reference_system_of_a_file_says_the_units(tmp_path, wkt, note):
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
    write_cloud(tmp_path / "a.las", Cloud(ROOM, header={"las": header}))
    cloud = read_cloud(tmp_path / "a.las")
    assert note in cloud.unit_note
    assert bool(note) == bool(cloud.unit_note)
    assert describe_units(ROOM, {"coordinate_metadata": wkt}) == cloud.unit_note


@pytest.mark.parametrize(("unit", "note"), [(9002, "units of 0.3048 m, z of 1 m"), (9001, "")])
def test_keys_of_geotiff_say_the_units(unit, note):
    keys = [
        SimpleNamespace(id=3076, value_offset=unit),
        SimpleNamespace(id=4099, value_offset=9001),
    ]
    header = SimpleNamespace(vlrs=[SimpleNamespace(geo_keys=keys)])
    assert note in describe_units(ROOM, {"las": header})
    assert bool(note) == bool(describe_units(ROOM, {"las": header}))
