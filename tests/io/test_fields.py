"""One name and one type for what formats call otherwise."""

from pathlib import Path

import numpy as np
import pytest

from torchrg.errors import FormatError
from torchrg.io import read_cloud, write_cloud
from torchrg.io.fields import assemble_cloud
from torchrg.structures import Cloud

PATH = Path("a.any")


def fields_of(**columns):
    axes = {axis: np.zeros(2) for axis in "xyz"}
    return assemble_cloud(PATH, {**axes, **{k: np.asarray(v) for k, v in columns.items()}}).fields


@pytest.mark.parametrize(
    ("columns", "name", "expected"),
    [
        ({"label": [1, 2]}, "labels", [1, 2]),
        ({"Label": [1.0, 2.0]}, "labels", [1, 2]),
        ({"scalar_label": [1.0, np.nan]}, "labels", [1, -1]),
        ({"labels": np.array([[1], [2]])}, "labels", [1, 2]),
        ({"labels": [True, False]}, "labels", [1, 0]),
        ({"intensities": [1.5, 2]}, "intensity", [1.5, 2]),
        ({"scalar_Intensity": [1.5, 2]}, "intensity", [1.5, 2]),
        (
            {"NormalX": [1, 0], "NormalY": [0, 1], "NormalZ": [0, 0]},
            "normals",
            [[1, 0, 0], [0, 1, 0]],
        ),
        ({"normal": np.eye(3)[:2]}, "normals", [[1, 0, 0], [0, 1, 0]]),
        ({"colors": np.full((2, 3), 0.5)}, "color", [[128] * 3] * 2),
        ({"rgb": np.full((2, 3), 200.0)}, "color", [[200] * 3] * 2),
        ({"color": np.full((2, 3), 65535, np.uint16)}, "color", [[255] * 3] * 2),
        ({"color": np.full((2, 3), 65534, np.uint16)}, "color", [[65534] * 3] * 2),
        ({"color": np.full((2, 3), 256.0)}, "color", [[256] * 3] * 2),
        ({"color": np.full((2, 3), np.nan)}, "color", [[0] * 3] * 2),
        ({"w_0": [1, 2], "w_1": [3, 4]}, "w", [[1, 3], [2, 4]]),
    ],
)
def test_names_and_types_are_normalised(columns, name, expected):
    fields = fields_of(**columns)
    assert list(fields) == [name]
    assert fields[name].tolist() == expected


@pytest.mark.parametrize(
    "columns",
    [
        {"w_0": [1, 2], "w_2": [3, 4]},
        {"w_1": [1, 2], "w_2": [3, 4]},
        {"w_0": [1, 2]},
        {"w_0": [1, 2], "w_1": [3.0, 4.0]},
        {"w": [1, 2], "w_0": [1, 2], "w_1": [3, 4]},
        {"rgb": [1.0, 2.0]},
        {"normal": [1.0, 2.0]},
        {"red": [1, 2], "green": [1, 2]},
    ],
)
def test_what_is_no_group_keeps_its_names(columns):
    assert fields_of(**columns).keys() == columns.keys()


def test_no_column_is_lost_when_two_have_one_name():
    fields = fields_of(label=[1, 2], labels=[3, 4], scalar_label=[5, 6], Label=[7, 8])
    assert sorted(int(values[0]) for values in fields.values()) == [1, 3, 5, 7]
    assert fields["labels"].tolist() == [1, 2]


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"labels": np.zeros((2, 2))}, r"expected labels to be one integer per point, got shape"),
        ({"labels": ["a", "b"]}, "expected labels to be one integer per point"),
        ({"labels": [0.5, 1]}, "expected 64-bit integer labels"),
        ({"labels": [np.inf, 1]}, "expected 64-bit integer labels"),
        ({"labels": np.array([2**64 - 1, 0], np.uint64)}, "expected 64-bit integer labels"),
        ({"normals": np.zeros(2)}, r"expected normals of shape \(N, 3\)"),
        ({"normals": np.zeros((2, 3), complex)}, r"expected normals of shape \(N, 3\)"),
        ({"color": np.zeros((2, 4))}, r"expected color of shape \(N, 3\)"),
        ({"color": np.full((2, 3), -1)}, r"expected color in 0\.\.255, got -1"),
        ({"color": np.full((2, 3), 65536)}, r"expected color in 0\.\.255, got 65536"),
    ],
)
def test_values_that_make_no_sense_are_refused(columns, message):
    with pytest.raises(FormatError, match=rf"a\.any: {message}"):
        fields_of(**columns)


def test_coordinates_need_their_names_and_one_number_each():
    with pytest.raises(FormatError, match="expected fields x, y, z, got 'x', 'y'; add or rename"):
        assemble_cloud(PATH, {"x": np.zeros(2), "y": np.zeros(2)})
    with pytest.raises(FormatError, match="expected x, y, z of one number per point"):
        assemble_cloud(PATH, {axis: np.zeros((2, 2)) for axis in "xyz"})


@pytest.mark.parametrize(
    ("code", "value", "last", "depth", "kept"),
    [
        ("f4", 0.5, 1.0, np.uint8, 128),
        ("f4", 0.5, 2.0, np.uint8, 0),
        ("u2", 514, 65535, np.uint8, 2),
        ("u2", 514, 65534, np.uint16, 514),
        ("u2", 200, 65535, np.uint16, 200),
        ("i4", 200, 255, np.uint8, 200),
        ("f8", 0.5, np.nan, np.uint8, 128),
    ],
)
def test_one_colour_decides_the_depth_of_all(code, value, last, depth, kept):
    color = np.full((2, 3), value).astype(code)
    color[-1] = last
    found = fields_of(color=color)["color"]
    assert found.dtype == depth
    assert found[0, 0] == kept


def test_colours_of_sixteen_bits_are_rounded_where_a_format_has_eight(tmp_path):
    colors = np.array([[128, 129, 65535]], dtype=np.uint16)
    write_cloud(tmp_path / "a.ply", Cloud(np.zeros((1, 3)), {"color": colors}))
    assert read_cloud(tmp_path / "a.ply").fields["color"].tolist() == [[0, 1, 255]]
