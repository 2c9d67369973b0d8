"""Pages beside pictures: of segment, of convert, and the index that leads from one to the other."""

import re

import numpy as np
import pytest

from torchrg.cli import main
from torchrg.render import gallery, render_cloud
from torchrg.render.gallery import Entry, write_index

pytest.importorskip("pydeck", reason="needs the extra view")


@pytest.fixture(autouse=True)
def _small_pictures(monkeypatch):
    def small(*arguments, **settings):
        return render_cloud(*arguments, **settings, width=80)

    monkeypatch.setattr(gallery, "render_cloud", small)


@pytest.fixture(scope="module")
def rooms(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rooms")
    for number in (1, 2):
        path = folder / f"room {number}.npz"
        assert main(["sample", str(path), "--num-points", "2000", "--seed", str(number)]) == 0
    return folder


def links(index):
    """Each page with the picture that leads to it."""
    return re.findall(r'<a href="([^"]*)"><img src="([^"]*)"', index.read_text())


def test_each_picture_of_segment_leads_to_its_page(rooms, tmp_path, capsys):
    pictures = tmp_path / "pictures"
    inputs = [str(path) for path in sorted(rooms.iterdir())]
    flags = ["--out", str(tmp_path / "out"), "--preset", "classic", "--picture", str(pictures)]
    assert main(["segment", *inputs, *flags, "--pages"]) == 0
    expected = [(f"room%20{number}.html", f"room%20{number}.png") for number in (1, 2)]
    assert links(pictures / "index.html") == expected
    for names in expected:
        assert all((pictures / name.replace("%20", " ")).is_file() for name in names)
    assert "index.html" in capsys.readouterr().out


def test_segment_writes_a_page_as_its_picture(rooms, tmp_path):
    page = tmp_path / "planes.html"
    flags = ["--out", str(tmp_path / "out.npz"), "--preset", "classic", "--picture", str(page)]
    assert main(["segment", str(rooms / "room 1.npz"), *flags]) == 0
    assert "Content-Security-Policy" in page.read_text()


def test_pages_need_a_directory(rooms, tmp_path, capsys):
    flags = ["--out", str(tmp_path / "out.npz"), "--pages"]
    for picture in ([], ["--picture", str(tmp_path / "one.png")]):
        assert main(["segment", str(rooms / "room 1.npz"), *flags, *picture]) == 2
        assert "--picture DIRECTORY" in capsys.readouterr().err
    assert not (tmp_path / "out.npz").exists()


def test_each_scan_of_convert_leads_to_its_page(rooms, tmp_path, capsys):
    command = ["convert", "folder", str(rooms), str(tmp_path / "out"), "--preset", "classic"]
    flags = ["--pages", str(tmp_path / "pages"), "--workers", "1"]
    assert main([*command, *flags]) == 0
    assert len(links(tmp_path / "pages" / "index.html")) == 2
    assert (tmp_path / "pages" / "room 2.html").is_file()
    text = (tmp_path / "pages" / "index.html").read_text()
    assert "2,000 points" in text
    plane = np.load(tmp_path / "out" / "room 1" / "plane.npy")
    assert f"{plane.max() + 1} planes" in text


def test_names_are_no_markup(tmp_path):
    evil = '"><script>alert(1)</script>'
    text = write_index(tmp_path, evil, [Entry(evil, f"{evil}.png", "javascript:x", evil)])
    assert "<script" not in text.read_text()
    assert "javascript:" not in text.read_text()
