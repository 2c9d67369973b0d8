"""Readers and search of camera files."""

import json
import math
import os
import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from reprlib import repr as shortened
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrg.datasets.folder import list_dir
from torchrg.datasets.rgbd_files import make_poses, read_array
from torchrg.depth.camera import Pinhole, check_camera
from torchrg.errors import DepthWarning, FormatError, TorchrgError, warn
from torchrg.io.files import PARSE_ERRORS, decode_file, wrap_errors
from torchrg.structures import FARTHEST

Entries = Mapping[str, Any]
SUFFIXES = ("", ".txt", ".csv", ".json", ".yaml", ".yml", ".npy", ".pincam", ".k")
"""Suffixes of files that may be camera files by their name."""
_SECTIONS = ("intrinsic", "intrinsics", "camera", "cam", "depth", "depth_intrinsics")
"""Sections that contain the camera of depth images: Open3D and NICE-SLAM."""
_LENS = (
    *("k1", "k2", "k3", "k4", "p1", "p2"),
    *("distortion_coefficients", "distCoeffs", "D", "d", "coeffs"),
)
"""Names of lens distortion coefficients, and of lists of them: ROS, OpenCV and RealSense."""
_PINHOLE_NAMES = {
    ("fl_x", "fl_y", "cx", "cy"): 0.5,
    ("fx", "fy", "cx", "cy"): 0.0,
    ("fx", "fy", "ppx", "ppy"): 0.0,
    ("fx_depth", "fy_depth", "mx_depth", "my_depth"): 0.0,
}
"""Names of focal lengths and principal point, with the coordinate of the center of pixel (0, 0):
nerfstudio and COLMAP; most programs; RealSense and ScanNet."""
_RECTIFIED = ("projection_matrix", "P", "p")
"""ROS names of the camera matrices of rectified (undistorted) images."""
_MATRICES = (
    *(*_RECTIFIED, "camera_matrix", "cameraMatrix", "K", "k", "cam_K"),
    *("intrinsic_matrix", "intrinsic", "intrinsics", "m_calibrationDepthIntrinsic"),
)
"""Names of camera matrices. ROS's rectified matrix comes first: depth images are rectified."""
_QUATERNION = (("x", "y", "z"), ("qx", "qy", "qz", "qw"))
"""Names of the position and the rotation of a camera."""
_SIDES = (
    *(("w", "h"), ("W", "H"), ("width", "height"), ("image_width", "image_height")),
    *(("m_depthWidth", "m_depthHeight"), ("depthWidth", "depthHeight")),
)
"""Names of image width and height."""
_SCALES = (
    *("m_depthShift", "png_depth_scale", "DepthMapFactor", "RGBD.DepthMapFactor"),
    *("depth_scale", "depth_unit_scale_factor"),
)
"""Names of the depth unit: BundleFusion, NICE-SLAM, ORB-SLAM, Open3D or librealsense, nerfstudio.
Values below 1 are meters per unit, others units per meter: no unit exceeds a meter."""
_SHAPES = {9: (3, 3), 12: (3, 4), 16: (4, 4)}
"""Shapes of cameras, projections and poses by their number of elements."""
_UNNAMED = (
    *("fx fy cx cy", "width height fx fy cx cy", "fx fy cx cy width height"),
    *("fx fy cx cy k1 k2 p1 p2", "fx fy cx cy k1 k2 p1 p2 k3"),
)
"""Names of unnamed numbers: ETH3D, ARKitScenes, PlaneRCNN, BAD SLAM."""
_COLMAP = re.compile(r"\d+ [A-Z][A-Z_]+ \d+ \d+ ")
"""Beginning of a camera in COLMAP's text format: ID, model, width, height; parameters follow."""
_COLMAP_NAMES = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")
_ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
"""COLMAP models with one focal length; the others have two."""
_MODELS = ("camera_model", "distortion_model", "type", "is_fisheye")
"""Names of the camera model: COLMAP, ROS, ORB-SLAM; instant-ngp's is a boolean."""
_NO_PINHOLE = re.compile("FISHEYE|EQUI|FOV|THIN_PRISM|OMNI|EUCM|KANNALA|PANORAM", re.IGNORECASE)
"""Parts of the names of camera models that are not pinhole."""
_NAMES = re.compile(
    r"(depth_)?(cameras?|cam|(camera_|cam_)?(intrinsics?|k|info|calib(ration)?)"
    r"|(camera_|cam_)(matrix|params?|parameters|primesense))(_depth)?|metadata|transforms"
)
"""Names of camera files without suffix, in lower case, with underscores for dashes."""
_FOLDERS = re.compile(r"intrinsics?|calib(ration)?|cameras?")
"""Names of folders that contain camera files."""
_AMBIGUOUS = ("info", "metadata", "transforms")
"""Names of files that often contain no camera, or several."""


