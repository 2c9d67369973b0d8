"""Kernels: written code, machine code, and what there is without a compiler."""

import dataclasses
import hashlib
import importlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests.made import cameras_around, render_depth
from torchrg import _compile, _parallel, kernels, load_config, segment_planes
from torchrg._compile import Kernel, compiled, kernel
from torchrg.depth import growth, make_intrinsics, segment_depth, windows
from torchrg.depth import normals as depth_normals
from torchrg.depth import segment as depth_segment
from torchrg.metrics import score_labels
from torchrg.normals.consensus import constants, hypotheses, noise
from torchrg.scenes import build_room, make_room
from torchrg.transforms import SegmentDepth

needs_compiler = pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHRG_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(_compile, "_prepared", {})
    return tmp_path


def few(rows, rng, count=8):
    return [torch.randn(rows, count, generator=rng) for _ in range(3)] + [torch.ones(rows, count)]


def fresh(one):
    """Return a kernel that has loaded nothing."""
    return Kernel(one.function, [" ".join(axes) for axes in one.axes])


def test_the_digest_knows_constants_and_what_is_called(monkeypatch):
    before = _compile._digest(hypotheses._refitted.function)
    assert before == _compile._digest(hypotheses._refitted.function)
    monkeypatch.setattr(hypotheses, "_within", lambda rests, reach: rests)
    assert _compile._digest(hypotheses._refitted.function) != before
    deviations = _compile._digest(noise._deviations.function)
    monkeypatch.setattr(constants, "MAX_LAYERED_KURTOSIS", 2.3)
    assert _compile._digest(noise._deviations.function) != deviations


def test_the_switch_reaches_the_threads(set_threads):
    set_threads(2)
    with compiled():
        found = _parallel.map_tasks(
            lambda task: (_compile.is_active.get(), _parallel.allowed_threads()),
            [0, 1],
            torch.device("cpu"),
        )
    assert found == [(True, 1), (True, 1)]


