"""What the names of files and fields hold never reaches the terminal as it is."""

import os
import re
import subprocess
import sys

import numpy as np
import pytest
import torch

from torchrg.errors import FormatError
from torchrg.io import write_cloud
from torchrg.render import write_png
from torchrg.structures import Cloud

EVIL = "a\nb\x1b[31m\u202e"
"""A new line, red, and text from right to left."""
SHOWN = "a\\nb\\x1b[31m\\u202e"
NOT_TEXT = os.fsdecode(b"lat\xe9.ply")


@pytest.fixture
def cloud(tmp_path, room):
    points = room(600).points.numpy()
    (tmp_path / "in").mkdir()
    path = tmp_path / "in" / f"{EVIL}.npz"
    write_cloud(path, Cloud(points, {EVIL: np.arange(600)}))
    return path


@pytest.fixture
def shown_by(run):
    """``shown_by(...)``: what a command printed, in which all is printable but ends of lines."""

    def call(*arguments, code=0):
        done = run(*arguments)
        assert done.code == code
        lines = (done.out + done.err).splitlines()
        assert all(line.isprintable() for line in lines), lines
        return done.out + done.err

    return call


def test_names_are_printed_with_escapes(cloud, tmp_path, shown_by):
    out, again = tmp_path / "o.npz", tmp_path / f"{EVIL}.ply"
    flags = ("--preset", "classic")
    assert f"\n{SHOWN}" in shown_by("info", cloud)
    said = shown_by("segment", cloud, "--out", out, *flags)
    assert said.count("\n") == 1
    assert re.search(rf"{re.escape(SHOWN)}.npz: \d+ planes?, .*; 600 points in ", said)
    assert f"without the input fields {SHOWN}" in said
    assert f"{SHOWN}.ply\n" in shown_by("normals", cloud, "--out", again, "--method", "pca")
    assert f"{SHOWN}.x: " in shown_by("info", f"{EVIL}.x", code=2)
    convert = ("convert", "folder", cloud.parent, tmp_path / "out", *flags)
    assert f"\n{SHOWN} " in shown_by(*convert, "--dry-run")
    said = shown_by(*convert, "--workers", "1")
    assert f"\n{SHOWN} " in said
    assert f"\n{SHOWN}: left out: {SHOWN}" in said


def test_names_that_are_no_text_are_taken(cloud, tmp_path, shown_by):
    path = tmp_path / NOT_TEXT
    shown_by("normals", cloud, "--out", path, "--method", "pca")
    assert "lat\\udce9.ply -> " in shown_by("view", path, "--out", tmp_path / "o.html")
    assert "lat\\udce9" in (tmp_path / "o.html").read_text(encoding="utf-8")
    with pytest.raises(FormatError, match="; rename it, image file names must be valid UTF-8"):
        write_png(path.with_suffix(".png"), torch.zeros(2, 2, 3, dtype=torch.uint8))
    assert sorted(place.name for place in tmp_path.iterdir()) == ["in", NOT_TEXT, "o.html"]


def test_streams_that_are_closed_do_no_harm(cloud, tmp_path):
    command = f"exec {sys.executable} -m torchrg segment in/* --out o.npz --preset classic"
    done = subprocess.run(["sh", "-c", f"{command} <&- >&- 2>&-"], cwd=tmp_path)
    assert done.returncode == 0
    assert sorted(np.load(tmp_path / "o.npz")["labels"].shape) == [600]


def test_a_file_whose_name_begins_as_a_flag(cloud, tmp_path, shown_by, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "-dash.npz").write_bytes(cloud.read_bytes())
    said = shown_by("segment", "-dash.npz", "--out", "o.npz", code=2)
    assert "-dash.npz. Did you mean ./-dash.npz?" in said
    assert "600 of float32" in shown_by("info", "./-dash.npz")