def read_camera(path: Path) -> Pinhole:
    """Read a camera file; its content determines the format.

    Supported formats: unnamed numbers (``fx fy cx cy``, before or after ``width height``, or a
    matrix of 3 x 3, 3 x 4 or 4 x 4, also as ``.npy``); JSON (Open3D, nerfstudio, Replica,
    RealSense, Record3D); YAML (ROS, OpenCV, ORB-SLAM); ``name = numbers`` (BundleFusion, ScanNet);
    COLMAP's ``cameras.txt``.

    Raises:
        FormatError: If the file is missing, or contains no camera.

    Warns:
        DepthWarning: If the lens distorts images, or a focal length is negative.
    """
    record = read_entries(path)
    if isinstance(record.get("frames"), list) and "fl_x" not in record:
        raise FormatError(
            f"{path}: expected one camera, got one per frame; pass its folder to convert rgbd."
        )
    return parse_camera(path, record)


def read_entries(path: Path) -> Entries:
    """Return the names and values of a camera file in any format."""
    if path.suffix.lower() == ".npy":
        return _name_numbers(path, read_array(path).astype(np.float64).ravel().tolist())
    text = decode_file(path)
    lines = (re.split(r"[\s,;\[\]()]+", line.partition("#")[0]) for line in text.splitlines())
    rows = [row for row in (" ".join(filter(None, line)) for line in lines) if row]
    numbers: list[float] = []
    with suppress(ValueError):
        numbers = [float(word) for row in rows for word in row.split()]
    if numbers:
        return _name_numbers(path, numbers)
    if re.search(r"^\s*[\w.]+\s*=", text, re.MULTILINE):
        return read_info(path)
    if rows and all(_COLMAP.match(row) for row in rows):
        return _colmap_camera(path, rows)
    content = read_mapping(path, repair="; correct it, or pass --intrinsics fx,fy,cx,cy")
    # ORB-SLAM's names have a prefix.
    record: Entries = {re.sub(r"^Camera1?\.", "", f"{name}"): content[name] for name in content}
    for section in _SECTIONS:
        record = {**record, **record[section]} if isinstance(record.get(section), dict) else record
    return record


def _name_numbers(path: Path, numbers: list[float]) -> Entries:
    """Return unnamed numbers as a record; their count determines the names.

    If several names fit, the optical axis nearest to the center of the image decides.
    """
    names = (text.split() for text in _UNNAMED)
    records = [dict(zip(n, numbers, strict=True)) for n in names if len(n) == len(numbers)]
    if records and not (len(numbers) in _SHAPES and (numbers[1] == 0 or numbers[-1] == 1)):
        return min(records, key=lambda row: abs(row["cx"] / (row.get("width") or math.inf) - 0.5))
    if len(numbers) not in _SHAPES:
        raise FormatError(
            f"{path}: expected a matrix of 3 x 3, 3 x 4 or 4 x 4, fx fy cx cy, or width height fx "
            f"fy cx cy, got {len(numbers):,} numbers; pass --intrinsics fx,fy,cx,cy."
        )
    return {"intrinsic": numbers}


def _colmap_camera(path: Path, rows: list[str]) -> Entries:
    """Return the camera in COLMAP's ``cameras.txt``, with nerfstudio's names."""
    if len(rows) > 1:
        raise FormatError(f"{path}: expected one camera, got {len(rows):,}; pass --intrinsics.")
    _, model, *words = rows[0].split()
    with wrap_errors(f"{path}: expected numbers after {model}, got: ", ValueError):
        width, height, *numbers = map(float, words)
    values = numbers[:1] * (model in _ONE_FOCAL) + numbers
    named = dict(zip(_COLMAP_NAMES, values, strict=False))
    return {"camera_model": model, "w": width, "h": height, **named}


