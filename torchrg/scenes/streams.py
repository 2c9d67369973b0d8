"""Random numbers that belong to a seed."""

import numpy as np

from torchrg.errors import ConfigError


def random_stream(seed: int, number: int) -> np.random.Generator:
    """Return one of several independent random generators that belong to a seed."""
    if seed < 0:
        raise ConfigError(f"torchrg.scenes: expected seed >= 0, got {seed}.")
    return np.random.Generator(np.random.PCG64([seed, number]))
