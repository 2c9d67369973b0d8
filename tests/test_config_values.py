"""Values and the words for them become those of an annotated type, or are refused in one line."""

import pickle
from fractions import Fraction
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch

from torchrg.config import SettingError, convert
from torchrg.datasets.folder import add_note
from torchrg.errors import ConfigError

Choice = Literal["one", "two"]


@pytest.mark.parametrize(
    ("hint", "given", "value"),
    [
        (int, "-3", -3),
        (int, np.uint8(3), 3),
        (int, torch.tensor(3), 3),
        (float, "1e-3", 1e-3),
        (float, 3, 3.0),
        (float, np.float32(8), 8.0),
        (float, Fraction(1, 4), 0.25),
        (float, np.array(2.5), 2.5),
        (float | None, "None", None),
        (bool, "Yes", True),
        (bool, "off", False),
        (bool, np.True_, True),
        (bool, np.False_, False),
        (Choice, "two", "two"),
        (int | Literal["auto"], "auto", "auto"),
        (int | Literal["auto"], "7", 7),
        (str, "7", "7"),
        (str | None, "null", None),
        (Path, "7", Path("7")),
        (tuple[Path, ...], ["a,b"], (Path("a,b"),)),
        (tuple[int, ...], "3, 2", (3, 2)),
        (tuple[int, ...], 3, (3,)),
        (tuple[float, float], range(2), (0.0, 1.0)),
        (tuple[float, ...], np.array([1, 2.5]), (1.0, 2.5)),
        (tuple[float, ...], torch.tensor([1, 2.5]), (1.0, 2.5)),
        (tuple[Choice, ...], ["two", "one"], ("two", "one")),
        (tuple[Choice, ...] | None, np.str_("two"), ("two",)),
        (tuple[Choice, ...] | None, "two,one", ("two", "one")),
    ],
)
def test_values_and_words_become_those_of_the_type(hint, given, value):
    found = convert(given, hint, "name")
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    ("hint", "given", "problem"),
    [
        (int, "3.0", "to be an integer, got '3.0'"),
        (int, 3.0, "to be an integer, got 3.0"),
        (int, True, "to be an integer, got True"),
        (int | None, "", "to be an integer or none, got ''"),
        (float, "nan", "to be a number, got 'nan'"),
        (float, 1j, "to be a number, got 1j"),
        (float, 10**400, "to be a number, got 1000"),
        (bool, "y", "to be true or false, got 'y'"),
        (bool, 0, "to be true or false, got 0"),
        (bool, "1", "to be true or false, got '1'"),
        (bool, 1.0, "to be true or false, got 1.0"),
        (bool, None, "to be true or false, got None"),
        (bool, ["no"], "to be true or false, got ['no']"),
        (Choice, "One", "to be one of one, two, got 'One'"),
        (Choice, None, "to be one of one, two, got None"),
        (tuple[Choice, ...], "one,three", "to be some of one, two, got 'one,three'"),
        (tuple[float, float], "1", "to be 2 numbers, got '1'"),
        (tuple[int, ...], {"a": 1}, "to be integers, got {'a': 1}"),
        (tuple[int, ...], b"ab", "to be integers, got b'ab'"),
        (Path, 3, "to be a path, got 3"),
        (str, 3, "to be text, got 3"),
    ],
)
def test_other_values_are_refused(hint, given, problem):
    with pytest.raises(ConfigError) as refused:
        convert(given, hint, "normals.k", "segment_planes")
    assert str(refused.value).startswith(f"segment_planes: expected normals.k {problem}")


def test_errors_survive_processes_and_take_notes():
    error = pickle.loads(pickle.dumps(SettingError("f", "k", ">= 3, got 2")))
    assert (str(error), error.name) == ("f: expected k >= 3, got 2.", "k")
    assert str(SettingError("", "--k", ">= 3, got 2")) == "expected --k >= 3, got 2."
    add_note(error, "This was room 3.")
    assert str(error).startswith("f: expected k >= 3, got 2.")
