"""Fuse the depth frames of a phone into one cloud, and segment it.

python scripts/examples/phone_capture.py capture/ room.ply

The capture is an export of Stray Scanner, Polycam, Record3D or RTAB-Map, a folder with
transforms.json, or a video of ARKitScenes. For all frames: torchrg convert rgbd --fuse 0.02.
"""

import sys

import torchrg
from torchrg.datasets import RGBDFrames
from torchrg.transforms import fuse_depth

source, target = sys.argv[1:]
frames = RGBDFrames.from_folder(source)
step = max(len(frames) // 100, 1)  # About 100 frames are enough for a room.
samples = [frames[index] for index in range(0, len(frames), step)]
samples = [sample for sample in samples if "pose" in sample]
fused = fuse_depth(samples, voxel_size=0.02)
fields = {} if fused.color is None else {"color": fused.color.numpy()}
cloud = torchrg.Cloud(fused.coord, fields)

seg = torchrg.segment_planes(cloud)
torchrg.write_cloud(target, cloud, seg)
print(f"{len(fused.coord)} points of {len(samples)} frames, {len(seg.planes)} planes -> {target}")

# Plane IDs also return to the pixels of every frame.
for sample, labels in zip(samples, fused.to_frames(seg.labels), strict=True):
    print(sample["name"], f"{(labels >= 0).float().mean():.0%} of the pixels are in planes")
