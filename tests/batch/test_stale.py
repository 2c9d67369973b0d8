"""Results of scans that have another name now, or left the data set, do not stay in silence."""

import json
import os
import shutil
from functools import partial

import numpy as np
import pytest
import yaml

from tests.batch.test_interruptions import results_of
from tests.batch.test_scans import make_claim
from tests.datasets.s3dis_tree import write_clean_room
from tests.datasets.scannet_tree import write_scan, write_tables
from torchrg.batch.run import LOCK, REPORT, list_jobs
from torchrg.batch.scans import RECORD
from torchrg.batch.sources import CloudSource
from torchrg.batch.stale import check_stale, find_stale, remove_stale
from torchrg.config import load_config
from torchrg.datasets import ScanNet
from torchrg.datasets.layouts import LAYOUTS
from torchrg.io.files import OUTPUT_MARK, remove_leftovers
from torchrg.io.result import PAGE_SUFFIXES
from torchrg.scenes import make_room

FIRST, MOVED, LAST = SCANS = ("scene0001_00", "scene0002_00", "scene0003_00")
ROOM = make_room(num_points=300, seed=1)
LISTS = ("train_database.yaml", "validation_database.yaml", "test_database.yaml")


@pytest.fixture(scope="module")
def release(tmp_path_factory):
    """Three scans of ScanNet, the last of them for validation."""
    root = tmp_path_factory.mktemp("release")
    coord, faces = ROOM.points.float().numpy(), ROOM.labels.numpy()
    objects = [("wall" if face % 2 else "table", [face]) for face in np.unique(faces)]
    for number, name in enumerate(SCANS):
        write_scan(
            root / "scans", name, coord, np.full(coord.shape, number, np.uint8), faces, objects
        )
    write_tables(root, [FIRST, MOVED], [LAST])
    return root


@pytest.fixture
def root(release, tmp_path):
    """A copy that a test may change."""
    return shutil.copytree(release, tmp_path / "scannet")


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out"


@pytest.fixture
def convert(run):
    """``convert(kind, root, out, ...)``: the command."""
    return lambda *arguments: run("convert", *arguments, "--preset", "classic")


def move(root, *, train=(FIRST,), val=(MOVED, LAST)):
    """Change the lists of splits."""
    for split, names in (("train", train), ("val", val)):
        (root / "meta_data" / f"scannetv2_{split}.txt").write_text("".join(f"{n}\n" for n in names))


def files_of(out):
    """Return results and lists by name, without what a run notes for itself."""
    files = {path.relative_to(out).as_posix(): path for path in out.rglob("*") if path.is_file()}
    return {name: path.read_bytes() for name, path in files.items() if name not in (LOCK, REPORT)}


def save_rooms(folder, *names, first=0):
    """Write small rooms, each of its own points."""
    for seed, name in enumerate(names, first):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        np.save(folder / name, make_room(num_points=300, seed=seed).points)


@pytest.mark.parametrize("layout", ["pointcept", *LAYOUTS])
def test_a_scan_that_changes_its_split_leaves_the_old_one(root, out, tmp_path, convert, layout):
    if layout == "nag":
        pytest.importorskip("h5py")
    command = ("scannet", root, out, "--layout", layout)
    assert convert(*command).code == 0
    before = files_of(out)
    move(root)
    message = f"remove train/{MOVED}: its scan is val/{MOVED} now\n"
    assert message in convert(*command, "--dry-run").out
    assert files_of(out) == before
    done = convert(*command)
    assert (done.code, done.err) == (0, "")
    assert f"{out}/train/{MOVED}: removed: its scan is val/{MOVED} now\n" in done.out
    assert "removed" not in convert(*command).out
    found = files_of(out)
    shutil.rmtree(out)
    assert convert(*command).code == 0
    # Everything is as if the first run had not been: files, lists, and no folder is left.
    assert files_of(out) == found
    assert not [path for path in out.rglob("*") if path.is_dir() and not any(path.iterdir())]


