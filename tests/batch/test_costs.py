"""What a plan is said to take, from a rate that is known."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from torchrg.batch import costs
from torchrg.batch.memory import memory_of_scan
from torchrg.batch.run import Plan
from torchrg.config import DepthConfig


@pytest.fixture
def plan():
    """Three scans of 1, 2 and 3 million points, of which the first is done."""
    source = SimpleNamespace(bytes_per_point=40, settings=None)
    jobs = tuple(
        SimpleNamespace(
            name=str(i),
            source=source,
            scan=SimpleNamespace(num_points=i * 1_000_000),
            memory=memory_of_scan(i * 1_000_000),
            out=Path(),
        )
        for i in (1, 2, 3)
    )
    return Plan(jobs, {"2": "new", "3": "new"})


@pytest.mark.parametrize(("workers", "at_once"), [(1, 1), (2, 2), (8, 2)])
def test_costs_are_in_proportion(plan, monkeypatch, workers, at_once):
    monkeypatch.setattr(costs, "seconds_per_point", lambda *_, **__: 1e-5)
    found = costs.estimate_costs(plan, workers=workers, limit=10**12)
    assert found.disk == 200_000_000
    assert found.workers == at_once
    assert found.memory == sum(memory_of_scan(i * 1_000_000) for i in (3, 2)[:at_once])
    assert found.seconds == pytest.approx(50 / at_once)


def test_memory_limits_how_many_run_at_a_time(plan, monkeypatch):
    monkeypatch.setattr(costs, "seconds_per_point", lambda *_, **__: 1e-5)
    assert costs.estimate_costs(plan, workers=2, limit=memory_of_scan(3_000_000)).workers == 1
    # The largest runs in any case, alone.
    assert costs.estimate_costs(plan, workers=2, limit=1).workers == 1


def test_nothing_to_do_costs_nothing(plan):
    assert costs.estimate_costs(plan._replace(reasons={}), workers=2, limit=1) == (0, 0, 0, 0.0)


def test_depth_images_have_a_rate_of_their_own():
    assert 0 < costs.seconds_per_point(DepthConfig()) < 1
