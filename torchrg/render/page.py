"""A page for the browser: one file that opens offline, to turn a cloud, point at planes, compare.

:func:`write_page` puts together what ``page.js`` beside this file shows. deck.gl draws and picks;
its JavaScript comes out of the installed package pydeck, so that the page needs no network. The
rows of points are packed as byte planes, compressed, and written as base64; names that come from
files are written as JSON with every character escaped that HTML could take for its own, and the
page's policy allows only the scripts that torchrg put there, and no connection.
"""

import base64
import functools
import hashlib
import html
import json
import math
import os
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from torchrg._optional import require
from torchrg.errors import ConfigError, MissingDependencyError
from torchrg.io.files import atomic_path
from torchrg.metrics.contingency import number_labels
from torchrg.neighbors import finite_rows, search_knn
from torchrg.regions import summarize_planes
from torchrg.render.channels import MODES, Channel, channels_of, encode_directions
from torchrg.render.cutaway import (
    LEAST_FACING,
    View,
    choose_viewpoint,
    find_outer_surfaces,
)
from torchrg.render.grid import build_grid, local_spacing, surface_cells
from torchrg.structures import PLANE_KINDS, Cloud, Planes

MAX_POINTS = 1_000_000
"""Points of a page by default: what a laptop turns fluently. Of more, a random sample is shown."""
NUM_STRATA = 8
"""Random parts of the points, each along a Morton curve. While the page moves on a slow machine it
draws the first ones; along a curve, positions compress to two thirds."""
_PAGE_EXTENT = 10.0
"""The longest side of a cloud on a page: pages do not depend on the unit."""
_STEPS = 65535
"""Steps of a position along that side: two bytes a coordinate."""
_TABLE_POINTS = 200_000
"""Points that tell outlines and which planes meet: enough for a picture."""
_TABLE_NEIGHBORS = 24
"""Neighbours that bridge the strip without labels along an edge."""
_MAX_SURFACES = 7
"""Outer surfaces that a page can cut away: bits of a byte, the last of which hides planes."""
_USUAL_RADIUS = 128
_STEPS_OF_OCTAVE = 16
_LARGEST_SPACING = 3.0
"""Radii of points are bytes: steps of their ratio to the usual one, which is bounded both ways."""
_UPRIGHT = 0.26
"""Cosine between the normal of a wall and the upward direction: 15 degrees."""
_BEYOND = 0.02
"""A point is beyond a wall from this share of the cloud's longest side on."""
_MOST_BEYOND = 0.03
"""Share of the points beyond an outer wall: those that a scanner saw through doors and windows."""
_ALIKE = 0.9
"""Cosine of the directions of walls that are cut away together."""
_MOST_WALLS, _WALL_POINTS = 200, 20_000
"""So many of the largest planes may be outer walls, as so many points of the cloud tell."""
_ASSETS = Path(__file__).parent
_LIBRARY = "nbextension/static/index.js"
"""Where pydeck keeps deck.gl, which it writes itself into pages for use offline."""


class Page(NamedTuple):
    """A page, and what it shows.

    Attributes:
        html: The text of the file.
        num_points: Points that are shown, of each cloud.
    """

    html: str
    num_points: tuple[int, ...]

    def _repr_html_(self) -> str:
        """Return the page in a frame of its own, as a notebook shows it."""
        frame = 'width="100%" height="620" style="border: 1px solid #d9dee5"'
        return f'<iframe {frame} srcdoc="{html.escape(self.html)}"></iframe>'


class _Frame(NamedTuple):
    """Where a page's axes are: z up, the middle of the first cloud in the origin.

    Attributes:
        origin: In the coordinates of the files, shape ``(3,)``, float64.
        rotation: Rows are the axes of the page, shape ``(3, 3)``, float64.
        scale: Length of a unit of the page, in the unit of the cloud.
    """

    origin: Tensor
    rotation: Tensor
    scale: float

    def place(self, points: Tensor, origin: NDArray[np.float64]) -> Tensor:
        """Return points about an origin in the axes of the page, float32."""
        moved = points.double() + (torch.from_numpy(origin) - self.origin)
        return (moved @ self.rotation.T / self.scale).float()


