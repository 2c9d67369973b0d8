"""``torchrg view``: a picture or a page of a cloud or of a result."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, get_args

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from torchrg.cli.arguments import Argument, parse
from torchrg.cli.ending import say, warn
from torchrg.cli.flags import ColumnsFlag, check_columns, columns_of
from torchrg.cli.loop import check_beside, is_page
from torchrg.errors import ConfigError
from torchrg.io.colors import narrow_colors
from torchrg.render import (
    color_curvature,
    color_normals,
    color_planes,
    color_sharp,
    make_page,
    render_cloud,
    write_page,
    write_png,
)
from torchrg.render.channels import MODES
from torchrg.render.page import MAX_POINTS
from torchrg.result import Result, read_result
from torchrg.structures import Cloud

ColorBy = Literal["plane", "superpoint", "color", "normal", "curvature", "sharp"]
PageColorBy = Literal[ColorBy, "error", "normal-error"]
Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
Direction = tuple[float, float, float]


@dataclass(frozen=True)
class Arguments:
    """Draw a cloud, coloured by its planes if it has labels.

    A picture is a PNG file. A page for the browser lets one turn the cloud, point at planes, and
    compare two results.

    Examples:
        torchrg view planes.npz --out planes.png
        torchrg view planes.npz --out planes.html
        torchrg view room.npz --beside planes.npz --out truth_and_result.png
        torchrg view planes.npz --out compared.html --beside other.npz --truth room.npz
        torchrg view scan.ply --out normals.png --color normal --view above
    """

    file: Annotated[Path, Argument("FILE", is_positional=True)]
    """Cloud or result to read."""
    out: Path
    """Picture (.png) or page (.html; pip install 'torchrg[view]') to write. A page is one file that
    opens without a network."""
    color: PageColorBy | None = None
    """Meaning of the colours, at first on a page, where they can be switched. Default: the planes,
    or the first thing that the file has. Errors need --truth, and a page."""
    view: Literal["cutaway", "above", "outside", "sensor"] = "cutaway"
    """Where the picture is taken from: from outside without ceiling and near walls (cutaway), from
    above without ceiling (above), from outside with everything (outside), or from the origin along
    z as a depth camera sees it (sensor)."""
    up: Axis | None = None
    """Axis that points up. Default: z; -y with --view sensor."""
    azimuth_deg: float | None = None
    """Angle about the up axis from which to look, in degrees. Default: the one that shows most."""
    width: int = 1600
    """Width in pixels of a picture, both halves together."""
    beside: Path | None = None
    """Another cloud or result, for the right half; on a page both are turned together."""
    truth: Path | None = None
    """Cloud of the same points with true labels or normals, to show errors on a page."""
    max_points: int = MAX_POINTS
    """Most points that a page shows. Of a larger cloud it shows a random sample, and says so."""
    unit: str | None = None
    """Name of the unit of the coordinates, such as m, for lengths and areas on a page. Default: m
    if the cloud is 2 to 6 units high, as rooms are in meters."""
    columns: ColumnsFlag = None


def run(argv: list[str]) -> int:
    """Parse the arguments, draw the cloud and write the picture."""
    arguments = parse(Arguments, argv, prog="torchrg view")
    check_beside(arguments.out)
    files = (arguments.file, arguments.beside, arguments.truth)
    check_columns(arguments.columns, [path for path in files if path is not None])
    write = _write_page if is_page(arguments.out) else _write_picture
    said = write(arguments, _read(arguments.file, arguments))
    say(f"{arguments.file} -> {arguments.out} ({said})")
    return 0


def _read(path: Path, arguments: Arguments) -> Result:
    """Read a cloud or a result, and print its notes."""
    result = read_result(path, columns=columns_of(path, arguments.columns))
    for note in result.cloud.notes:
        warn(f"{path}: {note}.")
    return result


def _write_picture(arguments: Arguments, result: Result) -> str:
    """Write a picture, or two side by side, and return what there is to say about it."""
    if arguments.truth is not None:
        raise ConfigError(
            f"expected --truth with a page, got {arguments.out}; take --out PAGE.html."
        )
    halves = [_draw(arguments, result)]
    if arguments.beside is not None:
        halves.append(_draw(arguments, _read(arguments.beside, arguments), result))
    height = max(len(half) for half in halves)
    level = [
        functional.pad(half, (0, 0, 0, 0, 0, height - len(half)), value=255) for half in halves
    ]
    write_png(arguments.out, torch.cat(level, dim=1))
    return f"{sum(half.shape[1] for half in halves)} x {height} pixels"


def _draw(arguments: Arguments, result: Result, first: Result | None = None) -> Tensor:
    """Draw a result; if the first has the same points, from the same place and in its colors."""
    cloud, normals = result.cloud, result.cloud.fields.get("normals")
    reference = None
    if first and np.array_equal(cloud.coordinates, first.cloud.coordinates, equal_nan=True):
        reference = first.fields.get("labels")
    up = _direction(arguments.up or "z")
    return render_cloud(
        cloud.points,
        _colors(cloud, arguments.color, up, reference),
        normals=None if normals is None else torch.from_numpy(normals).to(cloud.points.dtype),
        labels=result.fields.get("labels") if reference is None else reference,
        view=arguments.view,
        up=up,
        azimuth_deg=arguments.azimuth_deg,
        width=arguments.width // (1 if arguments.beside is None else 2),
    )


def _write_page(arguments: Arguments, result: Result) -> str:
    """Write a page, and return what there is to say about it."""
    page = make_page(
        result,
        beside=None if arguments.beside is None else _read(arguments.beside, arguments),
        truth=None if arguments.truth is None else _read(arguments.truth, arguments).cloud,
        color=arguments.color,
        view=arguments.view,
        up=None if arguments.up is None else _direction(arguments.up),
        azimuth_deg=arguments.azimuth_deg,
        max_points=arguments.max_points,
        unit=arguments.unit,
    )
    write_page(arguments.out, page)
    shown = " and ".join(f"{number:,}" for number in page.num_points)
    return f"{shown} points, {arguments.out.stat().st_size / 1e6:.1f} MB"


def _colors(
    cloud: Cloud, color: PageColorBy | None, up: Direction, reference: Tensor | None
) -> Tensor:
    """Return the colour of each point; raise ConfigError if the cloud has none of that kind."""
    present = [name for name in get_args(ColorBy) if MODES[name][1] in cloud.fields]
    if color is None:
        color = present[0] if present else None
    elif color not in present:
        raise ConfigError(
            f"{cloud.source}: expected {MODES[color][1]} for --color {color}, got a file with "
            f"{', '.join(cloud.fields) or 'points alone'}."
            + (" Errors are for pages, with --truth." if color.endswith("error") else "")
        )
    if color is None:
        return torch.full((len(cloud), 3), 170, dtype=torch.uint8)
    values = torch.from_numpy(cloud.fields[MODES[color][1]])
    if color in ("plane", "superpoint"):
        return color_planes(values, cloud.points, reference=reference if color == "plane" else None)
    if color == "normal":
        return color_normals(values, up=up)
    if color == "curvature":
        return color_curvature(values)
    if color == "sharp":
        return color_sharp(values)
    return torch.from_numpy(narrow_colors(cloud.fields["color"]))


def _direction(axis: Axis) -> Direction:
    """Return an axis as a vector."""
    sign = -1.0 if axis.startswith("-") else 1.0
    x, y, z = (sign * (letter == axis[-1]) for letter in "xyz")
    return x, y, z
