"""Every scan has a place of its own for its results, or the command ends before it begins."""

import unicodedata

import numpy as np
import pytest

from torchrg.batch.run import list_jobs
from torchrg.batch.scans import convert_scan
from torchrg.batch.sources import CloudSource, RGBDSource
from torchrg.config import load_config
from torchrg.datasets import FolderOfClouds, RGBDFrames
from torchrg.depth import DepthConfig
from torchrg.errors import ConfigError, FormatError
from torchrg.scenes import make_room

CLASSIC = load_config("classic")
UMLAUT = "Büro"


@pytest.fixture
def root(tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    return folder


def save(folder, *names, num_points=500):
    """Write a small room under each name, whatever its suffix says."""
    points = make_room(num_points=num_points, seed=1).points.numpy()
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        with (folder / name).open("wb") as stream:
            np.save(stream, points)


@pytest.fixture
def convert(run, root, tmp_path):
    """``convert(...)``: the command over the root."""
    command = ("convert", "folder", root, tmp_path / "out", "--preset", "classic", "--workers", "1")
    return lambda *flags: run(*command, *flags)


@pytest.fixture
def refused(convert, tmp_path):
    """``refused(...)``: the one line of a command that is refused before any work."""

    def call(*flags):
        done = convert(*flags)
        assert (done.code, done.out) == (2, "")
        assert not (tmp_path / "out").exists()
        return done.error

    return call


def test_scans_that_differ_in_the_suffix_alone_are_refused(root, convert, refused):
    save(root, "x.ply", "x.pcd", "x.ply.npz", "y.npy")
    for flags in ([], ["--dry-run"], ["--only", "y"]):
        assert "expected one file per scan, got x.pcd and x.ply; " in refused(*flags)
    shown = convert("--suffixes", ".npy", ".npz", "--dry-run").out
    assert "2 scans to convert" in shown


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["Hall.npy", "hall.npy"], "got Hall and hall, which are the same on many"),
        (["a/b.npy", "A/B.npy"], "expected distinct scan names, got"),
        (
            [f"{unicodedata.normalize(form, UMLAUT)}.npy" for form in ("NFC", "NFD")],
            "expected distinct scan names, got",
        ),
        (["straße.npy", "STRASSE.npy"], "expected distinct scan names, got"),
        (
            ["report.json.npy"],
            "a scan cannot be named report.json, like OUT/report.json",
        ),
        (
            ["Report.JSON/x.npy"],
            "a scan cannot be named Report.JSON/x, like OUT/report.json",
        ),
    ],
)
def test_names_that_lead_to_one_place_are_refused(root, refused, names, message):
    save(root, *names)
    if len({path.name for path in root.rglob("*.npy")}) < len(names):
        pytest.skip("this file system takes them for the same")
    assert message in refused()


FLAT = ("mmdet3d", "spformer", "isbnet", "mask3d", "npy")
"""Layouts in which files of all scans are in the same folders."""


@pytest.mark.parametrize(
    "names",
    [("a/b_c", "a_b/c"), ("train/x", "val/x"), ("a/B_c", "A_b/c"), ("bü/ro", "bu\u0308_ro")],
)
def test_files_of_two_scans_in_one_folder_are_refused(root, tmp_path, names):
    save(root, *(f"{name}.npy" for name in names))
    for layout in FLAT:
        with pytest.raises(FormatError, match="both use") as error:
            list_jobs(CloudSource(FolderOfClouds(root), CLASSIC, layout=layout), tmp_path / "out")
        assert all(name in str(error.value) for name in (*names, layout))
    for layout in ("pointcept", "scannet"):
        source = CloudSource(FolderOfClouds(root), CLASSIC, layout=layout)
        assert len(list_jobs(source, tmp_path / "out")) == 2


