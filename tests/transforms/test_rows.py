"""Every entry with a row for each point follows its points, whatever a sample says of itself."""

import numpy as np
import pytest
import torch

from torchrg.datasets import collate_offset
from torchrg.errors import ConfigError
from torchrg.transforms import CenterCloud, EstimateNormals, KeepFinite, SampleVoxels, SegmentPlanes

NUM_POINTS = 40
BAD = [3, 17]
KEPT = [row for row in range(NUM_POINTS) if row not in BAD]
NAMES = {
    "absent": None,
    "list": ["coord", "segment"],
    "tuple": ("coord", "segment"),
    "set": {"coord", "segment"},
    "text": "coord",
}


def sample_of(kind=np.asarray, **more):
    """A sample in which two points are not finite, and ``segment`` is the row of each point."""
    coord = np.random.default_rng(0).random((NUM_POINTS, 3), dtype=np.float32)
    coord[BAD] = np.nan
    return {"coord": kind(coord), "segment": kind(np.arange(NUM_POINTS)), "name": "a", **more}


@pytest.mark.parametrize("names", NAMES.values(), ids=NAMES)
@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor], ids=["numpy", "torch"])
def test_entries_follow_their_points(names, kind):
    feature = kind(np.arange(NUM_POINTS, dtype=np.uint8).repeat(2).reshape(-1, 2))
    sample = sample_of(kind, feature=feature, pose=kind(np.eye(4)))
    sample |= {} if names is None else {"index_valid_keys": names}
    found = KeepFinite()(sample)
    assert found["segment"].tolist() == KEPT
    assert found["feature"][:, 1].tolist() == KEPT
    assert found["feature"].dtype == feature.dtype
    assert found["pose"].shape == (4, 4)
    assert len(sample["coord"]) == NUM_POINTS
    assert sample.get("index_valid_keys") is names


@pytest.mark.parametrize("names", [*NAMES.values()][1:], ids=[*NAMES][1:])
def test_what_is_added_is_named_and_the_given_list_is_not_changed(names):
    sample = sample_of(index_valid_keys=names)
    before = set([names] if isinstance(names, str) else names)
    for transform in (SegmentPlanes("classic"), EstimateNormals(residual=True, k=9)):
        found = transform(sample)
        added = set(found) - set(sample) - {"index_valid_keys"}
        assert isinstance(found["index_valid_keys"], list)
        assert added | {"normal", "curvature"} | before <= set(found["index_valid_keys"])
        assert len(found["index_valid_keys"]) == len(set(found["index_valid_keys"]))
    kept = sample["index_valid_keys"]
    assert set([kept] if isinstance(kept, str) else kept) == before


def test_what_is_recognized_is_named_too():
    """So Pointcept takes points out of all of it; what it keeps of earlier points stays off."""
    sample = sample_of(mine=np.zeros((NUM_POINTS, 2)), origin_coord=np.zeros((NUM_POINTS, 3)))
    sample |= {"index_valid_keys": ["coord", "segment"]}
    named = SegmentPlanes("classic")(sample)["index_valid_keys"]
    assert "mine" in named
    assert not {"origin_coord", "name", "index_valid_keys"} & set(named)
    chosen = {**sample, "index_valid_keys": ["coord", "its_own"]}
    assert "mine" not in SegmentPlanes("classic")(chosen)["index_valid_keys"]


def test_one_list_of_two_samples_stays_as_it_is():
    shared = ["coord", "segment"]
    samples = [sample_of(index_valid_keys=shared) for _ in range(2)]
    found = [SegmentPlanes("classic")(sample)["index_valid_keys"] for sample in samples]
    assert shared == ["coord", "segment"]
    assert found[0] == found[1]
    assert found[0] is not found[1]


@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor], ids=["numpy", "torch"])
def test_samples_without_a_list_get_none(kind):
    assert "index_valid_keys" not in SegmentPlanes("classic")(sample_of(kind))


def test_what_pointcept_keeps_of_earlier_points_stays():
    earlier = np.arange(NUM_POINTS)
    sample = sample_of(origin_segment=earlier, inverse=np.zeros(NUM_POINTS, dtype=int))
    found = KeepFinite()(sample)
    assert found["origin_segment"] is earlier
    assert len(found["inverse"]) == NUM_POINTS


