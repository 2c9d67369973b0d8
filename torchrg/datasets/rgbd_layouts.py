"""Folder shapes of depth frames: benchmarks, data sets, and captures of phones.

A new shape is a function here that lists the frames of a recording, a row of :data:`LAYOUTS`, its
name among the choices of ``torchrg convert rgbd``, and a test.
"""

import re
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.datasets.camera_files import (
    camera_of,
    matrix_of,
    number_of,
    read_info,
    read_record,
)
from torchrg.datasets.folder import check_folder, files_below, listed, natural_key, warn_of_links
from torchrg.datasets.rgbd_files import (
    DEPTH_SUFFIXES,
    known_pose,
    read_axis_angles,
    read_matrix,
    read_nearest,
    read_numbers,
    read_timed,
    read_trajectory,
)
from torchrg.depth.camera import Pinhole
from torchrg.errors import ConfigError, DepthWarning, FormatError
from torchrg.io.files import refusing

_COLOR_SUFFIXES = (".png", ".jpg", ".jpeg")
_TUM_INTRINSICS = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3),
    "freiburg2": (520.9, 521.0, 325.1, 249.7),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}
"""fx, fy, cx, cy of the three cameras, as the data set gives them."""
_ICL_NUIM_INTRINSICS = (481.2, -480.0, 319.5, 239.5)
"""The scenes were rendered with y upwards: rows count against it."""
_SEVEN_SCENES_INTRINSICS = (585.0, 585.0, 320.0, 240.0)
_KINECT_SIZE = (640, 480)
"""Width and height of the images of these cameras."""
_NO_DEPTH = frozenset(
    re.findall(
        "[a-z]+",
        "albedo annotation annotations color colors confidence curvature extrinsics instance "
        "instances intrinsic intrinsics label labels mask masks normal normals plane planes pose "
        "poses rendered rgb seg segmentation segmentations semantic semantics semseg",
    )
)
"""Words in the names of files and folders whose images are not depth."""
_IPHONES = ("", "iphone/", "*/iphone/", "data/*/iphone/")
_SCANNETPP_COLOR = {"width": 1920, "height": 1440}
"""Sides of the colour images, which the intrinsics of ScanNet++ are of."""
_NERFSTUDIO_UNIT = 0.001
"""Metres that one stored value is worth for nerfstudio where no file says another."""
_OPENGL_AXES = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))
"""From the axes of our cameras to those of OpenGL: x right, y up, z backwards."""


class ListedFrame(NamedTuple):
    """A frame as a folder lists it, with its own camera and scale where a recording has none."""

    name: str
    depth: Path
    color: Path | None = None
    pose: Tensor | None = None
    sources: tuple[Path, ...] = ()
    camera: Pinhole | None = None
    depth_scale: float | None = None


Camera = Callable[[Path], Pinhole]
"""Returns the camera of a recording that has no camera file."""


class FrameLayout(NamedTuple):
    """The shape of a folder of frames.

    Attributes:
        frames: Yields the frames of a recording in natural order.
        mark: Pattern of the name of an entry of every recording; nothing where a folder is one.
        camera: The camera of a recording without a camera file, None where none is known or frames
            have their own.
        depth_scale: Stored value of one metre, None where frames have their own or none is known.
        no_depth: As of :class:`torchrg.datasets.RGBDFrame`.
        places: Where recordings are below a folder of several, as patterns.
        signs: Patterns of further entries, one of which tells the layout from others with the same
            mark; nothing where the mark is enough, no pattern where a folder does not show it.
    """

    frames: Callable[[Path], Iterable[ListedFrame]]
    mark: str = ""
    camera: Camera | None = None
    depth_scale: float | None = None
    no_depth: int | None = None
    places: tuple[str, ...] = ("", "*/")
    signs: tuple[str, ...] = ("",)


def _tum_frames(folder: Path) -> Iterator[ListedFrame]:
    """Yield the frames of TUM RGB-D, which are listed in ``depth.txt``.

    Colour (``rgb.txt``) and pose (``groundtruth.txt``) of a depth image are those nearest in time;
    without one, the frame has none.
    """
    lists = [folder / file for file in ("depth.txt", "rgb.txt", "groundtruth.txt")]
    times, images = read_timed(lists[0])
    colors = read_nearest(times, lists[1], read_timed)
    poses = read_nearest(times, lists[2], read_trajectory)
    sources = tuple(path for path in lists if path.is_file())
    for image, color, pose in zip(images, colors, poses, strict=True):
        beside = None if color is None else folder / color
        yield ListedFrame(Path(image).stem, folder / image, beside, pose, sources)


