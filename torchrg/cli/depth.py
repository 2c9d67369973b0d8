"""``torchrg depth``: planes of depth images and of organized clouds."""

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
from torchrg.batch.sources import write_frame
from torchrg.cli import flags
from torchrg.cli.arguments import Argument, parse
from torchrg.cli.ending import print_warnings, warn
from torchrg.cli.loop import (
    check_distinct,
    has_suffix,
    note_input,
    output_paths,
    report_planes,
    run_each,
    sidecar_paths,
)
from torchrg.datasets import RGBDFrame
from torchrg.datasets.provenance import describe_run
from torchrg.datasets.rgbd import scale_camera
from torchrg.datasets.rgbd_files import DEPTH_SUFFIXES, num_pixels, refuse_form
from torchrg.depth import DepthConfig, find_intrinsics, segment_depth
from torchrg.depth.camera import Pinhole, format_intrinsics, reprojection_error, unproject_image
from torchrg.errors import ConfigError, DepthWarning, FormatError
from torchrg.io import FORMATS, RESULT_FIELDS, check_output, read_cloud, write_cloud
from torchrg.io.files import check_writable
from torchrg.io.plane_table import TABLE_SUFFIXES, describe_planes
from torchrg.io.result import PLANES_FILE, write_table
from torchrg.render import color_planes, write_png
from torchrg.structures import Cloud

_COLORING_PIXELS = 200
"""Number of pixels along the longer side, evenly spaced, from which adjacent planes are found to
color them differently. Coloring from all pixels would take as long as segmentation."""
_NOT_IMAGES = ("planes", "points", "neighbors", "sampling", "num_copies")
"""Fields of an image segmentation that are not images."""
_MAX_MISFIT = 0.01
"""Maximum median reprojection error of a camera that fits, as a fraction of the longer side."""
_MIN_BYTES_PER_PIXEL = 300
"""Lower bound of the memory for segmentation, in bytes per pixel."""


@dataclass(frozen=True)
class Arguments:
    """Segment depth images, or organized clouds, into planes.

    Writes the plane labels as a 16-bit PNG (0: no plane, 1: first plane) with a colored image and a
    plane table (.json) next to it, or as a point cloud. With an output directory, each image gets a
    folder with the files of torchrg convert rgbd, for sequences. Results are in camera coordinates.

    Examples:
        torchrg depth frame.png --intrinsics 525,525,319.5,239.5 --depth-scale 1000 --out labels.png
        torchrg depth frame.png --intrinsics camera.json --depth-scale 1000 --out labels.png
        torchrg depth kinect.pcd --out planes.ply
        torchrg depth *.png --intrinsics 525,525,319.5,239.5 --depth-scale 1000 --out results
    """

    inputs: Annotated[tuple[Path, ...], Argument("IMAGE", is_positional=True)]
    """Depth images (16-bit .png, .pgm, or .npy), or organized clouds (.pcd)."""
    out: Path
    """Output file: .png for labels, or a point cloud format. With several inputs, an output
    directory: each image gets a folder with coord, normal, curvature and plane as .npy, and
    planes.json."""
    intrinsics: flags.IntrinsicsFlag = None
    depth_scale: flags.DepthScaleFlag = None
    depth_kind: flags.DepthKindFlag = "z"
    picture: Path | None = None
    """Colored image of the planes (.png); with several inputs, a directory. Default: next to .png
    labels, with _planes appended to the name."""
    table: flags.TableFlag = None
    depth: DepthConfig = field(default_factory=DepthConfig)
    """Planes of depth images."""
    orient: flags.ImageOrientFlag = "auto"
    threads: flags.ThreadsFlag = None


def run(argv: list[str]) -> int:
    """Parse the arguments, segment each image and write its result."""
    arguments = parse(Arguments, argv, prog="torchrg depth")
    flags.limit_threads(arguments.threads)
    camera = flags.parse_intrinsics(arguments.intrinsics)
    frames = [_find_frame(arguments, camera, path) for path in arguments.inputs]
    sources, inputs = [frame or camera for frame in frames], arguments.inputs
    is_folder = arguments.out.is_dir() or (
        len(inputs) > 1 and arguments.out.suffix.lower() not in (".png", *FORMATS)
    )
    targets = output_paths(inputs, arguments.out, suffix="" if is_folder else ".png")
    pictures = sidecar_paths(targets, arguments.picture, suffixes=(".png",))
    table_paths = sidecar_paths(targets, arguments.table, suffixes=TABLE_SUFFIXES)
    tables = [set() if path is None else {path} for path in table_paths]
    if not is_folder and has_suffix(targets[0], ".png"):
        if arguments.picture is None:
            pictures = [targets[0].with_name(f"{targets[0].stem}_planes.png")]
        tables[0].add(targets[0].with_suffix(".json"))
    sidecars = [*filter(None, pictures), *itertools.chain(*map(sorted, tables))]
    check_distinct([*targets, *sidecars], [*inputs, Path(arguments.intrinsics or "")])
    for path in sidecars:
        check_writable(path)
    for path in targets if is_folder else []:
        check_writable(path / PLANES_FILE if path.is_dir() else path)
    folders = [is_folder] * len(inputs)
    return run_each(_label, arguments, inputs, sources, targets, folders, pictures, tables)


