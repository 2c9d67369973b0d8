"""Cameras from files: those of Open3D, nerfstudio, Replica and ROS."""

import json
import warnings
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrg.depth.camera import Pinhole, check_camera
from torchrg.errors import FormatError
from torchrg.io.files import DAMAGES, read_text, refusing
from torchrg.structures import FARTHEST

Record = Mapping[str, Any]
CAMERA_SUFFIXES = (".json", ".yaml", ".yml")
"""Suffixes of files that hold a camera."""
_LENS = ("k1", "k2", "k3", "k4", "p1", "p2")
"""Names of the distortion of a lens in nerfstudio's files."""
_NUMBERS = {("fl_x", "fl_y", "cx", "cy"): 0.5, ("fx", "fy", "cx", "cy"): 0.0}
"""Names of focal lengths and optical axis, and where they have the middle of the first pixel."""
_MATRICES = (
    *("projection_matrix", "P", "p", "camera_matrix", "K", "k", "intrinsic_matrix", "intrinsic"),
    "m_calibrationDepthIntrinsic",
)
"""Names of camera matrices. Of ROS that of rectified images comes first, which depth images are."""
_SIDES = {
    "w": "h",
    "width": "height",
    "image_width": "image_height",
    "m_depthWidth": "m_depthHeight",
}
"""Names of the width and height of images."""
_SHAPES = {9: (3, 3), 12: (3, 4), 16: (4, 4)}
"""Shapes of cameras, projections and poses by the count of their numbers."""


def read_camera(path: Path) -> Pinhole:
    """Read a camera: Open3D's or nerfstudio's JSON, Replica's, or ``camera_info`` of ROS in YAML.

    Raises:
        FormatError: If there is no such file, or no camera in it.

    Warns:
        UserWarning: If the lens distorts images, which nothing takes back here.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "camera.json"
        >>> camera = {"width": 8, "height": 6, "intrinsic_matrix": [9, 0, 0, 0, 9, 0, 3.5, 2.5, 1]}
        >>> _ = path.write_text(json.dumps(camera))
        >>> read_camera(path)
        Pinhole(fx=9.0, fy=9.0, cx=3.5, cy=2.5, size=(8, 6))
    """
    record = read_record(path, "intrinsic", "camera")
    if "frames" in record and "fl_x" not in record:
        raise FormatError(
            f"{path}: expected one camera, got one for each frame, or none; give the folder of the "
            "file to torchrg convert rgbd."
        )
    return camera_of(path, record)


def read_record(path: Path, *parts: str) -> dict[str, Any]:
    """Read the names and values of JSON, or of the first document of YAML, or of a part in it."""
    import yaml

    text, is_json = read_text(path), path.suffix.lower() == ".json"
    with refusing(f"{path}: expected JSON or YAML, got: ", yaml.YAMLError, *DAMAGES):
        content = json.loads(text) if is_json else next(iter(yaml.safe_load_all(text)), None)
    if not isinstance(content, dict):
        raise FormatError(f"{path}: expected names with values, got {type(content).__name__}.")
    inside = (content[section] for section in parts if isinstance(content.get(section), dict))
    record: dict[str, Any] = next(inside, content)
    return record


def read_info(path: Path) -> dict[str, Any]:
    """Read rows of ``name = numbers``; one number is no list, and rows of words are left out."""
    record: dict[str, Any] = {}
    for name, _, words in (line.partition("=") for line in read_text(path).splitlines()):
        with suppress(ValueError):
            numbers = [float(word) for word in words.split()]
            record[name.strip()] = numbers[0] if len(numbers) == 1 else numbers
    return record


def camera_of(path: Path, record: Record) -> Pinhole:
    """Return the camera that a record of a file has under any of the names that are known."""
    size = _size_of(path, record)
    model = str(record.get("camera_model", ""))
    if "FISHEYE" in model or "EQUIRECT" in model:
        raise FormatError(
            f"{path}: expected images of a pinhole camera, got {model}; undistort them, as the "
            "image_undistorter of COLMAP does."
        )
    if bent := [name for name in _LENS if record.get(name) and "fl_x" in record]:
        warnings.warn(
            f"{path}: the distortion of the lens ({', '.join(bent)}) is left as it is; undistort "
            "images whose planes bend at the edges.",
            stacklevel=2,
        )
    for names, middle in _NUMBERS.items():
        if names[0] in record:
            fx, fy, cx, cy = (number_of(path, record, name) for name in names)
            if 0 in (fx, fy):
                raise FormatError(f"{path}: expected {names[0]} and {names[1]} other than 0.")
            return Pinhole(fx, fy, cx - middle, cy - middle, size)
    for name in _MATRICES:
        if name in record:
            matrix = matrix_of(path, record, name)[:3, :3]
            # Open3D's numbers run along columns.
            matrix = matrix.T if matrix[2, :2].any() else matrix
            check_camera(f"{path}", matrix)
            (fx, _, cx), (_, fy, cy) = matrix[:2].tolist()
            return Pinhole(fx, fy, cx, cy, size)
    raise FormatError(
        f"{path}: expected a camera, as fl_x, fl_y, cx, cy or a matrix, got none in "
        f"{', '.join(map(str, record))[:60]}; add it, or pass --intrinsics fx,fy,cx,cy."
    )


def matrix_of(path: Path, record: Record, key: str, columns: int = 3) -> Tensor:
    """Return a matrix of 3 or 4 rows and at least so many columns, nested or flat in a record."""
    value = record.get(key)
    with suppress(TypeError, ValueError, OverflowError):
        data = value.get("data") if isinstance(value, dict) else value
        values = torch.from_numpy(np.asarray(data, dtype=np.float64).ravel())
        if len(values) in _SHAPES and _SHAPES[len(values)][1] >= columns:
            return values.view(_SHAPES[len(values)])
    raise FormatError(f"{path}: expected {key} to be a matrix, got {str(value)[:60]}; repair it.")


def number_of(path: Path, record: Record, key: str) -> float:
    """Return a number of a record, finite and not so large that it is none in float64."""
    value = record.get(key)
    if not isinstance(value, (int, float)) or not abs(value) <= FARTHEST:
        raise FormatError(f"{path}: expected a number for {key}, got {value!r:.60}; add it.")
    return float(value)


def _size_of(path: Path, record: Record) -> tuple[int, int] | None:
    """Return width and height of a record's images, None where it names none."""
    for names in _SIDES.items():
        if names[0] in record:
            width, height = (int(number_of(path, record, name)) for name in names)
            if min(width, height) < 1:
                raise FormatError(f"{path}: expected {names[0]} and {names[1]} above 0.")
            return width, height
    return None