def read_mapping(path: Path, repair: str = "; correct it") -> dict[str, Any]:
    """Read JSON or the first YAML document as a dict."""
    import yaml

    text = decode_file(path)
    is_json = path.suffix.lower() == ".json" or text.lstrip()[:1] == "{"
    with wrap_errors(f"{path}: expected JSON or YAML, got: ", *PARSE_ERRORS, repair=repair):
        if is_json:
            content: Any = json.loads(text)
        else:
            # OpenCV's YAML has a header, a tag, tabs, and names without a blank after the colon.
            text = re.sub(r"^%YAML:.*$|!!opencv-matrix", "", text, flags=re.MULTILINE)
            text = re.sub(r"^([\w.]+):(?=[\w.+-])", r"\1: ", text.expandtabs(), flags=re.MULTILINE)
            try:
                if any(isinstance(token, yaml.AliasToken) for token in yaml.scan(text)):
                    raise ValueError("aliases, which can expand without bounds")
                content = next(iter(yaml.safe_load_all(text)), None)
            except yaml.YAMLError as error:
                words = re.sub(r'"<unicode string>", |\^', "", f"{error}").split()
                raise ValueError(" ".join(words)) from error
    if not isinstance(content, dict):
        got = repr(content[:40]) if isinstance(content, str) else type(content).__name__
        raise FormatError(f"{path}: expected names with values, got {got}.")
    return content


def read_info(path: Path) -> dict[str, Any]:
    """Read lines of ``name = numbers``; single numbers are scalars, and text lines are skipped."""
    record: dict[str, Any] = {}
    for name, _, words in (line.partition("=") for line in decode_file(path).splitlines()):
        with suppress(ValueError):
            numbers = [float(word) for word in words.split()]
            record[name.strip()] = numbers[0] if len(numbers) == 1 else numbers
    return record


def parse_camera(path: Path, record: Entries) -> Pinhole:
    """Return the camera in a record with any of the known names."""
    size = _image_size(path, record)
    values = ((name, record.get(name)) for name in _MODELS)
    models = (name if value in (True, 1) else str(value) for name, value in values)
    if model := next(filter(_NO_PINHOLE.search, models), ""):
        raise FormatError(
            f"{path}: expected a pinhole camera, got {model}; undistort images, as COLMAP does."
        )
    fx, fy, cx, cy = _read_pinhole(path, record)
    if distorted := _distortions(record):
        warn(
            f"{path}: lens distortion ({', '.join(distorted)}) is not corrected; undistort images "
            "whose planes bend at the edges.",
            DepthWarning,
        )
    if min(fx, fy) < 0:
        warn(
            f"{path}: a negative focal length, {min(fx, fy):g}, flips the image; remove the minus "
            "sign unless that is intended.",
            DepthWarning,
        )
    scales = (parse_number(path, record, name) for name in _SCALES if name in record)
    scale = next(scales, None)
    return Pinhole(fx, fy, cx, cy, size, 1 / scale if scale and 0 < scale < 1 else scale)


def parse_pose(path: Path, record: Entries) -> Tensor | None:
    """Return the pose in a record, camera to world, ``(4, 4)``; None if it has no known name."""
    if "qx" in record:
        parts = ([[parse_number(path, record, n) for n in names]] for names in _QUATERNION)
        return make_poses(*(torch.tensor(part, dtype=torch.float64) for part in parts))[0]
    key = "transform_matrix" if "transform_matrix" in record else "pose"
    if key == "pose" and record.get(key) is None:
        return None
    pose = torch.eye(4, dtype=torch.float64)
    rows = parse_matrix(path, record, key, columns=4)
    pose[: len(rows)] = rows
    return pose


