"""Signs of the normals of clouds by what their files know, and by rooms where they know nothing."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from torchrg.errors import ConfigError
from torchrg.neighbors import search_knn
from torchrg.normals import estimate_normals, orient_normals
from torchrg.structures import Cloud


@pytest.fixture(scope="module")
def scanned(room):
    """A cloud far from the origin whose front is the outside, the normals that it is for, truth."""
    scene = room(6000, 0.003, 1)
    normals = estimate_normals(scene.points, method="pca", k=20).normals
    front = (-3 * scene.normals).float().numpy()
    return Cloud(scene.points.numpy().astype(np.float64) + 5e5, front=front), normals, scene


def agrees(normals, truth):
    return (normals * truth.to(normals)).sum(dim=1) > 0


def test_normals_look_to_the_front_whatever_signs_they_had(scanned):
    cloud, normals, scene = scanned
    for signs in (1, -1):
        turned = orient_normals(cloud, signs * normals)
        assert agrees(turned, -scene.normals)[normals.any(dim=1)].all()
        assert torch.equal(turned.abs(), normals.abs())
    assert torch.equal(
        orient_normals(cloud, normals, orient="interior"), orient_normals(cloud.points, normals)
    )


def test_without_a_front_rooms_are_seen_from_inside(scanned):
    cloud, normals, scene = scanned
    turned = orient_normals(replace(cloud, front=None), normals)
    assert torch.equal(turned, orient_normals(cloud.points, normals))
    assert agrees(turned, scene.normals).double().mean() > 0.9


def test_up_and_none_and_a_viewpoint_are_what_they_say(scanned):
    cloud, normals, _ = scanned
    assert orient_normals(cloud, normals, orient="none") is normals
    assert torch.equal(
        orient_normals(cloud, normals, orient="up"),
        orient_normals(cloud.points, normals, orient="+z"),
    )
    place = cloud.coordinates.mean(axis=0)
    turned = orient_normals(cloud, normals, orient="viewpoint", viewpoint=place)
    arms = torch.from_numpy(place - cloud.coordinates)
    assert ((turned.double() * arms).sum(dim=1) > -1e-4).all()


def test_few_points_without_a_front_follow_the_nearest_that_have_one(scanned):
    cloud, normals, scene = scanned
    front = cloud.front.copy()
    lost = torch.randperm(len(front), generator=torch.Generator().manual_seed(1))[:50]
    front[lost] = 0
    turned = orient_normals(replace(cloud, front=front), normals)
    # To the front, which is the outside, and not into the room.
    assert agrees(turned[lost], -scene.normals[lost]).double().mean() > 0.85
    order = torch.randperm(len(front), generator=torch.Generator().manual_seed(2))
    moved = Cloud(cloud.coordinates[order], front=front[order])
    assert torch.equal(orient_normals(moved, -normals[order]), turned[order])


@pytest.mark.parametrize("odd", range(4))
def test_all_of_the_nearest_points_decide_where_a_point_without_a_front_looks(odd):
    # Four points as near as one another: three of them were seen from above, one from below.
    near = torch.tensor([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    far = torch.cartesian_prod(torch.arange(20.0) + 9, torch.arange(20.0), torch.zeros(1))
    points = torch.cat([torch.zeros(1, 3), near, far])
    front = torch.tensor([0.0, 0, 1]).repeat(len(points), 1)
    front[0], front[1 + odd] = 0, -front[1 + odd]
    normals = torch.tensor([0.0, 0, -1]).repeat(len(points), 1)
    turned = orient_normals(Cloud(points.numpy(), front=front.numpy()), normals)
    assert turned[0].tolist() == [0, 0, 1]


def test_many_points_without_a_front_look_into_the_room(scanned):
    cloud, normals, _ = scanned
    front = cloud.front.copy()
    front[200:] = 0
    turned = orient_normals(replace(cloud, front=front), normals)
    assert torch.equal(turned[:200], orient_normals(cloud, normals)[:200])
    assert torch.equal(turned[200:], orient_normals(cloud.points, normals)[200:])


def test_points_without_normals_or_place_need_no_front(scanned):
    cloud, normals, scene = scanned
    front, normals = cloud.front.copy(), normals.clone()
    places = cloud.coordinates.copy()
    front[:3000], normals[:2000], places[2000:3000] = 0, 0, np.nan
    cloud = Cloud(places, front=front)
    turned = orient_normals(cloud, normals)
    assert not turned[:2000].any()
    assert agrees(turned[3000:], -scene.normals[3000:]).all()


def test_a_viewpoint_that_is_not_known_is_refused_with_the_repair(scanned):
    cloud, normals, _ = scanned
    named = replace(cloud, source="a.ply")
    message = (
        r"^a\.ply: expected a viewpoint, .* got none; pass the viewpoint .*, or use interior\.$"
    )
    with pytest.raises(ConfigError, match=message):
        orient_normals(named, normals, orient="viewpoint")
    # A front by poses is one of scanners.
    posed = replace(cloud, header={"scans": ()})
    assert torch.equal(
        orient_normals(posed, normals, orient="viewpoint"), orient_normals(cloud, normals)
    )
    with pytest.raises(ConfigError, match="expected orient to be one of auto"):
        orient_normals(cloud, normals, orient="inwards")


@pytest.mark.parametrize("orient", ["auto", "interior", "consistent", "up", "-x", "viewpoint"])
def test_estimated_normals_are_oriented_by_the_same_rule(room, orient):
    scene = room(3_000, 0.003, 1)
    points = torch.cat([scene.points, scene.points[:100], torch.full((1, 3), torch.nan)])
    side = {"orient": orient, "viewpoint": (1.0, 1.0, 1.0) if orient == "viewpoint" else None}
    stages = []
    fit = estimate_normals(points, method="pca", k=20, **side, on_stage=stages.append)
    unoriented = estimate_normals(points, method="pca", k=20)
    expected = orient_normals(points, unoriented.normals, **side)
    assert torch.equal(fit.normals, expected)
    assert torch.equal(fit.curvature, unoriented.curvature)
    assert stages == ["normals", "orientation"]
    near = search_knn(scene.points, 20)
    listed = estimate_normals(scene.points, method="pca", neighbors=near, **side)
    unoriented = estimate_normals(scene.points, method="pca", neighbors=near)
    expected = orient_normals(scene.points, unoriented.normals, **side, neighbors=near)
    assert torch.equal(listed.normals, expected)


def test_the_front_of_a_cloud_orients_estimated_normals():
    floor = np.random.default_rng(0).random((200, 3)) * [1, 1, 0]
    cloud = Cloud(floor, front=np.tile(np.float32([0, 0, -1]), (200, 1)))
    fit = estimate_normals(cloud, method="pca", k=10, orient="auto")
    assert (fit.normals[:, 2] < -0.99).all()
    with pytest.raises(ConfigError, match="estimate_normals: expected a viewpoint"):
        estimate_normals(floor, orient="viewpoint")