class _Shown(NamedTuple):
    """The points of a cloud that a page shows.

    Attributes:
        finite: All finite rows of the cloud, in canonical order.
        rows: Those that are shown, by strata, shape ``(n,)``.
        levels: Number of points in the first stratum, in the first two, and so on.
        points: In the axes of the page, shape ``(n, 3)``, float32.
        fields: Of those points; normals in the axes of the page, labels numbered without gaps.
    """

    finite: Tensor
    rows: Tensor
    levels: list[int]
    points: Tensor
    fields: dict[str, Tensor]


def make_page(
    cloud: Cloud,
    *,
    beside: Cloud | None = None,
    truth: Cloud | None = None,
    title: str | None = None,
    color: str | None = None,
    view: View = "cutaway",
    up: tuple[float, float, float] | None = None,
    azimuth_deg: float | None = None,
    max_points: int = MAX_POINTS,
) -> Page:
    """Make a page that shows a cloud, or two of them with one camera.

    What can be seen depends on the fields of the cloud: ``labels`` (planes, with their table),
    ``superpoints``, ``color``, ``normals``, ``curvature``, ``sharp``. The page holds no time and
    no path: equal input gives equal bytes.

    Args:
        cloud: What to show. Points with NaN or Inf are left out, and counted.
        beside: Another cloud in the same coordinates, for the right half. If it has the same
            points, planes that are the same in both have the same colour.
        truth: A cloud of the same points, with the true ``labels`` or ``normals``, to show errors.
        title: Of the page. Default: the names of the files.
        color: A key of :data:`torchrg.render.channels.MODES` to begin with. Default: the first
            that there is.
        view: From where to look at first, see :func:`torchrg.render.render_cloud`.
        up: Upward direction. Default: z, for the view of a sensor -y.
        azimuth_deg: See :func:`torchrg.render.render_cloud`.
        max_points: Of more points, a random sample of so many is shown, and the page says so.

    Returns:
        The page.

    Raises:
        ConfigError: If a setting is not as above, or the cloud lacks what the colours shall show.
        MissingDependencyError: If pydeck is not installed.
    """
    up = _check_settings(cloud, truth, up, view, max_points)
    library = _read_library()
    frame = _frame_of(cloud, up)
    clouds = [_with_usable_fields(each) for each in (cloud, beside) if each is not None]
    truth = None if truth is None else _with_usable_fields(truth)
    shown = [_choose_points(each, frame, max_points) for each in clouds]
    truths: list[Cloud | None] = [truth]
    references: list[Tensor | None] = [None]
    if beside is not None:
        is_same = np.array_equal(cloud.coordinates, beside.coordinates, equal_nan=True)
        truths.append(truth if is_same else None)
        references.append(shown[0].fields.get("labels") if is_same else None)
    scenes: list[dict[str, Any]] = []
    blobs: list[str] = []
    for parts in zip(clouds, shown, truths, references, strict=True):
        scene, blob = _describe_cloud(*parts, frame)
        scenes.append(scene)
        blobs.append(blob)
    modes = [mode for mode in MODES if any(mode in scene["channels"] for scene in scenes)]
    if color is not None and color not in modes:
        needed = f"{MODES[color][1]} for" if color in MODES else f"one of {', '.join(MODES)} as"
        beyond = " and a truth" if color.endswith("error") else ""
        raise ConfigError(
            f"{cloud.source or 'make_page'}: expected {needed} the colour {color!r}{beyond}, got "
            f"{', '.join(cloud.fields) or 'points alone'}."
        )
    description = {
        "title": title or " and ".join(scene["name"] for scene in scenes),
        "modes": [(mode, MODES[mode][0]) for mode in modes],
        "mode": color or (modes[0] if modes else None),
        "toward": _rounded(_direction_of_view(shown[0].points, view, frame, azimuth_deg)),
        "cut": view in LEAST_FACING,
        "leastFacing": LEAST_FACING["above" if view == "above" else "cutaway"],
        "frame": {
            "origin": frame.origin.tolist(),
            "rotation": frame.rotation.tolist(),
            "scale": frame.scale,
        },
        "kinds": PLANE_KINDS,
        "clouds": scenes,
    }
    text = _fill_template(description, [_encode_library(library), *blobs], library)
    return Page(text, tuple(scene["shown"] for scene in scenes))


