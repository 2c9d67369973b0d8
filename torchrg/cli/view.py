"""``torchrg view``: a picture of a cloud or of a result."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro
from torch import Tensor

from torchrg.cli.console import check_picture, parse
from torchrg.errors import ConfigError
from torchrg.io import read_cloud
from torchrg.render import (
    color_curvature,
    color_normals,
    color_planes,
    color_sharp,
    render_cloud,
    write_png,
)
from torchrg.structures import Cloud

ColorBy = Literal["plane", "superpoint", "normal", "curvature", "sharp", "color"]
FIELDS: dict[str, str] = {
    "plane": "labels",
    "color": "color",
    "normal": "normals",
    "curvature": "curvature",
    "sharp": "sharp",
    "superpoint": "superpoints",
}
"""What a cloud can be coloured by, the first that it has by default, and the field it needs."""
Axis = Literal["x", "y", "z", "-x", "-y", "-z"]


@dataclass(frozen=True)
class Arguments:
    """Draw a cloud, coloured by its planes if it has labels, and write a PNG file."""

    file: Annotated[Path, tyro.conf.Positional]
    """Cloud or result to read."""
    out: Path
    """Picture to write, a .png file."""
    color: ColorBy | None = None
    """What the colours show. Default: the planes, or the first thing that the file has."""
    view: Literal["cutaway", "above", "outside", "sensor"] = "cutaway"
    """From outside without ceiling and near walls, from above without ceiling, from outside with
    everything, or from the origin along z as a depth camera sees it."""
    up: Axis = "z"
    """Axis that points up."""
    azimuth_deg: float | None = None
    """Direction to look from, about the up axis. Default: the one that shows most."""
    width: int = 1600
    """Width in pixels."""


def run(argv: list[str]) -> int:
    """Parse the arguments, draw the cloud and write the picture."""
    arguments = parse(Arguments, argv, prog="torchrg view")
    check_picture(arguments.out)
    cloud = read_cloud(arguments.file)
    normals = cloud.fields.get("normals")
    picture = render_cloud(
        cloud.points,
        _colors(cloud, arguments.color),
        normals=None if normals is None else torch.from_numpy(normals).to(cloud.points.dtype),
        view=arguments.view,
        up=_direction(arguments.up),
        azimuth_deg=arguments.azimuth_deg,
        width=arguments.width,
    )
    write_png(arguments.out, picture)
    print(f"{arguments.file} -> {arguments.out} ({picture.shape[1]} x {picture.shape[0]} pixels)")
    return 0


def _colors(cloud: Cloud, color: ColorBy | None) -> Tensor:
    """Return the colour of each point.

    Raises:
        ConfigError: If the cloud lacks what the colours shall show.
    """
    present = [name for name, field in FIELDS.items() if field in cloud.fields]
    if color is None:
        color = present[0] if present else None  # type: ignore[assignment]
    elif color not in present:
        raise ConfigError(
            f"{cloud.source}: expected {FIELDS[color]} for --color {color}, got a file with "
            f"{', '.join(cloud.fields) or 'points alone'}."
        )
    if color is None:
        return torch.full((len(cloud), 3), 170, dtype=torch.uint8)
    values = torch.from_numpy(cloud.fields[FIELDS[color]])
    if color in ("plane", "superpoint"):
        return color_planes(values, cloud.points)
    if color == "normal":
        return color_normals(values)
    if color == "curvature":
        return color_curvature(values)
    return color_sharp(values) if color == "sharp" else values[:, :3]


def _direction(axis: Axis) -> tuple[float, float, float]:
    """Return an axis as a vector."""
    sign = -1.0 if axis.startswith("-") else 1.0
    x, y, z = (sign * (letter == axis[-1]) for letter in "xyz")
    return x, y, z
