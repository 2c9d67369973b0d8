"""``torchrg depth``: planes of depth images and of organised clouds, found in the image."""

import itertools
import time
import warnings
from collections.abc import Collection
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from torchrg.batch.memory import available_memory
from torchrg.batch.records import describe_run
from torchrg.batch.sources import write_frame
from torchrg.cli import flags
from torchrg.cli.arguments import Argument, parse
from torchrg.cli.ending import say, warn, warnings_as_lines
from torchrg.cli.loop import check_apart, note_input, output_paths, paths_beside, run_each
from torchrg.datasets import RGBDFrame, RGBDFrames
from torchrg.datasets.rgbd import fit_camera
from torchrg.datasets.rgbd_files import (
    DEPTH_SUFFIXES,
    num_pixels,
    read_depth,
    refuse_recording,
)
from torchrg.depth import DepthConfig, find_intrinsics, segment_depth
from torchrg.depth.camera import Pinhole, find_misfit, numbers_of, points_of_image
from torchrg.errors import ConfigError, DepthWarning, FormatError
from torchrg.io import FORMATS, RESULT_FIELDS, check_output, read_cloud, write_cloud
from torchrg.io.files import check_place, make_folder
from torchrg.plane_table import TABLE_SUFFIXES, describe_planes
from torchrg.render import color_planes, write_png
from torchrg.result import PLANES_FILE, write_table
from torchrg.structures import Cloud

_COLORED_FROM = 200
"""Pixels along the longer side, evenly apart, that tell which planes are next to each other and
must differ in colour. Choosing colours from all pixels would take as long as finding the planes."""
_NO_IMAGES = ("planes", "points", "neighbors", "sampling", "num_copies")
"""Parts of a segmentation of an image that are no images."""
_MAX_MISFIT = 0.01
"""Median distance of points from their pixels, as a fraction of the longer side of the image, up to
which a camera may be that of a cloud."""
_MIN_BYTES_A_PIXEL = 300
"""Memory that labelling takes at least for each pixel."""


@dataclass(frozen=True)
class Arguments:
    """Label the planes of depth images, or of organised clouds taken as such.

    Labels are written as a 16-bit PNG (0 is no plane, the first plane is 1) with a coloured picture
    and a table of the planes, .json, beside it, or as a cloud. Into a directory each image writes a
    folder with the files of torchrg convert rgbd, which is for sequences and other folders. All
    results are in camera coordinates.

    Examples:
        torchrg depth frame.png --intrinsics 525,525,319.5,239.5 --depth-scale 1000 --out labels.png
        torchrg depth frame.png --intrinsics camera.json --depth-scale 1000 --out labels.png
        torchrg depth kinect.pcd --out planes.ply
        torchrg depth *.png --intrinsics 525,525,319.5,239.5 --depth-scale 1000 --out results
    """

    inputs: Annotated[tuple[Path, ...], Argument("IMAGE", is_positional=True)]
    """Depth images (.png or .pgm of 16 bits, .npy), folders with one of them, or organised clouds
    (.pcd)."""
    out: Path
    """File to write, .png for labels or a cloud by its suffix; for several inputs a directory, and
    for a folder, unless it has such a suffix. A directory gets a folder for each image, with coord,
    normal, curvature and plane as .npy, and planes.json."""
    intrinsics: flags.IntrinsicsFlag = None
    depth_scale: flags.DepthScaleFlag = None
    picture: Path | None = None
    """Place of the coloured picture, a .png file; for several inputs a directory. Default: beside
    labels that are written as .png, with _planes in its name."""
    table: flags.TableFlag = None
    depth: DepthConfig = field(default_factory=DepthConfig)
    """How planes are found."""
    orient: flags.ImageOrientFlag = "auto"
    threads: flags.ThreadsFlag = None


