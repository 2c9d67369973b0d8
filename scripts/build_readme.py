"""Makes the README that the package carries: its relative links lead to the tag of the version."""

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

_LINK = re.compile(r"(!?)\[([^\]]*)\]\((?![a-z]+:|#)([^)]+)\)")
"""Links and images with a path of the repository."""


def absolute(text: str, repository: str, tag: str) -> str:
    """Return Markdown whose relative links and images have addresses.

    Example:
        >>> absolute("![a](b.png) [c](d.md#e) [f](#g)", "https://h/r", "v1")
        '![a](https://h/r/raw/v1/b.png) [c](https://h/r/blob/v1/d.md#e) [f](#g)'
    """
    return _LINK.sub(
        lambda found: (
            f"{found[1]}[{found[2]}]({repository}/{'raw' if found[1] else 'blob'}/{tag}/{found[3]})"
        ),
        text,
    )


class ReadmeHook(MetadataHookInterface):
    """Adds the README to the metadata."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set the entry ``readme``."""
        text = Path(self.root, "README.md").read_text(encoding="utf-8")
        text = absolute(text, metadata["urls"]["Homepage"], f"v{metadata['version']}")
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