@pytest.mark.parametrize("flags", [[], ["--dry-run"]])
@pytest.mark.parametrize("layout", ["pointcept", "nag", "mask3d", "mmdet3d"])
def test_a_scan_that_left_the_data_set_is_named(root, out, convert, layout, flags):
    if layout == "nag":
        pytest.importorskip("h5py")
    command = ("scannet", root, out, "--layout", layout)
    assert convert(*command).code == 0
    before = files_of(out)
    shutil.rmtree(root / "scans" / MOVED)
    move(root, train=[FIRST], val=[LAST])
    done = convert(*command, *flags)
    assert done.code == 2
    assert done.error == (
        f"torchrg: {out}/train/{MOVED}: no scan in {root} belongs to these results; "
        "remove them with --prune, or keep them with --only '*'.\n"
    )
    assert files_of(out) == before
    assert convert(*command, "--only", "*").code == 0
    assert files_of(out) == before
    assert convert(*command, "--prune", *flags).code == 0
    assert (files_of(out) == before) == bool(flags)
    if not flags:
        assert not [name for name in files_of(out) if MOVED.removeprefix("scene") in name]
        assert not [text for text in files_of(out).values() if MOVED.encode() in text]


def test_lists_lose_the_scans_of_other_splits_and_keep_other_names(root, out, convert):
    command = ("scannet", root, out, "--layout", "mmdet3d")
    (out / "meta_data").mkdir(parents=True)
    (out / "meta_data" / "scannetv2_train.txt").write_text(f"scene0700_00\n{MOVED}\n")
    move(root)
    assert convert(*command).code == 0
    lists = {split: f"meta_data/scannetv2_{split}.txt" for split in ("train", "val")}
    assert files_of(out)[lists["train"]].decode().split() == ["scene0700_00", FIRST]
    assert files_of(out)[lists["val"]].decode().split() == [MOVED, LAST]


@pytest.mark.parametrize("layout", ["pointcept", "isbnet"])
def test_what_a_user_changed_or_added_is_never_removed(root, out, convert, layout):
    command = ("scannet", root, out, "--layout", layout, "--superpoints")
    assert convert(*command).code == 0
    move(root)
    folder = out / "train" / MOVED
    changed = folder / "plane.npy" if layout == "pointcept" else out / "planes" / f"{MOVED}.pth"
    whole = changed.read_bytes()
    for path, content in ((changed, b"by hand"), (folder / "notes.txt", b"mine")):
        before = path.read_bytes() if path.exists() else None
        path.write_bytes(content)
        held = files_of(out)
        for flags in ([], ["--dry-run"], ["--only", "val/*"]):
            done = convert(*command, *flags)
            assert done.code == 2
            assert f"{path}: was changed or not written by torchrg" in done.error
            assert f"its scan is val/{MOVED} now; move it.\n" in done.error
            assert files_of(out) == held
        path.unlink() if before is None else path.write_bytes(before)
    changed.unlink()
    changed.symlink_to(out.parent / "other")
    (out.parent / "other").write_bytes(whole)
    assert f"{changed}: was changed or not written" in convert(*command).error
    changed.unlink()
    assert convert(*command).code == 0
    assert not folder.exists()


def test_a_file_that_a_user_changed_stays_when_options_change(root, out, convert):
    command = ("scannet", root, out, "--only", f"*{FIRST}")
    assert convert(*command, "--superpoints", "--table", "planes.csv").code == 0
    for name in ("superpoint.npy", "planes.csv"):
        (out / "train" / FIRST / name).write_bytes(b"by hand")
    done = convert(*command)
    assert done.code == 0
    for name in ("superpoint.npy", "planes.csv"):
        assert (out / "train" / FIRST / name).read_bytes() == b"by hand"
        assert f"{name} is kept, as it was changed since torchrg wrote it" in done.out
    again = convert(*command, "--superpoints")
    assert again.code == 3
    assert "superpoint.npy" in again.err


