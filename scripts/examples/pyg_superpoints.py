"""Average point features over superpoints in a batch of PyG.

python scripts/examples/pyg_superpoints.py scans/
"""

import sys

import torch
from torch import nn
from torch_geometric.data import Data
from torch_geometric.loader import DataLoader
from torch_geometric.utils import scatter

from torchrg.datasets import FolderOfClouds
from torchrg.transforms import MakeSuperpoints, SegmentPlanes

# Transforms accept Data as well as dicts. PyG offsets entries with "index" in their names, so that
# the superpoints of two clouds stay distinct.
steps = nn.Sequential(SegmentPlanes(), MakeSuperpoints(keys={"superpoint": "superpoint_index"}))
clouds = FolderOfClouds(sys.argv[1])
rooms = [steps(Data(pos=torch.as_tensor(cloud["coord"]))) for cloud in clouds]
for batch in DataLoader(rooms, batch_size=2):
    features = torch.cat([batch.pos, batch.normal], dim=1)
    _, part = batch.superpoint_index.unique(return_inverse=True)
    pooled = scatter(features, part, reduce="mean")
    print(f"{len(features)} points -> {len(pooled)} superpoints, features {pooled[part].shape}")
