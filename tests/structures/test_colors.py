"""The range of colors: type and limits decide, then most of the values, and never a single one."""

import numpy as np
import pytest

from torchrg.errors import FormatError
from torchrg.io import read_cloud, write_cloud
from torchrg.io.result import Result
from torchrg.structures import Cloud
from torchrg.structures.colors import find_white, read_colors

RNG = np.random.default_rng(0)
POINTS = RNG.random((100, 3))
EIGHT = RNG.integers(0, 256, (100, 3))
SIXTEEN = RNG.integers(0, 65536, (100, 3))
DARK = RNG.integers(0, 2, (100, 3))
UNIT = EIGHT / 255
CLIPPED = "color values beyond 0..{} are clipped: {} of 300"
TAKEN = "colors are read as 0..{}, judging by their values"


def changed(colors, value, rows=1):
    """Return colors of which the last ones are others."""
    colors = np.array(colors)
    colors[-rows:, 1] = value
    return colors


def read(path):
    """Return the colors of a file, and what is said about them."""
    cloud = read_cloud(path)
    assert cloud.fields["color"].dtype in (np.uint8, np.uint16)
    return cloud.fields["color"].tolist(), [note for note in cloud.notes if "color" in note]


def save_npz(path, colors):
    np.savez(path, points=POINTS, color=colors)


def save_npy(path, colors):
    types = [(name, "f8") for name in "xyz"] + [(name, colors.dtype) for name in "rgb"]
    np.save(path, np.rec.fromarrays([*POINTS.T, *colors.T], dtype=types))


def save_ply(path, colors):
    word = {"f": "float", "i": "int"}.get(colors.dtype.kind, "ushort")
    names = [f"property double {axis}" for axis in "xyz"]
    names += [f"property {word} {name}" for name in ("red", "green", "blue")]
    write_lines(
        path, colors, ["ply", "format ascii 1.0", "element vertex 100", *names, "end_header"]
    )


def save_pcd(path, colors):
    kind = colors.dtype.kind.upper()
    header = ["FIELDS x y z r g b", "SIZE 8 8 8 8 8 8", f"TYPE F F F {kind} {kind} {kind}"]
    write_lines(path, colors, [*header, "WIDTH 100", "DATA ascii"])


def save_text(path, colors):
    write_lines(path, colors, ["x y z red green blue"])


def save_csv(path, colors):
    write_lines(path, colors, ["X,Y,Z,R,G,B"], ",")


def write_lines(path, colors, header, mark=" "):
    """Write a header, and a line for each point."""
    rows = zip(POINTS.tolist(), colors.tolist(), strict=True)
    lines = (mark.join(map(repr, [*point, *color])) for point, color in rows)
    path.write_text("\n".join([*header, *lines, ""]))


SAVE = {
    ".npz": save_npz,
    ".npy": save_npy,
    ".ply": save_ply,
    ".pcd": save_pcd,
    ".txt": save_text,
    ".csv": save_csv,
}
FLOATS = {
    "fractions": (UNIT, EIGHT, None),
    "rounding": (UNIT * (1 + 3e-9) - 1e-9, EIGHT, None),
    "outlier": (changed(UNIT, 255.0), changed(EIGHT, 255), CLIPPED.format(1, 1)),
    "bright": (changed(UNIT, 1.3, 40), changed(EIGHT, 255, 40), CLIPPED.format(1, 40)),
    "infinite": (changed(UNIT, np.inf), changed(EIGHT, 255), CLIPPED.format(1, 1)),
    "nan": (changed(UNIT, np.nan), changed(EIGHT, 0), "NaN color values are read as 0: 1"),
    "0 and 1": (DARK * 1.0, DARK * 255, TAKEN.format(1)),
    "8 bits": (EIGHT * 1.0, EIGHT, None),
    "averages": (np.clip(EIGHT + 0.25, 0, 255), EIGHT, None),
    "beyond 8 bits": (changed(EIGHT * 1.0, 300), changed(EIGHT, 255), CLIPPED.format(255, 1)),
    "negative": (changed(EIGHT * 1.0, -1), changed(EIGHT, 0), CLIPPED.format(255, 1)),
    "16 bits": (SIXTEEN * 1.0, SIXTEEN, TAKEN.format(65535)),
}
INTEGERS = {
    "8 bits": (EIGHT, EIGHT, None),
    "dark": (DARK, DARK, TAKEN.format(255)),
    "beyond 8 bits": (changed(EIGHT, 40_000), changed(EIGHT, 255), CLIPPED.format(255, 1)),
    "negative": (changed(EIGHT, -1), changed(EIGHT, 0), CLIPPED.format(255, 1)),
    "16 bits": (SIXTEEN, SIXTEEN, TAKEN.format(65535)),
    "wide": (EIGHT * 257, EIGHT, TAKEN.format(65535)),
    "some beyond": (changed(EIGHT, 40_000, 9), changed(EIGHT, 40_000, 9), TAKEN.format(65535)),
}