_FIELDS = {
    "labels": ("iu", ()),
    "superpoints": ("iu", ()),
    "color": ("u", (3,)),
    "normals": ("f", (3,)),
    "curvature": ("f", ()),
    "sharp": ("b", ()),
}
"""Kinds of numbers and shapes of the fields that can be shown."""


def _with_usable_fields(cloud: Cloud) -> Cloud:
    """Return a cloud with those fields that are what their names say: files may hold others."""
    fields = {
        name: values
        for name, values in cloud.fields.items()
        if name in _FIELDS
        and values.dtype.kind in _FIELDS[name][0]
        and values.shape[1:] == _FIELDS[name][1]
        and (name != "color" or values.dtype == np.uint8)
    }
    return replace(cloud, fields=fields)


def _check_settings(
    cloud: Cloud,
    truth: Cloud | None,
    up: tuple[float, float, float] | None,
    view: View,
    max_points: int,
) -> tuple[float, float, float]:
    """Return the upward direction, or say what is wrong with a setting."""
    if view not in get_args(View):
        names = ", ".join(get_args(View))
        raise ConfigError(f"make_page: expected view to be one of {names}, got {view!r}.")
    if max_points < 1:
        raise ConfigError(f"make_page: expected max_points >= 1, got {max_points}.")
    if up is not None and not any(up):
        raise ConfigError("make_page: expected up to be a direction, got zeros.")
    if truth is not None and len(truth) != len(cloud):
        raise ConfigError(
            f"{truth.source or 'make_page'}: expected a truth of {len(cloud):,} points, got "
            f"{len(truth):,}; it has to be of the same points in the same order."
        )
    return up or ((0.0, -1.0, 0.0) if view == "sensor" else (0.0, 0.0, 1.0))


def write_page(path: str | os.PathLike[str], page: Page) -> None:
    """Write a page; the file appears whole or not at all.

    Raises:
        FormatError: If the file cannot be written.
    """
    with atomic_path(path) as beside:
        beside.write_text(page.html, encoding="utf-8")


def check_library() -> None:
    """Raise MissingDependencyError before long work if no page can be made."""
    _read_library()


def _read_library() -> str:
    """Return the JavaScript of deck.gl."""
    found = require("pydeck", extra="view", purpose="write pages")
    source = Path(str(found.__file__)).parent / _LIBRARY
    if not source.is_file():
        raise MissingDependencyError(
            f"pydeck with {_LIBRARY} is needed to write pages; install it with: "
            "pip install --upgrade 'torchrg[view]'"
        )
    return source.read_text(encoding="utf-8")


def _frame_of(cloud: Cloud, up: tuple[float, float, float]) -> _Frame:
    """Return the axes of a page for its first cloud."""
    third = functional.normalize(torch.tensor(up, dtype=torch.float64), dim=0)
    # With z up, x stays x; else the axis least along the upward one, so that x is never up.
    start = torch.zeros(3, dtype=torch.float64)
    start[int(third.abs().argmin())] = 1
    first = functional.normalize(start - (start @ third) * third, dim=0)
    rotation = torch.stack([first, torch.linalg.cross(third, first), third])
    kept = cloud.coordinates[cloud.finite]
    if len(kept) == 0:
        return _Frame(torch.zeros(3, dtype=torch.float64), rotation, 1.0)
    low, high = (torch.from_numpy(end(axis=0).astype(np.float64)) for end in (kept.min, kept.max))
    extent = float((high - low).amax())
    return _Frame(low + (high - low) / 2, rotation, extent / _PAGE_EXTENT if extent > 0 else 1.0)


