"""``torch.set_default_device`` is for the caller's own tensors: it changes no result."""

import pytest
import torch

import torchrg
from tests.calls import calls, sample_of, segmented_room
from tests.test_inputs import CALLS, argument
from torchrg import transforms
from torchrg.config import SuperpointsConfig, preset_names
from torchrg.io.result import Result
from torchrg.normals import orient_normals
from torchrg.structures import Cloud

NUM_POINTS = 4000
"""With fewer, no walls are found that say how a room is turned."""
ROOM, SEG = segmented_room(NUM_POINTS)
POINTS, FEW, SAMPLE = ROOM.points, ROOM.points[:1000], sample_of(NUM_POINTS)
VIEWPOINT = torch.ones(3)
ARGUMENTS = {name: argument(name) for name in CALLS}
EVERYTHING = calls(NUM_POINTS) | {
    "align_axes, up": lambda: torchrg.align_axes(SEG, up=(0.1, 0, 1)),
    "orient_normals, ways": lambda: [
        orient_normals(POINTS, SEG.normals, orient=way, viewpoint=place)
        for way, place in (("consistent", None), ("interior", None), ("viewpoint", VIEWPOINT))
    ],
    "score_clusters, all": lambda: torchrg.metrics.score_clusters(SEG.normals, SEG.labels),
    "superpoints by count": lambda: torchrg.make_superpoints(
        POINTS, SEG, SuperpointsConfig(counts=(30, 10))
    ),
    "voxel": lambda: torchrg.segment_planes(POINTS, "classic", voxel=0.2),
    "make_intrinsics": lambda: torchrg.depth.make_intrinsics(50, 50, 20, 15),
    "default normals": lambda: transforms.EstimateNormals()({"coord": FEW}),
    "default planes": lambda: transforms.SegmentPlanes()({"coord": FEW}),
    "grown and aligned": lambda: transforms.AlignAxes()(
        transforms.GrowRegions()(transforms.EstimateNormals(method="pca")(SAMPLE))
    ),
    "result": lambda: Result.from_segmentation(Cloud(POINTS.numpy()), SEG).fields,
}
EVERYTHING |= {name: lambda name=name: CALLS[name](ARGUMENTS[name]) for name in CALLS}
EVERYTHING |= {
    f"preset {name}": lambda name=name: torchrg.segment_planes(FEW, name) for name in preset_names()
}


def parts_of(found):
    """Return the numbers and tensors of a result, in order."""
    if isinstance(found, dict):
        found = tuple(found[key] for key in sorted(found))
    if isinstance(found, list | tuple):
        return [leaf for part in found for leaf in parts_of(part)]
    if hasattr(found, "__dict__") and not isinstance(found, torch.Tensor):
        return parts_of(vars(found))
    return [found]


@pytest.mark.parametrize("call", EVERYTHING.values(), ids=EVERYTHING)
def test_the_default_device_changes_no_result(call):
    with torch.device("meta"):
        found = parts_of(call())
    expected = parts_of(call())
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        assert type(one) is type(other)
        if isinstance(one, torch.Tensor):
            assert one.device == other.device
            assert one.dtype == other.dtype
            one, other = one.numpy(), other.numpy()
        if hasattr(one, "tobytes"):
            assert one.tobytes() == other.tobytes()
        else:
            assert one == other or one != one
