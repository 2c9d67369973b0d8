"""``torchrg normals``: normals and curvature of scans."""

import dataclasses
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from torchrg.batch.records import describe_run
from torchrg.batch.scans import check_finite
from torchrg.cli import console
from torchrg.cli.arguments import parse
from torchrg.cli.loop import run_each
from torchrg.config import NormalMethod, NormalsConfig, PipelineConfig, load_config
from torchrg.errors import ConfigError
from torchrg.io import check_output, read_cloud, write_cloud
from torchrg.io.fields import put_results
from torchrg.normals import estimate_normals
from torchrg.normals.sides import CloudOrientation, check_viewpoint, orient_cloud

RESULTS = ("normals", "curvature", "sharp", "valid")
"""What is written of each point."""


@dataclass(frozen=True)
class Arguments:
    """Estimate normals and curvature of scans, and tell sharp feature points.

    Examples:
        torchrg normals scan.pcd --out normals.ply
        torchrg normals scan.ply --out normals.ply --orient interior
        torchrg normals scan.ply --out normals.npz --method pca --normals.k 30
        torchrg normals scan.e57 --out normals.laz --orient viewpoint
        torchrg normals scan.ply --out normals.ply --orient viewpoint --viewpoint 0 0 1.6
    """

    inputs: console.CloudsFlag
    out: Path
    """File to write, its format by suffix; for several inputs a directory."""
    method: NormalMethod | None = None
    """Estimator of the normals, a short form of --normals.method."""
    orient: CloudOrientation = "none"
    """How the sign of each normal is chosen: towards the viewpoint or along an axis (up is +z), so
    that neighbours agree (consistent), into the free space of rooms (interior), or as torchrg
    segment does it (auto): to the front of the faces of a mesh, to the scanner where the file names
    its places, else into rooms."""
    viewpoint: tuple[float, float, float] | None = None
    """Place of the scanner in the coordinates of the input, for --orient viewpoint. Default: those
    that an E57 file names."""
    normals: NormalsConfig = dataclasses.field(default_factory=lambda: load_config().normals)
    """How normals and curvature are estimated."""
    chunk_size: int = PipelineConfig.chunk_size
    """Number of points that are handled at a time. It bounds the memory and never changes a
    result."""
    threads: int | None = None
    """Number of threads. Default: as torch decides, usually one for each core."""
    columns: console.ColumnsFlag = None


def run(argv: list[str]) -> int:
    """Parse the arguments, estimate the normals of each input and write them."""
    arguments = parse(Arguments, argv, prog="torchrg normals")
    if arguments.chunk_size < 1:
        raise ConfigError(f"expected --chunk-size >= 1, got {arguments.chunk_size}.")
    if arguments.viewpoint is not None and arguments.orient != "viewpoint":
        raise ConfigError("expected --viewpoint X Y Z together with --orient viewpoint.")
    console.use_threads(arguments.threads)
    if arguments.method is not None:
        arguments = replace(arguments, normals=replace(arguments.normals, method=arguments.method))
    console.ColumnNames.parse(arguments.columns, arguments.inputs)
    outputs = console.output_paths(arguments.inputs, arguments.out)
    console.check_apart(outputs, arguments.inputs)
    return run_each(
        _estimate_file, arguments, list(map(str, arguments.inputs)), arguments.inputs, outputs
    )


def _estimate_file(arguments: Arguments, source: Path, target: Path) -> None:
    """Estimate the normals of one file."""
    begin = time.perf_counter()
    names = console.ColumnNames.parse(arguments.columns, arguments.inputs)
    cloud = read_cloud(source, columns=names.of(source))
    console.note_input(f"{source}", cloud, target, RESULTS)
    check_finite(cloud)
    if cloud.precision_note:
        console.warn(f"{source}: {cloud.precision_note}.")
    if arguments.viewpoint is None:
        check_viewpoint(cloud, arguments.orient, "pass --viewpoint X Y Z, or --orient interior")
    check_output(target, cloud)
    settings, size = arguments.normals, arguments.chunk_size
    with console.stage_bar(source.name, ("normals", "orientation")) as advance:
        advance("normals")
        fit = estimate_normals(cloud.points, config=settings, chunk_size=size)
        advance("orientation")
        place = None if arguments.viewpoint is None else np.array(arguments.viewpoint)
        turned = orient_cloud(cloud, fit.normals, arguments.orient, viewpoint=place)
        fit = fit._replace(normals=turned)
    provenance = describe_run(source, settings)
    provenance |= {"orient": arguments.orient, "viewpoint": arguments.viewpoint}
    if arguments.columns is not None:
        provenance["columns"] = arguments.columns
    sharp = torch.zeros_like(fit.valid) if fit.sharp is None else fit.sharp
    found = dict(zip(RESULTS, (fit.normals, fit.curvature, sharp, fit.valid), strict=True))
    # As with segmentations, .npz holds the results alone, other formats the cloud's fields too.
    kept = {} if target.suffix.lower() == ".npz" else cloud.fields
    fields = put_results(kept, {name: values.numpy() for name, values in found.items()})
    write_cloud(target, replace(cloud, fields=fields), provenance=provenance)
    num_valid = int(fit.valid.sum())
    if num_valid < len(cloud):
        num_bad = len(cloud) - num_valid
        console.warn(f"{source}: {num_bad:,} of {len(cloud):,} points have no normal.")
    counted = "" if fit.sharp is None else f"{int(sharp.sum()):,} sharp, "
    seconds = time.perf_counter() - begin
    without = console.without(target, cloud.fields)
    console.say(f"{source}: {len(cloud):,} points, {counted}{seconds:.1f} s -> {target}{without}")
