"""Pointcept's data pipeline after its documented rules, as far as a folder of scenes meets it.

A scene is a folder of .npy files, of which a whitelist is read; transforms that sample points
index the keys that ``index_valid_keys`` names; ``Collect`` picks keys and adds ``offset``; batches
are concatenated. Written from the description, for tests only.
"""

import numpy as np
import torch

WHITELIST = ("coord", "color", "normal", "strength", "segment", "instance", "pose")
INDEXED = ("coord", "color", "normal", "superpoint", "strength", "segment", "instance")


class Registry:
    """Classes by name, and objects from configs."""

    def __init__(self):
        self.classes = {}

    def register_module(self, *, module):
        self.classes[module.__name__] = module

    def build(self, config):
        settings = dict(config)
        return self.classes[settings.pop("type")](**settings)


class Scenes:
    """The default data set: every folder below ``root/split`` is a scene."""

    assets = WHITELIST

    def __init__(self, root, split, transforms=()):
        self.folders = sorted((root / split).glob("*"))
        self.transforms = transforms

    def __len__(self):
        return len(self.folders)

    def __getitem__(self, i):
        data = {}
        for file in self.folders[i].iterdir():
            if file.suffix == ".npy" and file.stem in self.assets:
                data[file.stem] = np.load(file)
        for key in ("coord", "color", "normal"):
            data[key] = data[key].astype(np.float32)
        for key in ("segment", "instance"):
            data[key] = data[key].reshape([-1]).astype(np.int32)
        data["name"] = self.folders[i].name
        for transform in self.transforms:
            data = transform(data)
        return data


class GridSample:
    """One point of each cell, taken from every key that may be indexed."""

    def __init__(self, grid_size):
        self.grid_size = grid_size

    def __call__(self, data):
        cells = np.floor(data["coord"] / self.grid_size).astype(np.int64)
        rows = np.unique(cells, axis=0, return_index=True)[1]
        data.setdefault("index_valid_keys", list(INDEXED))
        for key in data["index_valid_keys"]:
            if key in data:
                data[key] = data[key][rows]
        return data


class Collect:
    """Tensors of the keys asked for, ``feat`` and ``offset``."""

    def __init__(self, keys, feat_keys):
        self.keys, self.feat_keys = keys, feat_keys

    def __call__(self, data):
        out = {key: torch.from_numpy(data[key]) for key in self.keys}
        out["offset"] = torch.tensor([len(out["coord"])])
        out["feat"] = torch.cat([torch.from_numpy(data[key]) for key in self.feat_keys], dim=1)
        return out


def collate(samples):
    """Concatenate samples; offsets are cumulative."""
    batch = {key: torch.cat([sample[key] for sample in samples]) for key in samples[0]}
    return {**batch, "offset": batch["offset"].cumsum(0)}
