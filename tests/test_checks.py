"""Argument checks say what was expected and what came."""

from typing import Literal

import numpy as np
import pytest
import torch

from torchrg._checks import (
    as_tensor,
    check_choices,
    check_floating,
    check_shapes,
    default_device_cpu,
    is_concrete,
)
from torchrg.errors import ConfigError, ShapeError


def test_letters_are_shared_between_arguments():
    patches = torch.zeros(5, 8, 3)
    check_shapes("f", patches=(patches, "* K 3"), mask=(torch.zeros(5, 8).bool(), "* K"))
    with pytest.raises(
        ShapeError, match=r"f: expected mask of shape \(\*, K\) with \*=\(5,\), K=8"
    ):
        check_shapes("f", patches=(patches, "* K 3"), mask=(torch.zeros(5, 7).bool(), "* K"))


def test_repeated_letters_must_agree():
    with pytest.raises(ShapeError, match="expected m of shape"):
        check_shapes("f", m=(torch.zeros(2, 3), "P P"))


def test_missing_axes_are_refused():
    with pytest.raises(ShapeError, match="expected points of shape"):
        check_shapes("f", points=(torch.zeros(3), "N 3"))


@pytest.mark.parametrize(
    ("shape", "pattern", "repair"),
    [
        ((50,), "* K P", "x[:, None]"),
        ((3,), "N 3", "x[None]"),
        ((2, 5, 3), "N 3", "one part, as x[0] or x[..., 0]"),
        ((1, 8, 9), "H W", "one part, as x[0] or x[..., 0]"),
        ((8, 9, 3), "H W", "x, not colors"),
    ],
)
def test_an_axis_too_many_or_too_few_is_refused_with_the_repair(shape, pattern, repair):
    with pytest.raises(ShapeError) as refused:
        check_shapes("f", x=(torch.zeros(shape), pattern))
    assert str(refused.value).endswith(f", got {shape}; pass {repair}.")


def test_tensors_of_two_devices_are_refused_with_both_names():
    meta = torch.zeros(4, 3, device="meta")
    with pytest.raises(ShapeError, match=r"^f: expected x and y on one device, got cpu and meta;"):
        check_shapes("f", x=(torch.zeros(4, 3), "N 3"), y=(meta, "N 3"))


def test_arrays_become_tensors_that_share_memory():
    array = np.zeros((4, 3), dtype=np.float32)
    tensor = as_tensor("f", "points", array)
    array[0, 0] = 7
    assert tensor[0, 0] == 7


def test_foreign_byte_order_and_read_only_arrays_are_accepted():
    array = np.arange(6, dtype=">f8").reshape(2, 3)
    array.setflags(write=False)
    assert as_tensor("f", "points", array).tolist() == [[0, 1, 2], [3, 4, 5]]


@pytest.mark.parametrize("values", [[[1.0, 2, 3]], np.array(["a"]), np.array([None])])
def test_other_things_are_refused(values):
    with pytest.raises(ShapeError, match="expected points to be a tensor or a NumPy array"):
        as_tensor("f", "points", values)


def test_mixed_precision_is_refused():
    with pytest.raises(ShapeError, match="a and b of one dtype, got float32 and float64"):
        check_floating("f", a=torch.zeros(1), b=torch.zeros(1, dtype=torch.float64))


@pytest.mark.parametrize(
    ("mask", "kind"),
    [
        (torch.ones(8), "float32"),
        (torch.ones(8, dtype=torch.int64), "int64"),
        (np.ones(8, dtype=bool), "ndarray"),
        ([True] * 8, "list"),
    ],
)
def test_masks_of_other_types_are_refused_with_the_repair(mask, kind):
    repair = f"f: expected mask to be a tensor of bool, got {kind}; pass torch.as_tensor"
    with pytest.raises(ShapeError, match=repair):
        check_shapes("f", points=(torch.zeros(8, 3), "N 3"), mask=(mask, "N"))


def test_is_concrete_by_example():
    assert (is_concrete(torch.zeros(2)), is_concrete(torch.zeros(2, device="meta"))) == (
        True,
        False,
    )
    assert torch.vmap(lambda row: torch.tensor(is_concrete(row)))(torch.zeros(2, 3)).tolist() == [
        False,
        False,
    ]


def test_choices_are_listed_if_another_is_passed():
    message = "f: expected rule to be one of all, none, got 'half'."
    with pytest.raises(ConfigError, match=message):
        check_choices("f", rule=("half", Literal["all", "none"]))


def test_the_default_device_is_the_cpu_in_a_block():
    with torch.device("meta"), default_device_cpu():
        assert torch.zeros(2).device.type == "cpu"
