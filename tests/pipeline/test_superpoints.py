"""Superpoints of meshes: along edges, in the numbers and types of ScanNet's Segmentator."""

import numpy as np
import pytest
import torch

import torchrg as segmentator
from tests.made.cameras import cameras_around, render_depth
from tests.made.scanners import build_scanned_room
from torchrg.config import SuperpointsConfig, load_config
from torchrg.errors import ShapeError
from torchrg.metrics import score_partition
from torchrg.pipeline import make_superpoints, segment_planes

CLASSIC = load_config("classic")


def grid_faces(height, width):
    """Two triangles of each cell of a grid of vertices."""
    first = np.arange(height * width).reshape(height, width)
    a, b, c, d = first[:-1, :-1], first[:-1, 1:], first[1:, :-1], first[1:, 1:]
    halves = [np.stack(corners, -1).reshape(-1, 3) for corners in ((a, b, c), (b, d, c))]
    return torch.from_numpy(np.concatenate(halves))


@pytest.fixture(scope="module")
def mesh():
    """A frame of a Kinect in a made room as a mesh, without the triangles across steps."""
    model = build_scanned_room(seed=2)
    (camera,) = cameras_around(model, 1, width=96, height=72)
    frame = render_depth(model, camera, sensor="kinect")
    vertices = (torch.from_numpy(camera.rays()) * frame.depth[..., None]).reshape(-1, 3).float()
    faces = grid_faces(*frame.depth.shape)
    depth = frame.depth.reshape(-1)[faces]
    kept = (depth > 0).all(dim=1) & (depth.amax(1) - depth.amin(1) < 0.08)
    used = torch.unique(faces[kept])
    row = torch.full((len(vertices),), -1)
    row[used] = torch.arange(len(used))
    return vertices[used], row[faces[kept]], frame.labels.reshape(-1)[used]


def literal_segments(vertices, faces, k_thresh=0.01, least=20):
    """Felzenszwalb's segmentation on the edges of a mesh, vertex by vertex.

    An edge weighs 1 less the cosine of the normals, squared where the surface is convex; parts join
    along an edge that weighs no more than the largest edge in each and k over its size.
    """
    v, f = vertices.double().numpy(), faces.numpy()
    normal = np.zeros_like(v)
    across = np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    for corner in range(3):
        np.add.at(normal, f[:, corner], across)
    normal /= np.bincount(f.reshape(-1), minlength=len(v))[:, None]
    edges = np.concatenate([f[:, [0, 1]], f[:, [0, 2]], f[:, [2, 1]]])
    along = v[edges[:, 1]] - v[edges[:, 0]]
    weight = 1 - (normal[edges[:, 0]] * normal[edges[:, 1]]).sum(axis=1)
    convex = (normal[edges[:, 1]] * along).sum(axis=1) > 0
    weight = np.where(convex, weight**2, weight)
    owner, size = np.arange(len(v)), np.ones(len(v), int)
    bound = np.full(len(v), k_thresh)

    def find(x):
        while owner[x] != x:
            owner[x] = owner[owner[x]]
            x = owner[x]
        return x

    for edge in np.argsort(weight, kind="stable"):
        a, b = find(edges[edge, 0]), find(edges[edge, 1])
        if a != b and weight[edge] <= min(bound[a], bound[b]):
            owner[b] = a
            size[a] += size[b]
            bound[a] = weight[edge] + k_thresh / size[a]
    for one, other in edges:
        a, b = find(one), find(other)
        if a != b and min(size[a], size[b]) < least:
            owner[b] = a
            size[a] += size[b]
    return torch.tensor([find(x) for x in range(len(v))])


def test_the_call_of_other_programs_gives_what_they_expect(mesh):
    vertices, faces, _ = mesh
    superpoint = segmentator.segment_mesh(vertices, faces).numpy()
    assert superpoint.shape == (len(vertices),)
    assert superpoint.dtype == np.int64
    sizes = np.bincount(superpoint)
    assert (np.diff(sizes) <= 0).all()
    assert sizes[-1] > 0


def test_they_are_about_as_many_as_segmentators_and_hold_to_faces_better(mesh):
    vertices, faces, labels = mesh
    ours, theirs = segmentator.segment_mesh(vertices, faces), literal_segments(vertices, faces)
    count = len(torch.unique(theirs))
    assert 0.5 * count <= int(ours.max()) + 1 <= 1.5 * count
    accuracy = score_partition(theirs, labels, vertices).asa
    assert score_partition(ours, labels, vertices).asa > accuracy + 0.02


def test_sheets_that_no_edge_joins_stay_apart():
    x, y = np.meshgrid(np.arange(15.0), np.arange(15.0))
    sheet = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)
    vertices = torch.from_numpy(np.concatenate([sheet, sheet + np.array([0.3, 0.4, 0.2])])).float()
    faces = torch.cat([grid_faces(15, 15), grid_faces(15, 15) + 225])
    with_faces = segmentator.segment_mesh(vertices, faces, config=CLASSIC)
    assert len(torch.unique(with_faces[:225])) == len(torch.unique(with_faces[225:])) == 1
    assert with_faces[0] != with_faces[225]
    assert len(torch.unique(segmentator.segment_mesh(vertices, config=CLASSIC))) == 1


def test_the_order_of_vertices_and_faces_changes_nothing(mesh):
    vertices, faces, _ = mesh
    random = torch.Generator().manual_seed(0)
    order = torch.randperm(len(vertices), generator=random)
    row = order.argsort()
    mixed = row[faces][torch.randperm(len(faces), generator=random)].flip(1)
    given = segmentator.segment_mesh(vertices, faces, config=CLASSIC)
    again = segmentator.segment_mesh(vertices[order], mixed.numpy(), config=CLASSIC)
    assert torch.equal(again, given[order])


def test_without_faces_they_are_those_of_points(mesh):
    vertices, _, _ = mesh
    config = SuperpointsConfig(strengths=(2.0,), min_size=30)
    expected = make_superpoints(vertices, segment_planes(vertices, CLASSIC), config).labels
    found = segmentator.segment_mesh(vertices, None, 0.02, 30, config=CLASSIC)
    assert torch.equal(found, expected)


def test_vertices_with_many_edges_and_without_any():
    angle = torch.linspace(0, 6.2, 200)
    rim = torch.stack([angle.cos(), angle.sin(), torch.zeros(200)], dim=1)
    vertices = torch.cat([torch.zeros(1, 3), rim, torch.tensor([[9.0, 9, 9], [torch.nan, 0, 0]])])
    spokes = torch.arange(1, 200)
    faces = torch.stack([torch.zeros_like(spokes), spokes, spokes + 1], dim=1)
    found = segmentator.segment_mesh(vertices, faces, 0.02, config=CLASSIC)
    assert found.tolist() == [0] * 201 + [1, -1]


def test_mistakes_are_told(mesh):
    vertices, faces, _ = mesh
    for wrong in (faces + len(vertices), faces - 1):
        with pytest.raises(ShapeError, match=r"segment_mesh: expected vertex indices in"):
            segmentator.segment_mesh(vertices, wrong)
    with pytest.raises(ShapeError, match="expected faces"):
        segmentator.segment_mesh(vertices, faces[:, :2])
