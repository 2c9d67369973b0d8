"""The torchmetrics forms against the functions, torchmetrics itself, and a second worker."""

import copy
import pickle
import warnings

import numpy as np
import pytest
import torch

torchmetrics = pytest.importorskip("torchmetrics")

from torchmetrics.clustering import AdjustedRandScore  # noqa: E402

from tests.metrics.sphere_clusters import scattered  # noqa: E402
from torchrg.errors import ConfigError  # noqa: E402
from torchrg.metrics import METRICS, modules, score_clusters, score_labels, score_partition  # noqa: E402
from torchrg.metrics import score_normals as score_errors  # noqa: E402
from torchrg.metrics.modules import PlaneMetric  # noqa: E402

NO_NAMES = ("points", "invalid", "clusters")  # of several parts, or of a part itself


def values_of(metric):
    return {name: float(value) for name, value in metric.compute().items()}


def scans(part):
    """Four scans of different size as (arguments, their score as a dict)."""
    rng = torch.Generator().manual_seed(7)
    for count in (60, 90, 20, 200):
        labels, ground_truth = torch.randint(-1, 5, (2, count), generator=rng)
        ground_truth = torch.where(torch.rand(count, generator=rng) < 0.8, labels, ground_truth)
        normals, clusters = scattered(rng, [count, 7, 9], 0.1)
        other = normals + 0.1 * torch.randn(normals.shape, generator=rng, dtype=torch.float64)
        arguments, score = {
            "labels": ((labels, ground_truth), score_labels),
            "superpoints": (
                (labels, ground_truth, torch.rand(count, 3, generator=rng)),
                score_partition,
            ),
            "clusters": ((normals, clusters), score_clusters),
            "normals": ((normals, other), score_errors),
        }[part]
        yield arguments, score(*arguments)._asdict()


@pytest.mark.parametrize("part", METRICS)
def test_forward_gives_the_score_of_one_scan_and_compute_the_mean_of_all(part):
    metric, scores = PlaneMetric(part), []
    for arguments, score in scans(part):
        values = {name: float(value) for name, value in metric(*arguments).items()}
        assert values == pytest.approx({k: float(v) for k, v in score.items()}, rel=1e-12)
        scores.append(score)
    means = {name: np.mean([score[name] for score in scores]) for name in scores[0]}
    assert values_of(metric) == pytest.approx(means, rel=1e-12)


@pytest.mark.parametrize("part", METRICS)
def test_each_index_is_the_one_of_the_catalog_that_it_is_named_for(part):
    names = [name for name in METRICS[part] if name not in NO_NAMES]
    whole, *singles = PlaneMetric(part), *map(PlaneMetric, names)
    assert (whole.index, whole.unit, whole.higher_is_better) == (None, None, None)
    for arguments, _ in scans(part):
        for metric in (whole, *singles):
            metric.update(*arguments)
    for name, single in zip(names, singles, strict=True):
        assert torch.equal(single.compute(), whole.compute()[name])
        assert single.compute().shape == ()
        assert (single.part, single.index) == (part, name)
        assert (single.unit, single.higher_is_better) == METRICS[part][name]
        assert single.full_state_update is single.is_differentiable is False


def test_unknown_indices_and_those_of_several_parts_are_refused():
    with pytest.raises(ConfigError, match=r"expected index to be one of labels, .*, got 'f2'"):
        PlaneMetric("f2")
    with pytest.raises(ConfigError, match=r"'invalid' of clusters and normals; use PlaneMetric"):
        PlaneMetric("invalid")
    with pytest.raises(ValueError, match="Unexpected keyword arguments: `min_points`"):
        PlaneMetric("f1", min_points=3)


@pytest.mark.filterwarnings("ignore:Sparse invariant checks:UserWarning")
def test_agreement_with_torchmetrics_on_one_scan():
    for (labels, ground_truth), _ in scans("labels"):
        ours, theirs = PlaneMetric("ari"), AdjustedRandScore()
        assert float(ours(labels, ground_truth)) == pytest.approx(
            float(theirs(labels, ground_truth)), abs=1e-6
        )


