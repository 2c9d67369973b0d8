"""What the work on tiles has not made stays as it was, wherever it lies and whatever its name."""

import contextlib
import dataclasses
import os
import shutil
import stat
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from torchrg.batch.tiles import folder_of_work, segmented_in_tiles
from torchrg.config import load_config
from torchrg.errors import TorchrgError
from torchrg.io import stream_cloud, write_cloud
from torchrg.scenes import make_room

POINTS = make_room(num_points=900, noise=0.003, seed=1).points.numpy()
NAMES = (
    *("tiles.json", ".torchrg.lock", "points.npy", "coordinates.raw", "rows.npy", "cloud.npy"),
    *("boxes_low.npy", "neighbors.npy", "normals.npy", "edges_0.npy", "edges_2.npy", "edges.npy"),
    *("roots.npy", "labels.npy", "planes.pt", "result_labels.npy", "result_normals.npy"),
    *(".tiles.0123abcd.json", ".result.0123456789abcdef01234567.npz", ".result.0123abcd.npz"),
    *("model.pt", "sensor.raw", "notes.txt", "features.npy", "edges_9.npy", "result_color.npy"),
    *(".x.01234567.npy", ".coordinates.raw.swp", ".result.npz.tiles"),
)
THE_FOLDER = "the folder of the work itself"
KINDS = ("text", "empty", "read-only", "link", "link to a folder", "link to nothing", "folder")
THINGS = st.lists(
    st.tuples(
        st.sampled_from(["work", "work", "workdir", "beside"]),
        st.sampled_from([*NAMES, THE_FOLDER]),
        st.sampled_from(KINDS),
    ),
    min_size=2,
    max_size=8,
)


def config():
    """Settings of few neighbours, so that a cloud of few points has tiles."""
    given = load_config("classic")
    return dataclasses.replace(
        given,
        normals=dataclasses.replace(given.normals, k=8),
        growing=dataclasses.replace(given.growing, min_size=8),
    )


def segment(place, workdir, ends_at):
    """Segment a cloud in tiles, and end the run early at one of its steps."""
    source, target, left = place / "in" / "room.npy", place / "out" / "result.npz", [ends_at]

    def on_stage(stage, done, of):
        left[0] -= 1
        if left[0] == 0:
            raise KeyboardInterrupt

    folder = folder_of_work(target, workdir)
    stream, options = stream_cloud(source), {"tile_size": 250, "target": target}
    with segmented_in_tiles(
        [source], stream, folder, config(), on_stage=on_stage, **options
    ) as seg:
        write_cloud(target, stream, seg, provenance={})
    return target.read_bytes()


def put(path, kind, elsewhere):
    """Put something at a path where nothing is, as a user may."""
    if os.path.lexists(path):
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    if kind == "folder":
        path.mkdir()
        (path / "points.npy").write_text("in a folder")
    elif kind.startswith("link"):
        ends = {"link": "file.npy", "link to a folder": "folder", "link to nothing": "nothing"}
        path.symlink_to(elsewhere / ends[kind])
    else:
        path.write_text("" if kind == "empty" else f"a file of the user, {path.name}")
        path.chmod(0o444 if kind == "read-only" else 0o644)


def described(place):
    """Return what there is below a folder."""
    found = {}
    for path in sorted(place.rglob("*")):
        mode = path.lstat().st_mode
        content = path.read_bytes() if stat.S_ISREG(mode) else None
        found[path] = (mode, content, path.readlink() if path.is_symlink() else None)
    return found


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    """The result of an undisturbed run."""
    place = tmp_path_factory.mktemp("expected")
    make_input(place)
    return segment(place, None, 0)


def make_input(place):
    """Write the cloud, and what links lead to."""
    for name in ("in", "out", "elsewhere/folder"):
        (place / name).mkdir(parents=True)
    np.save(place / "in" / "room.npy", POINTS)
    (place / "elsewhere" / "file.npy").write_text("a file elsewhere")
    (place / "elsewhere" / "folder" / "points.npy").write_text("a file elsewhere")


@pytest.mark.parametrize("examples", [5, pytest.param(200, marks=pytest.mark.slow)])
def test_nothing_that_the_work_has_not_made_is_changed_or_removed(examples, expected):
    @settings(
        max_examples=examples,
        phases=[Phase.generate],
        deadline=None,
        database=None,
        derandomize=True,
        suppress_health_check=[HealthCheck.too_slow],
    )
    @given(things=THINGS, ends_at=st.integers(-2, 16), own=st.booleans())
    def check(things, ends_at, own):
        with tempfile.TemporaryDirectory() as folder:
            check_one(Path(folder), things, ends_at, own, expected)

    check()


def check_one(place, things, ends_at, own, expected):
    """Put things where the work is, before it or after a run that ended early, and go on."""
    make_input(place)
    workdir = place / "workdir" if own else None
    work = folder_of_work(place / "out" / "result.npz", workdir)
    places = {"workdir": place / "workdir", "work": work, "beside": place / "out"}
    if ends_at > 0:
        with contextlib.suppress(KeyboardInterrupt):
            segment(place, workdir, ends_at)
    ours = set(described(place)) - set(described(place / "elsewhere"))
    for where, name, kind in things:
        path = work if name == THE_FOLDER else places[where] / name
        # Only a process that was killed as it began leaves these two empty.
        is_begun = path.parent == work and path.name in ("tiles.json", ".torchrg.lock")
        if not any(part.is_symlink() for part in (work, *path.parents)):
            put(path, "text" if is_begun and kind == "empty" else kind, place / "elsewhere")
    theirs = {path: what for path, what in described(place).items() if path not in ours}
    while told := refusal(place, workdir, expected):
        assert "\n" not in told
        assert theirs.items() <= described(place).items()
        named = [path for path in theirs if str(path) in told]
        named = named or [path for path in theirs if path.parent == work and path.name in told]
        clear(max(named, key=lambda path: len(path.name)), theirs)
    theirs |= described(place / "elsewhere")
    found = described(place)
    assert theirs.items() <= found.items()
    left = {path for path in found.keys() - theirs.keys() if not path.is_dir()}
    assert left == {place / "in" / "room.npy", place / "out" / "result.npz"}
    assert work.exists() == any(path.is_relative_to(work) for path in theirs)


def refusal(place, workdir, expected):
    """Segment, and return what is said if something is in the way, None if not."""
    try:
        assert segment(place, workdir, 0) == expected
    except TorchrgError as error:
        return str(error)
    return None


def clear(path, theirs):
    """Move what is in the way out of it."""
    shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
    for gone in [other for other in theirs if other.is_relative_to(path)]:
        del theirs[gone]
