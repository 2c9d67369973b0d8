"""``torchrg depth``: planes of depth images and of organised clouds, found in the image."""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
import tyro
from torch import Tensor
from tqdm import tqdm

from torchrg.batch.local import run_here, run_local
from torchrg.batch.memory import memory_of_scan
from torchrg.batch.records import describe_run
from torchrg.batch.scans import Scan
from torchrg.batch.sources import num_pixels
from torchrg.batch.task import Converted, Reports, TaskReport, report_on
from torchrg.cli import console
from torchrg.datasets.folder import listed
from torchrg.datasets.rgbd_files import DEPTH_SUFFIXES, read_depth
from torchrg.depth import (
    DepthConfig,
    depth_to_points,
    find_intrinsics,
    make_intrinsics,
    segment_depth,
)
from torchrg.errors import ConfigError, FormatError
from torchrg.io import RESULT_FIELDS, check_output, estimate_points, read_cloud, write_cloud
from torchrg.io.fields import notes_on_results
from torchrg.io.files import check_place, make_mark, marked_parts, remove_leftovers
from torchrg.render import color_planes, write_png
from torchrg.structures import Cloud

_ORGANISED = ".pcd"
"""Suffix of organised clouds."""
_COLORED_FROM = 200
"""So many pixels along the longer side tell which planes are next to each other and must differ in
colour: choosing colours from all would take as long as finding the planes."""
_FRAMES_OF_WORKER = 8
"""Where no number of workers is given, each has so many frames at least: one takes as long to start
as it takes for some frames of 640 x 480 pixels."""


@dataclass(frozen=True)
class Arguments:
    """Label the planes of depth images, or of organised clouds taken as such.

    Labels are written as a 16-bit PNG (0 is no plane, the first plane is 1) with a coloured picture
    beside it, or as a cloud in camera coordinates. Frames of a sequence are labelled side by side.
    """

    inputs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Depth images (.png of 16 bits, .npy), organised clouds (.pcd), or folders of these."""
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
    workers: int | None = None
    """Processes of one thread each that label frames side by side. Default: one for each core, as
    far as there are eight frames for each."""
    threads: int | None = None
    """Threads to use where there is no second process. Default: as torch decides, usually one a
    core."""


class Labelled(NamedTuple):
    """What was found in an image."""

    shape: tuple[int, int]
    num_seen: int
    num_labelled: int
    num_planes: int
    notes: tuple[str, ...] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a user should know."""
        none = () if self.num_planes else ("no plane found: no region is large enough",)
        return tuple(f"{note}." for note in (*self.notes, *none))


@dataclass(frozen=True)
class Frame:
    """One image to label, with everything that another process needs for it.

    Results are written under names that bear the ``mark`` before they have their own.
    """

    scan: Scan
    target: Path
    picture: Path | None
    arguments: Arguments
    mark: str = dataclasses.field(default_factory=make_mark, compare=False)

    @property
    def source(self) -> Path:
        """The file of the image."""
        return self.scan.inputs[0]

    @property
    def name(self) -> str:
        """The file of the image."""
        return self.scan.name

    @property
    def memory(self) -> int:
        """What the image takes."""
        return memory_of_scan(self.scan.num_points)

    @property
    def inputs(self) -> tuple[Path, ...]:
        """The file of the image."""
        return self.scan.inputs

    def run(self) -> TaskReport:
        """Label the image; what goes wrong with it is in the report."""
        return report_frame(self)

    def clean(self) -> None:
        """Remove what a process that was killed left half-written."""
        for path in (self.target, self.picture):
            if path is not None:
                remove_leftovers(path.resolve().parent, self.mark)


