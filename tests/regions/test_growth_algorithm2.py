"""The library's labels against a literal Algorithm 2, for every combination of settings."""

import contextlib
import dataclasses
import itertools

import numpy as np
import pytest
import torch
from pypcd4 import PointCloud

from tests.kernels.clouds import definitions
from tests.regions import algorithm2, growing_clouds
from tests.regions.growing_clouds import papers_growing
from torchrg.neighbors import search_knn
from torchrg.regions import grow_regions

RULES = [
    {
        "seed_rule": seed_rule,
        "curvature_scope": curvature_scope,
        "connectivity": connectivity,
        "connectivity_scope": scope,
        "coplanarity": coplanarity_scope is not None,
        "coplanarity_scope": coplanarity_scope or "all",
    }
    for seed_rule, curvature_scope, (connectivity, scope), coplanarity_scope in itertools.product(
        ["curvature", "increment"],
        ["cloud", "neighborhood"],
        [(None, "region"), (0.5, "region"), (0.5, "seed")],
        [None, "all", "connected"],
    )
    if curvature_scope == "cloud" or coplanarity_scope is None
]
VARIANTS = [
    {"k": 8, "max_angle_deg": 10.0, "curvature_quantile": 0.8, "min_size": 1},
    {"k": 12, "max_angle_deg": 25.0, "curvature_quantile": 0.5, "min_size": 5, "ties": 4},
    {"k": 6, "max_angle_deg": 5.0, "curvature_quantile": 0.95, "min_size": 7, "f32": True},
]


def expected_labels(points, normals, curvature, neighbors, config, valid=None, residual_rms=None):
    counted = torch.ones_like(neighbors.indices, dtype=torch.bool)
    counted = counted if neighbors.valid is None else neighbors.valid
    knn = [row[c].tolist() for row, c in zip(neighbors.indices, counted, strict=True)]
    settings = {
        f.name: getattr(config, f.name)
        for f in dataclasses.fields(config)
        if f.name in algorithm2.segment.__kwdefaults__
    }
    return algorithm2.segment(
        points.tolist(),
        normals.tolist(),
        curvature.tolist(),
        knn,
        k=neighbors.indices.shape[1],
        valid=None if valid is None else valid.tolist(),
        residual_rms=None if residual_rms is None else residual_rms.tolist(),
        **settings,
    )


def check_rules(coordinates, chosen, k=8, ties=0, f32=False, **settings):
    dtype = torch.float32 if f32 else torch.float64
    cloud = growing_clouds.prepare(coordinates, k, dtype=dtype, ties=ties)
    for rules in chosen:
        config = papers_growing(**rules, **settings)
        expected = expected_labels(*cloud, config)
        for way in (contextlib.nullcontext(), definitions()):
            with way:
                labels = grow_regions(*cloud, config, canonical=True, chunk_size=64)
            assert labels.tolist() == expected, config


@pytest.mark.parametrize(
    ("kind", "variant"),
    [(kind, place % len(VARIANTS)) for place, kind in enumerate(growing_clouds.KINDS)],
)
def test_labels_equal_the_literal_algorithm(kind, variant):
    rng = np.random.default_rng(variant)
    # Every rule meets about six of the kinds.
    half = RULES[list(growing_clouds.KINDS).index(kind) % 2 :: 2]
    check_rules(growing_clouds.KINDS[kind](rng), half, **VARIANTS[variant])


@pytest.mark.parametrize("kind", growing_clouds.KINDS)
def test_labels_equal_the_literal_algorithm_for_settings_drawn_at_random(kind):
    rng = np.random.default_rng(list(growing_clouds.KINDS).index(kind))
    for _ in range(10):
        k, ties = int(rng.integers(4, 12)), int(rng.choice([0, 3, 6]))
        cloud = growing_clouds.prepare(growing_clouds.KINDS[kind](rng), k, ties=ties)
        rules = dict(RULES[rng.integers(len(RULES))])
        if rules["connectivity"] is not None:
            rules["connectivity"] = float(rng.choice([0.3, 0.5, 0.75]))
        config = papers_growing(
            **rules,
            max_angle_deg=float(rng.choice([3.0, 8.0, 20.0, 40.0])),
            curvature_quantile=float(rng.choice([0.0, 0.3, 0.6, 0.95, 1.0])),
            min_size=int(rng.choice([1, 2, k + 1])),
        )
        valid = torch.from_numpy(rng.random(len(cloud[0])) < 0.9)
        with rng.choice([contextlib.nullcontext(), definitions()]):
            labels = grow_regions(*cloud, config, valid=valid, canonical=True)
        assert labels.tolist() == expected_labels(*cloud, config, valid), config


@pytest.mark.parametrize("name", ["region_growing_tutorial.pcd", "room_scan1.pcd"])
@pytest.mark.parametrize("corner", [0.3, 0.6])
def test_labels_equal_the_literal_algorithm_on_crops_of_scans(scan, name, corner):
    points = PointCloud.from_path(scan(name)).numpy(("x", "y", "z"))
    points = points[np.isfinite(points).all(axis=1)]
    center = points[int(corner * len(points))]
    nearest = np.argsort(((points - center) ** 2).sum(axis=1), kind="stable")[:120]
    settings = {"k": 10, "max_angle_deg": 8.0, "curvature_quantile": 0.9, "min_size": 3}
    check_rules(points[nearest], RULES[::3], **settings)


@pytest.mark.parametrize("rules", RULES[::3])
def test_neighbors_beyond_the_search_radius_do_not_count(rules):
    rng = np.random.default_rng(6)
    points, normals, curvature, neighbors = growing_clouds.prepare(
        growing_clouds.room(rng, 250, 0.005), 10
    )
    limited = search_knn(points, 10, max_distance=0.11, canonical=True)
    assert not limited.valid.all()
    config = papers_growing(**{**rules, "connectivity": 0.3}, min_size=1, max_angle_deg=15.0)
    cloud = (points, normals, curvature, limited)
    labels = grow_regions(*cloud, config, canonical=True)
    assert labels.tolist() == expected_labels(*cloud, config)
    assert labels.tolist() != grow_regions(points, normals, curvature, neighbors, config).tolist()


@pytest.mark.parametrize("kind", ["room", "plates", "quantized", "sphere"])
@pytest.mark.parametrize("coplanarity", [True, False])
def test_planes_that_each_point_must_be_on(kind, coplanarity):
    rng = np.random.default_rng(3)
    coordinates = growing_clouds.KINDS[kind](rng)
    cloud = growing_clouds.prepare(coordinates, 9, dtype=torch.float64)
    # Exact fits, for which eq. 11 decides, and others.
    rms = torch.from_numpy(0.03 * rng.random(len(coordinates)))
    rms[::3] = 0
    for connectivity, scope in ((None, "seed"), (0.5, "region"), (0.5, "seed")):
        config = papers_growing(
            max_angle_deg=25.0,
            seed_rule="curvature",
            connectivity=connectivity,
            connectivity_scope=scope,
            coplanarity=coplanarity,
            plane_reach=1.5,
            min_size=3,
        )
        labels = grow_regions(*cloud, config, canonical=True, residual_rms=rms, chunk_size=64)
        assert labels.tolist() == expected_labels(*cloud, config, residual_rms=rms)
        loose = grow_regions(*cloud, dataclasses.replace(config, plane_reach=None), canonical=True)
        assert kind == "sphere" or labels.tolist() != loose.tolist()
