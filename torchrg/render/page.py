"""Interactive viewer: a single HTML file for rotating clouds and selecting planes, offline.

:func:`write_page` combines data with ``page.js``, which uses deck.gl for drawing and picking. The
JavaScript of deck.gl comes from the installed package pydeck, so the viewer needs no network.
Points are packed as byte planes, compressed, and stored as base64. Names from files are stored as
JSON with all characters special to HTML escaped. The content security policy allows only the
scripts of torchrg and no connections.
"""

import base64
import functools
import hashlib
import html
import math
import os
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from torchrg._checks import check_choices
from torchrg._optional import require
from torchrg.errors import ConfigError, MissingDependencyError
from torchrg.io.files import atomic_path
from torchrg.io.plane_table import encode_csv, guess_unit
from torchrg.io.result import Result
from torchrg.neighbors.order import scatter_rows
from torchrg.render.channels import COLOR_MODES, encode_directions, make_channels
from torchrg.render.colors import palette_of_planes
from torchrg.render.content import (
    PAGE_EXTENT,
    PageFrame,
    PointSample,
    choose_points,
    displayed_table,
    encode_radii,
    make_frame,
    page_planes,
    rounded,
)
from torchrg.render.cutaway import MIN_FACING, View, choose_viewpoint
from torchrg.structures import PLANE_KINDS, Cloud
from torchrg.structures.points import short_repr

if TYPE_CHECKING:
    from jinja2 import Template

MAX_SHOWN_POINTS = 1_000_000
"""Default maximum number of points in a viewer; laptops display this many smoothly."""
_STEPS = 65535
"""Steps of a position along the longest side of a cloud: two bytes per coordinate."""
_ASSETS = Path(__file__).parent
_LIBRARY = "nbextension/static/index.js"
"""File of deck.gl in pydeck, which pydeck itself embeds in offline pages."""


@short_repr
class Page(NamedTuple):
    """A viewer.

    Attributes:
        html: Content of the HTML file.
        num_points: Number of displayed points of each cloud.
    """

    html: str
    num_points: tuple[int, ...]

    def _repr_html_(self) -> str:
        """Return the viewer in an iframe, as displayed by notebooks."""
        frame = 'width="100%" height="620" style="border: 1px solid #d9dee5"'
        return f'<iframe {frame} srcdoc="{html.escape(self.html)}"></iframe>'


def make_page(
    result: Result,
    *,
    compare: Result | None = None,
    ground_truth: Cloud | None = None,
    title: str | None = None,
    color: str | None = None,
    view: View = "cutaway",
    up: Sequence[float] | str | None = None,
    azimuth_deg: float | None = None,
    max_points: int = MAX_SHOWN_POINTS,
    unit: str | None = None,
) -> Page:
    """Create a viewer of a result, or of two results with a shared camera.

    Available color modes depend on the fields of the cloud: ``labels`` (planes, with the plane
    table), ``superpoint``, ``color``, ``normals``, ``curvature``, ``sharp``. The output contains
    no time and no path: identical inputs produce identical bytes.

    Args:
        result: Result to show. Points with NaN or Inf are omitted and counted.
        compare: Another result in the same coordinates, for the right half. With the same points,
            matching planes have the same color.
        ground_truth: Cloud of the same points with ``labels`` or ``normals``, to show errors.
        title: Title. Default: the names of the files.
        color: Initial mode, of :data:`torchrg.render.channels.COLOR_MODES`. Default: the first.
        view: Initial camera, see :func:`torchrg.render.render_cloud`.
        up: Up direction, as in :func:`torchrg.render.render_cloud`. Default: z; -y for a sensor.
        azimuth_deg: See :func:`torchrg.render.render_cloud`.
        max_points: Maximum number of points per cloud; larger ones are sampled, with a note.
        unit: Unit of the coordinates. Default: "m" if a plane is as high as a room in meters.

    Returns:
        The viewer.

    Raises:
        ConfigError: If a setting is invalid, or the cloud lacks the fields of the color mode.
        MissingDependencyError: If pydeck is not installed.
    """
    cloud = result.cloud
    check_choices("make_page", view=(view, View))
    if max_points < 1:
        raise ConfigError(f"make_page: expected max_points >= 1, got {max_points}.")
    if ground_truth is not None and len(ground_truth) != len(cloud):
        raise ConfigError(
            f"{ground_truth.source or 'make_page'}: expected ground truth for {len(cloud):,} "
            f"points, got {len(ground_truth):,}; pass the same points in the same order."
        )
    library = read_library()
    frame = make_frame(cloud, up or ("-y" if view == "sensor" else "z"))
    true_fields = {} if ground_truth is None else Result(ground_truth).fields
    shown = choose_points(result, frame, max_points)
    described = [_describe_cloud(result, shown, true_fields, None, frame)]
    if compare is not None:
        same = np.array_equal(cloud.coordinates, compare.cloud.coordinates, equal_nan=True)
        reference = result.labels if same and "labels" in result.fields else None
        others = choose_points(compare, frame, max_points)
        true_fields = true_fields if same else {}
        described.append(_describe_cloud(compare, others, true_fields, reference, frame))
    scenes, blobs = [scene for scene, _ in described], [blob for _, blob in described]
    modes = [mode for mode in COLOR_MODES if any(mode in scene["channels"] for scene in scenes)]
    if color is not None and color not in modes:
        required = COLOR_MODES.get(color, ("", f"one of {', '.join(COLOR_MODES)}"))[1]
        hint = " and ground truth" if color.endswith("error") else ""
        raise ConfigError(
            f"{cloud.source or 'make_page'}: expected {required}{hint} for color={color!r}, "
            f"got {', '.join(cloud.fields) or 'points alone'}."
        )
    description = {
        "title": title or " and ".join(scene["name"] for scene in scenes),
        "modes": [(mode, COLOR_MODES[mode][0]) for mode in modes],
        "mode": color or (modes[0] if modes else None),
        "toward": rounded(_initial_direction(shown, view, frame, azimuth_deg)),
        "cut": view in MIN_FACING,
        "minFacing": MIN_FACING["above" if view == "above" else "cutaway"],
        "frame": {
            "origin": frame.origin.tolist(),
            "rotation": frame.rotation.tolist(),
            "scale": frame.scale,
        },
        "kinds": PLANE_KINDS,
        "unit": unit or (guess_unit(result.planes) if result.planes else "") or "units",
        "clouds": scenes,
    }
    text = _fill_template(description, [_encode_library(library), *blobs], library)
    return Page(text, tuple(scene["shown"] for scene in scenes))


