"""Folder layouts of depth frames.

A new layout needs a function that lists the frames of a recording, a row of :data:`FRAME_LAYOUTS`,
a choice of ``torchrg convert rgbd``, and a test.
"""

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.datasets.camera_files import (
    Entries,
    parse_camera,
    parse_number,
    parse_pose,
    read_camera,
    read_entries,
    read_mapping,
)
from torchrg.datasets.folder import check_folder, find_files, list_dir, natural_key, warn_skipped
from torchrg.datasets.rgbd_files import (
    DEPTH_SUFFIXES,
    read_axis_angles,
    read_nearest,
    read_numbers,
    read_table,
    read_timed,
    read_trajectory,
)
from torchrg.depth.camera import Pinhole
from torchrg.errors import DepthWarning, FormatError, warn
from torchrg.io.files import PARSE_ERRORS, wrap_errors

_COLOR_SUFFIXES = (".png", ".jpg", ".jpeg")
_KINECT_SIZE = (640, 480)
"""Width and height of the images of all built-in cameras, in pixels."""
_TUM_CAMERAS = {
    "freiburg1": Pinhole(517.3, 516.5, 318.6, 255.3, _KINECT_SIZE),
    "freiburg2": Pinhole(520.9, 521.0, 325.1, 249.7, _KINECT_SIZE),
    "freiburg3": Pinhole(535.4, 539.2, 320.1, 247.6, _KINECT_SIZE),
}
"""The three cameras in the data set's documentation."""
_SEVEN_SCENES_CAMERA = Pinhole(585.0, 585.0, 320.0, 240.0, _KINECT_SIZE)
_NON_DEPTH_WORDS = frozenset(
    re.findall(
        "[a-z]+",
        "albedo annotation annotations color colors confidence curvature extrinsics instance "
        "instances intrinsic intrinsics label labels mask masks normal normals plane planes pose "
        "poses rendered rgb seg segmentation segmentations semantic semantics semseg",
    )
)
"""Words in the names of files and folders of images that are not depth."""
_PHONE_COLOR = {"width": 1920, "height": 1440}
"""Size of an iPhone's color images, to which intrinsics of ScanNet++ and Stray Scanner refer."""
_OPENGL_AXES = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))
"""Conversion between torchrg's camera axes and OpenGL's: x right, y up, z backwards."""


class ListedFrame(NamedTuple):
    """Frame listed in a folder, with its camera if that is per frame; the pose is as stored.

    The last of ``sources`` is the file of the pose.
    """

    name: str
    depth: Path
    color: Path | None = None
    pose: Tensor | None = None
    sources: tuple[Path, ...] = ()
    camera: Pinhole | None = None
    confidence: Path | None = None


class FrameLayout(NamedTuple):
    """Layout of a folder of frames.

    Attributes:
        frames: Function that yields the frames of a recording in natural order.
        mark: Name pattern of an entry in every recording; empty if any folder is a recording.
        depth_scale: Depth units per meter in images of integers; None if unknown or per frame.
        array_scale: The same for ``.npy`` and ``.exr``.
        signs: Patterns of further entries, one of which distinguishes layouts with the same mark,
            or ``file:text``. Default: the mark is enough.
        levels: Maximum depth of recordings below the root folder.
        axes: Rotation from torchrg's camera axes to the axes of poses, ``(4, 4)``. Default: none.
        cameras: Cameras of recordings without a camera file, by a part of the recording's name.
    """

    frames: Callable[[Path], Iterable[ListedFrame]]
    mark: str = ""
    depth_scale: float | None = None
    array_scale: float | None = None
    signs: tuple[str, ...] = ()
    levels: int = 1
    axes: Tensor | None = None
    cameras: Mapping[str, Pinhole] = MappingProxyType({})


def _tum_frames(folder: Path) -> Iterator[ListedFrame]:
    """Yield the frames of TUM RGB-D listed in ``depth.txt``.

    Color (``rgb.txt``) and pose (``groundtruth.txt``) are the nearest in time, or None.
    """
    lists = [folder / file for file in ("depth.txt", "rgb.txt", "groundtruth.txt")]
    times, images = read_timed(lists[0])
    colors = read_nearest(times, lists[1], read_timed)
    poses = read_nearest(times, lists[2], read_trajectory)
    sources = tuple(path for path in lists if path.is_file())
    for image, color, pose in zip(images, colors, poses, strict=True):
        color_path = None if color is None else _listed_path(folder, color)
        path = _listed_path(folder, image)
        yield ListedFrame(path.stem, path, color_path, pose, sources)


