"""``torchrg segment`` of depth images and of organised clouds: planes found in the image."""

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro
from torch import Tensor

from torchrg.batch.records import describe_versions, hash_file
from torchrg.cli.console import SOME_FAILED, fail, output_paths, parse, warn
from torchrg.cli.picture import check_picture, picture_paths
from torchrg.datasets.rgbd_files import DEPTH_SUFFIXES, read_depth
from torchrg.depth import DepthConfig, segment_depth
from torchrg.depth.camera import depth_to_points, find_intrinsics, make_intrinsics
from torchrg.errors import ConfigError, FormatError, TorchrgError
from torchrg.io import check_output, read_cloud, write_cloud
from torchrg.io.files import check_place
from torchrg.render import color_planes, write_png
from torchrg.structures import Cloud, Segmentation


def read_frame(
    source: Path, *, intrinsics: str | None, depth_scale: float | None, organised: bool
) -> tuple[Cloud, Tensor, Tensor]:
    """Read a depth image, or an organised cloud.

    Args:
        source: The file.
        intrinsics: Camera as ``fx,fy,cx,cy``; clouds can do without.
        depth_scale: Stored value of one metre; clouds have none.
        organised: Whether it is an organised cloud whatever its suffix.

    Returns:
        The cloud in camera coordinates, its depth ``(H, W)``, and the camera matrix ``(3, 3)``.

    Raises:
        ConfigError: If camera or scale are needed and not given.
        FormatError: If the file is damaged, or not such a file.
    """
    if source.suffix.lower() not in DEPTH_SUFFIXES or organised:
        return _read_organised(source, intrinsics)
    if intrinsics is None or depth_scale is None:
        flag = "--intrinsics fx,fy,cx,cy" if intrinsics is None else "--depth-scale"
        raise ConfigError(f"{source}: expected {flag}, which depth images do not hold; pass it.")
    camera = parse_intrinsics(intrinsics)
    depth = read_depth(source, depth_scale=depth_scale)
    points = depth_to_points(depth[None].double(), camera[None])[0]
    height, width = depth.shape
    coordinates = points.view(-1, 3).float().numpy()
    return Cloud(coordinates, grid_shape=(height, width), source=str(source)), depth, camera


def _read_organised(source: Path, given: str | None) -> tuple[Cloud, Tensor, Tensor]:
    """Return an organised cloud, its depth, and the camera that is given or found."""
    cloud = read_cloud(source)
    if cloud.grid_shape is None:
        raise FormatError(
            f"{source}: expected an organised cloud, with a height above 1, got a list of points; "
            "leave out --image."
        )
    points = torch.from_numpy(cloud.coordinates).view(*cloud.grid_shape, 3)
    intrinsics = find_intrinsics(points) if given is None else parse_intrinsics(given)
    if intrinsics is None:
        raise FormatError(
            f"{source}: expected points of a pinhole camera in its own coordinates, got others; "
            "leave out --image."
        )
    depth = points[..., 2]
    return cloud, torch.where(depth.isfinite(), depth, 0.0), intrinsics


def parse_intrinsics(text: str) -> Tensor:
    """Return the camera matrix of ``fx,fy,cx,cy``.

    Raises:
        ConfigError: If these are not four numbers, or no camera.

    Example:
        >>> parse_intrinsics("525,525,319.5,239.5")[0].tolist()
        [525.0, 0.0, 319.5]
    """
    try:
        fx, fy, cx, cy = (float(word) for word in text.split(","))
    except ValueError:
        raise ConfigError(
            f"expected --intrinsics fx,fy,cx,cy, four numbers without blanks, got {text!r}."
        ) from None
    return make_intrinsics(fx, fy, cx, cy)


IMAGE_FLAGS = ("--intrinsics", "--depth-scale", "--image")
"""Flags that say that the inputs are images."""


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
    """Camera of the depth images: fx,fy,cx,cy in pixels; the middle of the first one is 0,0."""
    depth_scale: float | None = None
    """Stored value of one metre: 1000 for millimetres, 5000 for TUM, 1 for metres."""
    image: bool = False
    """Take organised clouds as depth images; their camera is found from the points."""
    picture: Path | None = None
    """Coloured picture, a .png file; for several inputs a directory. Default: beside labels that
    are written as .png, with _planes in its name."""
    depth: DepthConfig = dataclasses.field(default_factory=DepthConfig)
    """How planes are found."""
    threads: int | None = None
    """Threads to use. Default: as torch decides, usually one a core."""


