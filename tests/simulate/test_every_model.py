"""The law of simulated recordings, for every model: points lie on the scene at the true poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mlbatch.simulate.interface import lidar_models
from tests.builders.simulated import record, residuals, scenario_text

LIMIT_M = 5e-3
LIDAR = """\
  - name: lidar
    model: {model}
    noise_m: {noise}
    phase_deg: 211
    max_range_m: 60
    extrinsics: {{translation_m: [0.2, -0.1, 0.3], rotation_rpy_deg: [4, -7, 30]}}
"""
MODELS = lidar_models()
OUSTER = [name for name in MODELS if name.startswith("OS")]
PROFILES = MODELS["OS1-64"].profiles


def check(folder: Path, text: str, least_points: int = 3000, suffix: str = "pcap") -> None:
    recorded = record(folder, text, suffix)
    distances = residuals(recorded, recorded.scans())
    assert len(distances) >= least_points
    assert distances.max() < LIMIT_M


@pytest.mark.parametrize("model", MODELS)
def test_points_lie_on_the_scene(model: str, tmp_path: Path) -> None:
    profile = "    profile: RNG15_RFL8_NIR8\n" if model in OUSTER else ""
    check(tmp_path, scenario_text(LIDAR.format(model=model, noise=0) + profile, duration=0.12))


@pytest.mark.parametrize("profile", PROFILES)
def test_points_of_every_profile_lie_on_the_scene(profile: str, tmp_path: Path) -> None:
    lines = LIDAR.format(model="OS1-64", noise=0) + f"    profile: {profile}\n    columns: 512\n"
    check(tmp_path, scenario_text(lines))


@pytest.mark.parametrize(
    ("model", "mode"), [(name, mode) for name, model in MODELS.items() for mode in model.modes[1:]]
)
def test_points_of_every_mode_lie_on_the_scene(model: str, mode: str, tmp_path: Path) -> None:
    lines = LIDAR.format(model=model, noise=0) + f"    mode: {mode}\n"
    check(tmp_path, scenario_text(lines, duration=0.12), 500)


@pytest.mark.parametrize("suffix", ["mcap", "db3"])
@pytest.mark.parametrize("model", ["OS1-32", "VLP-16", "PandarXT-32", "Helios 32"])
def test_points_of_bags_lie_on_the_scene(model: str, suffix: str, tmp_path: Path) -> None:
    check(tmp_path, scenario_text(LIDAR.format(model=model, noise=0)), suffix=suffix)


def test_offset_and_drift_of_a_clock_are_those_of_the_scenario(tmp_path: Path) -> None:
    clock = "    clock: {offset_s: 0.137, drift_ppm: 400}\n"
    check(tmp_path, scenario_text(LIDAR.format(model="VLP-16", noise=0) + clock, duration=0.9))


def test_points_without_the_offset_are_off(tmp_path: Path) -> None:
    """The law can fail: a clock that is wrong by 20 ms moves points by centimetres."""
    recorded = record(
        tmp_path,
        scenario_text(LIDAR.format(model="VLP-16", noise=0) + "    clock: {offset_s: 0.02}\n"),
    )
    scans = recorded.scans()
    for scan in scans:
        scan.start_ns += 20_000_000
    assert np.percentile(residuals(recorded, scans), 95) > 4 * LIMIT_M


@pytest.mark.parametrize("noise", [0.01, 0.03])
def test_noise_has_the_standard_deviation_of_the_scenario(noise: float, tmp_path: Path) -> None:
    """Seen along its normal, the room's floor is that far off; all points within 6 sigma."""
    wall = "scene:\n  boxes:\n    - {centre_m: [0, 0, 0], size_m: [20, 20, 20]}\n"
    # Straight at a wall from its middle, so that distances are those along rays.
    lines = (
        f"  - {{name: lidar, model: OS1-64, noise_m: {noise}, profile: RNG19_RFL8_SIG16_NIR16}}\n"
    )
    recorded = record(tmp_path, scenario_text(lines, scene=wall, motion="", duration=0.3))
    scans = recorded.scans()
    xyz = np.concatenate([scan.xyz for scan in scans]).astype(np.float64)
    straight = np.abs(xyz[:, 1:]).max(axis=1) < 1.0
    off = np.abs(xyz[straight, 0]) - 10.0
    assert straight.sum() > 200
    assert off.std() == pytest.approx(noise, rel=0.15)
    assert residuals(recorded, scans).max() < LIMIT_M + 6 * noise
