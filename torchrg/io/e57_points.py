"""The points of one scan of an E57 file, through the node tree of pye57's ``libe57``."""

import uuid
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrg.io.e57_pose import Scan

AXES = ("cartesianX", "cartesianY", "cartesianZ")
STATE = "cartesianInvalidState"
COLOR = ("colorRed", "colorGreen", "colorBlue")
Block = dict[str, NDArray[Any]]


def read_points(pye57: Any, file: Any, header: Any) -> Block:  # noqa: ANN401
    """Return what the points of a scan hold.

    Args:
        pye57: The module.
        file: The open ``pye57.E57``.
        header: The scan's ``pye57.ScanHeader``.

    Returns:
        Columns by the standard's names: int64, float32 or float64; texts are left out.
    """
    libe57, count = pye57.libe57, header.point_count
    prototype = libe57.StructureNode(header.points.prototype())
    block: Block = {}
    buffers = libe57.VectorSourceDestBuffer()
    for name in header.point_fields:
        node = pye57.utils.get_node(prototype, name)
        if isinstance(node, libe57.StringNode):
            continue
        block[name] = np.empty(count, _letter(libe57, node))
        if count:
            buffer = libe57.SourceDestBuffer(file.image_file, name, block[name], count, True, True)
            buffers.append(buffer)
    if count:
        reader = header.points.reader(buffers)
        found = reader.read()
        reader.close()
        if found != count:
            raise EOFError(f"{found:,} of {count:,} points")
    return block


def _letter(libe57: Any, node: Any) -> str:  # noqa: ANN401
    """Return the letter of NumPy's type for a field; q is libe57's only one for 64 bits."""
    if isinstance(node, libe57.IntegerNode):
        return "q"
    single = isinstance(node, libe57.FloatNode) and node.precision() == libe57.E57_SINGLE
    return "f" if single else "d"


def write_points(libe57: Any, file: Any, scan: Scan, block: Block) -> None:  # noqa: ANN401
    """Add a scan to a file.

    Args:
        libe57: The module.
        file: The ``pye57.E57`` open for writing.
        scan: Name and pose.
        block: Columns by the standard's names, in the frame of the scan.
    """
    image, count = file.image_file, len(block[AXES[0]])
    prototype = libe57.StructureNode(image)
    buffers = libe57.VectorSourceDestBuffer()
    # libe57 keeps the addresses of the columns, so they have to live until it is done.
    kept = []
    for name, column in block.items():
        if column.dtype.kind == "f":
            precision = libe57.E57_DOUBLE if column.dtype.itemsize > 4 else libe57.E57_SINGLE
            prototype.set(name, libe57.FloatNode(image, 0.0, precision))
            kept.append(np.ascontiguousarray(column))
        else:
            low, high = int(column.min()), int(column.max())
            prototype.set(name, libe57.IntegerNode(image, low, low, high))
            kept.append(np.ascontiguousarray(column, dtype="q"))
        buffers.append(libe57.SourceDestBuffer(image, name, kept[-1], count, True, True))
    node = _tree(libe57, image, _facts(scan, block))
    points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
    node.set("points", points)
    file.data3d.append(node)
    writer = points.writer(buffers)
    writer.write(count)
    writer.close()


def _facts(scan: Scan, block: Block) -> dict[str, Any]:
    """Return what is said about a scan as a whole: identity, pose, limits."""
    there = block.get(STATE, np.zeros(len(block[AXES[0]]))) == 0
    facts: dict[str, Any] = {
        "guid": f"{{{uuid.uuid4()}}}",
        "name": scan.name,
        "pose": {
            "rotation": dict(zip("wxyz", map(float, scan.rotation), strict=True)),
            "translation": dict(zip("xyz", map(float, scan.translation), strict=True)),
        },
        "cartesianBounds": {
            f"{axis[-1].lower()}{end}": float(limit(block[axis][there])) if there.any() else 0.0
            for axis in AXES
            for end, limit in (("Minimum", np.min), ("Maximum", np.max))
        },
    }
    if "intensity" in block:
        known = block["intensity"][np.isfinite(block["intensity"])]
        facts["intensityLimits"] = {
            "intensityMinimum": float(known.min()) if known.size else 0.0,
            "intensityMaximum": float(known.max()) if known.size else 0.0,
        }
    if all(name in block for name in COLOR):
        facts["colorLimits"] = {
            f"{name}{end}": value
            for name in COLOR
            for end, value in (("Minimum", 0), ("Maximum", 255))
        }
    return facts


def _tree(libe57: Any, image: Any, facts: dict[str, Any]) -> Any:  # noqa: ANN401
    """Return a node for each fact."""
    kinds = {str: libe57.StringNode, int: libe57.IntegerNode, float: libe57.FloatNode}
    node = libe57.StructureNode(image)
    for name, fact in facts.items():
        if isinstance(fact, dict):
            node.set(name, _tree(libe57, image, fact))
        else:
            node.set(name, kinds[type(fact)](image, fact))
    return node