def _find_frame(arguments: Arguments, camera: Pinhole | None, path: Path) -> RGBDFrame | None:
    """Return the depth image of an input file; None for a cloud.

    Raises before reading if the camera or the depth scale is missing.
    """
    if path.is_dir():
        command = f"torchrg convert rgbd {path} OUT"
        raise ConfigError(f"{path}: expected depth images, got a folder; use {command}.")
    refuse_form(path, *FORMATS)
    if path.suffix.lower() not in DEPTH_SUFFIXES:
        if arguments.depth_scale is not None or arguments.depth_kind != "z":
            warn(f"{path}: --depth-scale and --depth-kind are ignored for point clouds.")
        return None
    camera_scale = None if camera is None else camera.depth_scale
    scale = camera_scale if arguments.depth_scale is None else arguments.depth_scale
    if camera is None or scale is None:
        flag, hint = "--depth-scale", "1000 for millimeters, 1 for meters"
        if camera is None:
            flag, hint = "--intrinsics fx,fy,cx,cy", "or a camera file"
        raise ConfigError(f"{path}: missing {flag}, required for depth images; pass it, {hint}.")
    matrix, doubt = scale_camera(path, camera)
    if doubt:
        warn(doubt)
    return RGBDFrame(path, matrix, scale, depth_kind=arguments.depth_kind)


def _label(
    arguments: Arguments,
    source: Path,
    known: RGBDFrame | Pinhole | None,
    target: Path,
    is_folder: bool,
    picture: Path | None,
    tables: Collection[Path],
) -> None:
    """Segment an image or a cloud, write the result, and print a line about it."""
    begin = time.perf_counter()
    _check_memory(source)
    scale = arguments.depth_scale
    if isinstance(known, RGBDFrame):
        scale = known.depth_scale
        with print_warnings():
            cloud, depth, camera = _read_image(known)
    else:
        cloud, depth, camera = _read_cloud(source, known)
    is_image = has_suffix(target, ".png")
    if not is_folder and not is_image:
        check_output(target, cloud)
    note_input(f"{source}", cloud, target, () if is_folder or is_image else RESULT_FIELDS)
    origin, pose = np.zeros(3), None
    if not is_folder:  # Results are relative to the cloud's origin.
        origin, pose = cloud.origin, torch.eye(4, dtype=torch.float64)
        pose[:3, 3] = -torch.from_numpy(origin)
    with warnings.catch_warnings():
        # The camera is already checked against the image size, or estimated from the points.
        warnings.simplefilter("ignore", DepthWarning)
        seg = segment_depth(depth, camera, arguments.depth, pose=pose, orient=arguments.orient)
    points = cloud.points.view(*depth.shape, 3)
    if picture is not None:
        step = -(-max(points.shape) // _COLORING_PIXELS)
        sparse = torch.full_like(points, torch.nan)
        sparse[::step, ::step] = points[::step, ::step]
        write_png(picture, color_planes(seg.labels, sparse) * (depth > 0)[..., None])
    if is_folder:
        write_frame(target, depth, torch.from_numpy(cloud.coordinates).view(*points.shape), seg)
    elif is_image:
        write_png(target, seg.labels + 1)
    else:
        provenance = describe_run(source, arguments.depth) | {
            "config": {"depth": asdict(arguments.depth)},
            "intrinsics": known and format_intrinsics(camera),
            "depth_scale": scale,
            "pose": "camera",
            "orient": arguments.orient,
        }
        images = {name: values for name, values in vars(seg).items() if name not in _NOT_IMAGES}
        rows = replace(seg, **{name: image.flatten(0, 1) for name, image in images.items()})
        write_cloud(target, cloud, rows, provenance=provenance)
    for table in tables:
        write_table(table, describe_planes(seg.planes, origin=origin.tolist()))
    num_seen, (height, width) = int((depth > 0).sum()), depth.shape
    size = f"{width} x {height} pixels, {num_seen:,} with depth, in"
    written = f"{size} {time.perf_counter() - begin:.1f} s -> {target}"
    report_planes(f"{source}", seg, num_seen, flags.reason_for_no_plane(arguments.depth), written)


def _check_memory(image: Path) -> None:
    """Raise before reading if the pixels of an image do not fit into memory."""
    is_depth, free = image.suffix.lower() in DEPTH_SUFFIXES, available_memory()
    size = num_pixels(image) if is_depth else 0
    if (needed := size * _MIN_BYTES_PER_PIXEL) > free:
        raise FormatError(
            f"{image}: not enough memory for {size:,} pixels: needs at least {needed / 1e9:,.1f} "
            f"GB, {free / 1e9:,.1f} GB are free; scale it down, or use a machine with more memory."
        )


def _read_image(frame: RGBDFrame) -> tuple[Cloud, Tensor, Tensor]:
    """Return the cloud of an image in camera coordinates, its depth ``(H, W)``, and its camera."""
    depth = frame.read_depth()
    points = unproject_image(depth, frame.intrinsics).view(-1, 3).float()
    height, width = depth.shape
    cloud = Cloud(points.numpy(), grid_shape=(height, width), source=str(frame.depth))
    return cloud, depth, frame.intrinsics


def _read_cloud(path: Path, known: Pinhole | None) -> tuple[Cloud, Tensor, Tensor]:
    """Return an organized cloud, its depth ``(H, W)``, and its camera matrix.

    The camera is estimated from the points if ``known`` is None.
    """
    cloud = read_cloud(path)
    if cloud.grid_shape is None:
        raise FormatError(f"{path}: not an organized cloud (its height is 1); use torchrg segment.")
    height, width = cloud.grid_shape
    points = torch.from_numpy(cloud.coordinates).view(height, width, 3)
    camera = find_intrinsics(points) if known is None else known.matrix((width, height), f"{path}")
    if camera is None:
        raise FormatError(f"{path}: expected points of a pinhole camera; use torchrg segment.")
    off = 0.0 if known is None else reprojection_error(points, camera)
    if off > _MAX_MISFIT * max(height, width):
        raise FormatError(
            f"{path}: --intrinsics do not match the points: half are {off:.3g} pixels off; omit it."
        )
    depth = points[..., 2]
    return cloud, torch.where(depth.isfinite(), depth, 0.0), camera