def write_page(path: str | os.PathLike[str], page: Page) -> None:
    """Write a viewer atomically.

    Raises:
        FormatError: If the file cannot be written.
    """
    with atomic_path(path) as temporary:
        temporary.write_text(page.html, encoding="utf-8", errors="backslashreplace")


def read_library() -> str:
    """Read the JavaScript of deck.gl; call before long computations that end in a viewer.

    Raises:
        MissingDependencyError: If viewers cannot be created.
    """
    module = require("pydeck", extra="view", purpose="create viewers")
    source = Path(str(module.__file__)).parent / _LIBRARY
    if not source.is_file():
        raise MissingDependencyError(
            f"pydeck with {_LIBRARY} is needed for viewers; pip install --upgrade 'torchrg[view]'"
        )
    return source.read_text(encoding="utf-8")


def _describe_cloud(
    result: Result,
    shown: PointSample,
    ground_truth: Mapping[str, Tensor],
    reference: Tensor | None,
    frame: PageFrame,
) -> tuple[dict[str, Any], str]:
    """Return the entry of a result in the description, and the packed arrays of its points."""
    cloud = result.cloud
    names = ground_truth.keys() & {"labels", "normals"}
    true_fields = {name: ground_truth[name][shown.rows] for name in names}
    if "normals" in true_fields:
        true_fields["normals"] = true_fields["normals"].float() @ frame.rotation.T.float()
    palettes = _palettes(result, shown, reference)
    channels = list(make_channels(shown.fields, true_fields, palettes))
    table = displayed_table(result, frame)
    planes = page_planes(table, frame)
    covered = scatter_rows(shown.sides.of_points, shown.surface.rows, len(shown.rows))
    if planes:
        labels = shown.fields["labels"]
        sides = covered.new_zeros(len(planes))
        sides[labels[labels >= 0]] = covered[labels >= 0]
        for plane, side in zip(planes, sides.tolist(), strict=True):
            plane["sides"] = side
    low = shown.points.amin(dim=0) if len(shown.points) else torch.zeros(3)
    steps = ((shown.points - low) * (_STEPS / PAGE_EXTENT)).round().clamp(0, _STEPS)
    arrays: dict[str, NDArray[np.generic]] = {"positions": steps.numpy().astype(np.uint16)}
    arrays["covered"] = covered.numpy()
    radii = encode_radii(shown)
    arrays["radii"] = scatter_rows(radii, shown.surface.rows, len(shown.rows)).numpy()
    if planes:
        arrays["table"] = np.frombuffer(encode_csv(table), np.uint8)
    if "normals" in shown.fields:
        arrays["normals"] = encode_directions(shown.fields["normals"])
    for channel in channels:
        arrays[channel.mode] = channel.values
        if channel.colors is not None:
            arrays[f"{channel.mode} colors"] = channel.colors
    manifest, blob = _pack(arrays)
    scene = {
        "name": Path(cloud.source).name or "cloud",
        "count": len(cloud),
        "finite": int(cloud.finite.sum()),
        "shown": len(shown.rows),
        "levels": shown.levels,
        "low": low.tolist(),
        "step": PAGE_EXTENT / _STEPS,
        "spacing": float(shown.surface.spacing.median()) if len(shown.rows) else 0.0,
        "surfaces": rounded(shown.sides.directions),
        "channels": {
            channel.mode: {"legend": channel.legend, "direct": channel.colors is None}
            for channel in channels
        },
        "planes": planes,
        "arrays": manifest,
    }
    return scene, blob