def _read_pinhole(path: Path, record: Entries) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy of a record, with pixel (0, 0) centered at 0."""
    matches = [names for names in _PINHOLE_NAMES if names[0] in record]
    if matches:
        names = max(matches, key=lambda names: len(record.keys() & {*names}))
        fx, fy, cx, cy = (parse_number(path, record, name) for name in names)
        if 0 in (fx, fy):
            raise FormatError(f"{path}: expected nonzero {names[0]} and {names[1]}, got 0.")
        return fx, fy, cx - _PINHOLE_NAMES[names], cy - _PINHOLE_NAMES[names]
    for name in _MATRICES:
        if name in record:
            matrix = parse_matrix(path, record, name)[:3, :3]
            # Open3D stores matrices in column-major order.
            matrix = matrix.T if matrix[2, :2].any() else matrix
            check_camera(f"{path}", matrix)
            (fx, _, cx), (_, fy, cy) = matrix[:2].tolist()
            return fx, fy, cx, cy
    raise FormatError(
        f"{path}: expected a camera, as fl_x, fl_y, cx, cy or a matrix, got only "
        f"{', '.join(map(str, record))[:60]}; add it, or pass --intrinsics fx,fy,cx,cy."
    )


def _distortions(record: Entries) -> list[str]:
    """Return the names of nonzero distortion coefficients; none if the images are rectified."""
    names = [] if record.keys() & {*_RECTIFIED} else [name for name in _LENS if name in record]
    values = {name: record[name] for name in names}
    values = {n: v.get("data") if isinstance(v, dict) else v for n, v in values.items()}
    return [n for n, value in values.items() if (any(value) if isinstance(value, list) else value)]


def parse_matrix(path: Path, record: Entries, key: str, columns: int = 3) -> Tensor:
    """Return a matrix of 3 or 4 rows and at least ``columns`` columns, stored nested or flat."""
    value = record.get(key)
    with suppress(TypeError, ValueError, OverflowError):
        data = value.get("data") if isinstance(value, dict) else value
        values = torch.from_numpy(np.asarray(data, dtype=np.float64).ravel())
        has_bool = bool in map(type, np.asarray(data, dtype=object).flat)
        if len(values) in _SHAPES and _SHAPES[len(values)][1] >= columns and not has_bool:
            return values.view(_SHAPES[len(values)])
    raise FormatError(f"{path}: expected {key} to be a matrix, got {shortened(value)}; correct it.")


def parse_number(path: Path, record: Entries, key: str) -> float:
    """Return a finite number of a record, within FARTHEST."""
    value = record.get(key)
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if value is None or not (is_number and abs(value) <= FARTHEST):
        raise FormatError(f"{path}: expected a number for {key}, got {shortened(value)}; add it.")
    return float(value)


def _image_size(path: Path, record: Entries) -> tuple[int, int] | None:
    """Return image width and height of a record, or None."""
    for names in _SIDES:
        if names[0] in record:
            width, height = (int(parse_number(path, record, name)) for name in names)
            if min(width, height) < 1:
                raise FormatError(f"{path}: {names[0]} and {names[1]} must be positive.")
            return width, height
    return None


def find_camera(folder: Path, root: Path) -> tuple[Pinhole, Path] | None:
    """Return the camera of the depth images in a folder and its file, or None.

    Camera files are searched in the folder, in its parents up to the parent of ``root``, and in
    camera folders in these. The nearest folder wins, and a file named after depth precedes others.
    Files with ambiguous names are skipped if they contain no camera.

    Raises:
        FormatError: If a camera file is corrupt.

    Warns:
        DepthWarning: If another file there has another camera, or the file is outside ``root``.
    """
    # Links are not resolved: the parents of a recording are those in its path.
    start, top = (Path(os.path.abspath(path)) for path in (folder, root))  # noqa: PTH100
    above = (parent for parent in start.parents if parent.is_relative_to(top.parent))
    for parent in (folder, *above):
        is_outside = parent != folder and not parent.is_relative_to(top)
        cameras: dict[Path, Pinhole] = {}
        for path in _camera_files(parent):
            is_ambiguous = path.stem.lower().strip("_") in (*_AMBIGUOUS, parent.name.lower())
            with suppress(*(TorchrgError,) if is_ambiguous or is_outside or cameras else ()):
                cameras[path] = read_camera(path)
        if cameras:
            (path, camera), *remaining = cameras.items()
            if is_outside:
                warn(
                    f"{root}: using the camera of {path}, outside this folder; pass --intrinsics "
                    "to choose another.",
                    DepthWarning,
                )
            for other, found in remaining:
                if found[:4] != camera[:4] and ("depth" in other.name) == ("depth" in path.name):
                    warn(
                        f"{path}: used as the camera, although {other.name} differs; pass "
                        "--intrinsics to choose.",
                        DepthWarning,
                    )
            return camera, path
    return None


def _camera_files(folder: Path) -> list[Path]:
    """Return the camera files in a folder and its camera folders, depth cameras first.

    The list is empty if the folder is missing or unreadable.
    """
    files: list[Path] = []
    with suppress(OSError):
        files += list_dir(folder)
        for parent in [path for path in files if _FOLDERS.fullmatch(path.name.lower())]:
            files += list_dir(parent) if parent.is_dir() else []
    names = {path: path.stem.lower().replace("-", "_").strip("_") for path in files}
    found = [
        path
        for path in files
        if path.suffix.lower() in SUFFIXES
        and (_NAMES.fullmatch(names[path]) or (path.suffix == ".txt" and path.stem == folder.name))
        and path.is_file()
    ]
    return sorted(found, key=lambda path: ("depth" not in names[path], names[path] in _AMBIGUOUS))
