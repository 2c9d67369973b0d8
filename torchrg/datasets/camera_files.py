"""Cameras from files of other programs, and the camera file of a folder of depth images."""

import json
import os
import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from reprlib import repr as shortened
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrg.datasets.folder import listed
from torchrg.depth.camera import Pinhole, check_camera
from torchrg.errors import DepthWarning, FormatError, TorchrgError
from torchrg.io.files import DAMAGES, check_file, read_text, refusing
from torchrg.structures import FARTHEST

Record = Mapping[str, Any]
SUFFIXES = ("", ".txt", ".csv", ".json", ".yaml", ".yml", ".npy", ".pincam", ".k")
"""Suffixes of files that are taken for camera files by their name."""
_SECTIONS = ("intrinsic", "intrinsics", "camera", "cam", "cam0", "depth", "depth_intrinsics")
"""Sections of a file that hold the camera of depth images: of Open3D, NICE-SLAM and Kalibr."""
_LENS = ("k1", "k2", "k3", "k4", "p1", "p2", "Camera.k1", "Camera.k2", "Camera1.k1", "Camera1.k2")
"""Names of the distortion of a lens."""
_LENS_LISTS = ("distortion_coefficients", "distortion_coeffs", "distCoeffs", "D", "d", "coeffs")
"""Names of the distortion of a lens as a list, in files of ROS, OpenCV, Kalibr and RealSense."""
_NUMBERS = {
    ("fl_x", "fl_y", "cx", "cy"): 0.5,
    ("fx", "fy", "cx", "cy"): 0.0,
    ("fx", "fy", "ppx", "ppy"): 0.0,
    ("fx_depth", "fy_depth", "mx_depth", "my_depth"): 0.0,
    ("Camera.fx", "Camera.fy", "Camera.cx", "Camera.cy"): 0.0,
    ("Camera1.fx", "Camera1.fy", "Camera1.cx", "Camera1.cy"): 0.0,
}
"""Names of focal lengths and optical axis, and where the middle of the first pixel is, in files of
nerfstudio and COLMAP; of most programs; of RealSense, ScanNet and ORB-SLAM."""
_RECTIFIED = ("projection_matrix", "P", "p")
"""Names of camera matrices of rectified images, without distortion, in files of ROS."""
_MATRICES = (
    *(*_RECTIFIED, "camera_matrix", "cameraMatrix", "K", "k", "cam_K"),
    *("intrinsic_matrix", "intrinsic", "intrinsics", "m_calibrationDepthIntrinsic"),
)
"""Names of camera matrices. Of ROS that of rectified images comes first, which depth images are."""
_SIDES = {
    "w": "h",
    "W": "H",
    "width": "height",
    "image_width": "image_height",
    "m_depthWidth": "m_depthHeight",
    "depthWidth": "depthHeight",
    "Camera.width": "Camera.height",
}
"""Names of the width and height of images."""
_SCALES = ("m_depthShift", "png_depth_scale", "DepthMapFactor", "RGBD.DepthMapFactor")
"""Names of the stored value of one meter in files of BundleFusion, NICE-SLAM and ORB-SLAM. A
``depth_scale`` means another thing in each program that writes it, and is left out."""
_SHAPES = {9: (3, 3), 12: (3, 4), 16: (4, 4)}
"""Shapes of cameras, projections and poses by the count of their numbers."""
_FOUR = ("fx", "fy", "cx", "cy")
_UNNAMED = {4: _FOUR, 6: ("width", "height", *_FOUR)}
"""Names of numbers without names, by their count: files of ETH3D and ARKitScenes."""
_COLMAP = re.compile(r"\d+ [A-Z][A-Z_]+ \d+ \d+ ")
"""Beginning of a camera of COLMAP's text: number, model, width and height; parameters follow."""
_COLMAP_NAMES = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")
_ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
"""Models of COLMAP that have one focal length; the others have two."""
_NO_PINHOLE = ("FISHEYE", "EQUIRECT", "FOV", "THIN_PRISM", "OMNI", "EUCM")
"""Words in the names of camera models whose images are bent."""
_NAMES = re.compile(
    r"(depth_)?(cameras?|cam|(camera_|cam_)?(intrinsics?|k|info|calib(ration)?)"
    r"|(camera_|cam_)(matrix|params?|parameters|primesense))(_depth)?|metadata|transforms"
)
"""Names of camera files without the suffix, in lower case, with dashes as underscores."""
_FOLDERS = re.compile(r"intrinsics?|calib(ration)?|cameras?")
"""Names of folders that hold camera files."""
_OTHERS = ("info", "metadata", "transforms")
"""Names of files that often hold no camera, or several."""


