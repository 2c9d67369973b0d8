"""Functions of clouds under compilers and transformations."""

import pytest
import torch
from torch import nn
from torch._dynamo.testing import CompileCounter

import torchrg
from tests.test_opaque import FUNCTIONS, of_torch
from torchrg import estimate_normals, grow_regions, make_superpoints, search_knn, segment_planes
from torchrg.depth import segment_depth
from torchrg.errors import ShapeError
from torchrg.normals import orient_normals
from torchrg.transforms import EstimateNormals, SegmentPlanes


class Model(nn.Module):
    """A model with a function of clouds in its middle."""

    def __init__(self, middle):
        super().__init__()
        torch.manual_seed(0)
        self.before, self.middle, self.after = nn.Linear(3, 3), middle, nn.Linear(3, 3)

    def forward(self, points):
        return self.after(self.middle(self.before(points)))


def regions_of(points):
    neighbors = search_knn(points, 5)
    return grow_regions(points, points, points[:, 0], neighbors, "classic")


CAMERA = torch.tensor([[30.0, 0, 1], [0, 30, 19.5], [0, 0, 1]])
NORMALS, PLANES = EstimateNormals(method="pca", k=8), SegmentPlanes("classic")
MIDDLES = {
    "estimate_normals": lambda points: estimate_normals(points, method="pca", k=8).normals,
    "EstimateNormals": lambda points: NORMALS({"coord": points})["normal"],
    "segment_planes": lambda points: points * (segment_planes(points).labels[:, None] + 1),
    "SegmentPlanes": lambda points: PLANES({"coord": points})["normal"],
    "search_knn": lambda points: points[search_knn(points, 3).indices[:, 2]],
    "orient_normals": lambda points: orient_normals(points, points),
    "make_superpoints": lambda points: points * (make_superpoints(points).labels[:, None] + 1),
    "grow_regions": lambda points: points * (2 + regions_of(points)[:, None]),
    "segment_depth": lambda points: points * (2 + segment_depth(points, CAMERA).labels),
}
OF_CLOUDS = set(MIDDLES) - {"EstimateNormals", "SegmentPlanes"}


# Torch's own, when a graph goes on with a tensor in its middle.
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor:UserWarning")
@pytest.mark.parametrize("name", MIDDLES)
def test_functions_of_clouds_break_a_graph_and_the_rest_is_compiled(name):
    model, points = (
        Model(MIDDLES[name]),
        torch.rand(40, 3, generator=torch.Generator().manual_seed(0)),
    )
    torch._dynamo.reset()
    counter = CompileCounter()
    found = torch.compile(model, backend=counter)(points)
    assert torch.equal(found, model(points))
    found.sum().backward()
    # One graph before and one behind, with a Linear each.
    assert counter.frame_count >= 2
    assert model.before.weight.grad is None or model.before.weight.grad.isfinite().all()


@pytest.mark.parametrize("name", sorted(OF_CLOUDS))
@pytest.mark.parametrize("call", [torch.vmap, torch.func.grad, torch.func.jacrev])
def test_functions_of_clouds_say_where_they_do_not_run(call, name):
    with pytest.raises(ShapeError, match=r"\w+: expected points with values, got a tensor of vmap"):
        call(lambda points: MIDDLES[name](points).sum())(torch.rand(2, 9, 3))


@of_torch
@pytest.mark.parametrize("name", sorted(OF_CLOUDS))
def test_functions_of_clouds_are_not_exported(name):
    class Whole(nn.Module):
        def forward(self, points):
            return MIDDLES[name](points)

    with pytest.raises(torch._dynamo.exc.Unsupported):
        torch.export.export(Whole(), (torch.rand(40, 3),), strict=True)


# What the tests of this file call otherwise.
NAMES = {
    "pca": "fit_normals_pca",
    "jet": "fit_normals_jet",
    "irls": "fit_normals_irls",
    "robust normals": "fit_normals_robust",
    **{name: f"fit_{name}" for name in ("detmcd", "fastmcd", "mve", "dets", "detmm")},
}


@pytest.mark.parametrize(
    ("kind", "tested"), [("Functions of patches", FUNCTIONS), ("Functions of clouds", OF_CLOUDS)]
)
def test_the_reference_names_the_functions_that_are_tested(kind, tested):
    listed = torchrg.__doc__.split(f"{kind} (")[1].partition(")")[0]
    names = {NAMES.get(name, name) for name in tested}
    assert set(listed.replace("`", "").replace(",", " ").split()) == names
