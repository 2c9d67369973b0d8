"""``torchrg settings``: all settings with their defaults."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from torchrg.cli import flags
from torchrg.cli.arguments import Argument, Flag, format_flag, list_flags, parse
from torchrg.config import DepthConfig, PipelineConfig, SuperpointsConfig, load_config

Section = Literal["normals", "growing", "planes", "partition", "depth"]


@dataclass(frozen=True)
class Arguments(flags.PlaneSettings):
    """List all settings with their defaults.

    A setting is --growing.min-size 50 for a command, growing.min_size: 50 in a --config file, and
    segment_planes(points, {"growing.min_size": 50}) in Python. Values are numbers, words, true,
    false or none; commas separate several. torchrg depth and torchrg convert rgbd have the section
    depth, --superpoints has partition, and other commands have the remaining sections.

    Examples:
        torchrg settings growing
        torchrg settings normals --preset paper
    """

    section: Annotated[Section | None, Argument("SECTION", is_positional=True)] = None
    """Section to list. Default: all sections."""


def flags_by_section(settings: PipelineConfig | None = None) -> dict[str, list[Flag]]:
    """Return the settings of each section, with ``settings`` as their defaults."""
    settings = settings or load_config()
    sections: dict[str, Any] = {
        **{name: getattr(settings, name) for name in ("normals", "growing", "planes")},
        "partition": SuperpointsConfig(),
        "depth": DepthConfig(),
    }
    return {
        name: [*list_flags(type(values), values, section=name)] for name, values in sections.items()
    }


def run(argv: list[str]) -> int:
    """Parse the arguments and print the settings."""
    arguments = parse(Arguments, argv, prog="torchrg settings")
    for name, members in flags_by_section(arguments.settings).items():
        if arguments.section in (None, name):
            print("\n".join([f"{name}:", *map(format_flag, members), ""]))
    return 0
