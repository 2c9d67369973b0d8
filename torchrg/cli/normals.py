"""``torchrg normals``: normals and curvature of scans."""

import dataclasses
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from torchrg.cli import flags, loop
from torchrg.cli.arguments import parse
from torchrg.cli.ending import print_lines, warn
from torchrg.config import NormalMethod, NormalsConfig, PipelineConfig, load_config
from torchrg.datasets.provenance import describe_run
from torchrg.errors import ConfigError
from torchrg.io import check_output, read_cloud, write_cloud
from torchrg.io.fields import add_result_fields
from torchrg.io.npy import DISPLAYED_FIELDS
from torchrg.neighbors import distinct_points
from torchrg.normals import estimate_normals
from torchrg.normals.orient import find_directions
from torchrg.pipeline.clouds import check_finite, note_on_copies

RESULTS = ("normals", "curvature", "sharp", "valid")
"""Per-point output fields."""


@dataclass(frozen=True)
class Arguments:
    """Estimate normals, curvature and sharp points of scans.

    Examples:
        torchrg normals scan.pcd --out normals.ply
        torchrg normals scan.ply --out normals.ply --orient none
        torchrg normals scan.ply --out normals.npz --method pca --normals.k 30
        torchrg normals scan.e57 --out normals.laz --orient viewpoint
        torchrg normals scan.ply --out normals.ply --orient viewpoint --viewpoint 0 0 1.6
    """

    inputs: flags.CloudsFlag
    out: flags.OutFlag
    method: NormalMethod | None = None
    """Normal estimator; short form of --normals.method."""
    orient: flags.OrientFlag = "auto"
    viewpoint: flags.ViewpointFlag = None
    normals: NormalsConfig = dataclasses.field(default_factory=lambda: load_config().normals)
    """Normals and curvature."""
    chunk_size: int = PipelineConfig.chunk_size
    """Points processed at a time; bounds memory use."""
    threads: flags.ThreadsFlag = None
    columns: flags.ColumnsFlag = None


def run(argv: list[str]) -> int:
    """Parse the arguments, estimate the normals of each input and write them."""
    arguments = parse(Arguments, argv, prog="torchrg normals")
    if arguments.chunk_size < 1:
        raise ConfigError(f"expected --chunk-size >= 1, got {arguments.chunk_size}.")
    flags.check_viewpoint(arguments.viewpoint, arguments.orient)
    flags.limit_threads(arguments.threads)
    if arguments.method is not None:
        arguments = replace(arguments, normals=replace(arguments.normals, method=arguments.method))
    flags.check_columns(arguments.columns, arguments.inputs)
    outputs = loop.output_paths(arguments.inputs, arguments.out)
    loop.check_distinct(outputs, arguments.inputs)
    return loop.run_each(_estimate_file, arguments, arguments.inputs, outputs)


def _estimate_file(arguments: Arguments, source: Path, target: Path) -> None:
    """Estimate the normals of one file."""
    begin = time.perf_counter()
    cloud = read_cloud(source, columns=flags.file_columns(source, arguments.columns))
    loop.note_input(f"{source}", cloud, target, RESULTS)
    for note in check_finite(cloud):
        warn(f"{source}: {note}.")
    side: dict[str, Any] = {"orient": arguments.orient, "viewpoint": arguments.viewpoint}
    # Fail before the computation.
    find_directions("normals", cloud, **side)
    check_output(target, cloud)
    with loop.stage_bar(source.name, ("normals", "orientation")) as advance:
        side |= {"chunk_size": arguments.chunk_size, "on_stage": advance}
        fit = estimate_normals(cloud, arguments.normals, **side)
    for note in note_on_copies(distinct_points(cloud.points).num_copies, len(cloud)):
        print_lines(f"{source}: {note}")
    provenance = describe_run(source, arguments.normals)
    names = ("orient", "viewpoint", *["columns"] * (arguments.columns is not None))
    provenance |= {name: getattr(arguments, name) for name in names}
    sharp = torch.zeros_like(fit.valid) if fit.sharp is None else fit.sharp
    results = zip(RESULTS, (fit.normals, fit.curvature, sharp, fit.valid), strict=True)
    keeps_fields = not loop.has_suffix(target, ".npz")
    fields = {
        name: v for name, v in cloud.fields.items() if keeps_fields or name in DISPLAYED_FIELDS
    }
    fields = add_result_fields(fields, {name: values.numpy() for name, values in results})
    write_cloud(target, replace(cloud, fields=fields), provenance=provenance)
    num_lost = int((~fit.valid.numpy() & cloud.finite).sum())
    if num_lost:
        warn(f"{source}: {num_lost:,} of {len(cloud):,} finite points have no normal.")
    counted = "" if fit.sharp is None else f"{int(sharp.sum()):,} sharp, "
    seconds = time.perf_counter() - begin
    destination = f"{target}{loop.dropped_fields_note(target, cloud.fields)}"
    print_lines(f"{source}: {len(cloud):,} points, {counted}{seconds:.1f} s -> {destination}")
