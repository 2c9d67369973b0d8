"""An annotation file reads as it was meant, or is refused with file, line and bytes."""

import numpy as np
import pytest

from tests.datasets.s3dis_tree import BROKEN, rows_of, text_of
from torchrg.datasets.s3dis import read_annotation
from torchrg.errors import FormatError, MissingDependencyError

pytest.importorskip("pyarrow", reason="needs torchrg[text]")
GOOD = b"1.000 2.000 3.000 10 20 30\n"


@pytest.fixture
def file(tmp_path):
    return tmp_path / "wall_1.txt"


def check_reads(file, rows):
    """Check that a file reads as some rows, and return what was repaired."""
    coord, color, repairs = read_annotation(file)
    assert coord.dtype == np.float32
    assert color.dtype == np.uint8
    assert np.array_equal(coord, np.array(rows)[:, :3].astype(np.float32))
    assert np.array_equal(color, np.array(rows)[:, 3:])
    return repairs


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("color", ["%d", "%.6f"])
def test_rows_read_as_they_were_written(file, end, color):
    rows = rows_of(0, 500)
    file.write_bytes(text_of(rows, end=end, color=color))
    assert check_reads(file, rows) == []


def test_numbers_are_rounded_as_numpy_rounds_them(file):
    file.write_bytes(text_of(rows_of(1, 2000)))
    expected = np.loadtxt(file)[:, :3].astype(np.float32)
    assert np.array_equal(read_annotation(file)[0], expected)


@pytest.mark.parametrize(
    "content",
    [
        b"1.000  2.000 3.000 10 20 30\n",
        b"1.000\t2.000\t3.000\t10 20 30\n",
        b" 1.000 2.000 3.000 10 20 30 \n",
        b"1.000 2.000 3.000 10 20 30",
        b"\n\r\n1.000 2.000 3.000 10 20 30\n\n",
        b"1e0 2.E+0 +3.000 10 20 30\n",
        b"1 2 3 9.6 20.4 30.49\n",
    ],
)
def test_other_spacing_is_understood(file, content):
    file.write_bytes(content)
    check_reads(file, [(1, 2, 3, 10, 20, 30)])


@pytest.mark.parametrize("end", [b"\n", b"\r\n"])
@pytest.mark.parametrize("line", BROKEN)
def test_known_broken_bytes_are_repaired_and_reported(file, line, end):
    file.write_bytes(GOOD.strip() + end + line + end + GOOD.strip() + end)
    found = check_reads(file, [(1, 2, 3, 10, 20, 30), BROKEN[line], (1, 2, 3, 10, 20, 30)])
    place = next(i for i, byte in enumerate(line) if byte < 32)
    after = line.translate(bytes(i | 32 if i < 32 else i for i in range(256)))
    assert found == [f"wall_1.txt: line 2, column {place + 1}: {line!r} read as {after!r}"]


def test_several_broken_bytes_are_all_reported(file):
    file.write_bytes(b"\x11.000 2.000 \x13.000 10 20 30\n" + GOOD + b"1\x0e000 2 3 10 20 30")
    found = check_reads(file, [(1, 2, 3, 10, 20, 30)] * 3)
    places = ("line 1, column 1:", "line 1, column 13:", "line 3, column 2:")
    assert len(found) == 3
    assert all(place in text for place, text in zip(places, found, strict=True))
    assert found[1].endswith("read as b'1.000 2.000 3.000 10 20 30'")


@pytest.mark.parametrize("extra", [b"", b"\x10"])
@pytest.mark.parametrize(
    "line",
    [
        b"1 2 3 10 20",
        b"1 2 3 10 20 30 40",
        b"1 2 x 10 20 30",
        b"1 2 nan 10 20 30",
        b"1 2 inf 10 20 30",
        b"1 2 1e39 10 20 30",
        b"1 2 3 10 20 256",
        b"1 2 3 10 255.5 30",
        b"1 2 3 -1 20 30",
        b"1 2 1_0 10 20 30",
        b"1 2 0x1 10 20 30",
        b"1 2 3,0 10 20 30",
        b"1 2 \xb3 10 20 30",
        b"1 2 3 10 20\x7f30",
        b"1 2 \r3 10 20 30",
        b"\r1 2 3 10 20 30",
        b"1 2 --3 10 20 30",
        b'1 2 "3" 10 20 30',
        b"1 2 3 10 20 - ",
        b"# x y z r g b",
    ],
)
def test_any_other_bad_line_is_an_error_that_shows_it(file, line, extra):
    file.write_bytes(GOOD + GOOD + line + extra + b"\n" + GOOD)
    with pytest.raises(FormatError) as caught:
        read_annotation(file)
    assert str(caught.value).startswith(f"{file}: line 3: expected x y z and colors")
    assert repr(line + extra) in str(caught.value)


def read_by_rules(content):
    """Read line by line as the rules say, None where a line is bad."""
    allowed = set(b"+-.0123456789eE \t")
    rows = []
    for line in content.split(b"\n"):
        text = bytes(b | 32 if b < 32 and b not in b"\t\r" else b for b in line)
        text = text[:-1] if text.endswith(b"\r") else text
        if not set(text) - set(b" \t\r") and b"\r" not in text:
            continue
        if set(text) - allowed:
            return None
        try:
            row = [float(word) for word in text.split()]
        except ValueError:
            return None
        if len(row) != 6 or not np.isfinite(np.float32(row[:3])).all():
            return None
        if min(np.rint(row[3:])) < 0 or max(np.rint(row[3:])) > 255:
            return None
        rows.append(row)
    return np.array(rows)


@pytest.mark.parametrize("column", range(6))
def test_any_byte_in_any_column_reads_by_the_rules_or_is_refused(file, column):
    lines = text_of(rows_of(6, 3)).split(b"\n")
    for byte in range(256):
        words = lines[1].split(b" ")
        words[column] = words[column][:1] + bytes([byte]) + words[column][2:]
        content = b"\n".join([lines[0], b" ".join(words), *lines[2:]])
        file.write_bytes(content)
        expected = read_by_rules(content)
        if expected is None:
            with pytest.raises(FormatError, match=r"line \d: expected"):
                read_annotation(file)
        else:
            check_reads(file, np.column_stack([expected[:, :3], np.rint(expected[:, 3:])]))


def test_long_lines_are_shown_in_part(file):
    file.write_bytes(b"1 " * 10_000)
    with pytest.raises(FormatError, match=r"got b'1 1.*\.\.\.'; correct"):
        read_annotation(file)


def test_a_file_of_line_ends_is_an_error(file):
    file.write_bytes(b"\n\n")
    with pytest.raises(FormatError, match="expected at least one point"):
        read_annotation(file)


def test_an_empty_or_missing_file_is_an_error(file):
    with pytest.raises(FormatError, match="file not found"):
        read_annotation(file)
    file.touch()
    with pytest.raises(FormatError, match="the file is empty"):
        read_annotation(file)


def test_the_reader_is_asked_for_by_name(file, monkeypatch):
    file.write_bytes(GOOD)
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'torchrg\[text\]'"):
        read_annotation(file)
