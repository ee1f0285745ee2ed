"""Parts of examples/odometry that need no other program: worlds, and intervals of medians."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from mlbatch.simulate.scenario import read_scenario
from mlbatch.simulate.scene import Boxes
from tests.contract.tree import ROOT


@pytest.fixture(autouse=True)
def _path(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(ROOT / "examples" / "odometry"))
    yield
    for name in ("results", "world"):
        sys.modules.pop(name, None)


def _module(name: str) -> ModuleType:
    return __import__(name)


@pytest.mark.parametrize(
    ("count", "low", "high", "coverage"),
    [
        # Binomial with p = 1/2: outside are 2 x 1/2^n, 2 x (1 + n)/2^n, 2 x (1 + n + n(n-1)/2)/2^n.
        (1, 1, 1, 0.0),
        (3, 1, 3, 0.75),
        (5, 1, 5, 0.9375),
        (8, 1, 8, 1 - 2 / 256),
        (9, 2, 8, 1 - 2 * 10 / 512),
        (12, 3, 10, 1 - 2 * 79 / 4096),
    ],
)
def test_intervals_of_medians_are_those_of_ranks(
    count: int, low: int, high: int, coverage: float
) -> None:
    shuffled = np.random.default_rng(1).permutation(np.arange(1.0, count + 1)).tolist()
    median, *interval = _module("results").median_interval(shuffled)
    assert median == (count + 1) / 2
    assert interval == [low, high, pytest.approx(coverage)]


def test_worlds_are_scenarios_and_differ(tmp_path: Path) -> None:
    world = _module("world")
    plans = []
    for seed in (1, 2, 2):
        world.write_scenario(tmp_path / "world.yaml", seed, 9.0)
        plans.append(read_scenario(str(tmp_path / "world.yaml")))
    at = np.linspace(0.0, 9.0, 10)
    first, second, again = (plan.trajectory.poses(at).position_m for plan in plans)
    assert np.array_equal(second, again)
    assert np.abs(first - second).max() > 1.0
    # 133 degrees at 10 Hz are 37 ms.
    assert [lidar.settings.phase_deg for lidar in plans[0].lidars] == [0.0, 133.0]


def test_worlds_stay_clear_of_the_way(tmp_path: Path) -> None:
    """No box within a metre of a place where the rig passes, nor a wall."""
    for seed in range(1, 13):
        _module("world").write_scenario(tmp_path / "world.yaml", seed, 9.0)
        plan = read_scenario(str(tmp_path / "world.yaml"))
        way = plan.trajectory.poses(np.arange(0.0, 9.0, 0.05)).position_m[:, :2]
        assert np.abs(way).max() < 20.0
        boxes = next(kind for kind in plan.scene.kinds if isinstance(kind, Boxes))
        for centre, size, yaw in zip(boxes.centre_m, boxes.size_m, boxes.yaw_rad, strict=True):
            turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
            inside = np.abs((way - centre[:2]) @ turn.T) - size[:2] / 2
            assert np.hypot(*np.maximum(inside, 0.0).T).min() > 1.0, seed