def _listed_path(folder: Path, name: object) -> Path:
    """Return the path of a file listed by a program, which may run on Windows."""
    return folder / str(name).replace("\\", "/")


def _named_frames(depth: str, color: str, pose: str) -> Callable[[Path], Iterator[ListedFrame]]:
    """Return a function that yields frames by file name patterns; ``*`` is the frame name."""

    def frames(folder: Path) -> Iterator[ListedFrame]:
        for frame in _list_frames(folder, depth, color):
            path = folder / pose.replace("*", frame.name)
            if path.is_file():
                rows = read_numbers(path, 4, "4 numbers, a row of a 4 x 4 matrix,")
                frame = frame._replace(pose=parse_pose(path, {"pose": rows}), sources=(path,))
            if not frame.name.endswith(".rendered"):
                yield frame

    return frames


def _list_frames(
    folder: Path, depth: str, color: str = "", confidence: str = ""
) -> Iterator[ListedFrame]:
    """Yield the depth images of a folder with their other images, in natural order.

    ``*`` in the patterns, which have no suffix, is the name of a frame.
    """
    subfolder, _, pattern = depth.rpartition("/")
    before, after = pattern.split("*")
    check_folder(folder / subfolder)
    for path in list_dir(folder / subfolder):
        fits = path.stem.startswith(before) and path.stem.endswith(after)
        if path.suffix.lower() in DEPTH_SUFFIXES and fits:
            name = path.stem.removeprefix(before).removesuffix(after)
            stems = (folder / pattern.replace("*", name) for pattern in (color, confidence))
            paths = ([path.with_name(path.name + end) for end in _COLOR_SUFFIXES] for path in stems)
            images = [next(filter(Path.is_file, endings), None) for endings in paths]
            yield ListedFrame(name, path, images[0], confidence=images[1])


def _number(frame: ListedFrame) -> float:
    """Return the number that names a frame, its index, ID or time; infinite if none does."""
    return float(frame.name) if re.fullmatch(r"\d+(\.\d*)?", frame.name) else math.inf


def _placed(frame: ListedFrame, record: Entries, path: Path, *others: Path) -> ListedFrame:
    """Return a frame with the camera in a record from a file, and the pose from the last file."""
    sources = (path, *others)
    camera, pose = parse_camera(path, record), parse_pose(sources[-1], record)
    return frame._replace(pose=pose, sources=sources, camera=camera)


def _all_images(folder: Path) -> Iterator[ListedFrame]:
    """Yield all depth images below a folder, with one camera, without colors and poses.

    Images whose names contain words for other content are skipped. If some names contain "depth",
    all images without it are skipped too.

    Warns:
        DepthWarning: If images are skipped.
    """
    images = [path for path in find_files(folder) if path.suffix.lower() in DEPTH_SUFFIXES]
    names = {path: path.relative_to(folder).as_posix().lower() for path in images}
    words = {path: {*re.findall("[a-z]+", name)} for path, name in names.items()}
    chosen = [path for path in images if words[path].isdisjoint(_NON_DEPTH_WORDS)]
    if any("depth" in words[path] for path in chosen):
        chosen = [path for path in chosen if "depth" in words[path]]
    if skipped := [path for path in images if path not in {*chosen}]:
        warn(
            f"{folder}: skipped {len(skipped):,} of {len(images):,} images that are not depth "
            f"by their names, {skipped[0].relative_to(folder)} first; rename them if they are.",
            DepthWarning,
        )
    for path in chosen:
        yield ListedFrame(path.relative_to(folder).with_suffix("").as_posix(), path)