def _choose_points(cloud: Cloud, frame: _Frame, max_points: int) -> _Shown:
    """Choose the points to show: the same whatever their order, and in random strata."""
    finite = finite_rows(cloud.points)
    mixed = torch.from_numpy(np.random.default_rng(0).permutation(len(finite))[:max_points])
    strata = [part.sort().values for part in mixed.tensor_split(NUM_STRATA)]
    levels = torch.tensor([len(part) for part in strata]).cumsum(0).tolist()
    rows = finite[torch.cat(strata)]
    fields = {
        name: torch.from_numpy(np.ascontiguousarray(cloud.fields[name][rows.numpy()]))
        for _, name in MODES.values()
        if name in cloud.fields
    }
    for name in ("normals", "curvature"):
        if name in fields:
            fields[name] = fields[name].float().nan_to_num(0, 0, 0)
    if "normals" in fields:
        fields["normals"] = fields["normals"] @ frame.rotation.T.float()
    for name in ("labels", "superpoints"):
        if name in fields:
            distinct = _distinct(cloud, name)
            places = torch.searchsorted(distinct, fields[name].long())
            fields[name] = torch.where(fields[name] < 0, -1, places)
    return _Shown(finite, rows, levels, frame.place(cloud.points[rows], cloud.origin), fields)


def _distinct(cloud: Cloud, name: str) -> Tensor:
    """Return the labels that occur at finite points, ascending."""
    values = torch.from_numpy(np.ascontiguousarray(cloud.fields[name][cloud.finite])).long()
    distinct: Tensor = torch.unique(values[values >= 0])
    return distinct


def _describe_cloud(
    cloud: Cloud, shown: _Shown, truth: Cloud | None, reference: Tensor | None, frame: _Frame
) -> tuple[dict[str, Any], str]:
    """Return what a page says about a cloud, and the packed arrays of its points."""
    true_fields = {
        name: torch.from_numpy(np.ascontiguousarray(truth.fields[name][shown.rows.numpy()]))
        for name in ("labels", "normals")
        if truth is not None and name in truth.fields
    }
    if "normals" in true_fields:
        true_fields["normals"] = true_fields["normals"].float() @ frame.rotation.T.float()
    channels = list(channels_of(shown.points, shown.fields, true_fields, reference=reference))
    surfaces = _outer_surfaces(shown.points)
    planes = _describe_planes(cloud, shown, frame)
    directions, covered = surfaces.directions, surfaces.covered
    if planes:
        labels = shown.fields["labels"]
        directions, sides = _sides_of_planes(shown, planes, frame, surfaces)
        # What stands against a wall, and the floor along it, is not part of the wall.
        covered = torch.where(labels < 0, covered, sides[labels])
        for plane, side in zip(planes, sides.tolist(), strict=True):
            plane["sides"] = side
    low = shown.points.amin(dim=0) if len(shown.points) else torch.zeros(3)
    steps = ((shown.points - low) * (_STEPS / _PAGE_EXTENT)).round().clamp(0, _STEPS)
    arrays: dict[str, NDArray[Any]] = {"positions": steps.numpy().astype(np.uint16)}
    arrays["covered"] = covered.numpy()
    arrays["radii"] = surfaces.radii.numpy()
    if "normals" in shown.fields:
        arrays["normals"] = encode_directions(shown.fields["normals"])
    for channel in channels:
        arrays[channel.mode] = channel.values
        if channel.colors is not None:
            arrays[f"{channel.mode} colors"] = channel.colors
    manifest, blob = _pack(arrays)
    num_finite = int(cloud.finite.sum())
    scene = {
        "name": Path(cloud.source).name or "cloud",
        "count": len(cloud),
        "finite": num_finite,
        "shown": len(shown.rows),
        "levels": shown.levels,
        "low": low.tolist(),
        "step": _PAGE_EXTENT / _STEPS,
        "spacing": surfaces.spacing,
        "surfaces": [_rounded(direction) for direction in directions],
        "channels": {channel.mode: _describe_channel(channel) for channel in channels},
        "planes": planes,
        "arrays": manifest,
    }
    return scene, blob


