"""Scenario files: every mistake is one line with file, line, key, expected, found, remedy."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from mlbatch.errors import RigError
from mlbatch.simulate.scenario import read_scenario
from tests.builders.simulated import scenario_text

ONE = "  - {name: one, model: VLP-16}\n"
TEXT = scenario_text(ONE)


def mistake(folder: Path, text: str) -> str:
    path = folder / "s.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(RigError) as caught:
        read_scenario(str(path))
    return str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("scenario/1", "scenario/2", "schema: expected mlbatch.scenario/1, found 'mlbatch.scen"),
        ("seed: 7", "sead: 7", "sead: expected a key of schema, seed, .* known key is seed"),
        ("seed: 7", "seed: -1", "seed: expected a whole number from 0 to 4294967295, found '-1'"),
        ("duration_s: 0.25", "duration_s: 0", "duration_s: expected a number from 0.1 to 86400"),
        ("duration_s: 0.25", "duration_s: 90", "motion: expected waypoints for 90 s, found 3 s"),
        ("[2, 0.8", "[0.5, 0.8", r"motion\.waypoints: expected times that start at 0 and increase"),
        ("0.2, 1.2, 1.15, 200]", "0.2, 1.2, 1.15]", r"waypoints: expected waypoints of one length"),
        ("coordinate: roll", "coordinate: rol", r"sway\[0\]\.coordinate: expected x or y or z or"),
        ("size_m: [14, 11, 4]", "size_m: [14, 0, 4]", r"boxes\[0\].*expected a number from 0.001"),
        ("size_m: [14, 11, 4]", "size_m: [14, 11]", r"boxes\[0\]\.size_m: expected 3 numbers"),
        ("across_m: [0, 3, 0]", "across_m: [1, 3, 0]", "across_m: expected edges at right angles"),
        ("radius_m: 0.3", "radius: 0.3", r"stems\[0\].* the nearest known key is radius_m"),
        ("model: VLP-16", "model: VLP-17", "expected a model of docs/simulate.md, found 'VLP-17'"),
        ("model: VLP-16", "model: VLP-16, profile: A", "profile: expected no profile for this"),
        ("model: VLP-16", "model: VLP-16, mode: dul", "mode: expected strongest or last or dual"),
        ("model: VLP-16", "model: VLP-16, rate_hz: 7", "rate_hz: expected 10 or 5 or 15 or 20"),
        ("model: VLP-16", "model: VLP-16, address: 10.5.5.300", "address: expected an IPv4"),
        ("model: VLP-16", "model: VLP-16, dropout: 2", "dropout: expected a number from 0 to 1"),
        (
            "sensors:\n",
            "body:\n  - {centre_m: [0, 0, 0], size_m: [1, 1, 1]}\nsensors:\n",
            r"body\[0\]: expected a box without a lidar in it, found one",
        ),
        ("motion:\n", "motion:\n  footprint_m: 3\n", "footprint_m: expected a scene with terrain"),
        (
            "motion:\n",
            "motion:\n  interpolation: cubic\n",
            "expected spline or monotone, found 'cu",
        ),
        (
            "sensors:\n",
            "  forest: [{area_m: [0, 0, 9, 9], per_hectare: 9, height_m: [1, 2]}]\nsensors:\n",
            r"forest\[0\]: expected radius_m of stems, crown, or both, found neither; add one",
        ),
        (
            "sensors:\n",
            "  forest: [{area_m: [0, 0, 9, 9], per_hectare: 9, height_m: [1, 2], crown: {low_m: "
            "[0, 1], radius_m: [1, 2], extinction_per_m: [2, 1]}}]\nsensors:\n",
            r"crown\.extinction_per_m: expected two sizes, the smaller first, found 2 and 1; swap",
        ),
        (
            "sensors:\n",
            "body:\n  - {centre_m: [0, 0, -1], size_m: [1, 1, 1], swing: {pivot_m: [0, 0, 0], "
            "axis: yaw, amplitude_deg: 5, frequency_hz: 1}}\nsensors:\n",
            r"body\[0\]\.swing\.axis: expected x or y or z, found 'yaw'",
        ),
        ("sensors:\n", "body: []\nsensors:\n", "body: expected at least one box, found"),
        (
            "sensors:\n",
            "body:\n  - {centre_m: [0, 0, -1], size_m: [1, 1, 1], repeat_s: 1}\nsensors:\n",
            r"body\[0\]\.repeat_s: expected a key of centre_m, size_m, yaw_deg, reflectivity",
        ),
        (ONE, 2 * ONE, r"sensors\[1\]: expected a name of its own, found one again"),
        ("truth: {", "truth: {topic: odom, ", "truth.topic: expected a topic, found 'odom'"),
        ("seed: 7", "start: tomorrow", "start: expected a time as 2026-05-04T08:00:00Z"),
        ("motion:\n", "motion:\n  above_ground: true\n", "above_ground: expected a scene with ter"),
        ("scene:\n", "scene:\n  terrain: {half_size_m: 10.3, relief_m: 1}\n", "half_size_m: expec"),
    ],
)
def test_a_mistake_is_one_line(old: str, new: str, expected: str, tmp_path: Path) -> None:
    assert old in TEXT
    text = TEXT.replace(old, new, 1)
    found = mistake(tmp_path, text)
    assert "\n" not in found
    assert re.search(rf"s\.yaml:\d+: .*{expected}", found), found
    # The line is that of the change, or of the mapping around it.
    line = int(re.search(r"s\.yaml:(\d+):", found)[1])  # type: ignore[index]
    changed = next(
        number
        for number, (one, other) in enumerate(
            zip(text.splitlines(), [*TEXT.splitlines(), ""], strict=False), 1
        )
        if one != other
    )
    assert abs(line - changed) <= 6


def test_a_scenario_needs_surfaces(tmp_path: Path) -> None:
    text = scenario_text(ONE, scene="scene: {boxes: []}\n")
    assert "scene: expected at least one surface, found none" in mistake(tmp_path, text)


def test_a_missing_scenario_names_those_of_the_package() -> None:
    with pytest.raises(RigError, match=r"none\.yaml: expected a scenario file or one of forest-"):
        read_scenario("none.yaml")


def test_defaults_and_units(tmp_path: Path) -> None:
    path = tmp_path / "s.yaml"
    path.write_text(
        scenario_text(
            "  - {name: one, model: OS1-64, extrinsics: {rotation_rpy_deg: [0, 0, 90]}, "
            "clock: {offset_s: -0.5, drift_ppm: 20}}\n"
        )
    )
    scenario = read_scenario(str(path), seed=5, duration_s=0.125)
    assert (scenario.seed, scenario.duration_s) == (5, 0.125)
    # 2026-05-04 08:00 UTC.
    assert scenario.start_ns == 1_777_881_600 * 10**9
    (plan,) = scenario.lidars
    assert plan.settings.profile == "RNG19_RFL8_SIG16_NIR16"
    assert (plan.settings.columns, plan.settings.rate_hz, plan.settings.imu) == (1024, 10, False)
    np.testing.assert_allclose(plan.body_from_sensor[:3, 0], [0, 1, 0], atol=1e-12)
    assert (plan.clock.offset_s, plan.clock.drift_ppm) == (-0.5, 20)
    # Sway in degrees, yaw in degrees.
    poses = scenario.trajectory.poses(np.array([1.0]))
    assert abs(np.degrees(np.arctan2(poses.rotation[0, 1, 0], poses.rotation[0, 0, 0])) - 60) < 0.5


@pytest.mark.parametrize("clearance_m", [0.5, 3.0])
def test_stems_keep_clear_of_the_way(clearance_m: float, tmp_path: Path) -> None:
    forest = (
        "  forest:\n    - {area_m: [-20, -20, 20, 20], per_hectare: 3000, radius_m: [0.1, 0.4], "
        f"height_m: [5, 9], taper: 0.5, clearance_m: {clearance_m}}}\n"
        "  terrain: {half_size_m: 25, relief_m: 1}\n"
    )
    path = tmp_path / "s.yaml"
    path.write_text(scenario_text(ONE, scene="scene:\n" + forest, duration=3.0))
    scenario = read_scenario(str(path))
    (stems,) = scenario.scene.kinds
    way = scenario.trajectory.poses(np.arange(0, 3, 0.5)).position_m[:, None, :2]
    base = stems.base_m  # type: ignore[union-attr]
    gap = np.hypot(*(way - base[:, :2]).transpose(2, 0, 1)) - stems.radius_m  # type: ignore[union-attr]
    assert gap.min() >= clearance_m
    # 3000 a hectare on 1600 m2, less those on the way.
    assert 300 < len(base) <= 480
    # Stems begin in the ground.
    assert scenario.scene.terrain is not None
    assert (base[:, 2] < scenario.scene.terrain.height(base[:, :2])).all()