def test_entries_left_off_a_list_that_somebody_made_are_in_doubt():
    names = ["coord", "segment", "mine"]
    sample = sample_of(
        mine=np.arange(NUM_POINTS), other=np.zeros(NUM_POINTS), index_valid_keys=names
    )
    with pytest.raises(ConfigError, match="KeepFinite: cannot decide whether other of the sample"):
        KeepFinite()(sample)
    names.append("other")
    assert len(KeepFinite()(sample)["other"]) == len(KEPT)


@pytest.mark.parametrize(
    "value",
    [list(range(NUM_POINTS)), {"inner": np.zeros(NUM_POINTS)}, ["a"] * NUM_POINTS],
    ids=["numbers", "nested", "words"],
)
def test_rows_that_are_not_in_an_array_are_in_doubt(value):
    with pytest.raises(ConfigError, match="cannot decide whether mine of the sample"):
        SampleVoxels(0.1)(sample_of(mine=value))


def test_in_a_tiny_cloud_only_names_tell():
    sample = {"coord": torch.rand(4, 3), "segment": torch.arange(4), "pose": torch.eye(4)}
    assert KeepFinite()(sample)["pose"].shape == (4, 4)
    with pytest.raises(ConfigError, match="cannot decide whether camera of the sample"):
        KeepFinite()({**sample, "camera": torch.eye(4)})
    with pytest.raises(ConfigError, match="cannot decide whether camera of the sample"):
        KeepFinite()({"coord": torch.rand(16, 3), "camera": torch.eye(4).flatten()})


@pytest.mark.parametrize("key", ["color", "normal", "front", "intensity", "displacement"])
def test_known_names_are_per_point_in_a_tiny_cloud(key):
    sample = {"coord": torch.tensor([[torch.nan, 0, 0], [1, 1, 1]]), key: torch.arange(2)}
    assert KeepFinite()(sample)[key].tolist() == [1]


@pytest.mark.parametrize(
    "transform", [CenterCloud(), EstimateNormals(), KeepFinite(), SampleVoxels(0.1)]
)
@pytest.mark.parametrize("key", ["plane", "curvature", "mine"])
def test_a_sample_that_is_out_of_step_already_is_refused(transform, key):
    shape = (60, 1) if key == "curvature" else (60,)
    sample = sample_of(**{key: np.zeros(shape)}, index_valid_keys=["coord", "mine"])
    with pytest.raises(ConfigError, match=f"expected {key} with 40 rows, .*, got 60"):
        transform(sample)


def test_images_may_have_the_names_of_entries():
    sample = {"coord": torch.rand(50, 3), "color": torch.zeros(3, 8, 9), "plane": torch.zeros(8, 9)}
    assert SegmentPlanes("classic")(sample)["plane"].shape == (50,)


@pytest.mark.parametrize("key", ["edge_index", "sampled_index", "frame_pcd_offset"])
def test_numbers_of_points_are_refused_by_who_takes_points_out(key):
    with pytest.raises(ConfigError, match=f"cannot remove points from samples with {key}"):
        KeepFinite()(sample_of(**{key: np.zeros((2, 5), dtype=int)}))


def test_a_batch_with_a_list_keeps_every_cloud_in_step():
    samples = [SegmentPlanes("classic")(sample_of()) for _ in range(2)]
    batch = KeepFinite()(collate_offset(samples))
    assert batch["offset"].tolist() == [len(KEPT), 2 * len(KEPT)]
    assert batch["segment"].tolist() == KEPT * 2
    assert {len(batch[key]) for key in ("plane", "normal", "curvature")} == {2 * len(KEPT)}


@pytest.mark.parametrize(
    ("key", "values"),
    [
        ("batch", np.arange(NUM_POINTS) % 2),
        ("batch", np.zeros(NUM_POINTS - 1, dtype=int)),
        ("offset", np.array([-3, NUM_POINTS])),
        ("offset", np.array([30, 20, NUM_POINTS])),
        ("offset", np.array([NUM_POINTS - 1])),
    ],
)
def test_clouds_that_do_not_lie_one_after_the_other_are_refused(key, values):
    with pytest.raises(ConfigError, match=f"expected {key} to ascend"):
        CenterCloud()(sample_of(**{key: values}))


def test_an_empty_cloud_at_the_end_of_a_batch_stays():
    # Only PyG's ptr tells it from no cloud.
    clouds = {"batch": np.repeat([0, 1], [25, 15]), "ptr": np.array([0, 25, 40, 40])}
    assert KeepFinite()(sample_of(**clouds))["ptr"].tolist() == [0, 23, 38, 38]