@pytest.mark.parametrize("suffix", SAVE)
@pytest.mark.parametrize(
    ("colors", "expected", "note"),
    [*FLOATS.values(), *INTEGERS.values()],
    ids=[*(f"floats-{name}" for name in FLOATS), *(f"integers-{name}" for name in INTEGERS)],
)
def test_most_values_decide_the_range_in_every_format(tmp_path, suffix, colors, expected, note):
    path = tmp_path / f"a{suffix}"
    SAVE[suffix](path, colors)
    assert read(path) == (expected.tolist(), [note] if note else [])


@pytest.mark.parametrize(
    ("colors", "expected", "note"),
    [
        (EIGHT.astype(np.uint8), EIGHT, None),
        (DARK.astype(np.uint8), DARK, None),
        (
            EIGHT.astype(np.uint8).view(np.int8),
            EIGHT,
            "its colors are signed bytes, read as",
        ),
        (EIGHT.astype(np.uint16), EIGHT, TAKEN.format(255)),
        (changed(EIGHT, 40_000).astype(np.uint16), changed(EIGHT, 255), TAKEN.format(255)),
        (SIXTEEN.astype(np.uint16), SIXTEEN, None),
        (np.zeros((100, 3), np.uint16), np.zeros((100, 3)), None),
        (EIGHT.astype(np.uint64), EIGHT, None),
        (np.float16(UNIT), EIGHT, None),
        (np.float16(EIGHT), EIGHT, None),
        (np.zeros((100, 3)), np.zeros((100, 3)), None),
        # What interpolation leaves of black says nothing.
        (np.where(DARK == 1, EIGHT + 0.25, 1e-9), np.where(DARK == 1, EIGHT, 0), None),
        (changed(np.ones((100, 3)), 255.0), np.full((100, 3), 255), TAKEN.format(1)),
    ],
)
def test_the_type_decides_where_it_can(colors, expected, note):
    found, notes = read_colors("a.ply", colors)
    np.testing.assert_allclose(found, expected, atol=colors.dtype == np.float16)
    assert [note in each for each in notes if "clipped" not in each] == ([True] if note else [])
    shuffled = RNG.permutation(len(colors))
    again, same = read_colors("a.ply", colors[shuffled])
    assert (again.tolist(), same) == (found[shuffled].tolist(), notes)


@pytest.mark.parametrize(
    ("colors", "expected"),
    [
        ([0.5, 0.25, 1.0000002], [128, 64, 255]),
        ([0.5, 0.25, 1.3], [128, 64, 255]),
        ([0.5, 0.25, 255.0], [128, 64, 255]),
        ([0.5, 0.25, -1e-9], [128, 64, 0]),
        ([0.5, 0.25, -0.1], [128, 64, 0]),
        ([9, 200, 300], [9, 200, 255]),
        ([9, 300, 300], [9, 300, 300]),
        ([9, 200, -1], [9, 200, 0]),
        ([1.0, 0.0, 0.0], [255, 0, 0]),
        ([1, 0, 0], [1, 0, 0]),
    ],
)
def test_single_points_have_a_range_too(colors, expected):
    assert read_colors("a.ply", np.array([colors]))[0].tolist() == [expected]


@pytest.mark.parametrize("colors", [2 * UNIT - 1, EIGHT - 128, SIXTEEN * 9, UNIT * 1e6])
def test_colors_of_no_range_are_refused(colors):
    message = r"^a\.ply: expected color in 0\.\.255, got .* to .*; scale the colors, or rename"
    with pytest.raises(FormatError, match=message):
        read_colors("a.ply", colors)