@pytest.mark.parametrize("has_record", [True, False])
def test_a_removal_that_is_killed_at_any_moment_goes_on(
    root, out, convert, monkeypatch, has_record
):
    assert convert("scannet", root, out, "--layout", "mask3d").code == 0
    record = out / "train" / MOVED / RECORD
    if not has_record:
        make_claim(record)
    start = shutil.copytree(out, out.with_name("start"))
    move(root)
    jobs = list_jobs(CloudSource(ScanNet(root), load_config("classic"), layout="mask3d"), out)

    def remove():
        remove_leftovers(out, OUTPUT_MARK)
        for result in find_stale(jobs):
            check_stale([result], root, prune=False)
            remove_stale(result)
        return files_of(out), [*out.rglob("*")]

    expected = remove()
    assert not [name for name in expected[0] if "2_00" in name and not name.startswith("val")]
    calls = {name: getattr(os, name) for name in ("unlink", "rmdir", "rename")}
    for moment in range(20):
        shutil.rmtree(out)
        shutil.copytree(start, out)
        left = iter(range(moment))

        def call(path, *given, name, left=left, **options):
            if next(left, None) is None:
                raise KeyboardInterrupt
            return calls[name](path, *given, **options)

        with monkeypatch.context() as patch:
            for name in calls:
                patch.setattr(os, name, partial(call, name=name))
            try:
                remove()
                break
            except KeyboardInterrupt:
                pass
        # The record stays until all files that it names are gone.
        left_over = [n for n in files_of(out) if n not in expected[0] and OUTPUT_MARK not in n]
        assert record.exists() or not left_over
        assert remove() == expected
    assert moment > 6


def test_what_a_killed_command_left_of_a_scan_that_moved_goes_too(root, out, convert):
    assert convert("scannet", root, out).code == 0
    folder = out / "train" / MOVED
    make_claim(folder / RECORD)
    (folder / "coord.npy").unlink()
    record = out / "train" / FIRST / RECORD
    described = json.loads(record.read_text())
    shutil.rmtree(record.parent)
    record.parent.mkdir()
    del described["outputs"]
    record.write_text(json.dumps(described | {"claims": {}}))
    move(root, train=[], val=SCANS)
    done = convert("scannet", root, out)
    assert (done.code, done.err) == (0, "")
    assert done.out.count("removed: its scan is") == 1
    assert sorted(path.name for path in out.iterdir() if path.is_dir()) == ["val"]


def test_scans_that_were_not_asked_for_are_not_missing(tmp_path, out, convert):
    pytest.importorskip("pyarrow")
    for area in (1, 2):
        counts = {"wall_1": 200, "floor_1": 100}
        write_clean_room(tmp_path / "s3dis" / f"Area_{area}" / "office_1", area, counts)
    command = ("s3dis", tmp_path / "s3dis", out, "--layout", "mask3d")
    for areas in ([1], [2], [1, 2], [1]):
        assert convert(*command, "--areas", *areas).code == 0
    databases = [yaml.safe_load((out / f"Area_{n}_database.yaml").read_text()) for n in (1, 2)]
    assert [[row["scene"] for row in rows] for rows in databases] == [["office_1"], ["office_1"]]
    shutil.rmtree(tmp_path / "s3dis" / "Area_2")
    done = convert(*command)
    assert done.code == 2
    assert f"{out}/Area_2/office_1: no scan in" in done.err
    assert convert(*command, "--prune").code == 0
    assert yaml.safe_load((out / "Area_2_database.yaml").read_text()) == []


def test_a_directory_holds_one_data_set(tmp_path, out, convert):
    roots = {name: tmp_path / name for name in ("one", "two", "three", "four")}
    save_rooms(roots["one"], "a.npy", "b.npy", "c.npy")
    save_rooms(roots["two"], "d.npy", "sub/e.npy", first=5)
    save_rooms(roots["three"], "f.npy", "a.npy", first=7)
    save_rooms(roots["four"], "a.npy", "b.npy", "c.npy", "d.npy", first=9)
    assert convert("folder", roots["one"], out).code == 0
    before = files_of(out)
    for name, results in (("two", "a, b, c"), ("three", "b, c"), ("four", "a, b, c")):
        for flags in ([], ["--prune"], ["--only", "*"], ["--force"], ["--dry-run"]):
            done = convert("folder", roots[name], out, *flags)
            assert done.code == 2
            assert done.error == (
                f"torchrg: {out}: expected results of {roots[name]}, got another data set "
                f"({results}); choose another directory, or remove them.\n"
            )
    assert files_of(out) == before
    (roots["one"] / "b.npy").unlink()
    # Copies of a data set are the same data set.
    copy = shutil.copytree(roots["one"], tmp_path / "copy")
    for root in (roots["one"], copy):
        assert f"{out}/b: no scan in {root} belongs" in convert("folder", root, out).error


