"""Settings of growth without what the preset consensus adds, for tests of one step."""

import dataclasses

from torchrg.config import load_config


def papers_growing(**changes):
    """Return the growth of the preset paper, with some settings changed."""
    return dataclasses.replace(load_config("paper").growing, **changes)
