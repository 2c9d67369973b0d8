"""Whatever the loader is given, a kernel gets what its signature says, or an error says why not."""

import math
import os
import random
import subprocess
import sys

import pytest
import torch

from tests.kernels.clouds import needs_library
from torchrg import kernels
from torchrg.kernels import SIGNATURES

pytestmark = pytest.mark.skipif(not needs_library, reason="needs the library of kernels")

LENGTHS = [0, 1, 2, 3, 8, 9, 16, 50, 64, 70]
NUMBERS = [0.0, 1.0, -1.0, 0.35, 1e30, float("inf"), float("nan")]
DTYPES = {"f": torch.float32, "d": torch.float64, "i": torch.int32, "l": torch.int64}


def any_tensor(draw, letter, shape, num_points):
    """Return values of any kind, often with strides, rows at the borders and sometimes beyond."""
    wide = [length + draw.choice([0, 0, 3]) for length in shape]
    if letter.lower() == "b":
        values = torch.rand(wide) < 0.5
    elif letter.lower() in "il":
        low, high = draw.choice([(0, num_points), (0, 1), (-1, num_points + 1), (-(2**31), 2**31)])
        values = torch.randint(low, max(high, low + 1), wide, dtype=torch.int64)
        values = values.to(DTYPES[letter.lower()])
    else:
        values = torch.randn(wide, dtype=DTYPES[letter.lower()])
        values *= 10.0 ** draw.choice([0, 0, 0, -30, 30])
        if draw.random() < 0.2 and values.numel():
            values.view(-1)[draw.randrange(values.numel())] = draw.choice(NUMBERS)
    for axis, length in enumerate(shape):
        values = values.unfold(axis, length, 1).select(axis, 0).movedim(-1, axis)
    return values


def lengths_of_image(height, width, num_narrow):
    """Return lengths that fit to those of an image: of cells of 2 pixels, of tables of windows."""
    shapes = [(height, width)]
    while len(shapes) < 4:
        shapes.append(tuple(-(-length // 2) for length in shapes[-1]))
    squares = sum(math.prod(shape) for shape in shapes)
    lengths = {"m": 10, "p": shapes[1][0], "q": shapes[1][1], "P": height * width}
    return lengths | {"N": 9 * squares, "M": 18 * num_narrow}


def any_call(draw, name):
    """Call a kernel with lengths of 0 to 70; return whether it took the arguments."""
    lengths = {letter: draw.choice(LENGTHS) for letter in "NnkpcCwhmqMPLAeErRFKST"}
    lengths["c"] = draw.choice([10, lengths["c"]])
    if "hw]" in SIGNATURES[name] and draw.random() < 0.7:
        lengths |= lengths_of_image(lengths["h"], lengths["w"], lengths["n"])
    arguments = []
    for word in SIGNATURES[name].split("->")[0].split():
        letter, axes = word[0], word[1:].strip("[]?")
        if not axes:
            integers = [0, 1, 2, 3, 8, 16, 70, -1, 10**6]
            arguments.append(draw.choice(integers) if letter == "n" else draw.choice(NUMBERS))
        elif word.endswith("?") and draw.random() < 0.5:
            arguments.append(None)
        else:
            shape = [int(a) if a.isdigit() else lengths[a] for a in axes]
            tensor = any_tensor(draw, letter, shape, lengths["N"])
            arguments.append(tensor.contiguous() if letter.isupper() else tensor)
    try:
        kernels.call(name, *arguments)
    except (IndexError, ValueError):
        return False
    return True


def count_taken(count):
    """Return for each kernel how many calls it took, of so many."""
    draw = random.Random(0)
    torch.manual_seed(0)
    return {name: sum(any_call(draw, name) for _ in range(count)) for name in SIGNATURES}


def test_no_arguments_crash_a_kernel():
    code = (
        "from tests.kernels.test_loader import count_taken; print(min(count_taken(400).values()))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    assert int(done.stdout) > 0


def test_a_row_that_is_not_there_is_an_error():
    points, lists = torch.rand(5, 3), torch.tensor([[0, 5, 1]], dtype=torch.int32)
    with pytest.raises(IndexError, match="expected neighbor indices of existing rows"):
        kernels.call("fit_normals_pca", points, lists, None, torch.zeros(1), 0.0, 0.0)


def test_lengths_that_disagree_are_an_error():
    lists, mask = torch.zeros(4, 3, dtype=torch.int32), torch.ones(4, 2, dtype=torch.bool)
    with pytest.raises(ValueError, match="fit_normals_pca: expected b"):
        kernels.call("fit_normals_pca", torch.rand(5, 3), lists, mask, torch.zeros(4), 0.0, 0.0)


def test_kernels_serve_plain_tensors_of_single_precision_alone():
    plain = torch.rand(3)
    assert kernels.serve(plain, None, k=50)
    assert not kernels.serve(plain.double())
    assert not kernels.serve(plain.requires_grad_())
    assert not kernels.serve(plain.detach(), k=0)
    assert not kernels.serve(plain.detach(), k=kernels.MAX_NEIGHBORS + 1)
    assert not kernels.serve(torch.rand(3, device="meta"))
    assert not any(torch.vmap(lambda row: torch.tensor(kernels.serve(row)))(torch.rand(2, 3)))


def test_a_library_that_is_older_than_its_sources_is_not_used(tmp_path):
    library, source = tmp_path / "libkernels-base.library", tmp_path / "scale.cpp"
    assert not kernels._is_stale(library)
    for path, second in ((library, 2), (source, 1)):
        path.touch()
        os.utime(path, (second, second))
    assert not kernels._is_stale(library)
    os.utime(source, (3, 3))
    assert kernels._is_stale(library)


def test_a_library_without_one_of_the_kernels_is_not_used(monkeypatch):
    monkeypatch.setitem(kernels.SIGNATURES, "kernel_of_tomorrow", "f[n] -> f[n]")
    with pytest.warns(UserWarning, match="of another version; install it again"):
        assert kernels._library.__wrapped__() is None


@pytest.mark.parametrize("wrong", [0, 1, 2])
def test_outputs_that_a_kernel_writes_to_must_be_contiguous(wrong):
    # A copy would take the values that the kernel writes.
    forest = [
        torch.arange(4, dtype=torch.int32),
        torch.zeros(4, dtype=torch.bool),
        torch.zeros(4, dtype=torch.bool),
    ]
    strided = torch.zeros(8, dtype=forest[wrong].dtype)[::2]
    strided.copy_(forest[wrong])
    forest[wrong] = strided
    with pytest.raises(ValueError, match="flatten_nodes: expected"):
        kernels.call("flatten_nodes", *forest)
