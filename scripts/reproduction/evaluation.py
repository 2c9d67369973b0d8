"""Segmentations of the clouds, each computed once, with their times and metrics."""

import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from reproduction.clouds import EvalCloud, Run
from reproduction.records import Record
from torchrg import Cloud, load_config, read_cloud, segment_planes, write_cloud
from torchrg.metrics import contingency_table, match_regions, score_clusters, score_labels
from torchrg.regions import grow_regions
from torchrg.render.channels import OUTCOMES, point_outcomes

METHODS = ("classic", "classic_increment", "detmm", "algorithm2", "paper", "consensus")
"""Presets to compare.

The paper compares all methods under its own description of region growing (II.B), which tests the
increment of the curvature (``classic_increment``, ``detmm``); PCL's ``RegionGrowing`` tests the
curvature itself (``classic``). ``algorithm2`` drops unconnected neighbors, as Algorithm 2 is
printed; according to the text (``paper``), they join without becoming seeds.
"""

PAPERS = ("classic_increment", "detmm", "paper")
"""The paper's methods, from worst to best by its claims."""

DRAWN = (*PAPERS, "consensus")
"""Methods shown in figures."""

LARGE = 1000
"""Minimum number of points of a large surface."""

FOUND = 0.5
"""Intersection over union with a region above which a surface is detected."""

SAMPLE_SIZE = 4000
"""Number of points of a cluster above which ``score_clusters`` subsamples it."""

_RIGHT, _NONE = (list(OUTCOMES).index(name) for name in ("right", "none"))


class Segmented(NamedTuple):
    """Labels ``(N,)`` and normals ``(N, 3)``, read from a file."""

    labels: Tensor
    normals: Tensor


class Surfaces(NamedTuple):
    """Ground-truth surfaces of a cloud, matched with the regions of a method.

    Attributes:
        labels: Labels of the surfaces, shape ``(F,)``.
        sizes: Number of points of each, shape ``(F,)``.
        best_iou: Maximum intersection over union with a region, shape ``(F,)``.
        precision: Precision of the matched region, in percent, shape ``(F,)``; NaN if unmatched.
        recall: Recall of the matched region, in the same form.
    """

    labels: Tensor
    sizes: Tensor
    best_iou: Tensor
    precision: Tensor
    recall: Tensor

    def f1(self, chosen: Tensor) -> float | None:
        """Return the paper's F1 in percent of the chosen surfaces; None if all are unmatched."""
        matched = chosen & ~self.precision.isnan()
        if not matched.any():
            return None
        precision, recall = (float(x[matched].mean()) for x in (self.precision, self.recall))
        return 2 * precision * recall / (precision + recall)

    def f1_of_every(self) -> float | None:
        """Return the F1 with precision and recall 0 for unmatched surfaces."""
        precision, recall = (values.nan_to_num(0.0) for values in (self.precision, self.recall))
        return self._replace(precision=precision, recall=recall).f1(self.sizes > 0)

    def found(self, chosen: Tensor) -> float | None:
        """Return the fraction of the chosen surfaces that are detected; None without any."""
        return float((self.best_iou[chosen] > FOUND).double().mean()) if chosen.any() else None


def match_surfaces(labels: Tensor, truth: Tensor) -> Surfaces:
    """Match regions ``(N,)`` with ground-truth surfaces ``(N,)``."""
    table = contingency_table(labels, truth)
    pairs = match_regions(table)
    rows, shared = table.faces[pairs], 100 * table.overlaps[pairs].double()
    nothing = torch.full((len(table.face_labels),), torch.nan, dtype=torch.float64)
    return Surfaces(
        table.face_labels,
        table.face_sizes,
        torch.zeros_like(nothing).scatter_reduce(0, table.faces, table.iou.double(), "amax"),
        nothing.index_copy(0, rows, shared / table.region_sizes[table.regions[pairs]]),
        nothing.index_copy(0, rows, shared / table.face_sizes[rows]),
    )