def _palettes(
    result: Result, shown: PointSample, reference: Tensor | None
) -> dict[str, tuple[Tensor, Tensor]]:
    """Return the colors of planes and superpoints, the same as in images of the cloud."""
    palettes, labels = {}, result.fields | {"labels": result.labels}
    for mode, name, same in (("plane", "labels", reference), ("superpoint", "superpoint", None)):
        if name in result.fields:
            regions = labels[name].long().clamp(min=-1)
            rows, colors = palette_of_planes(regions, result.cloud.points, reference=same)
            palettes[mode] = rows[shown.rows], colors
    return palettes


def _initial_direction(
    shown: PointSample, view: View, frame: PageFrame, azimuth_deg: float | None
) -> Tensor:
    """Return the initial direction toward the viewer, in viewer axes, shape ``(3,)``."""
    if view == "sensor":
        return frame.rotation[:, 2].float().neg()
    if len(shown.rows) == 0:
        return functional.normalize(torch.tensor([-1.0, -1.0, 1.0]), dim=0)
    up = torch.tensor([0.0, 0.0, 1.0])
    return choose_viewpoint(shown.surface, shown.sides, view, up, azimuth_deg=azimuth_deg).toward


def _pack(arrays: Mapping[str, NDArray[np.generic]]) -> tuple[list[dict[str, object]], str]:
    """Return the layout of arrays, and all arrays as one text; see ``unpack`` in ``page.js``.

    Columns are split into byte planes, low bytes first, positions as differences.
    """
    manifest, planes = [], []
    for name, array in arrays.items():
        columns = array.reshape(len(array), math.prod(array.shape[1:])).T
        is_curve = name == "positions"
        if is_curve:
            columns = np.diff(columns, axis=1, prepend=columns.dtype.type(0))
        width = array.dtype.itemsize
        as_bytes = np.ascontiguousarray(columns, dtype=array.dtype.newbyteorder("<"))
        split = as_bytes.view(np.uint8).reshape(len(columns), -1, width).transpose(0, 2, 1)
        planes.append(np.ascontiguousarray(split).tobytes())
        manifest.append(
            {
                "name": name,
                "width": width,
                "rows": len(array),
                "columns": len(columns),
                "differences": is_curve,
            }
        )
    return manifest, _encode(b"".join(planes))


@functools.cache
def _encode_library(library: str) -> str:
    """Encode the library for embedding."""
    return _encode(library.encode())


def _encode(content: bytes) -> str:
    """Compress bytes and encode them as base64."""
    # Above level 6 the time grows faster than the size shrinks.
    compressor = zlib.compressobj(6, wbits=zlib.MAX_WBITS | 16)
    return base64.b64encode(compressor.compress(content) + compressor.flush()).decode("ascii")


def _fill_template(description: Mapping[str, object], blobs: Iterable[str], library: str) -> str:
    """Render the HTML of a viewer."""
    script = (_ASSETS / "page.js").read_text(encoding="utf-8")
    text: str = load_template("page.html.jinja").render(
        title=description["title"],
        description=description,
        blobs=blobs,
        script=script,
        hashes=[_script_hash(script), _script_hash(library)],
    )
    return text


def load_template(name: str) -> "Template":
    """Load a template of this folder, with autoescaping."""
    jinja2 = require("jinja2", extra="view", purpose="create viewers")
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, undefined=jinja2.StrictUndefined
    )
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    template: Template = environment.from_string((_ASSETS / name).read_text(encoding="utf-8"))
    return template


def _script_hash(script: str) -> str:
    """Return the hash of a script for the content security policy."""
    digest = hashlib.sha256(script.encode()).digest()
    return f"sha256-{base64.b64encode(digest).decode('ascii')}"
