"""A room reads as its objects in natural order, whatever lies next to them."""

import numpy as np
import pytest

from tests.datasets.s3dis_tree import (
    BROKEN,
    digest,
    rows_of,
    text_of,
    write_clean_room,
    write_objects,
)
from torchrg.datasets import CLASS_ORDERS, read_room
from torchrg.errors import FormatError

pytest.importorskip("pyarrow", reason="needs torchrg[text]")


@pytest.fixture
def room(tmp_path):
    return tmp_path / "Area_5" / "office_36"


def broken_column(line):
    """Return the column of the byte that lost a bit, counted from one."""
    return next(i for i, byte in enumerate(line, start=1) if byte < 32)


def test_a_room_with_every_defect_reads_exactly(room):
    """The order of the objects is written out; glob, os.listdir and sorted would all differ."""
    rows = {name: rows_of(i, 40 + i) for i, name in enumerate("abcdef")}
    broken = b"\n".join(BROKEN) + b"\n"
    write_objects(
        room,
        {
            "wall_10.txt": text_of(rows["a"]),
            "wall_2.txt": text_of(rows["b"], end="\r\n"),
            "ceiling_1.txt": text_of(rows["c"], color="%.6f") + broken,
            "stairs_1.txt": text_of(rows["d"]),
            "chair_1.txt": text_of(rows["e"]),
            "wall_3.txt": text_of(rows["f"]),
            "wall_3 (1).txt": text_of(rows["f"]),
            "wall_2 (2).txt": b"not even numbers",
            "Icon\r": b"",
            ".DS_Store": b"\0\1",
            "._wall_2.txt": b"\0\5\x16\7",
            "notes.txt": b"hello",
        },
    )
    before = digest(room)
    found = read_room(room)
    # ceiling_1, chair_1, stairs_1, wall_2, wall_3, wall_10
    parts = [np.vstack([rows["c"], list(BROKEN.values())]), *(rows[name] for name in "edbfa")]
    points = np.vstack(parts)
    counts = [len(part) for part in parts]
    assert np.array_equal(found.coordinates, points[:, :3].astype(np.float32))
    assert np.array_equal(found.fields["color"], points[:, 3:])
    assert np.array_equal(found.fields["segment"], np.repeat([0, 8, 12, 2, 2, 2], counts))
    assert np.array_equal(found.fields["instance"], np.repeat(range(6), counts))
    assert (found.fields["segment"].dtype, found.fields["instance"].dtype) == (np.int16, np.int16)

    assert [text.partition(" read as ")[0] for text in found.repairs] == [
        f"ceiling_1.txt: line {43 + i}, column {broken_column(line)}: {line!r}"
        for i, line in enumerate(BROKEN)
    ]
    unnamed = "not read: not named CLASS_NUMBER.txt"
    assert sorted(found.notes) == [
        f".DS_Store {unnamed}",
        f"._wall_2.txt {unnamed}",
        f"Icon\r {unnamed}",
        f"notes.txt {unnamed}",
        "stairs_1.txt read as clutter",
        "wall_2 (2).txt not read: a copy of wall_2.txt by its name, but it differs",
        "wall_3 (1).txt not read: a copy of wall_3.txt",
    ]
    assert digest(room) == before


def test_a_copy_without_its_original_is_an_object(room):
    rows = write_clean_room(room, 1, {"wall_3 (1)": 5, "wall_4": 6})
    found = read_room(room)
    assert np.array_equal(
        found.coordinates, np.vstack(list(rows.values()))[:, :3].astype(np.float32)
    )
    assert found.notes == ()


def test_two_objects_of_the_same_points_are_told(room):
    rows = rows_of(3, 40)
    objects = {"chair_1": rows[:20], "chair_2": rows[20:], "table_1": rows[20:]}
    write_objects(room, {f"{name}.txt": text_of(part) for name, part in objects.items()})
    found = read_room(room)
    assert found.notes == ("table_1.txt has the same points as chair_2.txt",)
    assert len(found) == 60


def test_classes_are_those_of_pointcept(room):
    classes = CLASS_ORDERS["pointcept"]
    write_clean_room(room, 2, {f"{name}_1": 3 for name in classes})
    names = [classes[i] for i in read_room(room).fields["segment"]]
    assert names == sorted(names)
    assert {*names} == {*classes} == {*CLASS_ORDERS["spt"]}


def test_class_orders_are_those_of_the_two_families():
    both = ("ceiling", "floor", "wall", "beam", "column", "window", "door")
    assert CLASS_ORDERS["pointcept"] == (
        *both, "table", "chair", "sofa", "bookcase", "board", "clutter",
    )  # fmt: skip
    assert CLASS_ORDERS["spt"] == (
        *both, "chair", "table", "bookcase", "sofa", "board", "clutter",
    )  # fmt: skip


def test_rooms_without_objects_are_refused(room):
    room.mkdir(parents=True)
    with pytest.raises(FormatError, match="expected a folder Annotations"):
        read_room(room)
    write_objects(room, {"notes.txt": b"1 2 3 4 5 6"})
    with pytest.raises(FormatError, match=r"expected CLASS_NUMBER\.txt"):
        read_room(room)


@pytest.mark.parametrize("scale", [1, 255])
def test_all_objects_of_a_room_have_colors_of_one_range(room, scale):
    rows = rows_of(0, 40)
    pure = rows_of(1, 40)
    pure[:, 3:] = pure[:, 3:] % 2 * scale
    tables = {"wall_1.txt": rows, "wall_2.txt": pure}
    scaled = {name: table / [1, 1, 1, scale, scale, scale] for name, table in tables.items()}
    write_objects(room, {name: text_of(table, color="%.9f") for name, table in scaled.items()})
    found = read_room(room)
    color = found.fields["color"]
    assert np.array_equal(color, np.vstack([rows, pure])[:, 3:])
    assert color.dtype == np.uint8
    assert found.notes == ()
