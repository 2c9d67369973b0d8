"""Files appear whole or not at all."""

import gc
import io
import os
import resource
import signal
import stat
from pathlib import Path

import numpy as np
import pytest

from tests.io.conftest import needs
from torchrg.datasets import FolderOfClouds, RGBDFrames, ScanNet
from torchrg.errors import FormatError
from torchrg.io import FORMATS, read_cloud, write_cloud
from torchrg.io.files import atomic_path, check_end, list_some, normalize_file_name, split_words
from torchrg.io.result import read_result
from torchrg.structures import Cloud

WRITTEN = [kind for kind, row in FORMATS.items() if row.write]


def test_interrupted_writing_leaves_the_older_file(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def write_half():
        with atomic_path(path) as temporary:
            temporary.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_half()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_file_is_moved_into_place_at_the_end(tmp_path):
    path = tmp_path / "a.txt"
    with atomic_path(path) as temporary:
        temporary.write_text("new")
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".txt"
        assert not path.exists()
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_failing_disk_is_a_line_that_names_the_file(tmp_path, monkeypatch):
    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(FormatError, match=r"a\.npz: cannot be written: No space left on device\."):
        write_cloud(tmp_path / "a.npz", Cloud(np.zeros((2, 3))))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.name == "nt", reason="limits of POSIX")
@pytest.mark.parametrize("limit", [0, 100, 4096, 100_000])
@pytest.mark.parametrize("suffix", WRITTEN)
def test_a_disk_that_is_full_is_the_one_thing_told(tmp_path, capfd, suffix, limit):
    needs(suffix)
    cloud = Cloud(np.random.default_rng(0).random((20_000, 3)))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limits[1]))
    message = r"a\.\w+: cannot be written: (File too large|No space left on device)\."
    try:
        with pytest.raises(FormatError, match=message):
            write_cloud(tmp_path / f"a{suffix}", cloud)
        # What is left behind is not heard of either.
        gc.collect()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr().err == ""


@pytest.mark.skipif(os.name == "nt", reason="POSIX permissions")
def test_new_files_have_the_usual_permissions(tmp_path):
    write_cloud(tmp_path / "a.ply", Cloud(np.zeros((2, 3))))
    (tmp_path / "b").touch()
    modes = {stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("a.ply", "b")}
    assert len(modes) == 1


@pytest.mark.skipif(os.name == "nt", reason="links need rights there")
def test_links_are_followed(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link.ply").symlink_to(tmp_path / "real" / "a.ply")
    write_cloud(tmp_path / "link.ply", Cloud(np.zeros((2, 3))))
    assert (tmp_path / "link.ply").is_symlink()
    assert len(read_cloud(tmp_path / "real" / "a.ply")) == 2


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("s3://bucket/room.ply", "got a URL; copy it first"),
        ("file:///scans/room.ply", "got a URL; copy it first"),
        (Path("memory://room.ply"), "got a URL; copy it first"),
        (io.BytesIO(b"ply"), "got BytesIO; write its content to a temporary file"),
        (b"ply", "got bytes; write its content to a temporary file"),
    ],
)
@pytest.mark.parametrize(
    "read", [read_cloud, read_result, FolderOfClouds, RGBDFrames.from_folder, ScanNet]
)
def test_urls_and_open_files_are_named(source, message, read):
    with pytest.raises(FormatError, match=f"expected .*local.*{message}"):
        read(source)


def test_a_local_folder_may_look_like_a_url(tmp_path, monkeypatch):
    (tmp_path / "s3:").mkdir()
    write_cloud(tmp_path / "s3:" / "a.ply", Cloud(np.eye(3, dtype=np.float32)))
    monkeypatch.chdir(tmp_path)
    assert len(read_cloud("s3:/a.ply")) == 3


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_only_regular_files_are_read(tmp_path):
    os.mkfifo(tmp_path / "pipe.ply")
    (tmp_path / "zero.ply").symlink_to("/dev/zero")
    for name in ("pipe.ply", "zero.ply"):
        with pytest.raises(FormatError, match="expected a regular file, got a pipe or a device"):
            read_cloud(tmp_path / name)


@pytest.mark.parametrize("kind", [".ply", ".pcd"])
@pytest.mark.parametrize("is_ascii", [False, True])
def test_headers_may_end_their_lines_as_old_macs_did(tmp_path, kind, is_ascii):
    points = np.array([[0.0, 1.5, 13], [10, 4, 1e3]])
    path = tmp_path / f"a{kind}"
    write_cloud(path, Cloud(points))
    header, mark, body = path.read_bytes().partition(
        b"end_header\n" if kind == ".ply" else b"DATA binary\n"
    )
    header += mark
    if is_ascii:
        header = header.replace(b"binary_little_endian", b"ascii").replace(b"binary", b"ascii")
        body = b"0 1.5 13\n10 4 1e3\n"
    if kind == ".ply" and is_ascii:
        header = header.replace(
            b"end_header", b"element face 1\nproperty list uchar int vertex_indices\nend_header"
        )
        body += b"3 0 1 0\n"
    path.write_bytes(
        header.replace(b"\n", b"\r") + (body.replace(b"\n", b"\r") if is_ascii else body)
    )
    cloud = read_cloud(path)
    assert cloud.coordinates.tolist() == points.tolist()
    assert (cloud.front is not None) == (kind == ".ply" and is_ascii)


@pytest.mark.parametrize(("rest", "record_bytes", "refused"), [(11, 12, False), (12, 12, True)])
def test_bytes_after_the_last_record_are_refused_from_a_record_on(
    tmp_path, rest, record_bytes, refused
):
    path = tmp_path / "a.ply"
    path.write_bytes(b"points" + b"x" * rest)
    with path.open("rb") as stream:
        stream.seek(len(b"points"))
        if not refused:
            assert check_end(path, stream, record_bytes) == ()
            return
        with pytest.raises(FormatError, match=f"got {rest} more bytes"):
            check_end(path, stream, record_bytes)


def test_list_some_by_example():
    assert list_some(["a", "b", "c"], 2) == "a, b and 1 more"


def test_normalize_file_name_by_example():
    assert normalize_file_name("B\u00fcro") == normalize_file_name("bu\u0308RO")


def test_split_words_by_example():
    assert split_words("property float höhe".encode()) == ["property", "float", "höhe"]
    assert split_words(b"property float h\xf6he") == ["property", "float", "höhe"]


@pytest.mark.parametrize(
    ("content", "name", "kinds"),
    [
        (b"PK\3\4 and so on", "a.ply", ".npz or .zip"),
        (b"\x93NUMPY and so on", "a.xyz", ".npy"),
        (b"LASF and so on", "a.pcd", ".las or .laz"),
        (b"ply\nformat ascii 1.0", "a.txt", ".ply"),
    ],
)
def test_a_file_with_the_suffix_of_another_format_is_told(tmp_path, content, name, kinds):
    (tmp_path / name).write_bytes(content)
    message = f"{name}: byte 0: expected a {name[1:]} file, got a {kinds} file; rename it"
    with pytest.raises(FormatError, match=message):
        read_cloud(tmp_path / name)