def _tum_camera(folder: Path) -> Pinhole:
    """Return the camera of a recording by its name."""
    name = folder.resolve().name.lower()
    for camera, values in _TUM_INTRINSICS.items():
        if camera in name:
            return Pinhole(*values, _KINECT_SIZE)
    raise ConfigError(
        f"{folder}: expected intrinsics, as the name says none of {', '.join(_TUM_INTRINSICS)}; "
        "pass them."
    )


def _icl_nuim_frames(folder: Path) -> Iterator[ListedFrame]:
    """Yield the frames of ICL-NUIM in its TUM-compatible form: ``depth/0.png``, ``rgb/0.png``.

    There is perhaps one trajectory ``*.gt.freiburg``, whose first column is the number of the
    image.
    """
    tracks = tuple(sorted(folder.glob("*.gt.freiburg"))[:1])
    numbers, matrices = read_trajectory(tracks[0]) if tracks else ([], [])
    poses = {f"{number:.0f}": pose for number, pose in zip(numbers, matrices, strict=True)}
    for name, image in _depth_images(folder, "depth/*"):
        yield ListedFrame(name, image, _color_image(folder / "rgb" / name), poses.get(name), tracks)


def _named_frames(depth: str, color: str, pose: str) -> Callable[[Path], Iterator[ListedFrame]]:
    """Return what yields frames by the names of their files, where ``*`` is that of the frame."""

    def frames(folder: Path) -> Iterator[ListedFrame]:
        for name, image in _depth_images(folder, depth):
            if name.endswith(".rendered"):
                continue
            path = folder / pose.replace("*", name)
            posed = (known_pose(read_matrix(path)), (path,)) if path.is_file() else (None, ())
            yield ListedFrame(name, image, _color_image(folder / color.replace("*", name)), *posed)

    return frames


def _depth_images(folder: Path, pattern: str) -> Iterator[tuple[str, Path]]:
    """Yield names and depth images of a folder, in natural order; the pattern has no suffix."""
    place, _, name = pattern.rpartition("/")
    before, after = name.split("*")
    check_folder(folder / place)
    for path in listed(folder / place):
        fits = path.stem.startswith(before) and path.stem.endswith(after)
        if path.suffix.lower() in DEPTH_SUFFIXES and fits:
            yield path.stem.removeprefix(before).removesuffix(after), path


def _color_image(path: Path) -> Path | None:
    """Return the colour image of a path without its suffix, None if there is none."""
    paths = (path.with_name(f"{path.name}{suffix}") for suffix in _COLOR_SUFFIXES)
    return next((path for path in paths if path.is_file()), None)


def _same_camera(fx: float, fy: float, cx: float, cy: float) -> Camera:
    """Return what gives every recording the same camera."""
    return lambda folder: Pinhole(fx, fy, cx, cy, _KINECT_SIZE)


def _scannet_camera(folder: Path) -> Pinhole:
    """Refuse a scan without a camera file."""
    raise FormatError(
        f"{folder}: expected intrinsic/intrinsic_depth.txt or intrinsics_depth.txt, got none; add "
        "it, or pass --intrinsics."
    )


def _all_images(folder: Path) -> Iterator[ListedFrame]:
    """Yield all depth images below a folder, by one camera, without colours and poses.

    Where names speak of depth, the images without that word are left out, and everywhere those
    whose names speak of something else.

    Warns:
        DepthWarning: If images are left out.
    """
    images = [path for path in files_below(folder) if path.suffix.lower() in DEPTH_SUFFIXES]
    words = {
        path: {*re.findall("[a-z]+", path.relative_to(folder).as_posix().lower())}
        for path in images
    }
    chosen = [path for path in images if words[path].isdisjoint(_NO_DEPTH)]
    if any("depth" in words[path] for path in chosen):
        chosen = [path for path in chosen if "depth" in words[path]]
    if others := [path for path in images if path not in {*chosen}]:
        warnings.warn(
            f"{folder}: left out {len(others):,} of {len(images):,} images, which are not depth by "
            f"their names, {others[0].relative_to(folder)} first; rename them if they are.",
            DepthWarning,
            stacklevel=2,
        )
    for path in chosen:
        yield ListedFrame(path.relative_to(folder).with_suffix("").as_posix(), path)


