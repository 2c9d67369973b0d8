"""Numbers in text with pyarrow and without."""

import random
import sys

import numpy as np
import pytest

from torchrg.errors import FormatError
from torchrg.io import read_cloud, text
from torchrg.io.arrow import parse_numbers

MARKS = [" ", "\t", "  ", ",", ", ", ";"]
NUMBERS = ["nan", "-nan", "NaN", "inf", "-inf", "Infinity", "+1", "1e400", "5.", ".5", "-0", "007"]
NO_NUMBERS = [
    *("", "x", "nan(1)", "1e", "1 2", "0x10", "1_0"),
    *("1,5", "--1", "1.2.3", "1d5", "-", '"1"'),
]
NO_ROWS = ["", "  ", "\t", "# a b", "# a", "// a", "7", "\0"]


def broken_text(rng):
    """Up to forty rows of numbers, with one or two things that happen to text."""
    mark, num_columns = rng.choice(MARKS), rng.choice([3, 4, 6, 7])
    rows = [
        [
            rng.choice([f"{rng.gauss(0, 9):.3f}", repr(rng.random()), str(rng.randrange(256))])
            for _ in range(num_columns)
        ]
        for _ in range(rng.randrange(2, 40))
    ]
    for _ in range(rng.choice([0, 1, 2])):
        row = rng.choice(rows)
        match rng.randrange(5):
            case 0:
                row[rng.randrange(len(row))] = rng.choice(NO_NUMBERS)
            case 1:
                row[rng.randrange(len(row))] = rng.choice([*NUMBERS, "7" * rng.randrange(15, 400)])
            case 2:
                row[rng.randrange(len(row)) :] = rng.choice([[], ["1", "2"]])
    lines = [mark.join(row) for row in rows]
    for _ in range(rng.choice([0, 0, 1])):
        extra = [*NO_ROWS, *map(str.join, " ;", [rows[0]] * 2)]
        lines.insert(rng.randrange(len(lines)), rng.choice(extra))
    if rng.random() < 0.1:
        lines = [line.replace(".", ",") for line in lines]
    if rng.random() < 0.3:
        lines.insert(0, mark.join(["x", "y", "z", "a", "b", "c", "d"][:num_columns]))
    data = rng.choice(["\n", "\n", "\r\n", "\r"]).join(lines).encode()
    data = rng.choice([b"", b"", b"\xef\xbb\xbf"]) + data
    match rng.randrange(6):
        case 0:
            data = data[: rng.randrange(1, len(data))]
        case 1:
            place = rng.randrange(len(data))
            data = data[:place] + rng.choice([b"\0", b"\xb3", b"\x0b", b"'", b"\r"]) + data[place:]
    return data


def bits_or_refusal(path):
    """What reading gives: the bytes of all arrays with their names, or the message."""
    try:
        cloud = read_cloud(path)
    except FormatError as error:
        return str(error)
    fields = {name: (values.dtype, values.tobytes()) for name, values in cloud.fields.items()}
    return cloud.coordinates.tobytes(), fields, cloud.notes


@pytest.mark.parametrize("at_once", [60, 1 << 22])
def test_text_reads_the_same_with_pyarrow_and_without(tmp_path, monkeypatch, at_once):
    pytest.importorskip("pyarrow", reason="needs torchrg[text]")
    monkeypatch.setattr(text, "CHARACTERS_PER_READ", at_once)
    rng = random.Random(0)
    path, refused, taken = tmp_path / "a.txt", 0, []
    parse = text.parse_numbers
    monkeypatch.setattr(text, "parse_numbers", lambda *args: note(taken, parse(*args)))
    for _ in range(200):
        path.write_bytes(broken_text(rng))
        fast = bits_or_refusal(path)
        with monkeypatch.context() as without:
            without.setitem(sys.modules, "pyarrow", None)
            assert bits_or_refusal(path) == fast, path.read_bytes()
        refused += isinstance(fast, str)
    # Both ends are met often enough to say something.
    assert 40 <= refused <= 160
    assert sum(table is not None for table in taken) >= 40


def note(taken, table):
    taken.append(table)
    return table


def test_what_pyarrow_makes_of_characters_of_numbers_python_does(tmp_path):
    pytest.importorskip("pyarrow", reason="needs torchrg[text]")
    rng = random.Random(0)
    words = ["".join(rng.choices("0123456789+-.eE", k=rng.randrange(1, 9))) for _ in range(2000)]
    words += ["".join(rng.choices("naifNAIF+-", k=rng.randrange(2, 5))) for _ in range(2000)]
    read = 0
    for word in [*words, *NUMBERS, *NO_NUMBERS]:
        table = parse_numbers(f"{word} 0 0\n".encode(), 3)
        if table is not None:
            assert table[0, :1].tobytes() == np.array([float(word)]).tobytes(), word
            read += 1
    assert read > 500
