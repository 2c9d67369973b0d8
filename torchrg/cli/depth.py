"""``torchrg depth``: planes of depth images and of organised clouds, found in the image."""

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro
from torch import Tensor

from torchrg.batch.records import describe_run
from torchrg.cli import console
from torchrg.datasets.rgbd_files import DEPTH_SUFFIXES, read_depth
from torchrg.depth import (
    DepthConfig,
    depth_to_points,
    find_intrinsics,
    make_intrinsics,
    segment_depth,
)
from torchrg.errors import ConfigError, FormatError
from torchrg.io import check_output, read_cloud, write_cloud
from torchrg.io.files import check_place
from torchrg.render import color_planes, write_png
from torchrg.structures import Cloud


@dataclass(frozen=True)
class Arguments:
    """Label the planes of depth images, or of organised clouds taken as such.

    Labels are written as a 16-bit PNG (0 is no plane, the first plane is 1) with a coloured picture
    beside it, or as a cloud in camera coordinates.
    """

    inputs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Depth images (.png of 16 bits, .npy), or organised clouds (.pcd)."""
    out: Path
    """File to write: .png, or a cloud by its suffix; for several inputs a directory of .png."""
    intrinsics: str | None = None
    """Camera of the depth images: fx,fy,cx,cy in pixels; the middle of the first one is 0,0.
    Default: for organised clouds, found from the points."""
    depth_scale: float | None = None
    """Stored value of one metre: 1000 for millimetres, 5000 for TUM, 1 for metres."""
    picture: Path | None = None
    """Coloured picture, a .png file; for several inputs a directory. Default: beside labels that
    are written as .png, with _planes in its name."""
    depth: DepthConfig = dataclasses.field(default_factory=DepthConfig)
    """How planes are found."""
    threads: int | None = None
    """Threads to use. Default: as torch decides, usually one a core."""


def run(argv: list[str]) -> int:
    """Parse the arguments, segment each image and write its result."""
    arguments = console.parse(Arguments, argv, prog="torchrg depth")
    console.use_threads(arguments.threads)
    outputs = console.output_paths(arguments.inputs, arguments.out, suffix=".png")
    pictures = console.picture_paths(outputs, arguments.picture, suffixes=(".png",))
    return console.run_each(_segment_image, arguments, outputs, pictures)


def _segment_image(arguments: Arguments, source: Path, target: Path, picture: Path | None) -> None:
    """Segment one image, write its result and print one line about it."""
    begin = time.perf_counter()
    cloud, depth, intrinsics = _read_frame(source, arguments)
    is_image = target.suffix.lower() == ".png"
    check_place(target) if is_image else check_output(target, cloud)
    # Results are about the cloud's origin.
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = -torch.from_numpy(cloud.origin)
    seg = segment_depth(depth, intrinsics, arguments.depth, pose=pose)
    if is_image:
        write_png(target, seg.labels + 1)
        picture = picture or target.with_name(f"{target.stem}_planes.png")
    else:
        provenance = describe_run(source, arguments.depth) | {
            "config": {"depth": dataclasses.asdict(arguments.depth)},
            "intrinsics": arguments.intrinsics,
            "depth_scale": arguments.depth_scale,
        }
        not_images = ("planes", "points")
        images = {name: part for name, part in seg._asdict().items() if name not in not_images}
        rows = seg._replace(**{name: image.flatten(0, 1) for name, image in images.items()})
        write_cloud(target, cloud, rows, provenance=provenance)
    if picture is not None:
        colors = color_planes(seg.labels, cloud.points.view(*depth.shape, 3))
        write_png(picture, colors * (depth > 0)[..., None])
    num_planes, num_pixels = len(seg.planes.count), int((depth > 0).sum())
    if num_planes == 0:
        console.warn(f"{source}: no plane found: no region is large enough.")
    share = 100 * int((seg.labels >= 0).sum()) / max(num_pixels, 1)
    height, width = depth.shape
    print(
        f"{source}: {width} x {height} pixels, {num_pixels:,} with depth, {num_planes:,} planes, "
        f"{share:.1f} % of these labelled, {time.perf_counter() - begin:.1f} s -> {target}"
    )


def _read_frame(source: Path, arguments: Arguments) -> tuple[Cloud, Tensor, Tensor]:
    """Return the cloud in camera coordinates, its depth ``(H, W)``, and the camera matrix."""
    given, scale = arguments.intrinsics, arguments.depth_scale
    camera = None if given is None else make_intrinsics(*console.parse_intrinsics(given))
    if source.suffix.lower() not in DEPTH_SUFFIXES:
        return _read_organised(source, camera)
    if camera is None or scale is None:
        flag = "--intrinsics fx,fy,cx,cy" if camera is None else "--depth-scale"
        raise ConfigError(f"{source}: expected {flag}, which depth images do not hold; pass it.")
    depth = read_depth(source, depth_scale=scale)
    height, width = depth.shape
    points = depth_to_points(depth[None].double(), camera[None]).view(-1, 3).float()
    return Cloud(points.numpy(), grid_shape=(height, width), source=str(source)), depth, camera


def _read_organised(source: Path, camera: Tensor | None) -> tuple[Cloud, Tensor, Tensor]:
    """Return an organised cloud, its depth, and the camera that is given or found."""
    cloud = read_cloud(source)
    if cloud.grid_shape is None:
        raise FormatError(
            f"{source}: expected an organised cloud, with a height above 1, got a list of points; "
            "use torchrg segment."
        )
    points = torch.from_numpy(cloud.coordinates).view(*cloud.grid_shape, 3)
    camera = find_intrinsics(points) if camera is None else camera
    if camera is None:
        raise FormatError(
            f"{source}: expected points of a pinhole camera in its own coordinates, got others; "
            "use torchrg segment."
        )
    depth = points[..., 2]
    return cloud, torch.where(depth.isfinite(), depth, 0.0), camera
