"""``torchrg align``: make scans upright, with walls along x and y."""

import dataclasses
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg.cli import flags
from torchrg.cli.arguments import parse
from torchrg.cli.ending import print_lines, print_warnings, warn
from torchrg.cli.loop import STAGES, check_distinct, note_input, output_paths, run_each, stage_bar
from torchrg.datasets.provenance import describe_run
from torchrg.errors import ConfigError
from torchrg.io import RESULT_FIELDS, check_output, read_cloud, write_cloud
from torchrg.io.files import atomic_path, check_writable
from torchrg.pipeline import segment_planes
from torchrg.pipeline.clouds import check_finite
from torchrg.regions.axes import align_axes, transform_cloud, transform_planes
from torchrg.structures import Segmentation


@dataclass(frozen=True)
class Arguments(flags.PlaneSettings):
    """Make scans upright, with walls along x and y.

    The lowest floor is moved to z = 0 and the center to x = y = 0. Floors and walls are detected
    with the settings of torchrg segment. The axis --up may be off by up to 30 degrees.

    Examples:
        torchrg align scan.ply --out upright.ply
        torchrg align scan.ply --out upright.npz --segment --matrix motion.npy
        torchrg align scan.ply --out upright.ply --up -y
    """

    inputs: flags.CloudsFlag
    out: flags.OutFlag
    matrix: Path | None = None
    """File for the transform of one input: .npy (4 x 4 array) or .txt (ScanNet's axisAlignment)."""
    segment: bool = False
    """Also write labels, normals, curvature and the plane table, as torchrg segment does."""
    threads: flags.ThreadsFlag = None
    columns: flags.ColumnsFlag = None


def run(argv: list[str]) -> int:
    """Parse the arguments, align each input and write it."""
    arguments = parse(Arguments, argv, prog="torchrg align")
    flags.limit_threads(arguments.threads)
    flags.check_columns(arguments.columns, arguments.inputs)
    outputs = output_paths(arguments.inputs, arguments.out)
    check_distinct(outputs, arguments.inputs)
    if arguments.matrix is not None:
        _check_matrix(arguments, arguments.matrix, outputs)
    return run_each(_align_file, arguments, arguments.inputs, outputs)


def _check_matrix(arguments: Arguments, path: Path, outputs: list[Path]) -> None:
    """Raise if the transform cannot be written, or there are several inputs."""
    if len(arguments.inputs) > 1:
        raise ConfigError(f"expected one input with --matrix, got {len(outputs)}; align each.")
    if path.suffix.lower() not in (".npy", ".txt"):
        raise ConfigError(f"expected --matrix to end in .npy or .txt, got {path.name}.")
    check_distinct([path], [*arguments.inputs, *outputs])
    check_writable(path)


def _align_file(arguments: Arguments, source: Path, target: Path) -> None:
    """Align one file."""
    begin = time.perf_counter()
    cloud = read_cloud(source, columns=flags.file_columns(source, arguments.columns))
    note_input(f"{source}", cloud, target, RESULT_FIELDS if arguments.segment else ())
    for note in check_finite(cloud):
        warn(f"{source}: {note}.")
    check_output(target, dataclasses.replace(cloud, header={}))
    settings = arguments.settings
    with stage_bar(source.name, STAGES) as advance:
        seg = segment_planes(cloud.points, settings, on_stage=advance)
    try:
        with print_warnings():
            motion = align_axes(seg, up=settings.planes.up or "z")
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}") from None
    # The transform in file coordinates; points are relative to the cloud's origin.
    file_motion = motion.clone()
    file_motion[:3, 3] -= motion[:3, :3] @ torch.from_numpy(cloud.origin)
    moved = transform_cloud(cloud, file_motion)
    moved_seg = _move(seg, motion, moved.origin) if arguments.segment else None
    provenance = describe_run(source, settings) | {"motion": file_motion.tolist()}
    write_cloud(target, moved, moved_seg, provenance=provenance)
    if arguments.matrix is not None:
        _write_matrix(arguments.matrix, file_motion.numpy())
    tilt = torch.rad2deg(file_motion[2, 2].clamp(-1, 1).acos())
    turn = torch.rad2deg(torch.atan2(file_motion[1, 0], file_motion[0, 0]))
    seconds = time.perf_counter() - begin
    print_lines(
        f"{source}: {len(cloud):,} points, tilted by {tilt:.2f} and turned by {turn:.2f} degrees, "
        f"{seconds:.1f} s -> {target}"
    )


def _move(seg: Segmentation, motion: Tensor, origin: NDArray[np.float64]) -> Segmentation:
    """Transform a segmentation rigidly, relative to the origin of the moved cloud."""
    about = motion.clone()
    about[:3, 3] -= torch.from_numpy(origin)
    normals = (seg.normals.double() @ motion[:3, :3].T).to(seg.normals.dtype)
    return replace(seg, normals=normals, planes=transform_planes(seg.planes, about), points=None)


def _write_matrix(path: Path, matrix: NDArray[np.float64]) -> None:
    """Write a transform as an array, or as the axisAlignment line of ScanNet."""
    with atomic_path(path) as temporary:
        if path.suffix.lower() == ".npy":
            np.save(temporary, matrix)
        else:
            numbers = " ".join(f"{value:.9f}" for value in matrix.reshape(-1))
            temporary.write_text(f"axisAlignment = {numbers}\n", encoding="utf-8")