def read_camera(path: Path) -> Pinhole:
    """Read a camera, in whatever form a program writes it; the content tells which.

    These are numbers without names (``fx fy cx cy``, ``width height fx fy cx cy``, or a matrix of
    3 x 3, 3 x 4 or 4 x 4, also as ``.npy``), JSON (Open3D, nerfstudio, Replica, RealSense,
    Record3D), YAML (ROS, OpenCV, ORB-SLAM, Kalibr), ``name = numbers`` (BundleFusion, ScanNet), and
    ``cameras.txt`` of COLMAP.

    Raises:
        FormatError: If there is no such file, or no camera in it.

    Warns:
        DepthWarning: If the lens distorts images, which nothing takes back here, or a focal length
            is negative.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "camera.json"
        >>> camera = {"width": 8, "height": 6, "intrinsic_matrix": [9, 0, 0, 0, 9, 0, 3.5, 2.5, 1]}
        >>> _ = path.write_text(json.dumps(camera))
        >>> read_camera(path)[:5]
        (9.0, 9.0, 3.5, 2.5, (8, 6))
    """
    record = _read_any(path)
    if isinstance(record.get("frames"), list) and "fl_x" not in record:
        raise FormatError(
            f"{path}: expected one camera, got one for each frame, or none; give the folder of the "
            "file to torchrg convert rgbd."
        )
    return camera_of(path, record)


def _read_any(path: Path) -> Record:
    """Return the names and values of a camera file of any form."""
    if path.suffix.lower() == ".npy":
        return _named(path, _read_array(path))
    text = read_text(path)
    lines = (re.split(r"[\s,;\[\]()]+", line.partition("#")[0]) for line in text.splitlines())
    rows = [row for row in (" ".join(filter(None, line)) for line in lines) if row]
    numbers: list[float] = []
    with suppress(ValueError):
        numbers = [float(word) for row in rows for word in row.split()]
    if numbers:
        return _named(path, numbers)
    if re.search(r"^\s*[\w.]+\s*=", text, re.MULTILINE):
        return read_info(path)
    if rows and all(_COLMAP.match(row) for row in rows):
        return _colmap_camera(path, rows)
    record: Record = read_record(path)
    for section in _SECTIONS:
        record = {**record, **record[section]} if isinstance(record.get(section), dict) else record
    return record


def _read_array(path: Path) -> list[float]:
    """Return the numbers of a ``.npy`` file."""
    check_file(path)
    with refusing(f"{path}: expected the numbers of a camera, got: ", OSError, *DAMAGES):
        array = np.load(path, mmap_mode="r", allow_pickle=False)
        if array.dtype.kind not in "fiu" or array.size > max(_SHAPES):
            raise TypeError(f"shape {array.shape} and {array.dtype}")
        numbers: list[float] = array.astype(np.float64).ravel().tolist()
    return numbers


def _named(path: Path, numbers: list[float]) -> Record:
    """Return numbers without names under the names that their count tells."""
    if len(numbers) in _UNNAMED:
        return dict(zip(_UNNAMED[len(numbers)], numbers, strict=True))
    if len(numbers) not in _SHAPES:
        raise FormatError(
            f"{path}: expected a matrix of 3 x 3, 3 x 4 or 4 x 4, fx fy cx cy, or width height fx "
            f"fy cx cy, got {len(numbers):,} numbers; pass --intrinsics fx,fy,cx,cy."
        )
    return {"intrinsic": numbers}