def _nerfstudio_frames(folder: Path) -> Iterator[ListedFrame]:
    """Yield the frames of ``transforms.json``, which nerfstudio and its importers write.

    Its cameras have the axes of OpenGL, and what stands in a frame goes before what all share.
    """
    path = folder / "transforms.json"
    shared = read_record(path)
    frames = shared.get("frames", [])
    is_list = isinstance(frames, list) and all(isinstance(frame, dict) for frame in frames)
    if not is_list or not all(frame.get("depth_file_path") for frame in frames):
        raise FormatError(
            f"{path}: expected a list of frames, each with depth_file_path; name the depth images "
            "there, as ns-process-data polycam --use-depth does, and leave out frames without."
        )
    for frame in sorted(frames, key=lambda frame: natural_key(str(frame["depth_file_path"]))):
        record = {**shared, **frame}
        image = Path(str(record["depth_file_path"]))
        name = Path(image.as_posix().removesuffix(image.suffix))
        steps = [step for step in name.parts if step not in ("..", name.anchor)]
        color = folder / str(record.get("file_path"))
        unit = None if image.suffix.lower() == ".npy" else _NERFSTUDIO_UNIT
        if "depth_unit_scale_factor" in record:
            unit = number_of(path, record, "depth_unit_scale_factor")
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3] = matrix_of(path, record, "transform_matrix", columns=4)[:3]
        yield ListedFrame(
            "/".join(steps),
            folder / image,
            color if color.suffix.lower() in _COLOR_SUFFIXES and color.is_file() else None,
            known_pose(pose @ _OPENGL_AXES),
            (path,),
            camera_of(path, record),
            unit and 1 / unit,
        )


def _arkitscenes_frames(folder: Path) -> Iterator[ListedFrame]:
    """Yield the frames of ARKitScenes: ``lowres_depth/<video>_<seconds>.png``.

    Cameras are files of the same name, whose times are a millisecond off in some, and poses stand
    in ``lowres_wide.traj``.
    """
    images = [*_depth_images(folder, "lowres_depth/*")]
    with refusing(
        f"{folder / 'lowres_depth'}: expected seconds at the ends of names: ", ValueError
    ):
        times = [float(name.rpartition("_")[2]) for name, _ in images]
    track = folder / "lowres_wide.traj"
    tracks = (track,) if track.is_file() else ()
    poses = read_nearest(times, track, read_axis_angles)
    for (name, image), time, pose in zip(images, times, poses, strict=True):
        beside = folder / "lowres_wide_intrinsics" / f"{name}.pincam"
        video = name.rpartition("_")[0]
        near = [beside.with_name(f"{video}_{time + off:.3f}.pincam") for off in (-0.001, 0.001)]
        path = next((path for path in (beside, *near) if path.is_file()), beside)
        names = ("width", "height", "fx", "fy", "cx", "cy")
        record = dict(zip(names, read_numbers(path, 6, " ".join(names))[0], strict=True))
        camera = camera_of(path, record)
        color = _color_image(folder / "lowres_wide" / name)
        yield ListedFrame(name, image, color, pose, (path, *tracks), camera)


def _replica_frames(folder: Path) -> Iterator[ListedFrame]:
    """Yield the frames of Replica as NICE-SLAM gives them: ``results/depth000000.png``.

    The number of an image is that of its row in ``traj.txt``; the rooms share a camera.
    """
    places = [folder / "cam_params.json", folder.resolve().parent / "cam_params.json"]
    calibration = next((path for path in places if path.is_file()), places[0])
    record = read_record(calibration, "camera")
    camera = camera_of(calibration, record)
    scale = number_of(calibration, record, "scale")
    track = folder / "traj.txt"
    rows = read_numbers(track, 16, "16 numbers, those of a matrix,")
    poses = torch.tensor(rows, dtype=torch.float64).view(-1, 4, 4)
    for name, image in _depth_images(folder, "results/depth*"):
        color = _color_image(folder / "results" / f"frame{name}")
        has_row = name.isdecimal() and int(name) < len(poses)
        pose = known_pose(poses[int(name)]) if has_row else None
        yield ListedFrame(name, image, color, pose, (calibration, track), camera, scale)


def _scannetpp_frames(folder: Path) -> Iterator[ListedFrame]:
    """Yield the frames of an iPhone of ScanNet++, ``depth/frame_000000.png``, in the aligned world.

    A frame without an aligned pose has none.
    """
    path = folder / "pose_intrinsic_imu.json"
    if not (folder / "depth").is_dir():
        raise FormatError(
            f"{folder}: expected images in depth, got none; take them out of depth.bin by "
            "iphone/prepare_iphone_data.py of the data set's toolbox."
        )
    records = read_record(path)
    for name, image in _depth_images(folder, "depth/*"):
        record = records.get(name)
        if not isinstance(record, dict):
            raise FormatError(f"{path}: expected {name}, of which there is depth, got no such.")
        camera = camera_of(path, _SCANNETPP_COLOR | record)
        has_pose = record.get("aligned_pose") is not None
        pose = known_pose(matrix_of(path, record, "aligned_pose", 4)) if has_pose else None
        color = _color_image(folder / "rgb" / name)
        yield ListedFrame(name, image, color, pose, (path,), camera)