def _describe_channel(channel: Channel) -> dict[str, Any]:
    """Return what a page says about a meaning of colours."""
    return {"legend": channel.legend, "direct": channel.colors is None}


class _Surfaces(NamedTuple):
    """What closes a cloud, and how dense it is.

    Attributes:
        directions: From the inside toward the outside of each outer surface, shape ``(S, 3)``.
        covered: Bits of the surfaces that each point is in, shape ``(n,)``, uint8.
        spacing: The usual distance of a point from its neighbours.
        radii: That of each point, as a step of a sixteenth of an octave from 128, the usual one.
    """

    directions: Tensor
    covered: Tensor
    spacing: float
    radii: Tensor


def _outer_surfaces(points: Tensor) -> _Surfaces:
    """Find walls and ceiling, and how far points are from their neighbours."""
    covered = torch.zeros(len(points), dtype=torch.uint8)
    radii = torch.full((len(points),), _USUAL_RADIUS, dtype=torch.uint8)
    grid = build_grid(points)
    if len(grid.levels) == 0:
        return _Surfaces(points.new_zeros(0, 3), covered, 0.0, radii)
    up = torch.tensor([0.0, 0.0, 1.0])
    found = find_outer_surfaces(surface_cells(grid), up)[:_MAX_SURFACES]
    for place, surface in enumerate(found):
        covered[grid.rows] |= surface.covers(grid.points).to(torch.uint8) << place
    spacing = local_spacing(grid)
    usual = float(spacing.median())
    if usual > 0:
        octaves = (spacing / usual).clamp(min=1 / _LARGEST_SPACING, max=_LARGEST_SPACING).log2()
        steps = (octaves * _STEPS_OF_OCTAVE + _USUAL_RADIUS).round()
        radii[grid.rows] = steps.to(torch.uint8)
    directions = torch.stack([points.new_zeros(3), *(each.direction for each in found)])[1:]
    return _Surfaces(directions, covered, usual, radii)


def _direction_of_view(
    points: Tensor, view: View, frame: _Frame, azimuth_deg: float | None
) -> Tensor:
    """Return the direction toward the viewer at first, in the axes of the page, shape ``(3,)``."""
    if view == "sensor":
        return frame.rotation[:, 2].float().neg()
    grid = build_grid(points)
    if len(grid.levels) == 0:
        return functional.normalize(torch.tensor([-1.0, -1.0, 1.0]), dim=0)
    up = torch.tensor([0.0, 0.0, 1.0])
    return choose_viewpoint(surface_cells(grid), view, up, azimuth_deg=azimuth_deg).toward


