"""Cameras from files: those of Open3D, nerfstudio, Replica and ROS."""

import json
import warnings
from collections.abc import Iterable, Mapping
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

CAMERA_SUFFIXES = (".json", ".yaml", ".yml")
"""Suffixes of files that hold a camera."""
_LENS = ("k1", "k2", "k3", "k4", "p1", "p2")
"""Names of the distortion of a lens in nerfstudio's files."""
_SIDES = (
    *(("w", "h"), ("width", "height"), ("image_width", "image_height")),
    ("m_depthWidth", "m_depthHeight"),
)
"""Names of the width and height of images."""
Record = Mapping[str, Any]


def read_camera(path: Path) -> Pinhole:
    """Read a camera: Open3D's or nerfstudio's JSON, Replica's, or ``camera_info`` of ROS in YAML.

    The middle of the first pixel is 0 in all of them but nerfstudio's, where it is at 0.5. Of ROS
    the projection matrix is taken, which is that of rectified images, as depth images are.

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
    if "fl_x" in record:
        warn_of_lens(path, [record])
        return camera_of_transforms(path, record)
    if "fx" in record:
        return camera_of_numbers(path, record)
    for key in ("projection_matrix", "P", "p", "camera_matrix", "K", "k", "intrinsic_matrix"):
        if key in record:
            return camera_of_matrix(path, record, key)
    got = f"none in {', '.join(map(str, record))[:60]}; pass fx,fy,cx,cy"
    if "frames" in record:
        got = "one for each frame, or none; give its folder to torchrg convert rgbd"
    raise FormatError(f"{path}: expected a camera of Open3D, nerfstudio or ROS, got {got}.")


def read_record(path: Path, *parts: str) -> dict[str, Any]:
    """Read the names and values of a JSON file, or of the first document of a YAML file.

    Those of a part are taken where there is one of such a name.
    """
    import yaml

    text = read_text(path)
    with refusing(f"{path}: expected JSON or YAML, got: ", yaml.YAMLError, *DAMAGES):
        if path.suffix.lower() == ".json":
            content = json.loads(text)
        else:
            content = next(iter(yaml.safe_load_all(text)), None)
    if not isinstance(content, dict):
        raise FormatError(f"{path}: expected names with values, got {type(content).__name__}.")
    record: dict[str, Any] = content
    for part in parts:
        record = record[part] if isinstance(record.get(part), dict) else record
    return record


def read_info(path: Path) -> dict[str, Any]:
    """Read rows of ``name = numbers``; one number is no list, and rows of words are left out."""
    record: dict[str, Any] = {}
    for name, _, words in (line.partition("=") for line in read_text(path).splitlines()):
        with suppress(ValueError):
            numbers = [float(word) for word in words.split()]
            record[name.strip()] = numbers[0] if len(numbers) == 1 else numbers
    return record


def camera_of_numbers(
    path: Path, record: Record, names: tuple[str, str, str, str] = ("fx", "fy", "cx", "cy")
) -> Pinhole:
    """Return the camera whose focal lengths and axis a record has under some names."""
    fx, fy, cx, cy = (number_of(path, record, name) for name in names)
    if 0 in (fx, fy):
        raise FormatError(f"{path}: expected {names[0]} and {names[1]} other than 0.")
    return Pinhole(fx, fy, cx, cy, _size_of(path, record))


def camera_of_transforms(path: Path, record: Record) -> Pinhole:
    """Return the camera in a record of nerfstudio, whose first pixel has its middle at 0.5."""
    model = str(record.get("camera_model", "OPENCV"))
    if "FISHEYE" in model or "EQUIRECT" in model:
        raise FormatError(
            f"{path}: expected images of a pinhole camera, got {model}; undistort them, as the "
            "image_undistorter of COLMAP does."
        )
    camera = camera_of_numbers(path, record, ("fl_x", "fl_y", "cx", "cy"))
    return camera._replace(cx=camera.cx - 0.5, cy=camera.cy - 0.5)


def warn_of_lens(path: Path, records: Iterable[Record]) -> None:
    """Warn if a record of nerfstudio has a lens that bends lines, which stay bent here."""
    given = {name: record[name] for record in records for name in _LENS if record.get(name)}
    if given:
        warnings.warn(
            f"{path}: the distortion of the lens ({', '.join(given)}) is left as it is; undistort "
            "images whose planes bend at the edges.",
            stacklevel=2,
        )


def camera_of_matrix(
    path: Path, record: Record, key: str, size: tuple[int, int] | None = None
) -> Pinhole:
    """Return the camera of a matrix in a record, whose values run along rows or columns."""
    matrix = matrix_of(path, record, key, (3, 3), (3, 4), (4, 4))[:3, :3]
    matrix = matrix if not matrix[2, :2].any() else matrix.T
    check_camera(f"{path}: {key}", matrix)
    (fx, _, cx), (_, fy, cy) = matrix[:2].tolist()
    return Pinhole(fx, fy, cx, cy, size or _size_of(path, record))


def matrix_of(path: Path, record: Record, key: str, *shapes: tuple[int, int]) -> Tensor:
    """Return a matrix of a record, nested or flat, float64, in that of the shapes that it has."""
    given = record.get(key)
    given = given.get("data") if isinstance(given, dict) else given
    try:
        values = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        values = np.empty(0)
    for shape in shapes:
        if values.shape in (shape, (shape[0] * shape[1],)):
            return torch.from_numpy(values.reshape(shape))
    wanted = " or ".join(f"{rows} x {columns}" for rows, columns in shapes)
    raise FormatError(f"{path}: expected {key} of {wanted} numbers, got {str(given)[:60]}.")


def number_of(path: Path, record: Record, key: str, default: float | None = None) -> float:
    """Return a number of a record, finite and not so large that it is none in float64."""
    value = record.get(key, default)
    if not isinstance(value, (int, float)) or not abs(value) <= FARTHEST:
        raise FormatError(f"{path}: expected a number for {key}, got {value!r:.60}; add it.")
    return float(value)


def _size_of(path: Path, record: Record) -> tuple[int, int] | None:
    """Return width and height of a record's images, None where it names none."""
    for names in _SIDES:
        if names[0] in record:
            width, height = (int(number_of(path, record, name)) for name in names)
            if min(width, height) < 1:
                raise FormatError(f"{path}: expected {names[0]} and {names[1]} above 0.")
            return width, height
    return None
