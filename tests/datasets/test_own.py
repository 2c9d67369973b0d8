"""A data set of a user: one class that lists and reads is enough to train and to convert."""

import inspect

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from torchrg import Cloud, load_config, segment_planes
from torchrg.batch.local import run_local
from torchrg.batch.run import list_jobs
from torchrg.batch.sources import CloudSource
from torchrg.datasets import SceneDataset, SceneFiles, collate_offset
from torchrg.scenes import make_room
from torchrg.transforms import SegmentPlanes


class TextScans(SceneDataset):
    """Text with a class in the fourth column."""

    kind = "text-scans"

    def __init__(self, root, transform=None):
        self.root, self.transform = root, transform
        paths = sorted(root.glob("*.txt"))
        self.scenes = [SceneFiles(path.stem, path, (path,), "") for path in paths]

    def read_scene(self, scene):
        rows = np.loadtxt(scene.path, dtype=np.float32)
        return Cloud(rows[:, :3], {"segment": rows[:, 3].astype(np.int16)})


def test_the_class_has_at_most_15_lines():
    assert len(inspect.getsource(TextScans).splitlines()) <= 15


@pytest.fixture
def scans(tmp_path):
    """Two scans as text, their rows by name."""
    (tmp_path / "in").mkdir()
    tables = {}
    for seed, name in enumerate("ab"):
        room = make_room(1500 + 500 * seed, seed=seed)
        tables[name] = np.c_[room.points.numpy(), room.labels.numpy() % 5]
        np.savetxt(tmp_path / "in" / f"{name}.txt", tables[name])
    return tables


def test_a_loader_takes_it(tmp_path, scans):
    data = TextScans(tmp_path / "in", SegmentPlanes("classic"))
    (batch,) = DataLoader(data, batch_size=2, collate_fn=collate_offset, num_workers=1)
    assert batch["offset"].tolist() == [1500, 3500]
    assert batch["segment"].dtype == torch.int64
    assert np.array_equal(batch["segment"], np.concatenate([*scans.values()])[:, 3])
    planes = segment_planes(scans["a"][:, :3].astype(np.float32), "classic").labels
    assert torch.equal(batch["plane"][:1500], planes)


def test_worker_processes_convert_it(tmp_path, scans):
    source = CloudSource(TextScans(tmp_path / "in"), load_config("classic"))
    jobs = list_jobs(source, tmp_path / "out")
    reports = [*filter(None, run_local(jobs, workers=2, memory_limit=10**10))]
    assert sorted(r.name for r in reports if r.status == "converted") == ["a", "b"], reports
    for name, rows in scans.items():
        folder = tmp_path / "out" / name
        assert np.array_equal(np.load(folder / "segment.npy")[:, 0], rows[:, 3])
        assert len(np.load(folder / "plane.npy")) == len(rows)
