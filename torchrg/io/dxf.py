"""Plane polygons as DXF drawings, for CAD programs."""

import io

from torchrg._optional import require
from torchrg.io.plane_table import Json, bounding_rectangle, simplify_table

_LAYERS = {"wall": ("WALL", 1), "floor": ("FLOOR", 3), "ceiling": ("CEILING", 5)}
"""Layer and AutoCAD color index (red, green, blue) by class."""
_OTHER = ("OTHER", 8)
"""Layer and color index of all other planes."""
_METERS, _UNITLESS = 6, 0
"""Values of ``$INSUNITS``."""


def check_dxf() -> None:
    """Raise MissingDependencyError if DXF cannot be written; call before long computations."""
    require("ezdxf", extra="dxf", purpose="write DXF")


def encode_dxf(described: Json) -> bytes:
    """Convert the result of :func:`torchrg.io.plane_table.describe_planes` to a DXF drawing.

    Each ring of a polygon is a closed 3D polyline on the layer of its class, ``WALL``, ``FLOOR``,
    ``CEILING`` or ``OTHER``; a plane without a polygon has its bounding rectangle. CSV has the
    same polygons. The drawing is in meters if the table is, else its unit is unknown.

    Raises:
        MissingDependencyError: If ezdxf is not installed.
    """
    ezdxf = require("ezdxf", extra="dxf", purpose="write DXF")
    metadata = ezdxf.options.write_fixed_meta_data_for_testing
    ezdxf.options.write_fixed_meta_data_for_testing = True  # Identical runs, identical bytes.
    try:
        drawing = ezdxf.new("R2010", units=_METERS if described.get("unit") == "m" else _UNITLESS)
        for name, color in (*_LAYERS.values(), _OTHER):
            drawing.layers.add(name, color=color)
        for plane in simplify_table(described)["planes"]:
            layer = _LAYERS.get(plane.get("kind"), _OTHER)[0]
            for ring in plane.get("outline") or [bounding_rectangle(plane)]:
                drawing.modelspace().add_polyline3d(ring, close=True, dxfattribs={"layer": layer})
        # Otherwise ezdxf registers them in the order of a set.
        for entity in sorted(drawing.entitydb.dxf_types_in_use()):
            drawing.classes.add_class(entity)
        text = io.StringIO()
        drawing.write(text)
    finally:
        ezdxf.options.write_fixed_meta_data_for_testing = metadata
    return text.getvalue().encode()
