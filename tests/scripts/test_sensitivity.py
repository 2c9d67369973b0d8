"""The study of the constants of consensus normals covers them all."""

import ast
import json
from pathlib import Path

import pytest
import sensitivity

from torchrg.neighbors import search_knn
from torchrg.normals import consensus
from torchrg.normals.consensus import constants
from torchrg.scenes import make_room

NAMES = {name for name in vars(constants) if name.isupper()}


@pytest.fixture
def tiny():
    room = make_room(600)
    neighbors = search_knn(room.points, 20)
    return sensitivity.Case("room", room.points, neighbors, room.labels, room.normals, 153)


def test_the_table_has_every_constant_with_its_unit():
    table = sensitivity.read_table()
    assert {constant.name for constant in table} == NAMES
    assert all(0 < len(constant.unit) < 30 for constant in table)


def test_no_other_file_of_the_package_has_constants_but_numbers_of_parameters():
    for path in Path(consensus.__file__).parent.glob("*.py"):
        numbers = [
            line.targets[0].id
            for line in ast.parse(path.read_text()).body
            if isinstance(line, ast.Assign) and isinstance(line.value, ast.Constant | ast.Tuple)
        ]
        own = path.name == "constants.py"
        assert all(own or name.endswith("_PARAMETERS") for name in numbers), path.name


def test_every_constant_is_read_where_the_estimator_is_called():
    text = "".join(path.read_text() for path in Path(consensus.__file__).parent.glob("*.py"))
    assert all(f"constants.{name}" in text for name in NAMES)


def test_what_moves_is_put_back_and_what_matters_is_found(tiny):
    before = {name: getattr(constants, name) for name in NAMES}
    chosen = ("FLAT_LIMIT", "MIN_BREADTH", "NOISE_COUNTS")
    table = [constant for constant in sensitivity.read_table() if constant.name in chosen]
    *counts, breadth, flat = sensitivity.study([tiny], table)
    assert [one.constant for one in counts] == ["NOISE_COUNTS[0]", "NOISE_COUNTS[1]"]
    assert breadth.half.change == breadth.double.change == 0
    assert (breadth.lowest, breadth.highest) == (0.5, 2.0)
    assert (flat.half.value, flat.double.value) == (0.525, 2.1)
    assert flat.double.change != 0
    assert {name: getattr(constants, name) for name in NAMES} == before


def test_the_script_prints_a_table_and_leaves_out_parts_that_are_not_there(
    tiny, monkeypatch, capsys, tmp_path
):
    monkeypatch.setattr(sensitivity, "make_cases", lambda parts, quick: [tiny])
    out = tmp_path / "found.json"
    arguments = ["sensitivity.py", "--parts", "nowhere.pcd", "--only", "FLAT_LIMIT"]
    monkeypatch.setattr("sys.argv", [*arguments, "--out", str(out)])
    sensitivity.main()
    shown = capsys.readouterr()
    assert "nowhere.pcd" in shown.err
    assert shown.out.splitlines()[-1].startswith("| FLAT_LIMIT | 1.05 |")
    (found,) = json.loads(out.read_text())["findings"]
    assert found["constant"] == "FLAT_LIMIT"


def test_what_is_kept_is_of_the_constants_as_they_are():
    kept = json.loads(Path(sensitivity.__file__).with_name("sensitivity.json").read_text())
    assert [(one["constant"], one["value"]) for one in kept["findings"]] == [
        (constant.title, constant.value) for constant in sensitivity.read_table()
    ]
