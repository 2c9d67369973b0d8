"""Add normals and planes to a data set of Hugging Face, and store it.

python scripts/examples/hugging_face_dataset.py scans/ planes/
"""

import sys

import datasets

import torchrg
from torchrg.datasets import FolderOfClouds

source, target = sys.argv[1:]
clouds = FolderOfClouds(source)
names = [scene.name for scene in clouds.scenes]
coordinates = [cloud["coord"] for cloud in clouds]
rooms = datasets.Dataset.from_dict({"name": names, "coord": coordinates}).with_format("torch")


def add_planes(room: dict) -> dict:
    """Return the new columns of a room."""
    seg = torchrg.segment_planes(room["coord"])
    return {"normal": seg.normals, "plane": seg.labels}


rooms = rooms.map(add_planes)
rooms.save_to_disk(target)
for room in datasets.load_from_disk(target).with_format("torch"):
    print(room["name"], tuple(room["normal"].shape), int(room["plane"].max()) + 1, "planes")
