"""``torchrg settings``: all settings with their defaults."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from torchrg.cli import flags
from torchrg.cli.arguments import Argument, Flag, format_flag, list_flags, parse
from torchrg.config import DepthConfig, PipelineConfig, SuperpointsConfig

Section = Literal["selection", "normals", "growing", "planes", "partition", "depth"]


@dataclass(frozen=True)
class Arguments(flags.PlaneSettings):
    """List all settings with their defaults.

    A setting is --growing.min-size 50 for a command, growing.min_size: 50 in a --config file, and
    segment_planes(points, {"growing.min_size": 50}) in Python. Values are numbers, words, true,
    false or none; commas separate several. Names of the section selection have no section. torchrg
    depth and torchrg convert rgbd have the section depth, --superpoints has partition, and other
    commands have the remaining sections.

    Examples:
        torchrg settings growing
        torchrg settings normals --preset paper
    """

    section: Annotated[Section | None, Argument("SECTION", is_positional=True)] = None
    """Section to list. Default: all sections."""


def flags_by_section(settings: PipelineConfig) -> dict[str, list[Flag]]:
    """Return the settings of each section, with ``settings`` as their defaults."""
    sections: dict[str, Any] = {
        **{name: getattr(settings, name) for name in ("normals", "growing", "planes")},
        "partition": SuperpointsConfig(),
        "depth": DepthConfig(),
    }
    members = {name: [*list_flags(type(v), v, section=name)] for name, v in sections.items()}
    whole = [flag for flag in list_flags(PipelineConfig, settings) if "." not in flag.path]
    return {"selection": whole, **members}


def run(argv: list[str]) -> int:
    """Parse the arguments and print the settings."""
    arguments = parse(Arguments, argv, prog="torchrg settings")
    for name, members in flags_by_section(arguments.settings).items():
        if arguments.section in (None, name):
            print("\n".join([f"{name}:", *map(format_flag, members), ""]))
    return 0
