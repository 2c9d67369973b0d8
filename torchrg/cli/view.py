"""``torchrg view``: an image or interactive viewer of a cloud or result."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from torchrg import render
from torchrg.cli.arguments import Argument, parse
from torchrg.cli.ending import print_lines
from torchrg.cli.flags import ColumnsFlag, check_columns, read_noted
from torchrg.cli.loop import check_sidecar, has_suffix
from torchrg.config import Up
from torchrg.errors import ConfigError
from torchrg.io.result import Result
from torchrg.render.channels import COLOR_MODES
from torchrg.render.gallery import draw_planes
from torchrg.render.page import MAX_SHOWN_POINTS
from torchrg.structures import Cloud
from torchrg.structures.colors import narrow_colors

ColorBy = Literal["plane", "superpoint", "color", "normal", "curvature", "sharp"]
PageColorBy = Literal[ColorBy, "error", "normal-error"]


@dataclass(frozen=True)
class Arguments:
    """Render a cloud as an image or an interactive viewer, colored by its planes if it has labels.

    The viewer is an HTML page: rotate the cloud, select planes, compare two results.

    Examples:
        torchrg view planes.npz --out planes.png
        torchrg view planes.npz --out planes.html
        torchrg view room.npz --compare planes.npz --out truth_and_result.png
        torchrg view planes.npz --out compared.html --compare other.npz --ground-truth room.npz
        torchrg view scan.ply --out normals.png --color normal --view above
    """

    file: Annotated[Path, Argument("FILE", is_positional=True)]
    """Point cloud or result."""
    out: Path
    """Output image (.png) or viewer (.html, one offline file; pip install 'torchrg[view]')."""
    color: PageColorBy | None = None
    """Quantity shown as color; in a viewer, the initial one. Default: the planes, or the first
    quantity in the file. error and normal-error require --ground-truth and a viewer."""
    view: Literal["cutaway", "above", "outside", "sensor"] = "cutaway"
    """Camera. cutaway: from outside, without ceiling and near walls. above: from above, without
    ceiling. outside: from outside, with everything. sensor: from the origin along z, like a depth
    camera."""
    up: Up | None = None
    """Up axis. Default: z; -y with --view sensor."""
    azimuth_deg: float | None = None
    """Azimuth of the camera about the up axis, in degrees. Default: chosen to show the most."""
    width: int = 1600
    """Width of the image in pixels, including both halves."""
    compare: Path | None = None
    """Second cloud or result, shown in the right half; in a viewer both rotate together."""
    ground_truth: Path | None = None
    """Ground truth for the same points, with labels or normals; shows errors in a viewer."""
    max_points: int = MAX_SHOWN_POINTS
    """Maximum points in the viewer; larger clouds are randomly downsampled, with a note."""
    unit: str | None = None
    """Unit of the coordinates, such as m, for lengths and areas in a viewer. Default: m if the
    tallest plane is 2 to 6 units high, like a room in meters."""
    columns: ColumnsFlag = None


def run(argv: list[str]) -> int:
    """Parse the arguments, render the cloud and write the output."""
    arguments = parse(Arguments, argv, prog="torchrg view")
    check_sidecar(arguments.out)
    files = (arguments.file, arguments.compare, arguments.ground_truth)
    check_columns(arguments.columns, [path for path in files if path is not None])
    write = _write_page if has_suffix(arguments.out, ".html") else _write_picture
    summary = write(arguments, read_noted(arguments.file, arguments.columns))
    print_lines(f"{arguments.file} -> {arguments.out} ({summary})")
    return 0


def _write_picture(arguments: Arguments, result: Result) -> str:
    """Write an image, or two side by side, and return its description."""
    if arguments.ground_truth is not None:
        raise ConfigError(f"expected --ground-truth with a viewer, got {arguments.out}; use .html.")
    halves = [_render(arguments, result)]
    if arguments.compare is not None:
        halves.append(_render(arguments, read_noted(arguments.compare, arguments.columns), result))
    height = max(len(half) for half in halves)
    level = [
        functional.pad(half, (0, 0, 0, 0, 0, height - len(half)), value=255) for half in halves
    ]
    render.write_png(arguments.out, torch.cat(level, dim=1))
    return f"{sum(half.shape[1] for half in halves)} x {height} pixels"


def _render(arguments: Arguments, result: Result, first: Result | None = None) -> Tensor:
    """Render a result; with the same points as the first, use its camera and colors."""
    cloud, normals = result.cloud, result.cloud.fields.get("normals")
    reference = None
    if first and np.array_equal(cloud.coordinates, first.cloud.coordinates, equal_nan=True):
        reference = first.fields.get("labels")
    up = arguments.up or "z"
    camera: dict[str, Any] = {
        "view": arguments.view,
        "up": up,
        "azimuth_deg": arguments.azimuth_deg,
        "width": arguments.width // (1 if arguments.compare is None else 2),
    }
    by = {None: None, "plane": "labels", "superpoint": "superpoint"}.get(arguments.color, "")
    if reference is None and by != "" and (by or "labels") in result.fields:
        return draw_planes(result, by=by or "labels", **camera)
    return render.render_cloud(
        cloud.points,
        _colors(cloud, arguments.color, up, reference),
        normals=None if normals is None else torch.from_numpy(normals).to(cloud.points.dtype),
        labels=result.fields.get("labels") if reference is None else reference,
        **camera,
    )


def _write_page(arguments: Arguments, result: Result) -> str:
    """Write a viewer and return its description."""
    compare, ground_truth = (
        None if path is None else read_noted(path, arguments.columns)
        for path in (arguments.compare, arguments.ground_truth)
    )
    page = render.make_page(
        result,
        compare=compare,
        ground_truth=None if ground_truth is None else ground_truth.cloud,
        color=arguments.color,
        view=arguments.view,
        up=arguments.up,
        azimuth_deg=arguments.azimuth_deg,
        max_points=arguments.max_points,
        unit=arguments.unit,
    )
    render.write_page(arguments.out, page)
    shown = " and ".join(f"{number:,}" for number in page.num_points)
    return f"{shown} points, {arguments.out.stat().st_size / 1e6:.1f} MB"


def _colors(cloud: Cloud, color: PageColorBy | None, up: Up, reference: Tensor | None) -> Tensor:
    """Return the color of each point; raise ConfigError if the cloud lacks the quantity."""
    present = [name for name in get_args(ColorBy) if COLOR_MODES[name][1] in cloud.fields]
    if color is None:
        color = present[0] if present else None
    elif color not in present:
        raise ConfigError(
            f"{cloud.source}: missing {COLOR_MODES[color][1]}, required by --color {color}; has "
            f"{', '.join(cloud.fields) or 'points alone'}."
            + (" Errors require a viewer and --ground-truth." if color.endswith("error") else "")
        )
    if color is None:
        return torch.full((len(cloud), 3), 170, dtype=torch.uint8)
    values = torch.from_numpy(cloud.fields[COLOR_MODES[color][1]])
    if color in ("plane", "superpoint"):
        return render.color_planes(
            values, cloud.points, reference=reference if color == "plane" else None
        )
    if color == "normal":
        return render.color_normals(values, up=up)
    if color == "curvature":
        return render.color_curvature(values)
    if color == "sharp":
        return render.color_sharp(values)
    return torch.from_numpy(narrow_colors(cloud.fields["color"]))
