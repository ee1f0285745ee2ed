"""`fixtures/moving` is what its scenario gives, and shows what it says."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from mlbatch.simulate.recording import write_recording
from mlbatch.simulate.scenario import Scenario, read_scenario
from tests.builders.simulated import Recorded, read_tum, residuals
from tests.contract.tree import ROOT

FOLDER = ROOT / "fixtures" / "moving"
# Sines of other processors differ in the last bit, and a few ranges then by a step.
MOST_DIFFERENT = 1e-3


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    """The scenario of the fixture."""
    return read_scenario(str(FOLDER / "scenario.yaml"))


@pytest.fixture(scope="module")
def again(scenario: Scenario, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The fixture, made again."""
    path = tmp_path_factory.mktemp("moving") / "moving.mcap"
    write_recording(scenario, path)
    return path


def messages(path: Path) -> Iterator[tuple[str, int, bytes]]:
    """Topic, time and data of all messages."""
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
            yield channel.topic, message.log_time, message.data


def test_the_scenario_gives_the_recording(again: Path) -> None:
    ours, theirs = list(messages(FOLDER / "moving.mcap")), list(messages(again))
    assert [(topic, at, len(data)) for topic, at, data in ours] == [
        (topic, at, len(data)) for topic, at, data in theirs
    ]
    first, second = (b"".join(data for *_, data in one) for one in (ours, theirs))
    differs = np.frombuffer(first, np.uint8) != np.frombuffer(second, np.uint8)
    assert differs.mean() < MOST_DIFFERENT


def test_the_scenario_gives_the_files_beside_it(again: Path) -> None:
    names = {path.name for path in again.parent.iterdir()}
    others = {"scenario.yaml", "SOURCE.md", "expected.json"}
    assert names == {path.name for path in FOLDER.iterdir()} - others
    for name in ("moving.rig.yaml", "moving.left.json", "moving.right.json"):
        assert (again.parent / name).read_text() == (FOLDER / name).read_text()
    ours, theirs = (read_tum(folder / "moving.truth.tum") for folder in (FOLDER, again.parent))
    np.testing.assert_array_equal(ours[0], theirs[0])
    np.testing.assert_allclose(ours[1], theirs[1], atol=1e-8)


def test_its_points_lie_on_the_scene(scenario: Scenario) -> None:
    recorded = Recorded(scenario, FOLDER / "moving.mcap")
    noise_m = max(plan.noise_m for plan in scenario.lidars)
    distances = residuals(recorded, recorded.scans())
    assert len(distances) > 500_000
    assert distances.max() < 5e-3 + 6 * noise_m


def test_its_counts_are_those_of_the_page(again: Path) -> None:
    """3.5 s of 10 revolutions a second of 512 columns in packets of 16, for each lidar."""
    topics = [topic for topic, *_ in messages(again)]
    assert topics.count("/left/lidar_packets") == topics.count("/right/lidar_packets") == 1120
    assert topics.count("/imu/data") == 700
    assert len(json.loads((FOLDER / "moving.left.json").read_text())) > 0