def run(argv: list[str]) -> int:
    """Parse the arguments, segment each image and write its result."""
    arguments = console.parse(Arguments, argv, prog="torchrg depth")
    if arguments.workers is not None and arguments.workers < 1:
        raise ConfigError(f"expected --workers >= 1, got {arguments.workers}.")
    console.use_threads(arguments.threads)
    sources = list_images(arguments.inputs)
    _check_camera(sources, arguments)
    frames = _list_frames(sources, arguments)
    if len(frames) == 1:
        return _label_one(frames[0])
    return _label_sequence(frames)


def list_images(inputs: Sequence[Path]) -> tuple[Path, ...]:
    """Return the files that are given and, in natural order, the images in the given folders.

    Raises:
        FormatError: If a folder has none.
    """
    images: list[Path] = []
    for given in inputs:
        found = [given]
        if given.is_dir():
            found = [path for path in listed(given) if _is_image(path)]
        if not found:
            suffixes = " ".join((*DEPTH_SUFFIXES, _ORGANISED))
            raise FormatError(f"{given}: expected images ({suffixes}) in the folder, got none.")
        images += found
    return tuple(images)


def _is_image(path: Path) -> bool:
    """Return whether an entry of a folder is an image by its name."""
    is_hidden = path.name.startswith(".")
    return not is_hidden and path.suffix.lower() in (*DEPTH_SUFFIXES, _ORGANISED)


def _check_camera(sources: Sequence[Path], arguments: Arguments) -> None:
    """Refuse depth images without a camera and a scale, before any is read."""
    if arguments.intrinsics is not None:
        console.parse_intrinsics(arguments.intrinsics)
    image = next((path for path in sources if path.suffix.lower() in DEPTH_SUFFIXES), None)
    flag = "--intrinsics fx,fy,cx,cy" if arguments.intrinsics is None else "--depth-scale"
    if image is not None and None in (arguments.intrinsics, arguments.depth_scale):
        raise ConfigError(f"{image}: expected {flag}, which depth images do not hold; pass it.")


def _list_frames(sources: tuple[Path, ...], arguments: Arguments) -> list[Frame]:
    """Return what is to be done; no result is written over another one or over an input."""
    targets = console.output_paths(sources, arguments.out, suffix=".png")
    pictures = [
        picture or (target.with_name(f"{target.stem}_planes.png") if _is_png(target) else None)
        for target, picture in zip(
            targets,
            console.picture_paths(targets, arguments.picture, suffixes=(".png",)),
            strict=True,
        )
    ]
    drawn = [picture for picture in pictures if picture is not None]
    console.check_apart([*targets, *drawn], sources)
    for picture in drawn:
        check_place(picture)
    return [
        Frame(Scan(str(source), (source,), _size_of(source)), target, picture, arguments)
        for source, target, picture in zip(sources, targets, pictures, strict=True)
    ]


def _is_png(path: Path) -> bool:
    """Return whether labels go to a path as an image."""
    return path.suffix.lower() == ".png"


def _size_of(source: Path) -> int:
    """Return about how many pixels an image has; 0 where that cannot be told."""
    try:
        is_depth = source.suffix.lower() in DEPTH_SUFFIXES
        return num_pixels(source) if is_depth else estimate_points(source)
    except (OSError, FormatError):
        return 0


def _label_one(frame: Frame) -> int:
    """Label one image, and print one line about it."""
    begin = time.perf_counter()
    found = label_frame(frame)
    for warning in found.warnings:
        console.warn(f"{frame.source}: {warning}")
    height, width = found.shape
    share = 100 * found.num_labelled / max(found.num_seen, 1)
    print(
        f"{frame.source}: {width} x {height} pixels, {found.num_seen:,} with depth, "
        f"{found.num_planes:,} planes, {share:.1f} % of these labelled, "
        f"{time.perf_counter() - begin:.1f} s -> {frame.target}"
    )
    return 0