def _nerfstudio_frames(folder: Path) -> Iterator[ListedFrame]:
    """Yield the frames in ``transforms.json`` of nerfstudio and its importers.

    Values of a frame override shared values.
    """
    path = folder / "transforms.json"
    shared = read_mapping(path)
    frames = shared.get("frames", [])
    is_list = isinstance(frames, list) and all(isinstance(frame, dict) for frame in frames)
    if not is_list or not all(frame.get("depth_file_path") for frame in frames):
        raise FormatError(
            f"{path}: expected a list of frames, each with depth_file_path; add the depth images "
            "there, as ns-process-data polycam --use-depth does, and remove frames without."
        )
    for entry in sorted(frames, key=lambda entry: natural_key(str(entry["depth_file_path"]))):
        record = {**shared, **entry, "transform_matrix": entry.get("transform_matrix")}
        image = _listed_path(Path(), record["depth_file_path"])
        name = Path(image.as_posix().removesuffix(image.suffix))
        parts = [step for step in name.parts if step not in ("..", name.anchor)]
        color = _listed_path(folder, record.get("file_path"))
        is_color = color.suffix.lower() in _COLOR_SUFFIXES and color.is_file()
        frame = ListedFrame("/".join(parts), folder / image, color if is_color else None)
        yield _placed(frame, record, path)


def _arkitscenes_frames(folder: Path) -> Iterator[ListedFrame]:
    """Yield the frames of ARKitScenes: ``lowres_depth/<video>_<seconds>.png``.

    Cameras are files of the same name, up to a millisecond; poses are in ``lowres_wide.traj``.
    """
    frames = [*_list_frames(folder, "lowres_depth/*", "lowres_wide/*", "confidence/*")]
    with wrap_errors(
        f"{folder / 'lowres_depth'}: expected seconds at the ends of names: ", ValueError
    ):
        times = [float(frame.name.rpartition("_")[2]) for frame in frames]
    track = folder / "lowres_wide.traj"
    tracks = (track,) if track.is_file() else ()
    poses = read_nearest(times, track, read_axis_angles)
    for frame, time, pose in zip(frames, times, poses, strict=True):
        exact = folder / "lowres_wide_intrinsics" / f"{frame.name}.pincam"
        video = frame.name.rpartition("_")[0]
        near = [exact.with_name(f"{video}_{time + off:.3f}.pincam") for off in (-0.001, 0.001)]
        path = next((path for path in (exact, *near) if path.is_file()), exact)
        yield frame._replace(pose=pose, sources=(path, *tracks), camera=read_camera(path))


def _replica_frames(folder: Path) -> Iterator[ListedFrame]:
    """Yield the frames of NICE-SLAM's Replica: ``results/depth000000.png``.

    The number of an image is its row in ``traj.txt``; the rooms share a camera.
    """
    locations = [folder / "cam_params.json", folder.resolve().parent / "cam_params.json"]
    calibration = next((path for path in locations if path.is_file()), locations[0])
    record = read_entries(calibration)
    entries = {**record, "depth_scale": parse_number(calibration, record, "scale")}
    track = folder / "traj.txt"
    table = enumerate(read_numbers(track, 16, "16 numbers of a matrix"))
    rows = {float(number): {"pose": row} for number, row in table}
    for frame in _list_frames(folder, "results/depth*", "results/frame*"):
        yield _placed(frame, {**entries, **rows.get(_number(frame), {})}, calibration, track)


def _scannetpp_frames(folder: Path) -> Iterator[ListedFrame]:
    """Yield the iPhone frames of ScanNet++, ``depth/frame_000000.png``, in the aligned world.

    Frames without an aligned pose have none.
    """
    path = folder / "pose_intrinsic_imu.json"
    if not (folder / "depth").is_dir():
        raise FormatError(
            f"{folder}: expected images in depth, got none; extract them from depth.bin with "
            "iphone/prepare_iphone_data.py of the data set's toolbox."
        )
    records = read_mapping(path)
    for frame in _list_frames(folder, "depth/*", "rgb/*"):
        record = records.get(frame.name)
        if not isinstance(record, dict):
            raise FormatError(f"{path}: expected an entry for {frame.name}, got none.")
        # Poses before alignment are in another world.
        aligned = {"pose": record.get("aligned_pose")}
        yield _placed(frame, {**_PHONE_COLOR, **record, **aligned}, path)


