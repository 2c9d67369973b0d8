"""Segmentations of the clouds, each computed once and kept with its times and scores."""

import time
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor

from reproduction.cells import Record
from reproduction.methods import settings_of
from reproduction.runs import Run
from torchrg import Cloud, read_cloud, segment_planes, write_cloud
from torchrg.metrics import score_clusters, score_labels, score_normals
from torchrg.regions import grow_regions

SAMPLE_SIZE = 4000
"""Points of a cluster whose pairs the internal indices take all; see ``score_clusters``."""


@dataclass(frozen=True)
class Segmented:
    """Labels ``(N,)``, normals ``(N, 3)`` and validity ``(N,)``, read back from a file."""

    labels: Tensor
    normals: Tensor
    valid: Tensor


def segment(run: Run, key: str, preset: str) -> Record:
    """Segment a cloud by a method, and return the seconds of each stage and their ``total``."""
    cloud = run.cloud(key).cloud
    target = _result_path(run, key, preset)

    def work() -> Record:
        run.warm_up(preset)
        print(f"{cloud.name}, {preset}:", end="", flush=True)
        begins: list[tuple[str, float]] = []

        def note(stage: str) -> None:
            begins.append((stage, time.perf_counter()))
            print(f" {stage}", end="", flush=True)

        seg = segment_planes(cloud.points, settings_of(preset), on_stage=note)
        total = begins[-1][1] - begins[0][1]
        print(f", {total:.1f} s", flush=True)
        target.parent.mkdir(parents=True, exist_ok=True)
        write_cloud(target, Cloud(cloud.points.numpy()), seg)
        return {
            "cloud": key,
            "preset": preset,
            "points": len(cloud.points),
            "seconds": {stage: end - begin for (stage, begin), (_, end) in pairwise(begins)},
            "total": total,
            "sharp_fraction": float(seg.sharp.double().mean()),
        }

    return run.folder.cell(f"segment-{cloud.name}-{preset}", work, needs=target)


def read_segmented(run: Run, key: str, preset: str) -> Segmented:
    """Return a segmentation, computed first if it is not there yet."""
    segment(run, key, preset)
    fields = read_cloud(_result_path(run, key, preset)).fields
    names = ("labels", "normals", "valid")
    return Segmented(*(torch.from_numpy(fields[name]) for name in names))


def score(run: Run, key: str, preset: str, *, internal: bool) -> Record:
    """Score a segmentation by all indices that its cloud allows.

    Args:
        run: The call.
        key: Of the cloud.
        preset: A key of :data:`reproduction.methods.METHODS`.
        internal: Whether to add CP, SP, DBI and DVI, of faces and of distinct directions.

    Returns:
        The record: ``labels`` and ``normals`` where there is a truth, ``clusters`` and
        ``directions`` if asked for, and ``regions`` and ``share_labeled``.
    """
    cloud = run.cloud(key).cloud

    def work() -> Record:
        found = read_segmented(run, key, preset)
        record = {"cloud": key, "preset": preset, **count_regions(found.labels)}
        if cloud.labels is not None:
            record["labels"] = score_labels(found.labels, cloud.labels)._asdict()
        if cloud.normals is not None:
            valid = found.valid
            record["normals"] = score_normals(found.normals, cloud.normals, valid=valid)._asdict()
        if internal:
            for name, distinct in (("clusters", False), ("directions", True)):
                record[name] = score_clusters(
                    found.normals,
                    found.labels,
                    distinct_directions=distinct,
                    sample_size=SAMPLE_SIZE,
                )._asdict()
        return record

    kind = "indices" if internal else "external"
    return run.folder.cell(f"{kind}-{cloud.name}-{preset}", work)


def regrow(
    run: Run, key: str, preset: str, max_angle_deg: float, curvature_quantile: float
) -> Tensor:
    """Return the labels ``(N,)`` that a preset gives with other limits of growth."""
    growing = settings_of(preset).growing
    if (max_angle_deg, curvature_quantile) == (growing.max_angle_deg, growing.curvature_quantile):
        return read_segmented(run, key, preset).labels
    settings = replace(growing, max_angle_deg=max_angle_deg, curvature_quantile=curvature_quantile)
    loaded = run.cloud(key)
    fit = loaded.fit(preset)
    return grow_regions(
        loaded.cloud.points,
        fit.normals,
        fit.curvature,
        loaded.neighbors,
        settings,
        valid=fit.valid,
        residual_rms=fit.residual_rms,
    )


def count_regions(labels: Tensor) -> Record:
    """Return how many regions there are, and the share of points that lie in one."""
    return {
        "regions": int(labels.max()) + 1,
        "share_labeled": float((labels >= 0).double().mean()),
    }


def _result_path(run: Run, key: str, preset: str) -> Path:
    name = run.cloud(key).cloud.name
    return run.folder.path / "segmentations" / f"{name}-{preset}.npz"