def _label_sequence(frames: Sequence[Frame]) -> int:
    """Label images side by side, say which failed, and how many a second there were."""
    begin, reports = time.perf_counter(), dict[str, TaskReport]()
    bar = tqdm(total=len(frames), unit="frame", disable=None)
    with bar, contextlib.closing(_reports(frames)) as arriving:
        for report in arriving:
            if report is not None:
                reports[report.name] = report
            bar.update(report is not None)
    seconds = time.perf_counter() - begin
    for report in (reports[frame.scan.name] for frame in frames):
        for warning in report.warnings:
            console.warn(f"{report.name}: {warning}")
        if report.status == "failed":
            console.fail(f"{report.name}: {report.reason.removeprefix(f'{report.name}: ')}")
    done = [report for report in reports.values() if report.status == "converted"]
    print(
        f"{len(done):,} of {len(frames):,} frames, {sum(r.num_regions for r in done):,} planes, "
        f"{seconds:,.1f} s, {len(done) / seconds:.2f} frames a second -> {frames[0].arguments.out}"
    )
    if len(done) == len(frames):
        return 0
    message = f"{len(frames) - len(done)} of {len(frames)} inputs failed, the others are written."
    return console.fail(message, code=console.SOME_FAILED)


def _reports(frames: Sequence[Frame]) -> Reports:
    """Run the frames, in processes if they are worth their start."""
    worthwhile = min(console.num_cores(), max(len(frames) // _FRAMES_OF_WORKER, 1))
    workers = min(frames[0].arguments.workers or worthwhile, len(frames))
    return run_local(frames, workers=workers) if workers > 1 else run_here(frames)


def report_frame(frame: Frame) -> TaskReport:
    """Label one image; what goes wrong with it is in the report and never raised."""

    def convert(begin: Callable[[str], None]) -> Converted:
        begin("planes")
        with marked_parts(frame.mark):
            found = label_frame(frame)
        files = tuple(path.name for path in (frame.target, frame.picture) if path is not None)
        height, width = found.shape
        return Converted(height * width, found.num_planes, files, warnings=found.warnings)

    return report_on(frame.scan.name, convert)


def label_frame(frame: Frame) -> Labelled:
    """Segment one image and write its result.

    Raises:
        TorchrgError: If the image cannot be read, or a result not be written.
    """
    source, target, arguments = frame.source, frame.target, frame.arguments
    cloud, depth, intrinsics = _read_frame(source, arguments)
    check_place(target) if _is_png(target) else check_output(target, cloud)
    # Results are about the cloud's origin.
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = -torch.from_numpy(cloud.origin)
    seg = segment_depth(depth, intrinsics, arguments.depth, pose=pose)
    is_beside = target.suffix.lower() not in (".png", ".npz")
    notes = notes_on_results(cloud.fields, RESULT_FIELDS) if is_beside else []
    if _is_png(target):
        write_png(target, seg.labels + 1)
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
    if frame.picture is not None:
        colors = color_planes(seg.labels, _thinned(cloud.points.view(*depth.shape, 3)))
        write_png(frame.picture, colors * (depth > 0)[..., None])
    return Labelled(
        (depth.shape[0], depth.shape[1]),
        int((depth > 0).sum()),
        int((seg.labels >= 0).sum()),
        len(seg.planes.count),
        (*cloud.notes, *notes),
    )


def _thinned(points: Tensor) -> Tensor:
    """Return an image of points ``(H, W, 3)`` with NaN but for rows and columns evenly apart."""
    apart = -(-max(points.shape) // _COLORED_FROM)
    thinned = torch.full_like(points, torch.nan)
    thinned[::apart, ::apart] = points[::apart, ::apart]
    return thinned


def _read_frame(source: Path, arguments: Arguments) -> tuple[Cloud, Tensor, Tensor]:
    """Return the cloud in camera coordinates, its depth ``(H, W)``, and the camera matrix."""
    given, scale = arguments.intrinsics, arguments.depth_scale
    camera = None if given is None else make_intrinsics(*console.parse_intrinsics(given))
    if camera is None or scale is None or source.suffix.lower() not in DEPTH_SUFFIXES:
        return _read_organised(source, camera)
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