def test_a_data_set_is_known_by_its_place_when_all_its_scans_changed(tmp_path, out, convert):
    root = tmp_path / "in"
    save_rooms(root, "a.npy", "b.npy", "c.npy")
    assert convert("folder", root, out).code == 0
    (root / "c.npy").unlink()
    save_rooms(root, "a.npy", "b.npy", first=5)
    assert f"{out}/c: no scan in {root} belongs" in convert("folder", root, out).error
    assert convert("folder", root, out, "--prune").code == 0
    assert sorted(path.name for path in out.iterdir() if path.is_dir()) == ["a", "b"]


@pytest.mark.parametrize(
    "names",
    [
        {"a": "new"},
        {"a": "A"},
        {"a": "b/a"},
        {"a": "x", "b": "y", "c": "z"},
        {"c": "d", "b": "c", "a": "b"},
        {"a": None, "b": "a", "c": "b"},
    ],
)
def test_scans_of_other_names_are_known_by_their_content(tmp_path, out, convert, names):
    root, kept = tmp_path / "in", {old: new for old, new in names.items() if new is not None}
    save_rooms(root, *(f"{name}.npy" for name in names))
    assert convert("folder", root, out).code == 0
    for name in names.keys() - kept.keys():
        (root / f"{name}.npy").unlink()
    for old, new in kept.items():
        (root / new).parent.mkdir(exist_ok=True)
        (root / f"{old}.npy").rename(root / f"{new}.npy")
    done = convert("folder", root, out)
    assert (done.code, done.err) == (0, "")
    for name in names.keys() - kept.values():
        assert f"{out}/{name}: removed: its scan is {names[name]} now\n" in done.out
    found = files_of(out)
    shutil.rmtree(out)
    assert convert("folder", root, out).code == 0
    assert files_of(out) == found


def test_scans_that_failed_leave_no_folder(tmp_path, out, convert):
    root = tmp_path / "in"
    save_rooms(root, "a.npy", "sub/b.npy")
    (root / "sub" / "b.npy").rename(root / "sub" / "b.ply")
    (root / "sub" / "b.ply").write_text("ply\nformat")
    assert convert("folder", root, out).code == 3
    assert sorted(path.name for path in out.iterdir() if path.is_dir()) == ["a"]


def test_copies_are_no_new_names(tmp_path, out, convert):
    root = tmp_path / "in"
    save_rooms(root, "a.npy")
    shutil.copy(root / "a.npy", root / "b.npy")
    assert convert("folder", root, out).code == 0
    # A copy of a result is of the user, as is a record of another place.
    shutil.copytree(out / "a", out / "a_backup")
    (root / "a.npy").unlink()
    assert f"{out}/a: no scan in {root} belongs" in convert("folder", root, out).error
    assert convert("folder", root, out, "--prune").code == 0
    assert sorted(path.name for path in out.iterdir() if path.is_dir()) == ["a_backup", "b"]
    assert len([*(out / "a_backup").iterdir()]) == 6


def test_another_layout_goes_to_another_directory(root, out, convert):
    assert convert("scannet", root, out, "--layout", "mask3d").code == 0
    before, message = files_of(out), "expected results in layout npy, got mask3d; choose another "
    for flags in ([], ["--force"], ["--prune"], ["--dry-run"]):
        done = convert("scannet", root, out, "--layout", "npy", *flags)
        assert (done.code, done.error.count("\n")) == (2, 1)
        assert f"{out}/train/{FIRST}: {message}" in done.error
    assert files_of(out) == before


def test_pages_leave_with_their_scan(tmp_path, out, convert, monkeypatch):
    pytest.importorskip("jinja2")
    root, pages = tmp_path / "in", tmp_path / "pages"

    def write_entry(folder, name, result):
        for suffix in PAGE_SUFFIXES:
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / f"{name}{suffix}").write_text(f"{len(result.cloud)} points")

    monkeypatch.setattr("torchrg.cli.convert.write_entry", write_entry)
    save_rooms(root, "a.npy", "b.npy", "sub/c.npy", "s.npy")
    assert convert("folder", root, out, "--pages", pages).code == 0
    # A conversion without pages forgets none.
    assert convert("folder", root, out, "--only", "b", "--force").code == 0
    (root / "b.npy").unlink()
    (root / "sub" / "c.npy").rename(root / "d.npy")
    (pages / "b.txt").write_text("mine")
    assert convert("folder", root, out, "--prune").code == 0

    def find_pages():
        return {path.relative_to(pages).as_posix() for path in pages.rglob("*")}

    left = {"index.html", "b.txt", "a.html", "a.png", "s.html", "s.png"}
    assert find_pages() == left
    index = (pages / "index.html").read_text()
    assert [name for name in "abcds" if f"{name}.html" in index] == ["a", "s"]
    # The index lists the pages of all scans, whichever command drew them.
    done = convert("folder", root, out, "--only", "d", "--pages", pages)
    assert done.code == 0
    assert find_pages() == left | {"d.html", "d.png"}
    index = (pages / "index.html").read_text()
    assert [name for name in "abcds" if f"{name}.html" in index] == ["a", "d", "s"]


