"""What workers of a DataLoader need to import by name."""

import os

import torch
from torch import nn


class NoteProcess(nn.Module):
    """Run a transform, and note its process and how many threads torch may use there."""

    def __init__(self, transform):
        super().__init__()
        self.transform = transform

    def forward(self, sample):
        sample = self.transform(sample)
        return {**sample, "process": torch.tensor([[os.getpid(), torch.get_num_threads()]])}