def _describe_planes(cloud: Cloud, shown: _Shown, frame: _Frame) -> list[dict[str, Any]]:
    """Return what a page says about each plane, by the number that its points have there."""
    if "labels" not in shown.fields:
        return []
    names = _distinct(cloud, "labels")
    if len(names) == 0:
        return []
    kept = shown.finite
    labels = torch.from_numpy(np.ascontiguousarray(cloud.fields["labels"])).long()[kept]
    labels = torch.where(labels < 0, -1, torch.searchsorted(names, labels))
    points = cloud.points[kept]
    has_normals = "normals" in cloud.fields
    normals = torch.zeros_like(points)
    if has_normals:
        given = torch.from_numpy(np.ascontiguousarray(cloud.fields["normals"]))[kept]
        normals = given.to(points.dtype).nan_to_num(0, 0, 0)
    table = summarize_planes(points, normals, labels, up=frame.rotation[2].tolist())
    drawn = _planes_to_draw(shown, len(names))
    offset = table.offset.double() + table.normal.double() @ torch.from_numpy(cloud.origin)
    kinds = table.kind if table.kind is not None else torch.zeros_like(table.count)
    rows = zip(
        names.tolist(),
        table.count.tolist(),
        table.area.tolist(),
        table.rms.tolist(),
        table.extent.tolist(),
        table.normal.tolist(),
        offset.tolist(),
        kinds.tolist(),
        (table.curved & has_normals).tolist(),
        _rectangles(table, frame, cloud.origin),
        strict=True,
    )
    planes = []
    for number, row in enumerate(rows):
        name, count, area, rms, extent, normal, height, kind, curved, corners = row
        rings, met = drawn.get(number, ([], []))
        planes.append(
            {
                "name": name,
                "count": count,
                "area": area,
                "rms": rms,
                "extent": extent,
                "normal": normal,
                "offset": height,
                "kind": kind,
                "curved": curved,
                "rings": rings or [corners],
                "meets": met,
            }
        )
    return planes


def _planes_to_draw(
    shown: _Shown, num_planes: int
) -> dict[int, tuple[list[Any], list[tuple[int, float, float]]]]:
    """Return outlines in the axes of the page, and which planes meet at which angle and length.

    A sample of the points tells both; without shapely there are no outlines.
    """
    rows = shown.fields["labels"][:_TABLE_POINTS]
    points = shown.points[:_TABLE_POINTS]
    normals = shown.fields.get("normals", torch.zeros_like(points))[:_TABLE_POINTS]
    numbers, labels = number_labels(rows)
    neighbors = search_knn(points, min(_TABLE_NEIGHBORS, len(points)))
    can_trace = find_spec("shapely") is not None
    table = summarize_planes(points, normals, labels, neighbors=neighbors, outline=can_trace)
    found: dict[int, tuple[list[Any], list[tuple[int, float, float]]]] = {
        number: ([], []) for number in range(num_planes)
    }
    if table.outline is not None:
        for number, rings in zip(numbers.tolist(), table.outline, strict=True):
            found[number][0].extend(_rounded(ring) for ring in rings)
    if table.adjacency is not None:
        pairs = numbers[table.adjacency.pairs].tolist()
        angles = table.adjacency.dihedral_deg.tolist()
        lengths = table.adjacency.boundary_length.tolist()
        for (first, second), angle, length in zip(pairs, angles, lengths, strict=True):
            for own, other in ((first, second), (second, first)):
                found[own][1].append((other, round(angle, 1), length))
    return found


def _sides_of_planes(
    shown: _Shown, planes: list[dict[str, Any]], frame: _Frame, surfaces: _Surfaces
) -> tuple[Tensor, Tensor]:
    """Return the directions of outer surfaces ``(S, 3)``, and the bits of each plane ``(M,)``.

    A plane is in the outer surfaces that hold most of its points. Large upright ones are, too, in
    that of the direction in which there is next to nothing beyond them: walls of scans that are too
    open for a closed outer surface. There is a bit for each main direction.
    """
    labels = shown.fields["labels"]
    inside = labels >= 0
    own, bits = labels[inside], surfaces.covered[inside]
    counts = torch.bincount(own, minlength=len(planes))
    sides = torch.zeros(len(planes), dtype=torch.uint8)
    for place in range(len(surfaces.directions)):
        covered = torch.bincount(own[(bits >> place & 1).bool()], minlength=len(planes))
        sides |= (2 * covered > counts).to(torch.uint8) << place
    directions = list(surfaces.directions)
    normals = torch.tensor([plane["normal"] for plane in planes]).double()
    offsets = torch.tensor([plane["offset"] for plane in planes]).double()
    offsets = (offsets - normals @ frame.origin) / frame.scale
    normals = (normals @ frame.rotation.T).float()
    large = counts.argsort(descending=True, stable=True)[:_MOST_WALLS]
    walls = large[normals[large, 2].abs() < _UPRIGHT]
    heights = shown.points[:_WALL_POINTS] @ normals[walls].T - offsets[walls].float()
    margin = _BEYOND * _PAGE_EXTENT
    beyond = torch.stack([heights > margin, heights < -margin]).float().mean(dim=1)
    for sign, shares in zip((1, -1), beyond.tolist(), strict=True):
        for wall, share in zip(walls.tolist(), shares, strict=True):
            if share > _MOST_BEYOND:
                continue
            outward = sign * normals[wall]
            alike = [place for place, each in enumerate(directions) if each @ outward > _ALIKE]
            if not alike and len(directions) < _MAX_SURFACES:
                alike = [len(directions)]
                directions.append(outward)
            for place in alike[:1]:
                sides[wall] |= 1 << place
    return torch.stack([shown.points.new_zeros(3), *directions])[1:], sides