def _colmap_camera(path: Path, rows: list[str]) -> Record:
    """Return the camera of COLMAP's ``cameras.txt``, under the names of nerfstudio."""
    if len(rows) > 1:
        raise FormatError(
            f"{path}: expected one camera, got {len(rows):,}; pass --intrinsics fx,fy,cx,cy."
        )
    _, model, *words = rows[0].split()
    with refusing(f"{path}: expected numbers after {model}, got: ", ValueError):
        width, height, *numbers = map(float, words)
    values = numbers[:1] * (model in _ONE_FOCAL) + numbers
    named = dict(zip(_COLMAP_NAMES, values, strict=False))
    return {"camera_model": model, "w": width, "h": height, **named}


def read_record(path: Path, *parts: str) -> dict[str, Any]:
    """Read the names and values of JSON, or of the first document of YAML, or of a part in it."""
    import yaml

    text = read_text(path)
    is_json = path.suffix.lower() == ".json" or text.lstrip()[:1] == "{"
    with refusing(f"{path}: expected JSON or YAML, got: ", yaml.YAMLError, *DAMAGES):
        if is_json:
            content = json.loads(text)
        else:
            # OpenCV marks its files and matrices in ways that YAML does not know.
            text = re.sub(r"^%YAML:.*$|!!opencv-matrix", "", text, flags=re.MULTILINE)
            if any(isinstance(token, yaml.AliasToken) for token in yaml.scan(text)):
                raise ValueError("aliases, which grow without bounds")
            content = next(iter(yaml.safe_load_all(text)), None)
    if not isinstance(content, dict):
        got = repr(content[:40]) if isinstance(content, str) else type(content).__name__
        raise FormatError(f"{path}: expected names with values, got {got}.")
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
    if any(word in model.upper() for word in _NO_PINHOLE):
        raise FormatError(
            f"{path}: expected images of a pinhole camera, got {model}; undistort them, as the "
            "image_undistorter of COLMAP does."
        )
    fx, fy, cx, cy = _numbers_of(path, record)
    if bent := [*_bent(record)]:
        warnings.warn(
            f"{path}: the distortion of the lens ({', '.join(bent)}) is left as it is; undistort "
            "images whose planes bend at the edges.",
            DepthWarning,
            stacklevel=2,
        )
    if min(fx, fy) < 0:
        warnings.warn(
            f"{path}: a negative focal length, {min(fx, fy):g}, turns the image over; leave out "
            "the minus unless that is meant.",
            DepthWarning,
            stacklevel=2,
        )
    scales = (number_of(path, record, name) for name in _SCALES if name in record)
    return Pinhole(fx, fy, cx, cy, size, next(scales, None))


def _numbers_of(path: Path, record: Record) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy of a record, where the middle of the first pixel is 0."""
    values = record.get("intrinsics", record.get("intrinsic"))
    if isinstance(values, list) and len(values) == len(_FOUR) and not isinstance(values[0], list):
        record = dict(zip(_FOUR, values, strict=True))
    known = [names for names in _NUMBERS if names[0] in record]
    if known:
        names = max(known, key=lambda names: len(record.keys() & {*names}))
        fx, fy, cx, cy = (number_of(path, record, name) for name in names)
        if 0 in (fx, fy):
            raise FormatError(f"{path}: expected {names[0]} and {names[1]} other than 0.")
        return fx, fy, cx - _NUMBERS[names], cy - _NUMBERS[names]
    for name in _MATRICES:
        if name in record:
            matrix = matrix_of(path, record, name)[:3, :3]
            # Open3D's numbers run along columns.
            matrix = matrix.T if matrix[2, :2].any() else matrix
            check_camera(f"{path}", matrix)
            (fx, _, cx), (_, fy, cy) = matrix[:2].tolist()
            return fx, fy, cx, cy
    raise FormatError(
        f"{path}: expected a camera, as fl_x, fl_y, cx, cy or a matrix, got none in "
        f"{', '.join(map(str, record))[:60]}; add it, or pass --intrinsics fx,fy,cx,cy."
    )


def _bent(record: Record) -> Iterator[str]:
    """Yield the names of the distortion of a lens that a record has, unless it was taken back."""
    if not any(name in record for name in _RECTIFIED):
        yield from (name for name in _LENS if record.get(name))
        for name in _LENS_LISTS:
            values = record.get(name)
            values = values.get("data") if isinstance(values, dict) else values
            if isinstance(values, list) and any(values):
                yield name


def matrix_of(path: Path, record: Record, key: str, columns: int = 3) -> Tensor:
    """Return a matrix of 3 or 4 rows and at least so many columns, nested or flat in a record."""
    value = record.get(key)
    with suppress(TypeError, ValueError, OverflowError):
        data = value.get("data") if isinstance(value, dict) else value
        values = torch.from_numpy(np.asarray(data, dtype=np.float64).ravel())
        if len(values) in _SHAPES and _SHAPES[len(values)][1] >= columns:
            return values.view(_SHAPES[len(values)])
    raise FormatError(f"{path}: expected {key} to be a matrix, got {shortened(value)}; repair it.")


def number_of(path: Path, record: Record, key: str) -> float:
    """Return a number of a record, finite and not so large that it is none in float64."""
    value = record.get(key)
    if not isinstance(value, (int, float)) or not abs(value) <= FARTHEST:
        raise FormatError(f"{path}: expected a number for {key}, got {shortened(value)}; add it.")
    return float(value)


def _size_of(path: Path, record: Record) -> tuple[int, int] | None:
    """Return width and height of a record's images, None where it names none."""
    sides = record.get("resolution")
    if isinstance(sides, list) and len(sides) == 2:
        record = dict(zip(("width", "height"), sides, strict=True))
    for names in _SIDES.items():
        if names[0] in record:
            width, height = (int(number_of(path, record, name)) for name in names)
            if min(width, height) < 1:
                raise FormatError(f"{path}: expected {names[0]} and {names[1]} above 0.")
            return width, height
    return None