def _stray_frames(folder: Path) -> Iterator[ListedFrame]:
    """Yield the frames of Stray Scanner: ``depth/000000.png``, with rows of ``odometry.csv``.

    Rows of later versions have cameras, which precede the one in ``camera_matrix.csv``.
    """
    path, track = folder / "camera_matrix.csv", folder / "odometry.csv"
    shared, rows = read_entries(path), {row["frame"]: row for row in read_table(track, "frame")}
    for frame in _list_frames(folder, "depth/*", "", "confidence/*"):
        record = {**shared, **rows.get(_number(frame), {}), **_PHONE_COLOR}
        yield _placed(frame, record, path, track)


def _polycam_frames(folder: Path) -> Iterator[ListedFrame]:
    """Yield the frames of Polycam's raw data, ``keyframes/depth/<time>.png``.

    If poses are optimized (``corrected_cameras``), frames without an optimized pose have none.
    """
    inside = folder / "keyframes"
    corrected, cameras = inside / "corrected_cameras", inside / "cameras"
    is_optimized = any(corrected.glob("*.json"))
    for frame in _list_frames(inside, "depth/*", "images/*", "confidence/*"):
        paths = [parent / f"{frame.name}.json" for parent in (corrected, cameras)]
        path = next(filter(Path.is_file, paths), paths[1])
        record = read_mapping(path)
        if path == paths[0] or not is_optimized:
            names = (f"t_{cell // 4}{cell % 4}" for cell in range(12))
            record["pose"] = [parse_number(path, record, name) for name in names]
        yield _placed(frame, record, path)


def _record3d_frames(folder: Path) -> Iterator[ListedFrame]:
    """Yield the frames of Record3D, ``depth/0.exr``; their numbers are rows of ``metadata.json``.

    Intrinsics per frame, if any, precede the shared matrix.
    """
    path = folder / "metadata.json"
    shared = read_mapping(path)
    columns = {"poses": "qx qy qz qw x y z", "perFrameIntrinsicCoeffs": "fx fy cx cy"}
    rows: dict[float, Entries] = {}
    with wrap_errors(f"{path}: expected {columns}, got: ", *PARSE_ERRORS):
        for key, names in columns.items():
            for number, row in enumerate(shared.get(key) or ()):
                named = dict(zip(names.split(), row, strict=True))
                rows[number] = {**rows.get(number, {}), **named}
    for frame in _list_frames(folder, "depth/*", "rgb/*", "confidence/*"):
        yield _placed(frame, {**shared, **rows.get(_number(frame), {})}, path)


def _rtabmap_frames(folder: Path) -> Iterator[ListedFrame]:
    """Yield the frames that ``rtabmap-export`` writes: ``<map>_depth/<ID or time>.png``.

    Cameras are ``<map>_calib/<ID or time>.yaml``, and poses ``<map>_camera_poses.txt``.
    """
    names = "stamp x y z qx qy qz qw id"
    for track in sorted(folder.glob("*_camera_poses.txt")):
        base = track.name.removesuffix("_camera_poses.txt")
        table = read_numbers(track, 9, f"{names} (--poses_format 11)")
        rows = [dict(zip(names.split(), row, strict=True)) for row in table]
        frames = [*_list_frames(folder, f"{base}_depth/*", f"{base}_rgb/*")]
        numbers = {_number(frame) for frame in frames}
        by_key = [{row[key]: row for row in rows} for key in ("id", "stamp")]
        poses = max(by_key, key=lambda poses: len(numbers & poses.keys()))
        for frame in frames:
            path = folder / f"{base}_calib" / f"{frame.name}.yaml"
            yield _placed(
                frame, {**read_mapping(path), **poses.get(_number(frame), {})}, path, track
            )