def _rectangles(table: Planes, frame: _Frame, origin: NDArray[np.float64]) -> list[Any]:
    """Return the corners of the rectangle around each plane, in the axes of the page."""
    half = (table.axes * table.extent[:, :, None] / 2).double()
    signs = torch.tensor([[-1.0, -1], [1, -1], [1, 1], [-1, 1]]).double()
    corners = table.center.double()[:, None] + signs @ half
    return [_rounded(frame.place(each, origin)) for each in corners]


def _rounded(values: Tensor) -> Any:  # noqa: ANN401
    """Return numbers of a page as JSON needs them: a step is a hundred-thousandth of the cloud."""
    return np.round(values.numpy(force=True).astype(np.float64), 4).tolist()


def _pack(arrays: Mapping[str, NDArray[Any]]) -> tuple[list[dict[str, Any]], str]:
    """Return name, type and shape of arrays, and all of them as one text.

    Each column is split into its bytes, the low ones first. Of positions, which lie along a curve,
    it is the differences. Read again by ``unpack`` in ``page.js``.
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
    """Return the library as pages hold it."""
    return _encode(library.encode())


def _encode(content: bytes) -> str:
    """Return bytes compressed, as base64."""
    # Of zlib's levels 6 is where the time grows faster than the page shrinks.
    squeezer = zlib.compressobj(6, wbits=zlib.MAX_WBITS | 16)
    return base64.b64encode(squeezer.compress(content) + squeezer.flush()).decode("ascii")


def _fill_template(description: Mapping[str, Any], blobs: Iterable[str], library: str) -> str:
    """Return the text of a page."""
    from markupsafe import Markup

    script = (_ASSETS / "page.js").read_text(encoding="utf-8")
    text: str = template_of("page.html.jinja").render(
        title=description["title"],
        description=Markup(_json_for_html(description)),  # noqa: S704 Escaped there.
        blobs=[Markup(blob) for blob in blobs],  # noqa: S704 Base64.
        script=Markup(script),  # noqa: S704 Our own.
        hashes=[_script_hash(script), _script_hash(library)],
    )
    return text


def template_of(name: str) -> Any:  # noqa: ANN401
    """Return one of the templates beside this file; what is put into it is escaped.

    Raises:
        MissingDependencyError: If jinja2 is not installed.
    """
    jinja2 = require("jinja2", extra="view", purpose="write pages")
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, undefined=jinja2.StrictUndefined
    )
    return environment.from_string((_ASSETS / name).read_text(encoding="utf-8"))


def _json_for_html(value: object) -> str:
    r"""Return JSON in which no character means anything to HTML.

    Example:
        >>> _json_for_html({"name": "</script>&"})
        '{"name":"\\u003c/script\\u003e\\u0026"}'
    """
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def _script_hash(script: str) -> str:
    """Return the hash by which a page's policy allows one script and no other."""
    digest = hashlib.sha256(script.encode()).digest()
    return f"sha256-{base64.b64encode(digest).decode('ascii')}"
