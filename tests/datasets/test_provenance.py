"""The record of a scan names its files, first as a claim; no other file is touched."""

import json

import pytest

from torchrg.datasets.provenance import (
    check_owned,
    check_source,
    claim_files,
    owned_files,
    read_record,
    remove_unwritten,
    write_record,
)
from torchrg.errors import FormatError
from torchrg.io.files import fingerprint
from torchrg.io.result import RECORD


@pytest.mark.parametrize(
    "record",
    [
        {"versions": {}, "outputs": {"a.npy": {"bytes": 1}}},
        {"claims": {"a.npy": None}, "pages": ["../pages"]},
    ],
)
def test_records_and_claims_are_read_as_they_were_written(tmp_path, record):
    write_record(tmp_path, record)
    assert read_record(tmp_path, strict=True) == record
    assert [*owned_files(record)] == ["a.npy"]
    assert read_record(tmp_path / RECORD) is None
    assert read_record(tmp_path / "none", strict=True) is None


@pytest.mark.parametrize(
    "text",
    [
        "3",
        "[]",
        "{}",
        '{"outputs": {}}',
        '{"outputs": 3, "versions": {}}',
        '{"claims": ["a"]}',
        '{"claims": {}, "pages": 3}',
    ],
)
def test_records_of_other_programs_own_nothing(tmp_path, text):
    (tmp_path / RECORD).write_text(text)
    assert read_record(tmp_path, strict=True) is None
    with pytest.raises(FormatError, match=rf"{RECORD}: was not written by torchrg for this scan"):
        check_owned(tmp_path, [RECORD], None)


@pytest.mark.parametrize("content", [b"", b"{", b"\x00", b"\xff\xfe"])
def test_a_corrupt_record_is_named(tmp_path, content):
    (tmp_path / RECORD).write_bytes(content)
    assert read_record(tmp_path) is None
    with pytest.raises(FormatError, match=rf"{RECORD}: expected JSON, got: .*; move it, or its"):
        read_record(tmp_path, strict=True)


def test_a_claim_keeps_what_is_known_of_earlier_files(tmp_path):
    record = {"source": {"kind": "folder"}, "versions": {}, "outputs": {"a": {"bytes": 1}}}
    claim = claim_files(record, ["b"])
    assert claim["claims"] == {"a": {"bytes": 1}, "b": None}
    assert claim.keys() == {"source", "versions", "claims"}
    # What is about to be written may have any content.
    assert claim_files(claim, ["a"])["claims"] == {"a": None, "b": None}
    (tmp_path / "b").touch()
    (tmp_path / "c").symlink_to(tmp_path / "none")
    check_owned(tmp_path, ["a", "b", RECORD], claim)
    with pytest.raises(FormatError, match=r"c: was not written by torchrg for this scan; move it"):
        check_owned(tmp_path, ["b", "c"], claim)


def test_earlier_files_are_removed_unless_they_are_of_others(tmp_path):
    folder = tmp_path / "out" / "scan"
    folder.mkdir(parents=True)
    names = ["again", "changed", "claimed", "unchanged", "../shared", "../../other"]
    for name in (*names, "theirs"):
        (folder / name).write_text("a")
    stored = fingerprint(folder / "unchanged")
    claims = {name: None if name == "claimed" else stored for name in (*names, "gone")}
    (folder / "changed").write_text("b")
    record, paths = {"claims": claims}, {name: folder / name for name in (*names, "theirs")}
    assert remove_unwritten(tmp_path / "out", folder, record, ["again"]) == ["changed"]
    left = {name for name, path in paths.items() if path.exists()}
    assert left == {"again", "changed", "theirs", "../../other"}
    # A link is not the file that was written.
    (folder / "unchanged").symlink_to(folder / "again")
    assert remove_unwritten(tmp_path / "out", folder, record, []) == ["changed", "unchanged"]


@pytest.mark.parametrize(
    ("earlier", "source", "message"),
    [
        ({"kind": "folder"}, {"kind": "folder"}, ""),
        ({"kind": "folder"}, {"kind": "s3dis"}, "of convert s3dis, got folder; choose"),
        ({"layout": "npy", "version": 1}, {"layout": "npy", "version": 2, "kind": "folder"}, ""),
        ({"layout": "npy", "version": 2}, {}, "in layout pointcept, got npy; choose"),
        ({}, {"layout": "npy", "version": 2}, "in layout npy, got pointcept; choose"),
        # The layout of frames is that of the input.
        ({"kind": "rgbd", "layout": "tum"}, {"kind": "rgbd", "layout": "images"}, ""),
        (3, {"kind": "folder"}, ""),
    ],
)
def test_a_directory_is_of_one_kind_and_layout(tmp_path, earlier, source, message):
    record = json.loads(json.dumps({"source": earlier}))
    if not message:
        check_source(tmp_path, record, source)
        return
    with pytest.raises(FormatError, match=f"expected results {message} another directory"):
        check_source(tmp_path, record, source)


def test_owned_files_by_example():
    assert (owned_files({"claims": {"coord.npy": None}}), owned_files(None)) == (
        {"coord.npy": None},
        {},
    )


def test_claim_files_by_example():
    assert claim_files({"versions": {}, "outputs": {"a.npy": {"bytes": 8}}}, ["b.npy"]) == {
        "versions": {},
        "claims": {"a.npy": {"bytes": 8}, "b.npy": None},
    }
