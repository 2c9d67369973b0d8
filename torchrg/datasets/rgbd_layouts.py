"""Folder layouts of depth frames.

A new layout needs a function that lists the frames of a recording, a row of :data:`FRAME_LAYOUTS`,
a choice of ``torchrg convert rgbd``, and a test.
"""

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.datasets.camera_files import (
    Entries,
    parse_camera,
    parse_matrix,
    parse_number,
    read_camera,
    read_entries,
    read_mapping,
)
from torchrg.datasets.folder import check_folder, find_files, list_dir, natural_key, warn_skipped
from torchrg.datasets.rgbd_files import (
    DEPTH_SUFFIXES,
    make_poses,
    read_axis_angles,
    read_columns,
    read_matrix,
    read_nearest,
    read_numbers,
    read_timed,
    read_trajectory,
)
from torchrg.depth.camera import Pinhole
from torchrg.errors import DepthWarning, FormatError, warn
from torchrg.io.files import PARSE_ERRORS, wrap_errors

_COLOR_SUFFIXES = (".png", ".jpg", ".jpeg")
_TUM_INTRINSICS = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3),
    "freiburg2": (520.9, 521.0, 325.1, 249.7),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}
"""fx, fy, cx, cy of the three cameras, from the data set's documentation."""
_KINECT_SIZE = (640, 480)
"""Width and height of the images of all built-in cameras, in pixels."""
_ICL_NUIM_CAMERA = Pinhole(481.2, -480.0, 319.5, 239.5, _KINECT_SIZE)
"""The scenes were rendered with y up, so the vertical focal length is negative."""
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
_INTRINSICS = ("fx", "fy", "cx", "cy")
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
        camera: Function that returns the camera of a recording without a camera file, if it is
            known; None if it never is, or is per frame.
        depth_scale: Depth units per meter in images of integers; None if unknown or per frame.
        array_scale: The same for ``.npy`` and ``.exr``.
        locations: Path patterns of recordings below the root folder.
        signs: Patterns of further entries, one of which distinguishes layouts with the same mark;
            ``("",)`` if the mark is enough, empty if the layout cannot be detected.
    """

    frames: Callable[[Path], Iterable[ListedFrame]]
    mark: str = ""
    camera: Callable[[Path], Pinhole | None] | None = None
    depth_scale: float | None = None
    array_scale: float | None = None
    locations: tuple[str, ...] = ("", "*/")
    signs: tuple[str, ...] = ("",)


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


def _tum_camera(folder: Path) -> Pinhole | None:
    """Return the camera of a recording from its name, or None."""
    name = folder.resolve().name.lower()
    cameras = (values for camera, values in _TUM_INTRINSICS.items() if camera in name)
    return next((Pinhole(*values, _KINECT_SIZE) for values in cameras), None)


def _icl_nuim_frames(folder: Path) -> Iterator[ListedFrame]:
    """Yield the frames of ICL-NUIM in its TUM-compatible form: ``depth/0.png``, ``rgb/0.png``.

    An optional trajectory ``*.gt.freiburg`` has the image number in its first column.
    """
    tracks = tuple(sorted(folder.glob("*.gt.freiburg"))[:1])
    poses = dict(zip(*read_trajectory(tracks[0]), strict=True)) if tracks else {}
    for frame in _list_frames(folder, "depth/*", "rgb/*"):
        yield frame._replace(pose=poses.get(_number(frame)), sources=tracks)


def _named_frames(depth: str, color: str, pose: str) -> Callable[[Path], Iterator[ListedFrame]]:
    """Return a function that yields frames by file name patterns; ``*`` is the frame name."""

    def frames(folder: Path) -> Iterator[ListedFrame]:
        for frame in _list_frames(folder, depth, color):
            path = folder / pose.replace("*", frame.name)
            is_posed = path.is_file()
            if not frame.name.endswith(".rendered"):
                yield frame._replace(pose=read_matrix(path), sources=(path,)) if is_posed else frame

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
    """Return the number that names a frame, or NaN: its index, ID or time."""
    return float(frame.name) if re.fullmatch(r"\d+(\.\d*)?", frame.name) else math.nan


def _by_row(poses: Tensor) -> dict[float, Tensor]:
    """Return poses ``(n, 4, 4)`` by their row, from 0."""
    return {float(row): pose for row, pose in enumerate(poses)}


def _numbered_frames(
    frames: Iterable[ListedFrame],
    track: Path,
    poses: Mapping[float, Tensor],
    camera: Callable[[ListedFrame], tuple[Path, Entries]],
) -> Iterator[ListedFrame]:
    """Yield frames with the poses of their numbers in a file, and a camera from a file's entries.

    Raises:
        FormatError: If no frame has a pose there.
    """
    listed = [*frames]
    if listed and not any(_number(frame) in poses for frame in listed):
        raise FormatError(
            f"{track}: expected a pose of one of {len(listed):,} images, {listed[0].name} first, "
            "got none; export the images and poses of one recording."
        )
    for frame in listed:
        path, entries = camera(frame)
        pose, pinhole = poses.get(_number(frame)), parse_camera(path, entries)
        yield frame._replace(pose=pose, sources=(path, track), camera=pinhole)


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

    Its cameras have OpenGL's axes, and values of a frame override shared values.
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
    for frame in sorted(frames, key=lambda frame: natural_key(str(frame["depth_file_path"]))):
        record = {**shared, **frame}
        image = _listed_path(Path(), record["depth_file_path"])
        name = Path(image.as_posix().removesuffix(image.suffix))
        parts = [step for step in name.parts if step not in ("..", name.anchor)]
        color = _listed_path(folder, record.get("file_path"))
        pose = torch.eye(4, dtype=torch.float64)
        rows = parse_matrix(path, record, "transform_matrix", columns=4)
        pose[: len(rows)] = rows
        yield ListedFrame(
            "/".join(parts),
            folder / image,
            color if color.suffix.lower() in _COLOR_SUFFIXES and color.is_file() else None,
            pose @ _OPENGL_AXES,
            (path,),
            parse_camera(path, record),
        )


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
    rows = read_numbers(track, 16, "16 numbers, those of a matrix,")
    matrices = torch.tensor(rows, dtype=torch.float64).view(-1, 4, 4)
    frames = _list_frames(folder, "results/depth*", "results/frame*")
    return _numbered_frames(frames, track, _by_row(matrices), lambda _: (calibration, entries))


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
        camera = parse_camera(path, _PHONE_COLOR | record)
        has_pose = record.get("aligned_pose") is not None
        pose = parse_matrix(path, record, "aligned_pose", 4) if has_pose else None
        yield frame._replace(pose=pose, sources=(path,), camera=camera)


def _stray_frames(folder: Path) -> Iterator[ListedFrame]:
    """Yield the frames of Stray Scanner: ``depth/000000.png``, with rows of ``odometry.csv``.

    Cameras are columns there in later versions, else ``camera_matrix.csv`` is the camera.
    """
    track, shared = folder / "odometry.csv", folder / "camera_matrix.csv"
    table = read_columns(track, "frame", "x", "y", "z", "qx", "qy", "qz", "qw")
    poses = dict(zip(table[:, 0].tolist(), make_poses(table[:, 1:4], table[:, 4:]), strict=True))
    own: dict[float, Entries] = {}
    with suppress(FormatError):
        for number, *row in read_columns(track, "frame", *_INTRINSICS).tolist():
            own[number] = dict(zip(_INTRINSICS, row, strict=True))

    def camera(frame: ListedFrame) -> tuple[Path, Entries]:
        entries = own.get(_number(frame)) or read_entries(shared)
        return track if own else shared, {**entries, **_PHONE_COLOR}

    frames = _list_frames(folder, "depth/*", "", "confidence/*")
    return _numbered_frames(frames, track, poses, camera)


def _polycam_frames(folder: Path) -> Iterator[ListedFrame]:
    """Yield the frames of Polycam's raw data: ``keyframes/depth/<time>.png``, in OpenGL's axes.

    If poses are optimized (``corrected_cameras``), frames without an optimized pose have none.
    """
    inside = folder / "keyframes"
    corrected, cameras = inside / "corrected_cameras", inside / "cameras"
    is_optimized = any(corrected.glob("*.json"))
    for frame in _list_frames(inside, "depth/*", "images/*", "confidence/*"):
        paths = [parent / f"{frame.name}.json" for parent in (corrected, cameras)]
        path = next(filter(Path.is_file, paths), paths[1])
        record = read_mapping(path)
        cells = [parse_number(path, record, f"t_{i // 4}{i % 4}") for i in range(12)]
        pose = torch.tensor([*cells, 0, 0, 0, 1], dtype=torch.float64).view(4, 4) @ _OPENGL_AXES
        yield frame._replace(
            pose=None if is_optimized and path.parent == cameras else pose,
            sources=(path,),
            camera=parse_camera(path, record),
        )


def _record3d_frames(folder: Path) -> Iterator[ListedFrame]:
    """Yield the frames of Record3D, ``depth/0.exr``, whose cameras have OpenGL's axes.

    Poses in ``metadata.json`` are rows of ``qx qy qz qw tx ty tz``. Intrinsics per frame, if
    present, replace the shared matrix.
    """
    path = folder / "metadata.json"
    record = read_mapping(path)
    rows, cameras = (record.get(name) or [] for name in ("poses", "perFrameIntrinsicCoeffs"))
    with wrap_errors(f"{path}: expected poses of 7 and intrinsics of 4 numbers: ", *PARSE_ERRORS):
        table = torch.tensor(rows, dtype=torch.float64).view(len(rows), 7)
        own = [dict(zip(_INTRINSICS, row, strict=True)) for row in cameras]
        matrices = torch.stack(make_poses(table[:, 4:], table[:, :4])) @ _OPENGL_AXES

    def camera(frame: ListedFrame) -> tuple[Path, Entries]:
        number = _number(frame)
        return path, {**record, **(own[int(number)] if number < len(own) else {})}

    frames = _list_frames(folder, "depth/*", "rgb/*", "confidence/*")
    return _numbered_frames(frames, path, _by_row(matrices), camera)


def _rtabmap_frames(folder: Path) -> Iterator[ListedFrame]:
    """Yield the frames that ``rtabmap-export`` writes: ``<map>_depth/<ID or time>.png``.

    Cameras are ``<map>_calib/<ID or time>.yaml``, and poses ``<map>_camera_poses.txt``.
    """
    for images in sorted(folder.glob("*_depth")):
        base = images.name.removesuffix("_depth")
        track, calibration = folder / f"{base}_camera_poses.txt", folder / f"{base}_calib"
        columns = "stamp x y z qx qy qz qw id (--poses_camera --poses_format 11)"
        table = torch.tensor(read_numbers(track, 9, columns), dtype=torch.float64)
        frames = [*_list_frames(folder, f"{images.name}/*", f"{base}_rgb/*")]
        names = {_number(frame) for frame in frames}
        # The more frequent kind of name.
        numbers = max(table[:, [8, 0]].T.tolist(), key=lambda column: len(names & {*column}))
        poses = dict(zip(numbers, make_poses(table[:, 1:4], table[:, 4:8]), strict=True))

        def camera(frame: ListedFrame, parent: Path = calibration) -> tuple[Path, Entries]:
            path = parent / f"{frame.name}.yaml"
            return path, read_mapping(path)

        yield from _numbered_frames(frames, track, poses, camera)


_DOTTED_FRAMES = _named_frames("*.depth", "*.color", "*.pose.txt")
FRAME_LAYOUTS = {
    "scannetpp": FrameLayout(
        _scannetpp_frames,
        "pose_intrinsic_imu.json",
        depth_scale=1000.0,
        locations=("", "iphone/", "*/iphone/", "data/*/iphone/"),
    ),
    "arkitscenes": FrameLayout(
        _arkitscenes_frames,
        "lowres_depth",
        depth_scale=1000.0,
        locations=("", "*/", "*/*/", "*/*/*/"),
    ),
    "3rscan": FrameLayout(
        _DOTTED_FRAMES, "_info.txt", depth_scale=1000.0, locations=("", "*/", "*/sequence/")
    ),
    "replica": FrameLayout(_replica_frames, "traj.txt"),
    "stray": FrameLayout(
        _stray_frames,
        "odometry.csv",
        depth_scale=1000.0,
        array_scale=1000.0,
        signs=("camera_matrix.csv",),
    ),
    "polycam": FrameLayout(
        _polycam_frames, "keyframes", depth_scale=1000.0, signs=("keyframes/*cameras",)
    ),
    "record3d": FrameLayout(
        _record3d_frames,
        "metadata.json",
        depth_scale=1000.0,
        array_scale=1.0,
        locations=("", "*/", "*/*/"),
        signs=("depth/0.*",),
    ),
    "rtabmap": FrameLayout(_rtabmap_frames, "*_depth", depth_scale=1000.0, signs=("*_calib",)),
    "tum": FrameLayout(_tum_frames, "depth.txt", _tum_camera, 5000.0),
    "icl-nuim": FrameLayout(
        _icl_nuim_frames, "depth", lambda folder: _ICL_NUIM_CAMERA, 5000.0, signs=()
    ),
    "scannet": FrameLayout(
        _named_frames("depth/*", "color/*", "pose/*.txt"),
        "depth",
        depth_scale=1000.0,
        locations=("", "*/", "*/*/"),
        signs=("intrinsic*_depth.txt", "intrinsic*/intrinsic*_depth.txt"),
    ),
    "7-scenes": FrameLayout(
        _DOTTED_FRAMES,
        "frame-*.depth.png",
        lambda folder: _SEVEN_SCENES_CAMERA,
        1000.0,
        locations=("", "*/", "*/*/"),
    ),
    "nerfstudio": FrameLayout(_nerfstudio_frames, "transforms.json", depth_scale=1000.0),
    "images": FrameLayout(_all_images),
}
"""Layouts by name, in the order that :func:`find_layout` tries them: ScanNet++ (ICCV, 2023);
ARKitScenes (NeurIPS, 2021); 3RScan (RIO, ICCV, 2019); Replica as in NICE-SLAM (CVPR, 2022);
J. Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems, IROS, 2012; A. Handa et al.,
A benchmark for RGB-D visual odometry, 3D reconstruction and SLAM, ICRA, 2014; ScanNet (CVPR, 2017)
as its reader exports it; J. Shotton et al., Scene coordinate regression forests, CVPR, 2013;
Nerfstudio (SIGGRAPH, 2023); and any other folder. Stray Scanner, Polycam and Record3D are apps,
and ``rtabmap-export`` belongs to RTAB-Map."""


def find_layout(root: Path) -> str:
    """Detect the layout of a folder by its mark, and its sign if the mark is ambiguous.

    Default: ``images``.
    """
    for name, layout in FRAME_LAYOUTS.items():
        for folder in _marked_folders(root, layout) if layout.mark and layout.signs else ():
            if any(not sign or any(folder.glob(sign)) for sign in layout.signs):
                return name
    return "images"


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
    return (path.parent for prefix in layout.locations for path in root.glob(prefix + layout.mark))