def test_other_directories_are_left_alone_and_other_kinds_are_refused(tmp_path, root, out, convert):
    save_rooms(tmp_path / "in", "a.npy", "b.npy")
    assert convert("folder", tmp_path / "in", out).code == 0
    save_rooms(tmp_path / "more", "x.npy")
    assert convert("folder", tmp_path / "more", out / "more").code == 0
    error = convert("scannet", root, out).error
    assert f"{out}/a: expected results of convert scannet, got folder; choose another" in error
    (tmp_path / "in" / "b.npy").unlink()
    (out / "more" / "x" / RECORD).write_text("{")
    assert convert("folder", tmp_path / "in", out, "--prune").code == 0
    assert not (out / "b").exists()
    for name in ("a", "more/x"):
        assert (out / name / RECORD).is_file()


def test_a_folder_of_results_may_be_a_link(root, out, tmp_path, convert):
    (tmp_path / "disk").mkdir()
    out.mkdir()
    (out / "train").symlink_to(tmp_path / "disk")
    assert convert("scannet", root, out).code == 0
    assert len([*(tmp_path / "disk").iterdir()]) == 2
    move(root)
    assert convert("scannet", root, out).code == 0
    assert [path.name for path in (tmp_path / "disk").iterdir()] == [FIRST]
    shutil.move(out / "val" / LAST, tmp_path / "last")
    (out / "val" / LAST).symlink_to(tmp_path / "last")
    move(root, train=SCANS, val=[])
    assert (
        f"{out}/val/{LAST}: was changed or not written by torchrg"
        in convert("scannet", root, out).error
    )
    assert (tmp_path / "last" / RECORD).exists()


def test_a_scan_without_a_split_in_its_name_leaves_the_old_one_too(tmp_path, out, convert):
    scene = tmp_path / "in" / "hall"
    scene.mkdir(parents=True)
    np.save(scene / "coord.npy", ROOM.points.float().numpy())
    command, file = ("folder", tmp_path / "in", out, "--layout"), "hall_inst_nostuff.pth"
    for layout in ("spformer", "isbnet"):
        for label in ("segment20", "instance"):
            (scene / f"{label}.npy").unlink(missing_ok=True)
        assert convert(*command, layout).code == 0
        assert (out / "test" / file).exists()
        for label in ("segment20", "instance"):
            np.save(scene / f"{label}.npy", ROOM.labels.numpy().clip(0, 19))
        assert convert(*command, layout).code == 0
        assert ((out / "test" / file).exists(), (out / "train" / file).exists()) == (False, True)
        shutil.rmtree(out)


@pytest.mark.parametrize(
    "change",
    [
        {"inputs": 3},
        {"inputs": [3]},
        {"source": None},
        {"outputs": {"coord.npy": None}},
        {"outputs": {"coord.npy": {}, "../../../x": {}}},
        {"versions": {"torchrg": "9.9"}},
        "damaged",
    ],
)
def test_records_of_other_versions_end_in_no_loss(root, out, convert, change):
    assert convert("scannet", root, out).code == 0
    path = out / "train" / MOVED / RECORD
    is_whole = change != "damaged"
    path.write_text(json.dumps(json.loads(path.read_text()) | change) if is_whole else "{")
    before = results_of(out)
    move(root)
    done = convert("scannet", root, out)
    if "source" in change:  # The record of a single result.
        assert (done.code, path.exists()) == (0, True)
    elif "versions" in change:
        assert (done.code, done.err) == (0, "")
        assert not path.exists()
    elif not is_whole:
        assert f"{MOVED}/{RECORD}: expected JSON, got: " in done.error
        assert results_of(out) == before
    elif "inputs" in change:
        assert f"{path.parent}: no scan in {root} belongs" in done.error
    else:
        assert "npy: was changed or not written by torchrg" in done.error
        assert results_of(out) == before