def run(argv: list[str]) -> int:
    """Parse the arguments, segment each image and write its result."""
    arguments = parse(Arguments, argv, prog="torchrg depth")
    flags.use_threads(arguments.threads)
    camera = flags.parse_intrinsics(arguments.intrinsics)
    frames = [_find_frame(arguments, camera, path) for path in arguments.inputs]
    sources = [camera if frame is None else frame for frame in frames]
    inputs = [
        path if frame is None else frame.depth
        for path, frame in zip(arguments.inputs, frames, strict=True)
    ]
    if any(path.is_dir() for path in arguments.inputs) and not arguments.out.suffix:
        make_folder(arguments.out)
    is_folder = arguments.out.is_dir() or (
        len(inputs) > 1 and arguments.out.suffix.lower() not in (".png", *FORMATS)
    )
    targets = output_paths(inputs, arguments.out, suffix="" if is_folder else ".png")
    pictures = paths_beside(targets, arguments.picture, suffixes=(".png",))
    asked = paths_beside(targets, arguments.table, suffixes=TABLE_SUFFIXES)
    tables = [set() if path is None else {path} for path in asked]
    if not is_folder and _is_png(targets[0]):
        if arguments.picture is None:
            pictures = [targets[0].with_name(f"{targets[0].stem}_planes.png")]
        tables[0].add(targets[0].with_suffix(".json"))
    beside = [
        path for path in (*pictures, *itertools.chain(*map(sorted, tables))) if path is not None
    ]
    check_apart([*targets, *beside], [*inputs, Path(arguments.intrinsics or "")])
    for path in beside:
        check_place(path)
    for path in targets if is_folder else []:
        check_place(path / PLANES_FILE if path.is_dir() else path)
    folders = [is_folder] * len(inputs)
    return run_each(_label, arguments, inputs, sources, targets, folders, pictures, tables)


def _find_frame(arguments: Arguments, camera: Pinhole | None, path: Path) -> RGBDFrame | None:
    """Return the depth image that an input is, or that a folder holds; None of a cloud.

    Without a camera and a scale it is refused, before any is read.
    """
    refuse_recording(path)
    if path.is_dir():
        with warnings_as_lines():
            frame, *others = RGBDFrames.from_folder(
                path, intrinsics=camera, depth_scale=arguments.depth_scale
            ).frames
        if others:
            raise ConfigError(
                f"{path}: expected a folder of one depth image, got {1 + len(others):,}; use: "
                f"torchrg convert rgbd {path} OUT."
            )
        return frame
    if path.suffix.lower() not in DEPTH_SUFFIXES:
        if arguments.depth_scale is not None:
            warn(f"{path}: --depth-scale has no effect on a cloud, whose points keep their unit.")
        return None
    own = None if camera is None else camera.depth_scale
    scale = own if arguments.depth_scale is None else arguments.depth_scale
    if camera is None or scale is None:
        flag, hint = "--depth-scale", "1000 for millimetres, 1 for metres"
        if camera is None:
            flag, hint = "--intrinsics fx,fy,cx,cy", "or the file of the camera"
        raise ConfigError(
            f"{path}: expected {flag}, which depth images do not hold; pass it, {hint}."
        )
    matrix, doubt = fit_camera(path, camera)
    if doubt:
        warn(doubt)
    return RGBDFrame(path, matrix, scale)