@pytest.mark.parametrize("suffix", [".txt", ".csv", ".pts"])
def test_colors_without_names_are_of_8_or_16_bits(tmp_path, suffix):
    path, mark = tmp_path / f"a{suffix}", "," if suffix == ".csv" else " "
    for colors in (EIGHT, SIXTEEN):
        write_lines(path, colors, [], mark)
        assert read(path)[0] == colors.tolist()
    # Numbers of objects, which are small in one column, or large in a later row.
    for others in (SIXTEEN // [1, 1, 1000], changed(SIXTEEN, 65536)):
        write_lines(path, others, [], mark)
        assert "color" not in read_cloud(path).fields


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize(
    ("colors", "notes"),
    [
        (EIGHT, [TAKEN.format(255)]),
        (DARK, [TAKEN.format(255)]),
        (changed(EIGHT, 300), [TAKEN.format(255), CLIPPED.format(255, 1)]),
        (EIGHT * 256, []),
        (SIXTEEN, []),
    ],
)
def test_las_holds_8_bits_in_16_and_then_the_standards(tmp_path, suffix, colors, notes):
    laspy = pytest.importorskip("laspy")
    path = tmp_path / f"a{suffix}"
    data = laspy.LasData(laspy.LasHeader(point_format=2, version="1.2"))
    data.x, data.y, data.z = POINTS.T
    data.red, data.green, data.blue = colors.T.astype(np.uint16)
    data.write(path)
    expected = np.minimum(colors, 255) if notes else colors
    assert read(path) == (expected.tolist(), notes)
    write_cloud(tmp_path / "b.las", read_cloud(path))
    after = laspy.read(tmp_path / "b.las")
    wide = expected * (257 if notes else 1)
    np.testing.assert_array_equal(np.stack([after.red, after.green, after.blue], axis=1), wide)
    assert read(tmp_path / "b.las") == (expected.tolist(), [])


@pytest.mark.parametrize("colors", [EIGHT, DARK, np.full((100, 3), 255)])
def test_colors_survive_a_chain_of_formats(tmp_path, colors):
    write_cloud(tmp_path / "a.npz", Cloud(POINTS, {"color": colors.astype(np.uint8)}))
    path = tmp_path / "a.npz"
    for suffix in (".ply", ".txt", ".pcd", ".las", ".npy", ".xyz", ".laz", ".npz"):
        cloud = read_cloud(path)
        path = tmp_path / f"b{suffix}"
        write_cloud(path, cloud)
        assert read(path)[0] == colors.tolist(), suffix


def test_colors_of_16_bits_survive_formats_that_hold_them(tmp_path):
    write_cloud(tmp_path / "a.npz", Cloud(POINTS, {"color": SIXTEEN.astype(np.uint16)}))
    write_cloud(tmp_path / "a.las", read_cloud(tmp_path / "a.npz"))
    write_cloud(tmp_path / "b.npz", read_cloud(tmp_path / "a.las"))
    assert read(tmp_path / "b.npz") == (SIXTEEN.tolist(), [])
    for suffix in (".ply", ".txt", ".pcd"):
        write_cloud(tmp_path / f"b{suffix}", read_cloud(tmp_path / "b.npz"))
        narrow = np.rint(SIXTEEN / 257)
        np.testing.assert_array_equal(read_cloud(tmp_path / f"b{suffix}").fields["color"], narrow)


@pytest.mark.parametrize("kind", [".npz", ".npy", ".ply", ".pcd", ".las", ".xyz"])
@pytest.mark.parametrize("channel", [np.uint8, np.uint16, np.uint32, bool])
def test_writing_and_reading_choose_one_range(tmp_path, kind, channel):
    colors = EIGHT > 127 if channel is bool else EIGHT.astype(channel)
    path = tmp_path / f"cloud{kind}"
    write_cloud(path, Cloud(POINTS, {"color": colors}))
    shown = colors * 255 if channel is bool else EIGHT
    assert read_cloud(path).fields["color"].tolist() == shown.tolist()


def test_a_result_shows_small_values_of_16_bits():
    cloud = Cloud(POINTS, {"color": EIGHT.astype(np.uint16)})
    assert Result(cloud).fields["color"].tolist() == EIGHT.tolist()


@pytest.mark.parametrize(("outliers", "white"), [(4, 1), (5, 255)])
def test_up_to_one_percent_of_values_are_outliers_of_their_range(outliers, white):
    # Zeros and ones, which only the number of larger values tells from bytes.
    color = np.repeat([1.0, 0.0], [400, 200])
    color[:outliers] = 200.0
    assert find_white(color) == white
