"""Display of segmentations in notebooks."""

import base64
import html
import tempfile
from pathlib import Path
from typing import Any

from torchrg._optional import require
from torchrg.errors import ConfigError
from torchrg.io.plane_table import describe_planes, tabulate_planes
from torchrg.io.result import Result
from torchrg.render.gallery import write_planes
from torchrg.render.page import Page, make_page
from torchrg.structures import Cloud, Planes, Segmentation


def show(segmentation: Segmentation, **settings: Any) -> Page:  # noqa: ANN401
    """Return the viewer of a segmentation; ``settings`` are passed to :func:`make_page`."""
    return make_page(_result_of(segmentation), **settings)


def _result_of(segmentation: Segmentation) -> Result:
    """Return the result of a segmentation; raise if it has no points."""
    if segmentation.points is None:
        raise ConfigError(
            "Segmentation: expected points, got None; use dataclasses.replace(seg, points=points)."
        )
    points = segmentation.points.numpy(force=True).reshape(-1, 3)
    return Result.from_segmentation(Cloud(points, source="segmentation"), segmentation)


def as_frame(planes: Planes) -> Any:  # noqa: ANN401
    """Convert a plane table to a ``pandas.DataFrame``."""
    pandas = require("pandas", extra="report", purpose="create data frames")
    return pandas.DataFrame(tabulate_planes(describe_planes(planes)))


def as_html(segmentation: Segmentation) -> str:
    """Return a line about the planes, and their image with a legend if the points are known."""
    picture = ""
    if segmentation.points is not None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "planes.png"
            write_planes(path, _result_of(segmentation))
            content = base64.b64encode(path.read_bytes()).decode("ascii")
        picture = f'<img src="data:image/png;base64,{content}" style="max-width: 960px" alt="">'
    return f"<div><p>{html.escape(repr(segmentation))}, {segmentation.planes!r}</p>{picture}</div>"
