"""Segmentations of the clouds, each computed once and kept with its times and scores."""

import time
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor

from reproduction.cells import Record
from reproduction.faces import score_faces
from reproduction.runs import Run
from torchrg import Cloud, load_config, read_cloud, segment_planes, write_cloud
from torchrg.metrics import score_clusters, score_labels
from torchrg.regions import grow_regions

SAMPLE_SIZE = 4000
"""Points of a cluster whose pairs the internal indices take all; see ``score_clusters``."""


@dataclass(frozen=True)
class Segmented:
    """Labels ``(N,)`` and normals ``(N, 3)``, read back from a file."""

    labels: Tensor
    normals: Tensor


def segment(run: Run, key: str, method: str) -> Record:
    """Segment a cloud by a method, and return the seconds of each stage and their ``total``."""
    cloud = run.cloud(key).cloud
    target = _result_path(run, key, method)

    def work() -> Record:
        run.warm_up(method)
        print(f"{cloud.name}, {method}:", end="", flush=True)
        begins: list[tuple[str, float]] = []

        def note(stage: str) -> None:
            begins.append((stage, time.perf_counter()))
            print(f" {stage}", end="", flush=True)

        seg = segment_planes(cloud.points, load_config(method), on_stage=note)
        total = begins[-1][1] - begins[0][1]
        print(f", {total:.1f} s", flush=True)
        target.parent.mkdir(parents=True, exist_ok=True)
        write_cloud(target, Cloud(cloud.points.numpy()), seg)
        return {
            "cloud": key,
            "title": cloud.title,
            "method": method,
            "points": len(cloud.points),
            "seconds": {stage: end - begin for (stage, begin), (_, end) in pairwise(begins)},
            "total": total,
            "sharp_fraction": float(seg.sharp.double().mean()),
        }

    return run.folder.cell(f"segment-{cloud.name}-{method}", work, needs=target)


def read_segmented(run: Run, key: str, method: str) -> Segmented:
    """Return a segmentation, computed first if it is not there yet."""
    segment(run, key, method)
    fields = read_cloud(_result_path(run, key, method)).fields
    return Segmented(*(torch.from_numpy(fields[name]) for name in ("labels", "normals")))


def score(run: Run, key: str, method: str) -> Record:
    """Score a segmentation by all indices against the truth of its cloud.

    Returns:
        The record: ``regions``, ``fraction_labeled``, and with a truth ``labels`` (the fields of
        :class:`torchrg.metrics.LabelScore`) and ``faces`` (:func:`reproduction.faces.score_faces`).
    """
    loaded = run.cloud(key)
    cloud = loaded.cloud

    def work() -> Record:
        labels = read_segmented(run, key, method).labels
        record = {"cloud": key, "title": cloud.title, "method": method, **count_regions(labels)}
        if cloud.labels is not None:
            record["labels"] = score_labels(labels, cloud.labels)._asdict()
            record["faces"] = score_faces(labels, cloud, loaded.at_edges)
        return record

    return run.folder.cell(f"score-{cloud.name}-{method}", work)


def score_sphere(run: Run, key: str, method: str) -> Record:
    """Return CP, SP, DBI, DVI of a segmentation, and two of them over distinct ``directions``."""
    cloud = run.cloud(key).cloud

    def work() -> Record:
        found = read_segmented(run, key, method)
        indices, directions = (
            score_clusters(
                found.normals, found.labels, sample_size=SAMPLE_SIZE, distinct_directions=distinct
            )
            for distinct in (False, True)
        )
        return {
            "title": cloud.title,
            **indices._asdict(),
            "directions": {"sp": directions.sp, "dbi": directions.dbi},
        }

    return run.folder.cell(f"sphere-{cloud.name}-{method}", work)


def regrow(run: Run, key: str, method: str, angle_deg: float, curvature_quantile: float) -> Tensor:
    """Return the labels ``(N,)`` that a method gives at another angle and limit of curvature.

    The angle is the one of the paper, that of sharp points and of growth.
    """
    usual = load_config(method)
    settings = usual.with_angle(angle_deg)
    growing = replace(settings.growing, curvature_quantile=curvature_quantile)
    if growing == usual.growing:
        return read_segmented(run, key, method).labels
    # Only the paper's normals depend on an angle; others are estimated once.
    normals = settings.normals if usual.normals.method == "paper" else usual.normals
    loaded = run.cloud(key)
    fit = loaded.fit(normals)
    return grow_regions(
        loaded.cloud.points,
        fit.normals,
        fit.curvature,
        loaded.neighbors,
        growing,
        valid=fit.valid,
        residual_rms=fit.residual_rms,
    )


def count_regions(labels: Tensor) -> Record:
    """Return how many regions there are, and the share of points that lie in one."""
    return {
        "regions": int(labels.max()) + 1,
        "fraction_labeled": float((labels >= 0).double().mean()),
    }


def _result_path(run: Run, key: str, method: str) -> Path:
    name = run.cloud(key).cloud.name
    return run.folder.path / "segmentations" / f"{name}-{method}.npz"