def _label(
    arguments: Arguments,
    source: Path,
    given: RGBDFrame | Pinhole | None,
    target: Path,
    is_folder: bool,
    picture: Path | None,
    tables: Collection[Path],
) -> None:
    """Label an image, or a cloud with its camera, write the result, and print a line about it."""
    begin = time.perf_counter()
    _check_memory(source)
    scale = arguments.depth_scale
    if isinstance(given, RGBDFrame):
        scale = given.depth_scale
        with warnings_as_lines():
            cloud, depth, camera = _read_image(given)
    else:
        cloud, depth, camera = _read_cloud(source, given)
    is_image = _is_png(target)
    if not is_folder and not is_image:
        check_output(target, cloud)
    note_input(f"{source}", cloud, target, () if is_folder or is_image else RESULT_FIELDS)
    origin, pose = np.zeros(3), None
    if not is_folder:  # Results are about the cloud's origin.
        origin, pose = cloud.origin, torch.eye(4, dtype=torch.float64)
        pose[:3, 3] = -torch.from_numpy(origin)
    with warnings.catch_warnings():
        # The camera was checked against the size of the image, or found from the points.
        warnings.simplefilter("ignore", DepthWarning)
        seg = segment_depth(depth, camera, arguments.depth, pose=pose, orient=arguments.orient)
    points = cloud.points.view(*depth.shape, 3)
    num_planes = len(seg.planes)
    if num_planes == 0:
        warn(f"{source}: no plane found: {flags.reason_for_no_plane(arguments.depth)}.")
    if picture is not None:
        apart = -(-max(points.shape) // _COLORED_FROM)
        few = torch.full_like(points, torch.nan)
        few[::apart, ::apart] = points[::apart, ::apart]
        write_png(picture, color_planes(seg.labels, few) * (depth > 0)[..., None])
    if is_folder:
        write_frame(target, depth, torch.from_numpy(cloud.coordinates).view(*points.shape), seg)
    elif is_image:
        write_png(target, seg.labels + 1)
    else:
        provenance = describe_run(source, arguments.depth) | {
            "config": {"depth": asdict(arguments.depth)},
            "intrinsics": given and numbers_of(camera),
            "depth_scale": scale,
            "orient": arguments.orient,
        }
        images = {name: values for name, values in vars(seg).items() if name not in _NO_IMAGES}
        rows = replace(seg, **{name: image.flatten(0, 1) for name, image in images.items()})
        write_cloud(target, cloud, rows, provenance=provenance)
    for table in tables:
        write_table(table, describe_planes(seg.planes, origin=origin.tolist()))
    num_seen, (height, width) = int((depth > 0).sum()), depth.shape
    percent = 100 * int((seg.labels >= 0).sum()) / max(num_seen, 1)
    say(
        f"{source}: {width} x {height} pixels, {num_seen:,} with depth, {num_planes:,} planes, "
        f"{percent:.1f} % of these labelled, {time.perf_counter() - begin:.1f} s -> {target}"
    )


def _check_memory(image: Path) -> None:
    """Refuse an image that says it has more pixels than memory has room for, before it is read."""
    is_depth, free = image.suffix.lower() in DEPTH_SUFFIXES, available_memory()
    size = num_pixels(image) if is_depth else 0
    if (needed := size * _MIN_BYTES_A_PIXEL) > free:
        raise FormatError(
            f"{image}: expected an image that memory has room for, got {size:,} pixels, which take "
            f"at least {needed / 1e9:,.1f} GB of {free / 1e9:,.1f} that are free; make it smaller, "
            "or use a machine with more."
        )


def _is_png(path: Path) -> bool:
    """Return whether labels go to a path as an image."""
    return path.suffix.lower() == ".png"


def _read_image(frame: RGBDFrame) -> tuple[Cloud, Tensor, Tensor]:
    """Return the cloud of an image in camera coordinates, its depth ``(H, W)``, and its camera."""
    depth = read_depth(frame.depth, depth_scale=frame.depth_scale, no_depth=frame.no_depth)
    points = points_of_image(depth, frame.intrinsics).view(-1, 3).float()
    height, width = depth.shape
    cloud = Cloud(points.numpy(), grid_shape=(height, width), source=str(frame.depth))
    return cloud, depth, frame.intrinsics


def _read_cloud(path: Path, given: Pinhole | None) -> tuple[Cloud, Tensor, Tensor]:
    """Return an organised cloud, its depth ``(H, W)``, and its camera matrix.

    Without a camera that is found from the points.
    """
    cloud = read_cloud(path)
    if cloud.grid_shape is None:
        raise FormatError(
            f"{path}: expected an organised cloud, with a height above 1, got a list of points; "
            "use torchrg segment."
        )
    height, width = cloud.grid_shape
    points = torch.from_numpy(cloud.coordinates).view(height, width, 3)
    camera = find_intrinsics(points) if given is None else given.matrix((width, height), f"{path}")
    if camera is None:
        raise FormatError(
            f"{path}: expected points of a pinhole camera in its own coordinates, got others; "
            "use torchrg segment."
        )
    off = 0.0 if given is None else find_misfit(points, camera)
    if off > _MAX_MISFIT * max(height, width):
        raise FormatError(
            f"{path}: expected --intrinsics of the camera that the points are of, got one that "
            f"puts half of them {off:.3g} pixels or more off; leave it out."
        )
    depth = points[..., 2]
    return cloud, torch.where(depth.isfinite(), depth, 0.0), camera