def test_the_command_refuses_them_before_any_work(root, refused):
    save(root, "a/b_c.npy", "a_b/c.npy", "other.npy")
    for flags in (["--dry-run"], ["--only", "other"], []):
        error = refused("--layout", "npy", *flags)
        assert "layout npy: a/b_c and a_b/c both use a_b_c; rename one" in error


def test_short_names_of_mask3d_are_compared_too(root, convert, refused):
    save(root, "scene0011_00.npy", "0011_00.npy")
    error = refused("--layout", "mask3d")
    assert "layout mask3d: 0011_00 and scene0011_00 both use 0011_00" in error
    assert convert("--layout", "npy", "--dry-run").code == 0


def test_a_scan_of_another_command_with_the_same_files_is_refused(root, tmp_path):
    save(root, "a/b_c.npy")
    save(tmp_path / "second", "a_b/c.npy")
    reports, before = [], None
    for folder in (root, tmp_path / "second"):
        source = CloudSource(FolderOfClouds(folder), CLASSIC, layout="npy")
        (job,) = list_jobs(source, tmp_path / "out")
        before = {path: path.read_bytes() for path in (tmp_path / "out").rglob("*.npy")}
        reports.append(convert_scan(job))
    assert [report.status for report in reports] == ["converted", "failed"]
    assert "a_b_c.npy: was not written by torchrg for this scan" in reports[1].reason
    assert len(before) == 2
    assert {path: path.read_bytes() for path in (tmp_path / "out").rglob("*.npy")} == before


@pytest.mark.parametrize("name", ["../x", "/x", "a/../../x"])
def test_no_name_leads_out_of_the_directory(faults, tmp_path, name):
    (job,) = faults.make_jobs(tmp_path, {"1_a": "plain"})
    scan = job.scan._replace(name=name)
    source = job.source.__class__(job.source.data)
    object.__setattr__(source, "list_scans", lambda out: [scan])
    with pytest.raises(FormatError, match="expected a name inside OUT, got"):
        list_jobs(source, tmp_path / "out")


@pytest.mark.filterwarnings("ignore:.*using the built-in camera")
def test_a_recording_is_found_once_and_links_are_told(root, tmp_path):
    for name in ("seq-01", "seq-02"):
        (root / name).mkdir()
        (root / name / "frame-000000.depth.png").touch()
    (root / "loop").symlink_to("seq-01")
    (root / "seq-01" / "self").symlink_to(".")
    with pytest.warns(UserWarning, match=f"{root}: skipped loop and 1 more: links to"):
        data = RGBDFrames.from_folder(root, "7-scenes")
    jobs = list_jobs(RGBDSource(data, DepthConfig()), tmp_path / "out")
    assert [job.scan.name for job in jobs] == ["seq-01/frame-000000", "seq-02/frame-000000"]
    with pytest.warns(UserWarning, match="skipped self: links to files"):
        data = RGBDFrames.from_folder(root / "seq-01", "7-scenes")
    jobs = list_jobs(RGBDSource(data, DepthConfig()), tmp_path / "out")
    assert [job.scan.name for job in jobs] == ["seq-01/frame-000000"]


def test_results_are_never_read_as_scans_through_a_link_or_from_above(root, tmp_path):
    save(root, "hall.npy")
    (tmp_path / "out" / "hall").mkdir(parents=True)
    save(tmp_path / "out", "hall/coord.npy")
    (root / "results").symlink_to(tmp_path / "out")
    with pytest.raises(ConfigError, match="so that no result is read as a scan"):
        list_jobs(CloudSource(FolderOfClouds(root), CLASSIC), tmp_path / "out")
    (root / "results").unlink()
    save(root, "in/hall.npy")
    assert len(list_jobs(CloudSource(FolderOfClouds(root), CLASSIC), tmp_path / "out")) == 2
    # The scan in/in/hall.npy would get the folder in/hall below the directory above.
    with pytest.raises(ConfigError, match="so that no result is read as a scan"):
        list_jobs(CloudSource(FolderOfClouds(root), CLASSIC), tmp_path)