def asks_for_images(argv: list[str]) -> bool:
    """Return whether arguments of ``torchrg segment`` are about images.

    Example:
        >>> asks_for_images(["a.png", "--out", "b.png"]), asks_for_images(["a.pcd", "--out=b.npz"])
        (True, False)
    """
    if any(argument.partition("=")[0] in IMAGE_FLAGS for argument in argv):
        return True
    before = ["", *argv]
    return any(
        argument.lower().endswith(".png") and not last.startswith("--") and argument[0] != "-"
        for last, argument in zip(before, argv, strict=False)
    )


def run(argv: list[str]) -> int:
    """Parse the arguments, segment each image and write its result."""
    arguments = parse(Arguments, argv, prog="torchrg segment")
    if arguments.threads is not None:
        if arguments.threads < 1:
            raise ConfigError(f"expected --threads >= 1, got {arguments.threads}.")
        torch.set_num_threads(arguments.threads)
    outputs = _output_paths(arguments)
    pictures = picture_paths(outputs, arguments.picture)
    failed = 0
    for source, target, picture in zip(arguments.inputs, outputs, pictures, strict=True):
        if picture is None and target.suffix.lower() == ".png":
            picture = target.with_name(f"{target.stem}_planes.png")
        try:
            _segment_image(source, target, picture, arguments)
        except TorchrgError as error:
            if len(outputs) == 1:
                raise
            failed += 1
            fail(str(error))
    if failed:
        return fail(
            f"{failed} of {len(outputs)} inputs failed, the others are written.", code=SOME_FAILED
        )
    return 0


def _output_paths(arguments: Arguments) -> list[Path]:
    """Return where the labels of each input go."""
    inputs, out = arguments.inputs, arguments.out
    if len(inputs) == 1 and not out.is_dir() and out.suffix.lower() == ".png":
        check_picture(out)
        return [out]
    if len(inputs) > 1 and out.suffix.lower() == ".png" and not out.is_dir():
        raise FormatError(f"{out}: expected a directory for {len(inputs)} inputs, got a file name.")
    return output_paths(inputs, out, suffix=".png")


def _segment_image(source: Path, target: Path, picture: Path | None, arguments: Arguments) -> None:
    """Segment one image."""
    begin = time.perf_counter()
    cloud, depth, intrinsics = read_frame(
        source,
        intrinsics=arguments.intrinsics,
        depth_scale=arguments.depth_scale,
        organised=arguments.image,
    )
    is_image = target.suffix.lower() == ".png"
    check_place(target) if is_image else check_output(target, cloud)
    # Results are about the cloud's origin.
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = -torch.from_numpy(cloud.origin)
    seg = segment_depth(depth, intrinsics, arguments.depth, pose=pose)
    if is_image:
        write_png(target, seg.labels + 1)
    else:
        write_cloud(target, cloud, _flattened(seg), provenance=_describe(source, arguments))
    if picture is not None:
        points = cloud.points.view(*depth.shape, 3)
        write_png(picture, color_planes(seg.labels, points) * (depth > 0)[..., None])
    num_planes, num_pixels = len(seg.planes.count), int((depth > 0).sum())
    if num_planes == 0:
        warn(f"{source}: no plane found: no region is large enough.")
    share = 100 * int((seg.labels >= 0).sum()) / max(num_pixels, 1)
    height, width = depth.shape
    print(
        f"{source}: {width} x {height} pixels, {num_pixels:,} with depth, {num_planes:,} planes, "
        f"{share:.1f} % of these labelled, {time.perf_counter() - begin:.1f} s -> {target}"
    )


def _flattened(seg: Segmentation) -> Segmentation:
    """Return a segmentation whose images are lists of points."""
    return Segmentation(
        seg.labels.flatten(),
        seg.normals.view(-1, 3),
        seg.curvature.flatten(),
        seg.sharp.flatten(),
        seg.valid.flatten(),
        seg.planes,
    )


def _describe(source: Path, arguments: Arguments) -> dict[str, object]:
    """Return what is needed to make a result again."""
    return {
        "versions": describe_versions(),
        "config": {"depth": dataclasses.asdict(arguments.depth)},
        "intrinsics": arguments.intrinsics,
        "depth_scale": arguments.depth_scale,
        "input": {"name": source.name, "sha256": hash_file(source)},
        "device": "cpu",
    }
