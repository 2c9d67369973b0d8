"""Points as text of other programs, whole and broken, with pyarrow and without."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from torchrg.errors import FormatError
from torchrg.io import read_cloud, text, write_cloud
from torchrg.io.text import LINES_PER_CHUNK
from torchrg.structures import Cloud

POINTS = [[0.0, 1.5, -2.0], [3.0, 4.0, 1e3]]


def save(path, text):
    path.write_bytes(text.encode())
    return path


@pytest.mark.parametrize("suffix", [".xyz", ".txt", ".asc", ".pts", ".csv"])
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


@pytest.mark.parametrize(
    "text",
    ["0,0;1,5;-2,0\n3;4;1e3\n", "0,0 1,5 -2,0\n3 4 1e3\n", "0,0\t1,5\t-2,0\n3\t4\t1e3\n"],
)
def test_decimals_may_begin_with_commas_and_that_is_told(tmp_path, text):
    path = save(tmp_path / "a.txt", text)
    cloud = read_cloud(path)
    assert cloud.coordinates.tolist() == POINTS
    assert cloud.notes == ("its commas are read as decimal points",)


@pytest.mark.parametrize(
    ("text", "fields"),
    [
        # CloudCompare: names of fields keep their blanks where these are not between columns.
        ("//X,Y,Z,Scalar field\n0,1.5,-2,7\n3,4,1e3,8\n", {"Scalar field": [7, 8]}),
        ('"X";"Y";"Z";"Range, in m"\n0;1.5;-2;7\n3;4;1e3;8\n', {"Range, in m": [7, 8]}),
        ("X\tY\tZ\tScalar field\n0\t1.5\t-2\t7\n3\t4\t1e3\t8\n", {"Scalar field": [7, 8]}),
        ('x y z "a b"\n0 1.5 -2 7\n3 4 1e3 8\n', {"a b": [7, 8]}),
        ("X;Y;Z;d\n0,0;1,5;-2,0;7,5\n3;4;1e3;8\n", {"d": [7.5, 8]}),
        (
            "//X Y Z Rf Gf Bf\n0 1.5 -2 0 0 1\n3 4 1e3 1 0.2 0\n",
            {"color": [[0, 0, 255], [255, 51, 0]]},
        ),
    ],
)
def test_names_of_other_programs_are_told_apart(tmp_path, text, fields):
    cloud = read_cloud(save(tmp_path / "a.txt", text))
    assert cloud.coordinates.tolist() == POINTS
    assert {name: values.tolist() for name, values in cloud.fields.items()} == fields


LEICA = "0 1.5 -2 {} 255 128 7\n3 4 1e3 {} 0 1 2\n"


@pytest.mark.parametrize(
    ("text", "taken"),
    [
        ("0 1.5 -2\n3 4 1e3\n", ""),
        ("x y z i\n0 1.5 -2 7\n3 4 1e3 8\n", ""),
        # Intensities as Cyclone writes them, and as programs that scale them do.
        (LEICA.format(-1640, 900), "x y z intensity red green blue"),
        (LEICA.format(0.5, 0.25), "x y z intensity red green blue"),
        (LEICA.format(200, 100), "x y z column_4 column_5 column_6 column_7"),
    ],
)
def test_names_that_are_taken_for_granted_are_told(tmp_path, text, taken):
    cloud = read_cloud(save(tmp_path / "a.txt", text))
    reported = f"its columns have no names and are taken as {taken}; if they are others, name them"
    assert [note.removesuffix(" with --columns") for note in cloud.notes] == [reported] * bool(
        taken
    )


def test_colours_come_last_in_files_of_leica(tmp_path):
    lines = "2\n" + LEICA.format(200, 100)
    fields = read_cloud(save(tmp_path / "a.pts", lines)).fields
    assert fields["intensity"].tolist() == [200, 100]
    assert fields["color"].tolist() == [[255, 128, 7], [0, 1, 2]]


@pytest.mark.parametrize("kind", [".npy", ".xyz"])
@pytest.mark.parametrize("at", [0, 59])
@pytest.mark.parametrize(
    ("row", "fields"),
    [
        ([0.0, 0.6, 0.8, 1.0], ["normals", "column_7"]),
        ([0.0, 0.6, 0.8, 1.5], ["normals", "column_7"]),
        ([0.5, 0.0, 0.6, 0.8], ["normals", "column_4"]),
        ([256.0, 2.0, 3.0, 1.0], ["color", "intensity"]),
        ([0.0, 2.0, 3.0, 256.0], ["color", "column_7"]),
        ([0.0, 2.0, 3.0, 1.0], ["column_4", "column_5", "column_6", "column_7"]),
        ([0.0, 0.5, 0.5, 1.0], ["column_4", "column_5", "column_6", "column_7"]),
        ([np.nan, 0.0, 1.0, 0.5], ["normals", "column_7"]),
    ],
)
def test_one_row_decides_the_names_of_all(tmp_path, kind, at, row, fields):
    # Unit vectors that are whole numbers, too: normals or colors, as the other row says.
    table = np.zeros((60, 7))
    table[:, :3] = np.random.default_rng(0).random((60, 3))
    table[np.arange(60), 3 + np.arange(60) % 3] = 1.0
    table[at, 3:] = row
    path = tmp_path / f"a{kind}"
    np.save(path, table) if kind == ".npy" else np.savetxt(path, table)
    assert list(read_cloud(path).fields) == fields


def test_names_are_guessed_from_the_first_thousand_rows(tmp_path):
    table = np.zeros((1001, 6))
    table[:, 5] = 1.0
    table[1000, 3:] = 0.5
    np.savetxt(tmp_path / "a.txt", table)
    assert list(read_cloud(tmp_path / "a.txt").fields) == ["normals"]
    np.savetxt(tmp_path / "b.txt", table[1:])
    assert list(read_cloud(tmp_path / "b.txt").fields) == ["column_4", "column_5", "column_6"]


@pytest.mark.parametrize("kind", [".txt", ".npy"])
def test_names_that_are_given_decide(tmp_path, kind):
    table = np.array([[9.0, 0, 1.5, -2, 200, 255, 128, 7], [9, 3, 4, 1e3, 100, 0, 1, 2]])
    path = tmp_path / f"a{kind}"
    np.savetxt(path, table) if kind == ".txt" else np.save(path, table)
    names = ["_", "x", "y", "z", "intensity", "r", "g", "b"]
    cloud = read_cloud(path, columns=names)
    assert cloud.coordinates.tolist() == POINTS
    assert {name: values.tolist() for name, values in cloud.fields.items()} == {
        "color": [[255, 128, 7], [0, 1, 2]],
        "intensity": [200, 100],
    }
    assert cloud.notes == ()


def test_names_that_are_given_take_the_place_of_the_first_line(tmp_path):
    text = "a b c\n0 1.5 -2\n3 4 1e3\n"
    cloud = read_cloud(save(tmp_path / "a.txt", text), columns=("z", "y", "x"))
    assert cloud.coordinates[0].tolist() == [-2, 1.5, 0]
    text = "//X Y Z Scalar field\n0 1.5 -2 7\n"
    cloud = read_cloud(save(tmp_path / "a.txt", text), columns=("x", "y", "z", "label"))
    assert cloud.fields["labels"].tolist() == [7]


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ("xy", "expected distinct column names that include x, y and z, got x,y; use _ to skip"),
        ("xyzz", "expected distinct column names that include x, y and z, got x,y,z,z"),
        ("xyz", r"expected names for 4 columns, got 3 \(x,y,z\); use _ to skip a column"),
    ],
)
def test_names_that_do_not_fit_are_refused(tmp_path, names, message):
    np.save(tmp_path / "a.npy", np.ones((9, 4)))
    np.savetxt(tmp_path / "a.txt", np.ones((9, 4)))
    for kind in ("npy", "txt"):
        with pytest.raises(FormatError, match=rf"a\.{kind}: {message}"):
            read_cloud(tmp_path / f"a.{kind}", columns=list(names))


def test_names_for_files_that_have_their_own_are_refused(tmp_path):
    write_cloud(tmp_path / "a.ply", Cloud(np.eye(3)))
    write_cloud(tmp_path / "a.npy", Cloud(np.eye(3), {"a": np.ones(3)}))
    with pytest.raises(
        FormatError, match=r"a\.ply: column names apply to text and \.npy files only"
    ):
        read_cloud(tmp_path / "a.ply", columns=["x", "y", "z"])
    with pytest.raises(FormatError, match=r"a\.npy: column names .* has fields x, y, z, a. Omit"):
        read_cloud(tmp_path / "a.npy", columns=["x", "y", "z", "b"])


def test_text_between_blank_lines_and_comments(tmp_path):
    lines = ["// x y z label", "3", "0 0 0 1", "", "# a", "# b", "1 0 0 2", "", "1 2 3 4 # end", ""]
    (tmp_path / "a.txt").write_text("\n".join(lines))
    assert read_cloud(tmp_path / "a.txt").fields["labels"].tolist() == [1, 2, 4]
    (tmp_path / "a.txt").write_text("\n".join([*lines, "1 2 x"]))
    with pytest.raises(FormatError, match=r"a\.txt: line 11: expected 4 numbers, got '1 2 x'"):
        read_cloud(tmp_path / "a.txt")


@pytest.mark.parametrize("has_arrow", [True, False])
def test_counts_come_before_the_points_of_each_scan(tmp_path, monkeypatch, has_arrow):
    if not has_arrow:
        monkeypatch.setattr(text, "parse_numbers", lambda *_: None)
    rows = [f"{i} 1.5 -2 {i} 255 128 7\n" for i in range(50)]
    scans = [rows[:20], rows[20:21], rows[21:]]
    counted = "".join(f"{len(scan)}\n{''.join(scan)}" for scan in scans)
    expected = read_cloud(save(tmp_path / "a.pts", "".join(rows)))
    for at_once in (40, 1 << 22):
        monkeypatch.setattr(text, "CHARACTERS_PER_READ", at_once)
        cloud = read_cloud(save(tmp_path / "b.pts", counted))
        np.testing.assert_array_equal(cloud.coordinates, expected.coordinates)
        assert cloud.fields.keys() == expected.fields.keys()
        assert cloud.notes == expected.notes


@pytest.mark.parametrize("count", [0, 1])
def test_more_points_than_their_count_are_told(tmp_path, count):
    cloud = read_cloud(save(tmp_path / "a.pts", f"{count}\n0 1.5 -2\n3 4 1e3\n"))
    assert cloud.coordinates.tolist() == POINTS
    assert cloud.notes == (f"the count before its points is {count}, but 2 follow",)


def test_a_few_points_may_have_many_columns(tmp_path):
    rows = np.arange(36.0).reshape(3, 12)
    np.savetxt(tmp_path / "a.txt", rows)
    cloud = read_cloud(tmp_path / "a.txt")
    np.testing.assert_array_equal(cloud.coordinates, rows[:, :3])
    assert cloud.fields["column_12"].tolist() == [11, 23, 35]
    (note,) = cloud.notes
    assert "taken as x y z column_4 column_5 column_6 column_7 ... column_12; if" in note


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
    num = 2 * LINES_PER_CHUNK + 3
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
        ("0 1 2\n3 4 five\n", "line 2: expected 3 numbers, got '3 4 five'; correct or delete"),
        ("0 1 2\n3 4\n", "line 2: expected 3 numbers, got '3 4'"),
        ("0 1 2\n3 4 5 6\n", "line 2: expected 3 numbers, got '3 4 5 6'"),
        ("0 1 2\n\n3 4 5 6\n", "line 3: expected 3 numbers, got '3 4 5 6'"),
        ("0 1 two\n3 4 5\n", "line 1: expected 3 numbers, got '0 1 two'"),
        ("# x y z\n0 1 2 3\n", "line 2: expected 3 numbers, got '0 1 2 3'"),
        ("0 1\n", "line 1: expected at least 3 numbers, got '0 1'"),
        ("0 0 0\n1,5 2,5 3,5\n", "line 2: expected 3 numbers, got '1,5 2,5 3,5'; write all dec"),
        ("0;0;0\n1,5;2,5;3,5\n", "line 2: expected 3 numbers, got '1,5;2,5;3,5'; write all dec"),
        (
            "//X Y Z R G B Scalar field\n2\n0 1 2 3 4 5 6\n",
            "line 3: expected 8 numbers, got '0 1 2 3 4 5 6', for names that may contain blanks: "
            "'X Y Z R G B Scalar field'; name the 7 columns with --columns, or replace the blanks",
        ),
        ("9\n0 1 2\n3 4 5\n", "expected 9 points by the count before them, got 2; the file"),
        ("3\n0 1 2\n3 4 5\n", "expected 3 points by the count before them, got 2; the file"),
        ("1\n0 1 2\n2\n3 4 5\n", "expected 3 points by the count before them, got 2"),
        ("-2\n0 1 2\n3 4 5\n", "line 1: expected a point count or a point, got '-2'; corr"),
        ("2.5\n0 1 2\n3 4 5\n", "line 1: expected a point count or a point, got '2.5'"),
        ("nan\n0 1 2\n3 4 5\n", "line 1: expected a point count or a point, got 'nan'"),
        (f"{10**20}\n0 1 2\n", "line 1: expected a point count or a point, got '1000"),
        ("0 1 2\n2\n3 4 5\n", "line 2: expected 3 numbers, got '2'; correct or delete"),
        ("0,1,2\n3 4 5\n", "line 2: expected 3 numbers, got '3 4 5'; separate all numbers with c"),
        ("0 1 2\n3;4;5\n", "line 2: expected 3 numbers, got '3;4;5'; separate all .* with blanks"),
        ("2\n1\n0 0 0\n", "line 2: expected a point after the point count, got a second count"),
        ("1 0 0 5\n0 1 0 6\n0 0 1 7\n0 0 0 1\n", "expected points, got a 4 x 4 pose matrix; pass"),
        (
            f"{'1 ' * 900}\n{'2 ' * 900}\n# z\n{'3 ' * 900}\n",
            "expected one row per point, got 3 rows of 900 numbers; transpose them",
        ),
        ("a b c\n0 1 2\n", "line 1: expected numbers or column names with x, y and z, got 'a"),
        ("x y z x\n0 1 2 3\n", "line 1: expected numbers or column names"),
        ("x y z\nx y z\n", "line 2: expected 3 numbers, got 'x y z'"),
        ("solid ascii\n", "line 1: expected numbers or column names"),
        ("# nothing\n\n", "expected at least one point, got none"),
        ("x y z\n", "expected at least one point, got none"),
        ("\0\0\0\n", "line 1: expected numbers or column names"),
        ("0 1 2\n" + "7" * 99 + "\n", "line 2: expected 3 numbers, got '7{57}...'"),
        (
            "x,y,z,room\n1,2,3,7\n4,5,6,hall\n",
            "line 3: expected 4 numbers, got '4,5,6,hall'; correct or delete this line, or skip "
            "a column of words with _ in --columns",
        ),
        (
            "# 3D point list with one line of data per point:\n#   POINT3D_ID, X, Y, Z, R, G, B, "
            "ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n63 1.6 0.1 0.7 115 121 122 1.33 16 6 1 5\n",
            "line 3: expected 10 numbers, got '63 1.6 0.1 0.7 115 121 122 1.33 16 6 1 5'; correct",
        ),
        (
            "x y z label\n0 1 2 0.5\n",
            "expected 64-bit integer labels, got fractions or larger; rename",
        ),
        ("x y z label\n0 1 2 1e30\n", "expected 64-bit integer labels"),
    ],
)
def test_broken_text_names_the_line(tmp_path, text, message):
    with pytest.raises(FormatError, match=rf"a\.txt: {message}"):
        read_cloud(save(tmp_path / "a.txt", text))


@pytest.mark.parametrize("number", [2**53, 2**53 + 1, -(2**53) - 1, 2**63 - 1])
@pytest.mark.parametrize("name", ["labels", "id"])
@pytest.mark.parametrize("suffix", [".xyz", ".txt", ".ply"])
def test_whole_numbers_that_float64_rounds_are_not_written(tmp_path, number, name, suffix):
    path = tmp_path / f"cloud{suffix}"
    cloud = Cloud(np.eye(3), {name: np.array([0, number, -1])})
    with pytest.raises(FormatError, match=rf"{suffix}: \w+ has integers above 2\^53"):
        write_cloud(path, cloud)
    assert not list(tmp_path.iterdir())
    largest = replace(cloud, fields={name: np.array([0, 2**53 - 1, 1 - 2**53])})
    write_cloud(path, largest)
    assert read_cloud(path).fields[name].tolist() == [0, 2**53 - 1, 1 - 2**53]


@pytest.mark.parametrize("number", [2**53 + 1, -(2**53) - 1, 10**17])
def test_labels_that_float64_rounds_are_not_read(tmp_path, number):
    path = tmp_path / "cloud.txt"
    path.write_text(f"x y z label\n0 0 0 {number}\n")
    with pytest.raises(FormatError, match=r"cloud\.txt: expected labels within 2\^53"):
        read_cloud(path)


def test_columns_of_words_are_left_out_by_name(tmp_path):
    path = save(tmp_path / "a.csv", "name,x,y,z,room\na,0,1.5,-2,hall\nb,3,4,1e3,3\n")
    cloud = read_cloud(path, columns=["_", "x", "y", "z", "_"])
    assert cloud.coordinates.tolist() == POINTS
    assert cloud.fields == {}


@pytest.mark.parametrize(
    ("suffix", "tool"),
    [
        (".obj", "CloudCompare or pcl_mesh_sampling"),
        (".STL", "sample points"),
        (".ptx", "save it there"),
        (".tif", "torchrg depth"),
        (".h5", "numpy.save"),
    ],
)
def test_what_is_no_cloud_names_the_program_that_makes_one(tmp_path, suffix, tool):
    with pytest.raises(FormatError, match=rf"a\{suffix}: expected points, got .*{tool}"):
        read_cloud(save(tmp_path / f"a{suffix}", "v 0 0 0\n"))


@pytest.mark.parametrize("place", range(3))
@pytest.mark.parametrize("word", ["-1.#IND", "1.#QNAN0", "-nan(ind)", "nan(snan)", "1.#INF00"])
def test_windows_spellings_of_missing_numbers_are_read(tmp_path, word, place):
    rows = [["0", "1.5", "-2"], ["3", "4", "1e3"]]
    for row in (0, 1):
        words = [list(line) for line in rows]
        words[row][place] = word
        text = "\n".join(" ".join(line) for line in words)
        expected = np.array(POINTS)
        expected[row, place] = np.nan
        ply = "ply\nformat ascii 1.0\nelement vertex 2\n"
        ply += "".join(f"property double {axis}\n" for axis in "xyz") + "end_header\n"
        for name, content in (("a.xyz", text), ("a.ply", ply + text)):
            cloud = read_cloud(save(tmp_path / name, content + "\n"))
            np.testing.assert_array_equal(cloud.coordinates, expected)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8-sig", "utf-8"])
@pytest.mark.parametrize("names", ["", "x y z höhe\n"])
def test_marked_encodings_are_read(tmp_path, encoding, names):
    text = f"{names}0 1.5 -2 7\n3 4 1e3 8\n"
    (tmp_path / "a.txt").write_bytes(text.encode(encoding))
    cloud = read_cloud(tmp_path / "a.txt")
    assert cloud.coordinates.tolist() == POINTS
    assert list(cloud.fields) == ["höhe" if names else "intensity"]


def test_words_alone_separate_scans(tmp_path):
    text = "BEGIN\n0 1.5 -2\nEND\nBEGIN\n3 4 1e3\nEND\n"
    assert read_cloud(save(tmp_path / "a.pts", text)).coordinates.tolist() == POINTS


@pytest.mark.parametrize(
    ("comment", "named"),
    [
        ("# time row col east", True),
        ("#time,row,col,east", True),
        ("# written by some program", True),
        ("# a comment of more words than columns", False),
        ("# 2024 01 02 03", False),
        ("# X [m] Y [m] Z [m] i", False),
    ],
)
def test_names_in_a_comment_are_used_or_told(tmp_path, comment, named):
    path = save(tmp_path / "a.txt", f"{comment}\n0 1.5 -2 7\n3 4 1e3 8\n")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert read_cloud(path).coordinates.tolist() == POINTS
    assert [f"{path}: its comment names columns" in str(w.message) for w in caught] == [
        True
    ] * named
    assert not any("comment" in str(w.message) for w in caught if not named)
