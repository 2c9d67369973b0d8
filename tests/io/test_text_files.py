"""Points as text of other programs, whole and broken."""

import numpy as np
import pytest

from torchrg.errors import FormatError
from torchrg.io import read_cloud, write_cloud
from torchrg.io.text import LINES_AT_ONCE
from torchrg.structures import Cloud

POINTS = [[0.0, 1.5, -2.0], [3.0, 4.0, 1e3]]


def save(path, text):
    path.write_bytes(text.encode())
    return path


@pytest.mark.parametrize("suffix", [".xyz", ".txt"])
@pytest.mark.parametrize(
    "text",
    [
        "0 1.5 -2\n3 4 1e3\n",
        "0 1.5 -2\n3 4 1e3",
        "  0\t1.5   -2 \r\n\r\n3 4 1e3\r\n",
        "0,1.5,-2\n3, 4, 1e3\n",
        "0;1.5;-2\n3;4;1e3\n",
        "x y z\n0 1.5 -2\n3 4 1e3\n",
        '"X","Y","Z"\n0,1.5,-2\n3,4,1e3\n',
        "//X Y Z\n0 1.5 -2\n3 4 1e3\n",
        "# scanned by hand\n# x y z\n\n0 1.5 -2 # first\n# between\n3 4 1e3 # last\n",
        "\ufeffx y z\n0 1.5 -2\n3 4 1e3\n",
        "2\n0 1.5 -2\n3 4 1e3\n",
        "// X Y Z\n2\n0 1.5 -2\n3 4 1e3\n",
    ],
)
def test_every_way_to_write_two_points_is_read(tmp_path, suffix, text):
    cloud = read_cloud(save(tmp_path / f"a{suffix}", text))
    assert cloud.coordinates.tolist() == POINTS
    assert cloud.coordinates.dtype == np.float64
    assert cloud.fields == {}


def test_names_in_the_first_line_name_the_columns(tmp_path):
    text = "R,G,B,X,Y,Z,Label,height\n255,0,7,1,2,3,4,0.5\n"
    cloud = read_cloud(save(tmp_path / "a.txt", text))
    assert cloud.coordinates.tolist() == [[1, 2, 3]]
    assert cloud.fields["color"].tolist() == [[255, 0, 7]]
    assert cloud.fields["labels"].tolist() == [4]
    assert cloud.fields["height"].tolist() == [0.5]


def test_infinite_and_missing_numbers_are_read(tmp_path):
    cloud = read_cloud(save(tmp_path / "a.xyz", "nan NaN 1\ninf -inf 2\n"))
    np.testing.assert_array_equal(cloud.coordinates, [[np.nan, np.nan, 1], [np.inf, -np.inf, 2]])


def test_files_longer_than_a_block_are_read_in_order(tmp_path):
    num = 2 * LINES_AT_ONCE + 3
    table = np.arange(3.0 * num).reshape(num, 3)
    write_cloud(tmp_path / "a.xyz", Cloud(table))
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.xyz").coordinates, table)
    with (tmp_path / "a.xyz").open("a") as stream:
        stream.write("1 2 three\n")
    message = rf"a\.xyz: line {num + 1}: expected 3 numbers, got '1 2 three'"
    with pytest.raises(FormatError, match=message):
        read_cloud(tmp_path / "a.xyz")


def test_written_text_says_what_its_columns_are(tmp_path):
    fields = {"labels": np.array([7]), "color": np.array([[1, 2, 3]], np.uint8)}
    write_cloud(tmp_path / "a.xyz", Cloud(np.array([[0.1, 2, 3e-9]]), fields))
    assert (tmp_path / "a.xyz").read_text() == (
        "# x y z label red green blue\n0.1 2.0 3e-09 7 1 2 3\n"
    )
    write_cloud(tmp_path / "a.xyz", Cloud(np.array([[0.1, 2, 3]], np.float32)))
    assert (tmp_path / "a.xyz").read_text() == "0.100000001 2 3\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0 1 2\n3 4 five\n", "line 2: expected 3 numbers, got '3 4 five'; repair or delete"),
        ("0 1 2\n3 4\n", "line 2: expected 3 numbers, got '3 4'"),
        ("0 1 2\n3 4 5 6\n", "line 2: expected 3 numbers, got '3 4 5 6'"),
        ("0 1 2\n\n3 4 5 6\n", "line 3: expected 3 numbers, got '3 4 5 6'"),
        ("0 1 two\n3 4 5\n", "line 1: expected 3 numbers, got '0 1 two'"),
        ("# x y z\n0 1 2 3\n", "line 2: expected 3 numbers, got '0 1 2 3'"),
        ("0 1\n", "line 1: expected at least 3 numbers, got '0 1'"),
        ("1,5 2,5 3,5\n", "line 1: expected 4 numbers, got '1,5 2,5 3,5'"),
        ("0,1,2\n3 4 5\n", "line 2: expected 3 numbers, got '3 4 5'"),
        ("a b c\n0 1 2\n", "line 1: expected numbers or names of columns with x, y and z, got 'a"),
        ("x y z x\n0 1 2 3\n", "line 1: expected numbers or names of columns"),
        ("x y z\nx y z\n", "line 2: expected 3 numbers, got 'x y z'"),
        ("solid ascii\n", "line 1: expected numbers or names of columns"),
        ("# nothing\n\n", "expected at least one point, got none"),
        ("x y z\n", "expected at least one point, got none"),
        ("\0\0\0\n", "line 1: expected numbers or names"),
        ("0 1 2\n" + "7" * 99 + "\n", "line 2: expected 3 numbers, got '7{57}...'"),
        ("x y z label\n0 1 2 0.5\n", "expected labels to be whole numbers of 64 bits; rename"),
        ("x y z label\n0 1 2 1e30\n", "expected labels to be whole numbers of 64 bits"),
    ],
)
def test_broken_text_names_the_line(tmp_path, text, message):
    with pytest.raises(FormatError, match=rf"a\.txt: {message}"):
        read_cloud(save(tmp_path / "a.txt", text))