def _3rscan_frames(folder: Path) -> Iterator[ListedFrame]:
    """Yield the frames of 3RScan, ``frame-000000.depth.pgm``, and of others with ``_info.txt``."""
    path = folder / "_info.txt"
    record = read_info(path)
    camera = camera_of(path, record)
    scale = number_of(path, record, "m_depthShift")
    for frame in _named_frames("*.depth", "*.color", "*.pose.txt")(folder):
        yield frame._replace(sources=(path, *frame.sources), camera=camera, depth_scale=scale)


LAYOUTS = {
    "scannetpp": FrameLayout(
        _scannetpp_frames,
        "pose_intrinsic_imu.json",
        depth_scale=1000.0,
        places=_IPHONES,
    ),
    "arkitscenes": FrameLayout(
        _arkitscenes_frames,
        "lowres_depth",
        depth_scale=1000.0,
        places=("", "*/", "*/*/", "*/*/*/"),
    ),
    "3rscan": FrameLayout(_3rscan_frames, "_info.txt", places=("", "*/", "*/sequence/")),
    "replica": FrameLayout(_replica_frames, "traj.txt"),
    "tum": FrameLayout(_tum_frames, "depth.txt", _tum_camera, 5000.0),
    "icl-nuim": FrameLayout(
        _icl_nuim_frames, "depth", _same_camera(*_ICL_NUIM_INTRINSICS), 5000.0, signs=()
    ),
    "scannet": FrameLayout(
        _named_frames("depth/*", "color/*", "pose/*.txt"),
        "depth",
        _scannet_camera,
        1000.0,
        places=("", "*/", "*/*/"),
        signs=("intrinsic*_depth.txt", "intrinsic*/intrinsic*_depth.txt"),
    ),
    "7-scenes": FrameLayout(
        _named_frames("*.depth", "*.color", "*.pose.txt"),
        "frame-*.depth.png",
        _same_camera(*_SEVEN_SCENES_INTRINSICS),
        1000.0,
        no_depth=65535,
        places=("", "*/", "*/*/"),
    ),
    "nerfstudio": FrameLayout(_nerfstudio_frames, "transforms.json"),
    "images": FrameLayout(_all_images),
}
"""Shapes of folders of frames by their names, as :func:`find_layout` tries them: ScanNet++ (ICCV,
2023); ARKitScenes (NeurIPS, 2021); 3RScan (RIO, ICCV, 2019); Replica as in NICE-SLAM (CVPR, 2022);
J. Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems, IROS, 2012; A. Handa et al.,
A benchmark for RGB-D visual odometry, 3D reconstruction and SLAM, ICRA, 2014; ScanNet (CVPR, 2017)
as its reader exports it; J. Shotton et al., Scene coordinate regression forests, CVPR, 2013;
Nerfstudio (SIGGRAPH, 2023); and any other."""


def find_layout(root: Path) -> str:
    """Return the layout whose mark a folder has, and its sign where the mark is not enough.

    It is ``images`` where there is no mark.
    """
    for name, layout in LAYOUTS.items():
        for folder in _marked(root, layout) if layout.mark and layout.signs else ():
            if any(not sign or any(folder.glob(sign)) for sign in layout.signs):
                return name
    return "images"


def find_recordings(root: Path, layout: FrameLayout) -> Iterator[tuple[str, Path]]:
    """Yield the recordings in a folder, which may be one itself, with the folder of their names.

    One that is there under several names has the one without links, or else the one that comes
    first.
    """
    check_folder(root)
    if not layout.mark:
        yield "", root
        return
    marked = sorted({*_marked(root, layout)}, key=lambda path: natural_key(str(path)))
    first_names: dict[Path, Path] = {}
    for path in sorted(marked, key=lambda path: path != root and path.is_symlink()):
        first_names.setdefault(path.resolve(), path)
    folders = [path for path in marked if first_names[path.resolve()] == path]
    passed = [path for path in marked if path not in folders]
    warn_of_links(root, [path for path in passed if not {*path.parents} & {*passed}])
    if not folders:
        raise FormatError(f"{root}: expected recordings with {layout.mark} in them, got none.")
    for folder in folders:
        inside = folder.resolve().name if folder == root else folder.relative_to(root).as_posix()
        yield f"{inside}/", folder


def _marked(root: Path, layout: FrameLayout) -> Iterator[Path]:
    """Return the folders with the mark of a layout, each perhaps several times."""
    return (path.parent for place in layout.places for path in root.glob(place + layout.mark))
