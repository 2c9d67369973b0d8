"""Small files that promise, or unpack to, more than memory holds, or take hours to read."""

import io
import re
import struct
import tracemalloc
import zipfile
import zlib

import numpy as np
import pytest
from numpy.lib import format as npy_format

from tests.io.e57_pages import join_e57, split_e57
from torchrg.errors import FormatError
from torchrg.io import read_cloud

POINTS = np.arange(15, dtype=np.float64).reshape(5, 3)


def array_bytes(shape, zeros=0):
    """A file of NumPy that begins as one of this shape, with so many zeros."""
    stream = io.BytesIO()
    layout = {"descr": "<f8", "fortran_order": False, "shape": shape}
    npy_format.write_array_header_1_0(stream, layout)
    return stream.getvalue() + bytes(zeros)


def pack(content):
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    return packer.compress(content) + packer.flush()


def test_arrays_that_share_their_bytes_are_refused(tmp_path):
    """One entry of a megabyte of zeros, listed as many times as there are arrays."""
    path, content, name = tmp_path / "shared.npz", array_bytes((43_690, 3), 2**20), b"points.npy"
    packed = pack(content)
    common = struct.pack("<HHHHIIIHH", 0, 8, 0, 33, 0, len(packed), len(content), len(name), 0)
    entry = b"PK\1\2" + struct.pack("<HH", 20, 20) + common + bytes(14) + name
    first = b"PK\3\4" + struct.pack("<H", 20) + common + name + packed
    tail = struct.pack("<HHHHIIH", 0, 0, 50, 50, 50 * len(entry), len(first), 0)
    path.write_bytes(first + 50 * entry + b"PK\5\6" + tail)
    with pytest.raises(FormatError, match=r"shared\.npz: .* bytes for 50 arrays, got"):
        read_cloud(path)


def test_more_arrays_than_a_result_has_are_refused(tmp_path):
    path = tmp_path / "many.npz"
    with zipfile.ZipFile(path, "w") as archive:
        for number in range(10_001):
            archive.writestr(f"{number}.npy", b"")
    with pytest.raises(FormatError, match=r"many\.npz: expected at most 10,000 arrays, got 10,001"):
        read_cloud(path)


@pytest.mark.parametrize("name", ["other", "provenance"])
def test_arrays_that_are_left_out_take_no_memory(tmp_path, name):
    path = tmp_path / "zeros.npz"
    np.savez_compressed(path, points=POINTS, **{name: np.zeros(2**24)})
    assert path.stat().st_size < 2**18
    tracemalloc.start()
    assert len(read_cloud(path)) == 5
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 2**24


def test_missing_memory_is_not_told_as_damage(tmp_path, monkeypatch):
    np.savez(tmp_path / "a.npz", points=POINTS)

    def refuse(*_, **__):
        raise MemoryError("Unable to allocate 9 TB")

    monkeypatch.setattr("torchrg.io.npy.scratch.empty", refuse)
    with pytest.raises(FormatError, match=r"a\.npz: 'points\.npy': out of memory; use a machine"):
        read_cloud(tmp_path / "a.npz")


def rewrite(path, pattern, replacement):
    """Change the XML of an E57 file."""
    before, xml = split_e57(path.read_bytes())
    xml, count = re.subn(pattern, replacement, xml)
    assert count
    path.write_bytes(join_e57(before, xml))


FIELDS = b"".join(b'<extra%d type="Integer" minimum="0" maximum="0"/>' % i for i in range(900))
AXIS = rb'<cartesian([XYZ]) type="Float".*?</cartesian.>'
CONSTANT = rb'<cartesian\1 type="Integer" minimum="5" maximum="5">5</cartesian\1>'


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ([(rb'recordCount="5"', b'recordCount="2000000000"')], "for 2,000,000,000 points, got"),
        (
            [
                (AXIS, CONSTANT),
                (rb'recordCount="5"', b'recordCount="300000"'),
                (rb"</prototype>", FIELDS + b"</prototype>"),
            ],
            "for 300,000 points, got",
        ),
        (
            [(rb"</e57Root>", b'<w type="Structure">' + FIELDS + FIELDS + b"</w></e57Root>")],
            "1,000 fields per structure, got more at",
        ),
        (
            [(rb"</e57Root>", b"<d>" * 9_000 + b"</d>" * 9_000 + b"</e57Root>")],
            "at most 100 levels",
        ),
        (
            [
                (
                    rb'(<\?xml.*?\?>)([\s\S]*?)(<name type="String">)',
                    rb'\1<!DOCTYPE e57Root [<!ENTITY a "aaaaaaaa"><!ENTITY b "&a;&a;">]>\2\3&b;',
                )
            ],
            "expected an E57 file, got: XML not well formed",
        ),
    ],
)
def test_scans_that_promise_too_much_are_refused(tmp_path, changes, message):
    pye57 = pytest.importorskip("pye57")
    path = tmp_path / "scan.e57"
    with pye57.E57(str(path), "w") as file:
        axes = ("cartesianX", "cartesianY", "cartesianZ")
        file.write_scan_raw(dict(zip(axes, POINTS.T, strict=True)), name="scan")
    assert len(read_cloud(path)) == 5
    for pattern, replacement in changes:
        rewrite(path, pattern, replacement)
    with pytest.raises(FormatError, match=message):
        read_cloud(path)