_DOTTED_FRAMES = _named_frames("*.depth", "*.color", "*.pose.txt")
FRAME_LAYOUTS = {
    "scannetpp": FrameLayout(_scannetpp_frames, "pose_intrinsic_imu.json", 1000.0, levels=3),
    "arkitscenes": FrameLayout(_arkitscenes_frames, "lowres_depth", 1000.0, levels=3),
    "3rscan": FrameLayout(_DOTTED_FRAMES, "_info.txt", 1000.0, levels=2),
    "replica": FrameLayout(_replica_frames, "traj.txt"),
    "stray": FrameLayout(_stray_frames, "odometry.csv", 1000.0, 1000.0, ("camera_matrix.csv",)),
    "polycam": FrameLayout(
        _polycam_frames, "keyframes", 1000.0, signs=("keyframes/*cameras",), axes=_OPENGL_AXES
    ),
    "record3d": FrameLayout(
        _record3d_frames, "metadata.json", 1000.0, 1.0, ('metadata.json:"poses"',), 2, _OPENGL_AXES
    ),
    "rtabmap": FrameLayout(_rtabmap_frames, "*_camera_poses.txt", 1000.0, signs=("*_calib",)),
    "tum": FrameLayout(_tum_frames, "depth.txt", 5000.0, cameras=_TUM_CAMERAS),
    "scannet": FrameLayout(
        _named_frames("depth/*", "color/*", "pose/*.txt"),
        "depth",
        1000.0,
        signs=("intrinsic*_depth.txt", "intrinsic*/intrinsic*_depth.txt"),
        levels=2,
    ),
    "7-scenes": FrameLayout(
        _DOTTED_FRAMES, "frame-*.depth.png", 1000.0, levels=2, cameras={"": _SEVEN_SCENES_CAMERA}
    ),
    "nerfstudio": FrameLayout(_nerfstudio_frames, "transforms.json", 1000.0, axes=_OPENGL_AXES),
    "images": FrameLayout(_all_images),
}
"""Layouts by name, in the order that :func:`find_layout` tries them: ScanNet++ (ICCV, 2023);
ARKitScenes (NeurIPS, 2021); 3RScan (RIO, ICCV, 2019); Replica as in NICE-SLAM (CVPR, 2022);
J. Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems, IROS, 2012; ScanNet (CVPR,
2017) as its reader exports it; J. Shotton et al., Scene coordinate regression forests, CVPR, 2013;
Nerfstudio (SIGGRAPH, 2023); and any other folder. Stray Scanner, Polycam and Record3D are apps,
and ``rtabmap-export`` belongs to RTAB-Map."""


def find_layout(root: Path) -> str:
    """Detect the layout of a folder by its mark, and its sign if the mark is ambiguous.

    Default: ``images``.
    """
    for name, layout in FRAME_LAYOUTS.items():
        for folder in _marked_folders(root, layout) if layout.mark else ():
            if not layout.signs or any(_has_sign(folder, sign) for sign in layout.signs):
                return name
    return "images"


def _has_sign(folder: Path, sign: str) -> bool:
    """Whether a folder has an entry by its pattern, with the text after a colon in it, if any."""
    pattern, _, text = sign.partition(":")
    return any(not text or text.encode() in path.read_bytes() for path in folder.glob(pattern))


def find_recordings(root: Path, layout: FrameLayout) -> Iterator[tuple[str, Path]]:
    """Yield the recordings in a folder (or the folder itself), with their name prefixes.

    For duplicates, the path without links is used, else the first path.
    """
    check_folder(root)
    if not layout.mark:
        yield "", root
        return
    marked = sorted({*_marked_folders(root, layout)}, key=lambda path: natural_key(str(path)))
    first_names: dict[Path, Path] = {}
    for path in sorted(marked, key=lambda path: path != root and path.is_symlink()):
        first_names.setdefault(path.resolve(), path)
    folders = [path for path in marked if first_names[path.resolve()] == path]
    skipped = [path for path in marked if path not in folders]
    warn_skipped(root, [path for path in skipped if not {*path.parents} & {*skipped}])
    if not folders:
        raise FormatError(f"{root}: expected recordings that contain {layout.mark}, got none.")
    for folder in folders:
        inside = folder.resolve().name if folder == root else folder.relative_to(root).as_posix()
        yield f"{inside}/", folder


def _marked_folders(root: Path, layout: FrameLayout) -> Iterator[Path]:
    """Return the folders with the mark of a layout, possibly with duplicates."""
    patterns = ("*/" * level + layout.mark for level in range(layout.levels + 1))
    return (path.parent for pattern in patterns for path in root.glob(pattern))