def evaluate_surfaces(labels: Tensor, cloud: EvalCloud, at_edges: Tensor) -> Record:
    """Return metrics by size of the surfaces, at edges, of curved surfaces and of objects.

    Args:
        labels: Regions, shape ``(N,)``.
        cloud: Cloud with ground truth.
        at_edges: Points near an edge, shape ``(N,)``; see :func:`reproduction.clouds.find_edges`.
    """
    surfaces = match_surfaces(labels, cloud.labels)
    large = surfaces.sizes >= LARGE
    near = point_outcomes(labels, cloud.labels)[at_edges]
    metrics = {
        "f1_large": surfaces.f1(large),
        "f1_of_every": surfaces.f1_of_every(),
        "found_large": surfaces.found(large),
        "found_small": surfaces.found(~large),
        "right_at_edges": float((near == _RIGHT).double().mean()),
        "none_at_edges": float((near == _NONE).double().mean()),
    }
    if cloud.curved is not None:
        curved = torch.isin(surfaces.labels, cloud.curved)
        metrics |= {
            "found_curved": surfaces.found(curved & large),
            "found_flat": surfaces.found(~curved & large),
        }
    if cloud.objects is not None:
        objects = match_surfaces(labels, cloud.objects)
        every = objects.sizes > 0
        metrics["f1_objects"] = objects.f1(every)
        metrics["f1_objects_exact"] = match_surfaces(cloud.labels, cloud.objects).f1(every)
    return metrics


def segment(run: Run, key: str, method: str) -> Record:
    """Segment a cloud, and return the seconds of each stage and their ``total``."""
    cloud = run.cloud(key).cloud
    target = _result_path(run, key, method)

    def compute() -> Record:
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

    return run.folder.cell(f"segment-{cloud.name}-{method}", compute, needs=target)


def read_segmented(run: Run, key: str, method: str) -> Segmented:
    """Return a segmentation, computed if necessary."""
    segment(run, key, method)
    fields = read_cloud(_result_path(run, key, method)).fields
    return Segmented(*(torch.from_numpy(fields[name]) for name in ("labels", "normals")))


def evaluate(run: Run, key: str, method: str) -> Record:
    """Evaluate a segmentation against the ground truth of its cloud.

    Returns:
        The record: ``regions``, ``fraction_labeled``, and with ground truth ``labels`` (the fields
        of :class:`torchrg.metrics.LabelScore`) and ``faces`` (:func:`evaluate_surfaces`).
    """
    loaded = run.cloud(key)
    cloud = loaded.cloud

    def compute() -> Record:
        labels = read_segmented(run, key, method).labels
        record = {"cloud": key, "title": cloud.title, "method": method, **count_regions(labels)}
        if cloud.labels is not None:
            record["labels"] = score_labels(labels, cloud.labels)._asdict()
            record["faces"] = evaluate_surfaces(labels, cloud, loaded.at_edges)
        return record

    return run.folder.cell(f"score-{cloud.name}-{method}", compute)


def evaluate_sphere(run: Run, key: str, method: str) -> Record:
    """Return CP, SP, DBI and DVI, and SP and DBI with one cluster per direction."""
    cloud = run.cloud(key).cloud

    def compute() -> Record:
        found = read_segmented(run, key, method)
        indices, directions = (
            score_clusters(
                found.normals, found.labels, sample_size=SAMPLE_SIZE, distinct_directions=distinct
            )
            for distinct in (False, True)
        )
        merged = {"sp": directions.sp, "dbi": directions.dbi}
        return {"title": cloud.title, **indices._asdict(), "directions": merged}

    return run.folder.cell(f"sphere-{cloud.name}-{method}", compute)


def regrow(run: Run, key: str, method: str, angle_deg: float, curvature_quantile: float) -> Tensor:
    """Return the labels ``(N,)`` of a method with another angle and curvature limit.

    As in the paper, the angle applies to sharp points and to growth.
    """
    default = load_config(method)
    config = default.with_angle(angle_deg)
    growing = replace(config.growing, curvature_quantile=curvature_quantile)
    if growing == default.growing:
        return read_segmented(run, key, method).labels
    # Only the paper's normals depend on the angle.
    normals = config.normals if default.normals.method == "paper" else default.normals
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
    """Return the number of regions, and the fraction of labeled points."""
    labeled = float((labels >= 0).double().mean())
    return {"regions": int(labels.max()) + 1, "fraction_labeled": labeled}


def _result_path(run: Run, key: str, method: str) -> Path:
    name = run.cloud(key).cloud.name
    return run.folder.path / "segmentations" / f"{name}-{method}.npz"
