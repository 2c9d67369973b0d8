"""Train a network on normals and planes that the loader computes.

python scripts/examples/lightning_training.py scans/
"""

import sys

import lightning as L  # noqa: N812
import torch
from torch.nn import functional
from torch.utils.data import DataLoader

from torchrg.datasets import FolderOfClouds, collate_offset
from torchrg.transforms import SegmentPlanes


class PlaneOrNot(L.LightningModule):
    """Predict from coordinates and normals whether a point is in a plane."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = torch.nn.Linear(6, 2)

    def training_step(self, batch: dict[str, torch.Tensor], _index: int) -> torch.Tensor:
        """Return the loss of a ragged batch; ``offset`` holds the end of each cloud."""
        scores = self.layer(torch.cat([batch["coord"], batch["normal"]], dim=1).float())
        return functional.cross_entropy(scores, (batch["plane"] >= 0).long())

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Return the optimizer."""
        return torch.optim.Adam(self.parameters())


data = FolderOfClouds(sys.argv[1], transform=SegmentPlanes("classic"))
loader = DataLoader(data, batch_size=2, shuffle=True, collate_fn=collate_offset)
trainer = L.Trainer(max_epochs=2, accelerator="cpu", logger=False, enable_checkpointing=False)
trainer.fit(PlaneOrNot(), loader)