def find_camera(folder: Path, root: Path) -> tuple[Pinhole, Path] | None:
    """Return the camera of the depth images in a folder and its file; None if there is no file.

    Camera files are in the folder or next to it, in one of the folders above up to ``root``, or
    next to that. The nearest one counts, and a file named after depth before others. Files whose
    names are not those of cameras alone are passed over where they hold none.

    Raises:
        FormatError: If a camera file is damaged.

    Warns:
        DepthWarning: If another file of the same folder has another camera, or the file is outside
            of ``root``.
    """
    # Links stay what they are: the folders above a recording are those that lead to it.
    start, top = (Path(os.path.abspath(path)) for path in (folder, root))  # noqa: PTH100
    above = (place for place in start.parents if place.is_relative_to(top.parent))
    for place in (folder, *above):
        is_outside = place != folder and not place.is_relative_to(top)
        cameras: dict[Path, Pinhole] = {}
        for path in _camera_files(place):
            is_doubtful = path.stem.lower().strip("_") in (*_OTHERS, place.name.lower())
            with suppress(*(TorchrgError,) if is_doubtful or is_outside or cameras else ()):
                cameras[path] = read_camera(path)
        if cameras:
            (path, camera), *others = cameras.items()
            if is_outside:
                warnings.warn(
                    f"{root}: taking the camera of {path}, outside of this folder; pass "
                    "--intrinsics to choose another.",
                    DepthWarning,
                    stacklevel=3,
                )
            for other, its in others:
                if its[:4] != camera[:4] and ("depth" in other.name) == ("depth" in path.name):
                    warnings.warn(
                        f"{path}: taken as the camera, although {other.name} has another; pass "
                        "--intrinsics to choose.",
                        DepthWarning,
                        stacklevel=2,
                    )
            return camera, path
    return None


def _camera_files(folder: Path) -> list[Path]:
    """Return the camera files of a folder and of its folders of cameras, those of depth first.

    There are none in a folder that is missing or not readable.
    """
    files: list[Path] = []
    with suppress(OSError):
        files += listed(folder)
        for place in [path for path in files if _FOLDERS.fullmatch(path.name.lower())]:
            files += listed(place) if place.is_dir() else []
    names = {path: path.stem.lower().replace("-", "_").strip("_") for path in files}
    found = [
        path
        for path in files
        if path.suffix.lower() in SUFFIXES
        and (_NAMES.fullmatch(names[path]) or (path.suffix == ".txt" and path.stem == folder.name))
        and path.is_file()
    ]
    return sorted(found, key=lambda path: ("depth" not in names[path], names[path] in _OTHERS))
