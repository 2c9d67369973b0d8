"""Planes chosen again among those of the neighbors."""

import pytest
import torch

from torchrg import search_knn
from torchrg.config import NormalsConfig
from torchrg.normals import consensus
from torchrg.normals.consensus.smoothing import TangentPlanes, choose_planes


def test_a_point_takes_the_plane_of_its_face():
    steps = torch.arange(0.05, 1.0, 0.1)
    y, along = torch.cartesian_prod(steps, steps).unbind(dim=1)
    none = torch.zeros_like(y)
    points = torch.cat([torch.stack([along, y, none], dim=1), torch.stack([none, y, along], dim=1)])
    normals = torch.eye(3)[[2] * 100 + [0] * 100]
    wrong = torch.tensor([50, 150])  # Next to the edge, one on each face.
    planes = TangentPlanes(normals.clone(), torch.zeros(200))
    planes.normals[wrong] = torch.tensor([-(0.5**0.5), 0, 0.5**0.5])
    noise = torch.full((200,), 0.01)
    chosen = choose_planes(points, search_knn(points, 20), planes, noise, wrong, chunk_size=64)
    assert torch.equal(chosen.normals.abs(), normals)
    assert torch.equal(chosen.offsets, torch.zeros(200))


@pytest.mark.parametrize("seed", range(2))
def test_the_choice_improves_normals_at_edges(seed, room, monkeypatch):
    model = room(6000, 0.003, seed)
    neighbors = search_knn(model.points, 50)

    def wrong_fraction():
        fit = consensus.estimate_consensus(model.points, neighbors, NormalsConfig(k=50), 4096)
        cosine = (fit.normals * model.normals).sum(dim=1).abs()
        return float((cosine[fit.sharp] < 0.94).float().mean())

    with_choice = wrong_fraction()
    monkeypatch.setattr(consensus, "choose_planes", lambda points, near, planes, *_, **__: planes)
    assert with_choice < wrong_fraction() - 0.001
