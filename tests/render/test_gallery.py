"""Viewers next to images: segment, convert, and the index of all viewers."""

import re

import numpy as np
import pytest

from torchrg.render.gallery import Entry, write_index

pytest.importorskip("pydeck", reason="needs the extra view")


pytestmark = pytest.mark.usefixtures("small_pictures")


@pytest.fixture(scope="module")
def rooms(folder_of_clouds):
    return folder_of_clouds("room 1.npz", "room 2.npz")


def links(index):
    """Each page with the picture that leads to it."""
    return re.findall(r'<a href="([^"]*)"><img src="([^"]*)"', index.read_text())


def test_each_picture_of_segment_leads_to_its_page(rooms, tmp_path, run):
    pictures = tmp_path / "pictures"
    flags = ("--out", tmp_path / "out", "--preset", "classic", "--picture", pictures, "--pages")
    done = run("segment", *sorted(rooms.iterdir()), *flags)
    assert "index.html" in done.out
    expected = [(f"room%20{number}.html", f"room%20{number}.png") for number in (1, 2)]
    assert links(pictures / "index.html") == expected
    for names in expected:
        assert all((pictures / name.replace("%20", " ")).is_file() for name in names)


def test_segment_writes_a_page_as_its_picture(rooms, tmp_path, run):
    page = tmp_path / "planes.html"
    flags = ("--out", tmp_path / "out.npz", "--preset", "classic", "--picture", page)
    assert run("segment", rooms / "room 1.npz", *flags).code == 0
    assert "Content-Security-Policy" in page.read_text()


def test_pages_need_a_directory(rooms, tmp_path, run):
    for picture in ((), ("--picture", tmp_path / "one.png")):
        done = run(
            "segment", rooms / "room 1.npz", "--out", tmp_path / "out.npz", "--pages", *picture
        )
        assert done.code == 2
        assert "--picture DIRECTORY" in done.error
    assert not (tmp_path / "out.npz").exists()


def test_each_scan_of_convert_leads_to_its_page(rooms, tmp_path, run):
    pages = tmp_path / "pages"
    flags = ("--preset", "classic", "--pages", pages, "--workers", "1")
    assert run("convert", "folder", rooms, tmp_path / "out", *flags).code == 0
    assert len(links(pages / "index.html")) == 2
    assert (pages / "room 2.html").is_file()
    text = (pages / "index.html").read_text()
    assert "2,000 points" in text
    plane = np.load(tmp_path / "out" / "room 1" / "plane.npy")
    assert f"{plane.max() + 1} planes" in text


def test_names_are_no_markup(tmp_path):
    evil = '"><script>alert(1)</script>'
    text = write_index(tmp_path, evil, [Entry(evil, f"{evil}.png", "javascript:x", evil)])
    assert "<script" not in text.read_text()
    assert "javascript:" not in text.read_text()