@pytest.mark.parametrize("part", METRICS)
def test_states_of_two_workers_add_up(part):
    whole, workers = PlaneMetric(part), [PlaneMetric(part), PlaneMetric(part)]
    for number, (arguments, _) in enumerate(scans(part)):
        whole.update(*arguments)
        workers[number % 2].update(*arguments)
    states = [{name: getattr(metric, name) for name in metric._defaults} for metric in workers]

    def gather(state, group=None):
        name = next(n for n, value in states[0].items() if value is state)
        return [other[name] for other in states]

    workers[0].dist_sync_fn = gather
    workers[0].distributed_available_fn = lambda: True
    assert values_of(workers[0]) == pytest.approx(values_of(whole), rel=1e-12)


def test_scans_without_an_index_do_not_count_for_it():
    metric = PlaneMetric("clusters")
    normals, clusters = scattered(torch.Generator().manual_seed(0), [9, 9], 0.1)
    metric.update(normals, clusters)
    metric.update(normals, torch.zeros_like(clusters))
    both, one = score_clusters(normals, clusters), score_clusters(normals, clusters * 0)
    assert float(metric.compute()["dvi"]) == pytest.approx(both.dvi, rel=1e-12)
    assert float(metric.compute()["cp"]) == pytest.approx((both.cp + one.cp) / 2, rel=1e-12)


def test_an_infinite_index_makes_the_mean_infinite():
    metric = PlaneMetric("dbi")
    metric.update(torch.eye(3)[[0, 0]], torch.tensor([0, 1]))
    metric.update(torch.eye(3)[[0, 1]], torch.tensor([0, 1]))
    assert metric.compute() == torch.inf


def test_no_scan_gives_nan():
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="The ``compute`` method", category=UserWarning)
        assert PlaneMetric("f1").compute().isnan()


def test_settings_reach_the_function():
    labels, ground_truth = torch.tensor([0, 0, 0, 1, 2, 2]), torch.tensor([5, 5, 5, 5, 7, 7])
    metric = PlaneMetric("labels", min_size=2, ignore=7)
    metric.update(labels, ground_truth)
    expected = score_labels(labels, ground_truth, min_size=2, ignore=7)
    assert values_of(metric) == expected._asdict()
    normals, clusters = scattered(
        torch.Generator().manual_seed(0), [90, 90, 5], 0.1, axes=torch.eye(3)[[0, 0, 1]]
    )
    settings = {"min_size": 2, "distinct_directions": True, "sample_size": 30}
    merged = PlaneMetric("clusters", **settings)
    merged.update(normals, clusters)
    assert float(merged.compute()["dbi"]) == score_clusters(normals, clusters, **settings).dbi


def test_a_collection_scores_each_scan_once(monkeypatch):
    calls = []

    def counted(*arguments, **settings):
        calls.append(arguments)
        return score_labels(*arguments, **settings)

    monkeypatch.setitem(modules._SCORES, "labels", counted)
    names = ("f1", "ari", "mean_best_iou", "covering")
    collection = torchmetrics.MetricCollection({name: PlaneMetric(name) for name in names})
    data = list(scans("labels"))
    for arguments, _ in data:
        collection.update(*arguments)
    # The first scan shows that the states are the same; after that one of the four is enough.
    assert len(calls) == 4 + len(data) - 1
    values = {name: float(value) for name, value in collection.compute().items()}
    means = {name: np.mean([score[name] for _, score in data]) for name in names}
    assert values == pytest.approx(means)


def test_reset_forgets_and_copies_remember():
    (arguments, score), *_ = scans("labels")
    metric = PlaneMetric("f1")
    metric.update(*arguments)
    for twin in (copy.deepcopy(metric), pickle.loads(pickle.dumps(metric))):
        assert float(twin.compute()) == score["f1"]
    metric.reset()
    assert int(metric.scans.sum()) == 0
