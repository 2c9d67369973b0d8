"""The version of torchrg, for whoever must know it without loading anything else."""

__version__ = "0.1.0"
