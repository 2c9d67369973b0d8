"""Areas read as one cloud become what the reader of KPConv asks for."""

import numpy as np
import pytest
import torch

from torchrg.datasets import read_pointcept_area, read_pointcept_scene, write_pointcept_scene
from torchrg.errors import FormatError
from torchrg.io import write_cloud
from torchrg.pipeline import segment_planes
from torchrg.scenes import make_room
from torchrg.structures import Cloud

SIZES = {"office_2": 1500, "office_10": 1200}
"""Rooms in natural order, which is not that of the alphabet."""


@pytest.fixture(scope="module")
def area(tmp_path_factory):
    """An area of two rooms as ``torchrg convert s3dis`` writes it."""
    folder = tmp_path_factory.mktemp("OUT") / "Area_1"
    for seed, (name, size) in enumerate(SIZES.items()):
        room = make_room(size, 0.003, seed)
        sample = {
            "coord": room.points,
            "color": torch.full((size, 3), 10 * (seed + 1), dtype=torch.uint8),
            "segment": torch.arange(size) % 13,
            "instance": torch.arange(size) % 7,
        }
        write_pointcept_scene(folder / name, sample, segment_planes(room.points))
    return folder


def test_an_area_is_its_rooms_end_to_end_with_numbers_of_their_own(area):
    joined = read_pointcept_area(area)
    assert joined["name"] == list(SIZES)
    assert joined["offset"].tolist() == [1500, 2700]
    rooms = [read_pointcept_scene(area / name) for name in SIZES]
    for key in ("coord", "color", "normal", "curvature", "segment"):
        assert torch.equal(joined[key], torch.cat([room[key] for room in rooms]))
    first, second = joined["plane"][:1500], joined["plane"][1500:]
    assert second[second >= 0].min() == rooms[0]["plane"].max() + 1
    assert torch.equal(first, rooms[0]["plane"])
    assert torch.equal(second < 0, rooms[1]["plane"] < 0)
    assert joined["instance"].unique().tolist() == list(range(14))


def read_as_kpconv(path):
    """Read a PLY as KPConv's ``utils/ply.py`` does: any element, any property, little endian."""
    types = {"uchar": "u1", "int": "i4", "float": "f4", "double": "f8"}
    with path.open("rb") as stream:
        assert b"ply" in stream.readline()
        assert stream.readline().split()[1] == b"binary_little_endian"
        count, properties, line = None, [], b""
        while b"end_header" not in line:
            line = stream.readline()
            words = line.decode().split()
            if b"element" in line:
                count = int(words[2])
            elif b"property" in line:
                properties.append((words[2], "<" + types[words[1]]))
        return np.fromfile(stream, dtype=properties, count=count)


def test_kpconv_reads_an_area(area, tmp_path):
    joined = {key: np.asarray(value) for key, value in read_pointcept_area(area).items()}
    fields = {"color": joined["color"], "class": joined["segment"].astype(np.int32)}
    fields |= {"normals": joined["normal"], "plane": joined["plane"]}
    write_cloud(tmp_path / "Area_1.ply", Cloud(joined["coord"], fields))
    data = read_as_kpconv(tmp_path / "Area_1.ply")
    assert np.array_equal(np.vstack((data["x"], data["y"], data["z"])).T, joined["coord"])
    assert data["x"].dtype == np.float32
    assert data["class"].dtype == np.int32
    assert data["class"].tolist() == joined["segment"].tolist()
    assert data["red"].dtype == np.uint8
    assert data["red"].tolist() == [10] * 1500 + [20] * 1200
    assert data["plane"].tolist() == joined["plane"].tolist()


def test_a_folder_without_scenes_is_named(tmp_path):
    with pytest.raises(FormatError, match=r"expected folders with coord\.npy"):
        read_pointcept_area(tmp_path)
