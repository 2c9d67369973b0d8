"""Recipes for other programs: a shell runs their lines on small releases, programs read the files.

``git``, ``python`` and ``sh`` are stand-ins that do nothing. With ``TORCHRG_CLIENTS``, a folder in
which ``git clone --bare`` has put the programs' repositories, ``python`` and ``sh`` make the first
batch by the programs' loaders and settings. What these need besides, as ``first_batch.py`` says, is
installed or on ``PYTHONPATH``.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import guide_pages
import numpy as np
import pytest

from tests.datasets.s3dis_tree import digest, text_of, write_objects
from tests.datasets.scannet_tree import WORDS, write_scan, write_scan_plus, write_tables
from torchrg.io import write_cloud
from torchrg.scenes import make_room
from torchrg.structures import Cloud

RECIPES = guide_pages.GUIDES / "clients.md"
FIRST_BATCH = Path(__file__).with_name("first_batch.py")
SCANS = {"train": "scene0000_00", "val": "scene0011_00", "test": "scene0707_00"}
"""Scans by the splits that they are of in the lists of the programs."""
LISTS = {
    "SPFormer": "data/scannetv2",
    "ISBNet": "dataset/scannetv2",
    "oneformer3d": "data/scannet/meta_data",
    "unidet3d": "data/scannet/meta_data",
}
"""Where programs bring their lists of ScanNet, cut here to the scans that are there."""
OPENED = {
    "Pointcept": ["Pointcept/data/s3dis/Area_5/office_1/plane.npy"],
    "SGIFormer": ["Pointcept/data/scannetpp/train/0a5c013435/superpoint.npy"],
    "SPFormer": ["SPFormer/data/scannetv2/train/scene0000_00_inst_nostuff.pth"],
    "Your own scans in SPFormer": ["SPFormer/data/scannetv2/test/hall_inst_nostuff.pth"],
    "ISBNet": [
        "ISBNet/dataset/scannetv2/superpoints/scene0000_00.pth",
        "ISBNet/dataset/s3dis/preprocess/Area_5_office_1_inst_nostuff.pth",
    ],
    "OneFormer3D and UniDet3D": ["oneformer3d/data/scannet/super_points/scene0000_00.bin"],
    "UniDet3D": ["unidet3d/data/scannet/super_points/scene0000_00.bin"],
    "OneFormer3D with S3DIS": ["oneformer3d/data/s3dis/points/Area_5_office_1.bin"],
    "Mask3D": [
        "Mask3D/data/processed/scannet/validation_database.yaml",
        "Mask3D/data/processed/s3dis/Area_5_database.yaml",
    ],
    "SAI3D": ["SAI3D/data/ScanNet/scans/scene0011_00/scene0011_00_vh_clean_2.0.010000.segs.json"],
    "Superpoint Transformer": ["superpoint_transformer/data/planes/nag/Area_5_office_1.h5"],
    "SpatialLM": ["upright.ply"],
}
"""Some of the files that programs open, by the title of the recipe."""
PROCESSED = {
    "s3dis": "Area_1/office_1",
    "scannet": "train/scene0000_00",
    "structured3d": "train/scene_00000/room_0",
    "arkitscenes": "Training/40753679",
    "hm3d": "train/00006_HkseAnWCgqk_000_000",
    "matterport3d": "train/17DRP5sb8fy_00",
}
"""A scene of each data set as Pointcept processes it."""


def recipes():
    """Commands by the title of the recipe."""
    parts = re.split(r"^## (.+)$", RECIPES.read_text(encoding="utf-8"), flags=re.MULTILINE)
    blocks = {
        title: re.findall(r"^```console\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
        for title, text in zip(parts[1::2], parts[2::2], strict=True)
    }
    found = {title: "".join(lines) for title, lines in blocks.items() if lines}
    lines = found["OneFormer3D and UniDet3D"].replace("oneformer3d_1xb4", "unidet3d_1xb8")
    return found | {"UniDet3D": lines.replace("oneformer3d", "unidet3d")}


def write_processed(folder, name, room):
    """A scene with the types that the preprocessing of Pointcept gives each data set."""
    count = len(room.points)
    floats = np.float64 if name == "arkitscenes" else np.float32
    arrays = {
        "coord": room.points.numpy().astype(floats),
        "color": np.full((count, 3), 128, np.uint8).astype(
            floats if name == "arkitscenes" else np.uint8
        ),
        "normal": room.normals.numpy().astype(floats),
    }
    if name != "arkitscenes":
        labels = room.labels.numpy()
        short, column = labels.astype(np.int16), labels.astype(np.int16)[:, None]
        arrays |= {
            "s3dis": {"segment": column, "instance": column},
            "scannet": {"segment20": labels, "segment200": labels, "instance": labels},
            "structured3d": {"segment": column},
            "hm3d": {"segment": short, "instance": short},
            "matterport3d": {"segment": short},
        }[name]
    folder.mkdir(parents=True)
    for key, values in arrays.items():
        np.save(folder / f"{key}.npy", values)


@pytest.fixture(scope="module")
def releases(tmp_path_factory):
    """Small releases of ScanNet, ScanNet++ and S3DIS, and a scan."""
    root = tmp_path_factory.mktemp("releases")
    room = make_room(24_000, noise=0.003, seed=1)
    coord, faces = room.points.float().numpy(), room.labels.numpy()
    color = np.random.default_rng(0).integers(0, 256, coord.shape).astype(np.uint8)
    words = [*WORDS]
    objects = [(words[i % len(words)], [face]) for i, face in enumerate(np.unique(faces))]
    for split, name in SCANS.items():
        place = "scans_test" if split == "test" else "scans"
        truth = None if split == "test" else objects
        write_scan(root / "scannet" / place, name, coord, color, faces, truth)
    write_tables(root / "scannet", [SCANS["train"]], [SCANS["val"]])
    write_scan_plus(root / "scannetpp", "0a5c013435", coord, color, faces, objects)
    for area in range(1, 7):
        write_objects(
            root / "Stanford3dDataset_v1.2" / f"Area_{area}" / "office_1",
            {
                f"{word}_1.txt": text_of(np.hstack([coord, color])[faces % 4 == number])
                for number, word in enumerate(("wall", "floor", "table", "clutter"))
            },
        )
    for path in (root / "scan.ply", root / "scans" / "hall.ply"):
        path.parent.mkdir(exist_ok=True)
        write_cloud(path, Cloud(coord, {"color": color}))
    return root


@pytest.fixture
def workplace(releases, tmp_path):
    """A folder with the releases and stand-ins, and what a shell has to know there."""
    for path in releases.iterdir():
        (tmp_path / path.name).symlink_to(path)
    stand_ins = tmp_path / "bin"
    stand_ins.mkdir()
    for name in ("git", "python", "python3", "sh"):
        path = stand_ins / name
        path.write_text('#!/bin/bash\n[ ! "$FIRST_BATCH" ] || exec "$REAL" "$FIRST_BATCH" "$@"\n')
        path.chmod(0o755)
    (stand_ins / "git").write_text("#!/bin/bash\n")
    places = [stand_ins, Path(sys.executable).parent, os.environ["PATH"]]
    return tmp_path, os.environ | {"PATH": ":".join(map(str, places)), "REAL": sys.executable}


@pytest.fixture
def programs(workplace):
    """The same with checkouts of the programs; the test is skipped where they are absent."""
    folder, environment = workplace
    if "TORCHRG_CLIENTS" not in os.environ:
        pytest.skip("needs TORCHRG_CLIENTS, a folder of `git clone --bare` of each program")
    return folder, environment | {"FIRST_BATCH": str(FIRST_BATCH)}


def clone(name, folder):
    """Check a program out of its repository, and what has to be installed for it."""
    for needed in (name, "mmdetection3d") if name in ("oneformer3d", "unidet3d") else (name,):
        if not (folder / needed).exists():
            repository = Path(os.environ["TORCHRG_CLIENTS"], f"{needed}.git").absolute()
            subprocess.run(["git", "clone", "-q", repository], cwd=folder, check=True)


def check_out(title, folder, environment):
    """Put checkouts where ``git clone`` puts them; without the programs, folders with lists."""
    for name in re.findall(r"git clone \S+/(\S+)", recipes()[title]):
        checkout = folder / name
        if "FIRST_BATCH" in environment:
            clone(name, folder)
        for part in ("data", "pointcept/datasets"):
            (checkout / part).mkdir(parents=True, exist_ok=True)
        if name in LISTS:
            lists = checkout / LISTS[name]
            lists.mkdir(parents=True, exist_ok=True)
            for split, name in SCANS.items():
                (lists / f"scannetv2_{split}.txt").write_text(f"{name}\n")


def follow(title, folder, environment):
    """Run the lines of a recipe; return what they print."""
    if "--layout nag" in recipes()[title]:
        pytest.importorskip("h5py", reason="needs the extra nag")
    check_out(title, folder, environment)
    done = subprocess.run(
        ["bash", "-euc", recipes()[title]],
        cwd=folder, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Traceback" not in done.stderr, done.stderr
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("title", OPENED)
def test_the_lines_of_a_recipe_write_what_its_program_opens(title, workplace):
    folder, _ = workplace
    follow(title, *workplace)
    assert all((folder / path).is_file() for path in OPENED[title])


@pytest.mark.slow
@pytest.mark.parametrize("title", sorted(OPENED.keys() - {"Your own scans in SPFormer"}))
def test_the_program_makes_its_first_batch(title, programs):
    printed = follow(title, *programs)
    lines = re.findall(r"^(?:python3?|sh) ", recipes()[title], re.MULTILINE)
    assert len(re.findall(r"^ok ", printed, re.MULTILINE)) >= len(lines) > 0, printed


TITLE = "Pointcept's compressed releases"


def complete(folder, environment):
    """Follow the recipe for processed data; return the folders of its data sets."""
    places = {name: folder / "Pointcept" / "data" / name for name in PROCESSED}
    for seed, (name, scene) in enumerate(PROCESSED.items()):
        write_processed(places[name] / scene, name, make_room(3000, noise=0.003, seed=seed))
    before = {name: digest(place) for name, place in places.items()}
    follow(TITLE, folder, environment)
    new = ("curvature.npy", "plane.npy", "superpoint.npy", "planes.json", "provenance.json")
    held = {path: path.read_bytes() for place in places.values() for path in place.rglob("*.npy")}
    for place in places.values():
        for path in [*place.rglob("*")]:
            if path.is_file() and (path.name in new or path.parent == place):
                path.unlink()
    assert {name: digest(place) for name, place in places.items()} == before
    for path, content in held.items():
        path.write_bytes(content)
    return places


@pytest.mark.slow
def test_processed_scenes_are_completed_and_stay_as_they_are(workplace):
    for name, place in complete(*workplace).items():
        scene = place / PROCESSED[name]
        count = len(np.load(scene / "coord.npy"))
        superpoint = np.load(scene / "superpoint.npy")
        assert (superpoint.dtype, superpoint.shape) == (np.int32, (count,))
        assert np.load(scene / "plane.npy").max() > 3


@pytest.mark.slow
def test_pointcept_loads_completed_scenes(programs):
    folder, environment = programs
    clone("Pointcept", folder)
    complete(folder, environment)
    line = "import torchrg.transforms.pointcept\n"
    with (folder / "Pointcept/pointcept/datasets/__init__.py").open("a") as stream:
        stream.write(line)
    for name, scene in PROCESSED.items():
        done = subprocess.run(
            [sys.executable, FIRST_BATCH, "pointcept", name, scene.partition("/")[0]],
            cwd=folder / "Pointcept", capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert re.search("^ok ", done.stdout, re.MULTILINE), done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sonata", "Concerto"])
def test_encoders_take_a_converted_scene(name, programs):
    folder, environment = programs
    clone(name, folder)
    scans = folder / "clouds"
    scans.mkdir()
    (scans / "room1.ply").symlink_to(folder / "scan.ply")
    subprocess.run(
        ["torchrg", "convert", "folder", "clouds", "scenes"],
        cwd=folder, env=environment, check=True, capture_output=True,
    )  # fmt: skip
    done = subprocess.run(
        [sys.executable, FIRST_BATCH, "sonata", folder / "scenes" / "room1"],
        cwd=folder / name, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert re.search("^ok ", done.stdout, re.MULTILINE), done.stdout + done.stderr
