"""Labels do not depend on order, chunks, threads, unit or origin."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.regions import growing_clouds
from tests.regions.growing_clouds import papers_growing
from torchrg.config import load_config
from torchrg.neighbors import search_knn
from torchrg.regions import grow_regions
from torchrg.structures import Neighbors

# Of consensus only what needs no residuals.
PRESETS = {name: load_config(name).growing for name in ("classic", "paper", "consensus")}
PRESETS["consensus"] = dataclasses.replace(PRESETS["consensus"], plane_reach=None)
SMALL = {"min_size": 3, "max_angle_deg": 12.0}
CONFIGS = {name: dataclasses.replace(config, **SMALL) for name, config in PRESETS.items()} | {
    "seeds by value": papers_growing(seed_rule="curvature", **SMALL),
    "as printed": papers_growing(connectivity_scope="region", **SMALL),
}


def clouds(kind, seed=0, k=10, **options):
    return growing_clouds.prepare(
        growing_clouds.KINDS[kind](np.random.default_rng(seed)), k, **options
    )


def permuted(points, normals, curvature, neighbors, order):
    """The same cloud with its rows, and the rows its neighbors name, in another order."""
    row_of = torch.empty_like(order)
    row_of[order] = torch.arange(len(order))
    indices = row_of[neighbors.indices[order].long()].to(torch.int32)
    return points[order], normals[order], curvature[order], Neighbors(indices)


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
@pytest.mark.parametrize("kind", ["room", "lattice", "blob"])
def test_labels_follow_the_points_into_any_order(kind, config, rng):
    cloud = clouds(kind, ties=5)
    labels = grow_regions(*cloud, config)
    assert labels.max() > 0
    order = torch.randperm(len(labels), generator=rng)
    assert torch.equal(grow_regions(*permuted(*cloud, order), config), labels[order])


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
def test_swapped_duplicates_are_all_that_another_order_changes(config, rng):
    points, normals, curvature, _ = clouds("doubled", ties=5)

    def labelled_places(order):
        neighbors = search_knn(points[order], 10)
        labels = grow_regions(points[order], normals[order], curvature[order], neighbors, config)
        rows = torch.cat([points[order], labels[:, None].double()], dim=1)
        return sorted(rows.tolist())

    first = labelled_places(torch.arange(len(points)))
    assert labelled_places(torch.randperm(len(points), generator=rng)) == first


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
def test_labels_do_not_depend_on_chunk_size_or_threads(config, set_threads):
    cloud = clouds("quantized", dtype=torch.float32)
    labels = grow_regions(*cloud, config)
    for chunk_size in (1, 7, 64, 1000):
        assert torch.equal(grow_regions(*cloud, config, chunk_size=chunk_size), labels)
    for threads in (3, 1):
        set_threads(threads)
        assert torch.equal(grow_regions(*cloud, config, chunk_size=50), labels)


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
@pytest.mark.parametrize("kind", ["noisy room", "exact room", "lattice"])
def test_labels_do_not_depend_on_unit_or_origin(kind, config):
    points, normals, curvature, neighbors = clouds(kind)
    labels = grow_regions(points, normals, curvature, neighbors, config)
    for moved in (points * 1e-4, points * 1e3, points + torch.tensor([5e6, -5e6, 100.0])):
        again = grow_regions(moved, normals, curvature, neighbors, config, canonical=True)
        assert torch.equal(again, labels)
