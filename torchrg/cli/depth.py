"""``torchrg depth``: planes of depth images and of organised clouds, found in the image."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor

from torchrg._parallel import num_cores
from torchrg.batch.local import run_here, run_local
from torchrg.batch.lock import DirectoryLock
from torchrg.batch.memory import available_memory
from torchrg.batch.records import describe_run, write_record
from torchrg.batch.run import make_plan
from torchrg.batch.scans import Job, Scan
from torchrg.batch.sources import RGBDSource
from torchrg.batch.task import Converted, TaskReport, report_on
from torchrg.cli import console
from torchrg.cli.arguments import Argument, parse
from torchrg.cli.loop import finish, run_with_bar, tell_failure
from torchrg.datasets.folder import listed
from torchrg.datasets.rgbd_files import DEPTH_SUFFIXES, num_pixels, read_depth
from torchrg.depth import (
    DepthConfig,
    find_intrinsics,
    make_intrinsics,
    segment_depth,
)
from torchrg.depth.camera import points_of_image
from torchrg.errors import ConfigError, FormatError
from torchrg.io import RESULT_FIELDS, check_output, estimate_points, read_cloud, write_cloud
from torchrg.io.fields import notes_on_results
from torchrg.io.files import check_place, marked_parts, remove_leftovers
from torchrg.render import color_planes, write_png
from torchrg.structures import Cloud, Segmentation

_ORGANISED = ".pcd"
"""Suffix of organised clouds."""
_COLORED_FROM = 200
"""Pixels along the longer side that tell which planes are next to each other and must differ in
colour. Choosing colours from all pixels would take as long as finding the planes."""
_NO_IMAGES = ("planes", "points", "neighbors")
"""Parts of a segmentation of an image that are no images."""
_LEAST_BYTES_A_PIXEL = 300
"""Memory that labelling takes at least for each pixel."""
_FRAMES_OF_WORKER = 8
"""Least number of frames for each worker where no number of workers is given. To start one takes as
long as some frames of 640 x 480 pixels take."""


@dataclass(frozen=True)
class Arguments:
    """Label the planes of depth images, or of organised clouds taken as such.

    Labels are written as a 16-bit PNG (0 is no plane, the first plane is 1) with a coloured picture
    beside it, or as a cloud in camera coordinates. Frames of a sequence are labelled side by side,
    and those that are done already are not done again.

    Examples:
        torchrg depth frame.png --intrinsics 525,525,319.5,239.5 --depth-scale 1000 --out labels.png
        torchrg depth frames --intrinsics 525,525,319.5,239.5 --depth-scale 5000 --out labels
        torchrg depth kinect.pcd --out planes.ply
    """

    inputs: Annotated[tuple[Path, ...], Argument("IMAGE", is_positional=True)]
    """Depth images (.png of 16 bits, .npy), organised clouds (.pcd), or folders of these."""
    out: Path
    """File to write, .png for labels or a cloud by its suffix; for several inputs a directory."""
    intrinsics: str | None = None
    """Camera of the depth images, as fx,fy,cx,cy in pixels, where the middle of the first pixel is
    0,0. Default: found from the points, for organised clouds."""
    depth_scale: float | None = None
    """Stored value of one metre: 1000 for depth in millimetres, 5000 for TUM, 1 for metres."""
    picture: Path | None = None
    """Place of the coloured picture, a .png file; for several inputs a directory. Default: beside
    labels that are written as .png, with _planes in its name."""
    depth: DepthConfig = field(default_factory=DepthConfig)
    """How planes are found."""
    orient: console.ImageOrientFlag = "auto"
    compile: console.CompileFlag = False
    workers: int | None = None
    """Number of processes of one thread each that label frames side by side. Default: one for each
    core, as far as there are eight frames for each."""
    threads: int | None = None
    """Number of threads where there is no second process. Default: as torch decides, usually one
    for each core."""


@dataclass(frozen=True)
class FrameJob(Job):
    """The task of labelling one image: a frame of an RGB-D source with images as its results.

    The labels hold the record. One that is alone may become a cloud instead.
    """

    source: RGBDSource
    target: Path = Path()
    picture: Path | None = None

    @property
    def record(self) -> Path:
        """The labels."""
        return self.target

    def place_of(self, name: str) -> Path:
        """Return where the labels or the picture of them are."""
        place = self.picture if name == "picture" else self.target
        return place or self.target / name

    def run(self) -> TaskReport:
        """Label the image; what goes wrong with it is in the report."""

        def convert(begin: Callable[[str], None]) -> Converted:
            begin("planes")
            self.clean()
            return self.label()[0]

        return report_on(self.name, convert)

    def clean(self) -> None:
        """Remove what a process that was killed left half-written."""
        for path in (self.target, self.picture):
            if path is not None:
                remove_leftovers(path.resolve().parent, self.mark)

    def label(self) -> tuple[Converted, str]:
        """Segment the image and write its result; return what was found, also in words.

        Raises:
            TorchrgError: If the image cannot be read, or a result not be written.
        """
        target, is_labels = self.target, _is_png(self.target)
        description = self.describe() if is_labels else {}
        _check_memory(self.inputs[0])
        cloud, depth, intrinsics = _read_frame(self.inputs[0], self.source)
        check_place(target) if is_labels else check_output(target, cloud)
        # Results are about the cloud's origin.
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, 3] = -torch.from_numpy(cloud.origin)
        source = self.source
        seg = segment_depth(depth, intrinsics, source.settings, pose=pose, compile=source.compile)
        seg = source.turned(seg, cloud.points.view(*depth.shape, 3))
        notes, num_planes = [*cloud.notes], len(seg.planes.count)
        if not is_labels and target.suffix.lower() != ".npz":
            notes += notes_on_results(cloud.fields, RESULT_FIELDS)
        if num_planes == 0:
            notes.append("no plane found: no region is large enough")
        files = ("labels",) if self.picture is None else ("labels", "picture")
        warnings = tuple(f"{note}." for note in notes)
        found = Converted(depth.numel(), num_planes, files, warnings=warnings)
        with marked_parts(self.mark):
            if self.picture is not None:
                colors = color_planes(seg.labels, _thinned(cloud.points.view(*depth.shape, 3)))
                write_png(self.picture, colors * (depth > 0)[..., None])
            if is_labels:
                write_png(target, seg.labels + 1)
                write_record(self, description, found)
            else:
                _write_cloud(self, cloud, seg)
        num_seen, (height, width) = int((depth > 0).sum()), depth.shape
        share = 100 * int((seg.labels >= 0).sum()) / max(num_seen, 1)
        return found, (
            f"{width} x {height} pixels, {num_seen:,} with depth, {num_planes:,} planes, "
            f"{share:.1f} % of these labelled"
        )


def run(argv: list[str]) -> int:
    """Parse the arguments, segment each image and write its result."""
    arguments = parse(Arguments, argv, prog="torchrg depth")
    if arguments.workers is not None and arguments.workers < 1:
        raise ConfigError(f"expected --workers >= 1, got {arguments.workers}.")
    console.use_threads(arguments.threads)
    sources = list_images(arguments.inputs)
    jobs = _list_jobs(sources, arguments)
    compiles = console.prepared_for_depth(arguments.compile)
    jobs = [replace(job, source=replace(job.source, compile=compiles)) for job in jobs]
    return _label_one(jobs[0]) if len(jobs) == 1 else _label_sequence(jobs, arguments)


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


def _list_jobs(sources: tuple[Path, ...], arguments: Arguments) -> list[FrameJob]:
    """Return what is to be done; no result is written over another one or over an input.

    Depth images without a camera and a scale are refused before any is read.
    """
    given = arguments.intrinsics
    camera = None if given is None else console.parse_intrinsics(given)
    image = next((path for path in sources if path.suffix.lower() in DEPTH_SUFFIXES), None)
    if image is not None and None in (camera, arguments.depth_scale):
        flag = "--intrinsics fx,fy,cx,cy" if camera is None else "--depth-scale"
        raise ConfigError(f"{image}: expected {flag}, which depth images do not hold; pass it.")
    source = RGBDSource(
        *(sources[0].parent, arguments.depth, "images", camera, arguments.depth_scale),
        orient=arguments.orient,
    )
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
    scans = [Scan(str(path), (path,), _size_of(path)) for path in sources]
    return [
        FrameJob(source, scan, target.parent, target=target, picture=picture)
        for scan, target, picture in zip(scans, targets, pictures, strict=True)
    ]


def _check_memory(image: Path) -> None:
    """Refuse a PNG that says it has more pixels than memory has room for, before it is read."""
    size, free = num_pixels(image) if _is_png(image) else 0, available_memory()
    if (needed := size * _LEAST_BYTES_A_PIXEL) > free:
        raise FormatError(
            f"{image}: expected an image that memory has room for, got {size:,} pixels, which take "
            f"at least {needed / 1e9:,.1f} GB of {free / 1e9:,.1f} that are free; make it smaller, "
            "or use a machine with more."
        )


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


def _label_one(job: FrameJob) -> int:
    """Label one image here, and print one line about it."""
    begin = time.perf_counter()
    found, words = job.label()
    for warning in found.warnings:
        console.warn(f"{job.name}: {warning}")
    console.say(f"{job.name}: {words}, {time.perf_counter() - begin:.1f} s -> {job.target}")
    return 0


def _label_sequence(jobs: Sequence[FrameJob], arguments: Arguments) -> int:
    """Label the images that are not done, in processes if they are worth their start.

    Says which failed, and how many a second there were.
    """
    with DirectoryLock(arguments.out) as lock:
        jobs = [replace(job, mark=lock.mark_of(job.target.name)) for job in jobs]
        plan = make_plan(jobs, threads=num_cores())
        frames = plan.to_convert
        worthwhile = min(num_cores(), max(len(frames) // _FRAMES_OF_WORKER, 1))
        workers = min(arguments.workers or worthwhile, max(len(frames), 1))
        started = run_local(frames, workers=workers, lock=lock) if workers > 1 else run_here(frames)
        report = run_with_bar(plan, started, engine="local", workers=workers, unit="frame")
        lock.remove()
    for frame in report.scans:
        for warning in frame.warnings:
            console.warn(f"{frame.name}: {warning}")
        tell_failure(frame)
    code = finish(report, arguments.out, unit="frame")
    num_new = len(report.with_status("converted"))
    console.say(
        f"{len(report.complete):,} of {len(jobs):,} frames, "
        f"{sum(frame.num_regions for frame in report.complete):,} planes, {report.seconds:,.1f} s, "
        f"{num_new / max(report.seconds, 1e-9):.2f} frames a second -> {arguments.out}"
    )
    return code


def _write_cloud(job: FrameJob, cloud: Cloud, seg: Segmentation) -> None:
    """Write an image that is alone as a cloud with its results."""
    source = job.source
    camera = source.intrinsics and ",".join(f"{value:.15g}" for value in source.intrinsics)
    provenance = describe_run(job.inputs[0], source.settings) | {
        "config": {"depth": asdict(source.settings)},
        "intrinsics": camera,
        "depth_scale": source.depth_scale,
        "compile": source.compile,
        "orient": source.orient,
    }
    images = {name: part for name, part in seg._asdict().items() if name not in _NO_IMAGES}
    rows = seg._replace(**{name: image.flatten(0, 1) for name, image in images.items()})
    write_cloud(job.target, cloud, rows, provenance=provenance)


def _thinned(points: Tensor) -> Tensor:
    """Return an image of points ``(H, W, 3)`` with NaN but for rows and columns evenly apart."""
    apart = -(-max(points.shape) // _COLORED_FROM)
    thinned = torch.full_like(points, torch.nan)
    thinned[::apart, ::apart] = points[::apart, ::apart]
    return thinned


def _read_frame(path: Path, source: RGBDSource) -> tuple[Cloud, Tensor, Tensor]:
    """Return the cloud in camera coordinates, its depth ``(H, W)``, and the camera matrix."""
    given, scale = source.intrinsics, source.depth_scale
    camera = None if given is None else make_intrinsics(*given)
    if camera is None or scale is None or path.suffix.lower() not in DEPTH_SUFFIXES:
        return _read_organised(path, camera)
    depth = read_depth(path, depth_scale=scale)
    height, width = depth.shape
    points = points_of_image(depth, camera).view(-1, 3).float()
    return Cloud(points.numpy(), grid_shape=(height, width), source=str(path)), depth, camera


def _read_organised(path: Path, camera: Tensor | None) -> tuple[Cloud, Tensor, Tensor]:
    """Return an organised cloud, its depth, and the camera that is given or found."""
    cloud = read_cloud(path)
    if cloud.grid_shape is None:
        raise FormatError(
            f"{path}: expected an organised cloud, with a height above 1, got a list of points; "
            "use torchrg segment."
        )
    points = torch.from_numpy(cloud.coordinates).view(*cloud.grid_shape, 3)
    camera = find_intrinsics(points) if camera is None else camera
    if camera is None:
        raise FormatError(
            f"{path}: expected points of a pinhole camera in its own coordinates, got others; "
            "use torchrg segment."
        )
    depth = points[..., 2]
    return cloud, torch.where(depth.isfinite(), depth, 0.0), camera
