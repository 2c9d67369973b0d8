"""Workers of a DataLoader give what the main process gives, on one thread each, and never hang."""

import os

import pytest
import torch
from torch import nn
from torch.utils.data import DataLoader

from tests.datasets.s3dis_tree import text_of, write_objects
from torchrg.datasets import S3DIS, collate_offset
from torchrg.scenes import make_room
from torchrg.transforms import CenterCloud, SampleVoxels, SegmentPlanes

SECONDS_UNTIL_HUNG = 300
KEYS = ("coord", "color", "segment", "instance", "plane", "normal", "curvature", "inverse")


class NoteProcess(nn.Module):
    """Run a transform, and note its process and how many threads torch may use there."""

    def __init__(self, transform):
        super().__init__()
        self.transform = transform

    def forward(self, sample):
        sample = self.transform(sample)
        return {**sample, "process": torch.tensor([[os.getpid(), torch.get_num_threads()]])}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("S3DIS")
    for i in range(3):
        points = make_room(1500, 0.003, i).points.numpy()
        rows = [(*point, 1, 2, 3) for point in points]
        write_objects(root / "Area_1" / f"office_{i}", {"wall_1.txt": text_of(rows)})
    return root


# The parent has threads on purpose: that is what a fork must survive.
@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:.*rooms, got:UserWarning")
def test_workers_give_what_the_main_process_gives(set_threads, root):
    set_threads(2)
    pytest.importorskip("pyarrow", reason="needs torchrg[text]")
    steps = NoteProcess(nn.Sequential(SampleVoxels(0.2), CenterCloud(), SegmentPlanes("paper")))
    plain = S3DIS(root, [1], transform=steps)
    expected = [plain[i] for i in range(3)]
    assert {int(sample["process"][0, 1]) for sample in expected} == {2}
    batches = DataLoader(
        S3DIS(root, [1], transform=steps),
        num_workers=2,
        multiprocessing_context="fork",
        persistent_workers=True,
        timeout=SECONDS_UNTIL_HUNG,
        collate_fn=collate_offset,
    )
    for _ in range(2):
        notes = []
        for sample, batch in zip(expected, batches, strict=True):
            assert batch["name"] == [sample["name"]]
            assert all(torch.equal(batch[key], sample[key]) for key in KEYS)
            notes.append(batch["process"][0].tolist())
        processes, threads = zip(*notes, strict=True)
        assert len(set(processes)) == 2
        assert os.getpid() not in processes
        assert set(threads) == {1}