@pytest.mark.slow
def test_without_a_compiler_all_runs_as_written(folder, monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    monkeypatch.setenv("PATH", "")
    one, columns = fresh(noise._of_few), few(9, torch.Generator().manual_seed(0))
    with compiled(), pytest.warns(UserWarning, match="kernels are not compiled") as caught:
        found = one(*columns)
    assert len(caught) == 1
    assert "\n" not in str(caught[0].message)
    assert torch.equal(found[0], one.function(*columns)[0])


def test_without_a_folder_all_runs_as_written(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("TORCHRG_CACHE_DIR", str(tmp_path / "file" / "below"))
    one, columns = fresh(noise._of_few), few(9, torch.Generator().manual_seed(0))
    with compiled(), pytest.warns(UserWarning, match="set TORCHRG_CACHE_DIR"):
        found = one(*columns)
    assert torch.equal(found[0], one.function(*columns)[0])


def run_as_written(match):
    """Run a kernel that cannot be had compiled; one line says why."""
    one, columns = fresh(noise._of_few), few(9, torch.Generator().manual_seed(0))
    with compiled(), pytest.warns(UserWarning, match=match) as caught:
        found, _ = one(*columns), one(*columns)
    assert len(caught) == 1
    assert torch.equal(found[0], one.function(*columns)[0])


def test_a_cache_that_others_can_write_to_is_not_used(folder):
    for mode in (0o770, 0o707, 0o1777):
        folder.chmod(mode)
        run_as_written(rf"others can write to {folder}, set TORCHRG_CACHE_DIR to a folder of yours")
    assert not list(folder.iterdir())


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
def test_a_cache_of_somebody_else_is_not_used(folder):
    os.chown(folder, 12345, -1)
    run_as_written("others can write to")


def test_a_cache_in_use_by_somebody_else_or_damaged_is_one_line(folder):
    (folder / "lock").mkdir()
    run_as_written("lock: Is a directory")
    (folder / "lock").rmdir()
    # Code that is whole, and none that the system can load: a file of text, one without symbols.
    one, columns = fresh(noise._of_few), few(9, torch.Generator().manual_seed(0))
    path = one.path(tuple(map(_compile._kind, columns)))
    for code, match in ((b"text", "file too short|invalid ELF"), (_library(), "undefined symbol")):
        path.write_bytes(code + hashlib.sha256(code).digest())
        path.chmod(0o644)
        run_as_written(match)
    path.chmod(0o666)
    assert not _compile._is_whole(path)
    path.chmod(0o644)
    assert _compile._is_whole(path)


def _library():
    """Return a library of somebody else."""
    return Path(importlib.import_module("_ctypes").__file__).read_bytes()


def test_the_settings_say_whether_kernels_are_compiled(folder, monkeypatch):
    monkeypatch.setattr(_compile, "compile_kernels", lambda wanted, announce=None: False)
    from torchrg.pipeline import prepare_kernels

    config = dataclasses.replace(load_config("classic"), compile=True)
    assert prepare_kernels(config).compile is False
    assert prepare_kernels(load_config("classic")).compile is False


@pytest.fixture
def noted(folder, monkeypatch):
    """Names of the kernels that are to be compiled, where there is no compiler."""
    names = set()

    def note(wanted, announce=None):
        names.update(one.function.__name__ for one, _ in wanted)
        return False

    monkeypatch.setattr(_compile, "compile_kernels", note)
    monkeypatch.setattr(kernels, "serve", lambda *tensors, k=1: False)
    return names


def test_a_rehearsal_finds_the_kernels_of_a_preset(noted):
    seg = segment_planes(make_room(800, 0.003).points, load_config("consensus"), compile=True)
    assert len(seg.labels) == 800
    assert {"_smoothed", "_wedge", "_corner", "_refitted", "_deviations", "_pass"} <= noted


def test_a_rehearsal_finds_all_kernels_of_depth_images(noted):
    sample = {"depth": torch.full((30, 40), 2.0), "intrinsics": make_intrinsics(50, 50, 20, 15)}
    assert SegmentDepth(compile=True)(sample)["plane"].unique().tolist() == [0]
    modules = windows, depth_normals, growth, depth_segment
    kernels = {
        name
        for module in modules
        for name, value in vars(module).items()
        if isinstance(value, Kernel)
    }
    assert noted == kernels
    assert len(kernels) == 6


def test_a_row_alone_is_done_twice(monkeypatch):
    """The code is for two rows and more."""
    asked = []

    def code(tensors):
        asked.append([tuple(tensor.shape) for tensor in tensors])
        return (tensors[0] * tensors[1][:, None],)

    scaled = Kernel(lambda values, factors, table: (values * factors[:, None],), ["n K", "n", "T"])
    monkeypatch.setattr(Kernel, "load", lambda self, signature: code)
    values, table = torch.arange(4.0).view(1, 4), torch.zeros(5)
    with compiled():
        found = scaled(values, torch.tensor([2.0]), table)
        assert torch.equal(found[0], 2 * values)
        assert scaled(values[:0], torch.ones(0), table)[0].shape == (0, 4)
        assert scaled(values[:, :2], torch.ones(1), table)[0].shape == (1, 2)
    assert asked == [[(2, 4), (2,), (5,)]]


def test_a_last_row_alone_and_axes_that_follow_from_others(monkeypatch):
    asked = []

    def code(tensors):
        asked.append([tuple(tensor.shape) for tensor in tensors])
        return (tensors[0] + tensors[1],)

    added = Kernel(lambda a, b: (a + b,), ["2L+1 n", "n"])
    monkeypatch.setattr(Kernel, "load", lambda self, signature: code)
    with compiled():
        assert torch.equal(added(torch.ones(9, 1), torch.ones(1))[0], torch.full((9, 1), 2.0))
        assert added(torch.ones(6, 4), torch.ones(4))[0].shape == (6, 4)
    assert asked == [[(9, 2), (2,)]]
    lengths = dict(zip(["16", "n", "3L+1", "2L"], [16, 5, 16, 10], strict=True))
    assert {axis: _compile._length(axis, 5) for axis in lengths} == lengths


def test_gradients_need_the_written_code():
    @kernel("n K")
    def doubled(values):
        return (2 * values,)

    values = torch.ones(3, 4, requires_grad=True)
    with compiled():
        doubled(values)[0].sum().backward()
    assert torch.equal(values.grad, torch.full((3, 4), 2.0))


def test_a_torn_file_and_one_of_another_machine_are_no_code(folder, monkeypatch):
    one, signature = fresh(noise._of_few), ("float32",) * 4
    path, code = one.path(signature), b"machine code"
    path.write_bytes(code + hashlib.sha256(code).digest())
    assert _compile._is_whole(path)
    path.write_bytes(code[:-1] + b"X" + hashlib.sha256(code).digest())
    assert not _compile._is_whole(path)
    monkeypatch.setattr(_compile, "_machine", lambda: "another processor")
    assert one.path(signature) != path


@needs_compiler
@pytest.mark.slow
def test_code_gives_the_same_bits_for_any_rows_and_is_made_anew_if_torn(folder):
    rng = torch.Generator().manual_seed(0)
    columns = few(1000, rng)
    one = fresh(noise._of_few)
    with compiled():
        found = one(*columns)[0]
        for rows in (1, 2, 3, 7, 15, 16, 17, 31, 33, 500, 999):
            part = one(*(column[-rows:] for column in columns))[0]
            assert torch.equal(part, found[-rows:]), rows
        # Sixteen points need no other code.
        one(*few(5, rng, 16))
    assert torch.allclose(found, one.function(*columns)[0], rtol=1e-5, atol=1e-7)
    (path,) = (path for path in folder.iterdir() if path.name.startswith("_of_few"))
    written = path.stat().st_mtime_ns
    with compiled():
        fresh(one)(*columns)
    assert path.stat().st_mtime_ns == written
    # In a file of its own, as this process has the code of the other still open.
    torn = folder / "torn"
    torn.write_bytes(path.read_bytes()[:-100])
    torn.replace(path)
    with compiled():
        assert torch.equal(fresh(one)(*columns)[0], found)
    assert _compile._is_whole(path)


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("preset", ["consensus", "paper"])
def test_compiled_results_do_not_depend_on_order_chunks_or_threads(preset, set_threads):
    """And they are those of the written code, to rounding; the code stays in the user's folder."""
    points = make_room(20_000, 0.003, seed=5).points
    config = dataclasses.replace(load_config(preset), compile=True)
    expected = segment_planes(points, config)
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(1))
    shuffled = segment_planes(points[order], dataclasses.replace(config, chunk_size=777))
    assert torch.equal(shuffled.labels, expected.labels[order])
    assert torch.equal(shuffled.normals, expected.normals[order])
    set_threads(2)
    again = segment_planes(points, config)
    assert torch.equal(again.labels, expected.labels)
    assert torch.equal(again.normals, expected.normals)
    written = segment_planes(points, load_config(preset))
    assert score_labels(written.labels, expected.labels).ari > 0.9999
    script = "from torchrg import _compile; print('torch._dynamo' in __import__('sys').modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True)
    assert done.stdout.strip() == b"False"


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("sensor", ["exact", "kinect"])
def test_compiled_depth_is_that_of_the_written_code_on_any_number_of_threads(sensor, set_threads):
    model = build_room(2)
    camera = cameras_around(model, 4, seed=2, width=320, height=240)[3]
    depth = render_depth(model, camera, sensor=sensor, seed=2).depth
    written, first = (segment_depth(depth, camera.intrinsics, compile=on) for on in (False, True))
    assert score_labels(first.labels.flatten(), written.labels.flatten()).ari > 0.9999
    same = (first.labels == written.labels) & (first.valid == written.valid)
    torch.testing.assert_close(first.normals[same], written.normals[same], rtol=0, atol=1e-6)
    torch.testing.assert_close(first.curvature[same], written.curvature[same], rtol=0, atol=1e-6)
    set_threads(3)
    again = segment_depth(depth, camera.intrinsics, compile=True)
    for part in ("labels", "normals", "curvature", "sharp", "valid"):
        assert torch.equal(getattr(again, part), getattr(first, part)), part
