"""Decode what the encoder made: ranges, levels, times, angles and lenses come back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mlbatch.sensors.robosense import sensor as robosense
from mlbatch.types import F32Array, I64Array
from tests.builders.robosense import (
    Angles,
    RobosenseSpec,
    angles_csv,
    azimuths_deg,
    difop,
    directions,
    fan,
    firing_times_ns,
    msop,
    origins,
)
from tests.builders.robosense_decoded import Decoded, built_in, decoded, evidence_of
from tests.builders.robosense_models import AIRY_MOUNTS, DUAL, LAST, MODELS, NEAREST, STRONGEST

# A block's azimuth is rounded to 0.01 degree; two of them tell the speed of a short packet.
MOST_DEG = 0.015
# The time of a packet is cut to whole us, of which its second half of a column knows nothing.
SPLIT_NS = 1000


def _readings(spec: RobosenseSpec, packets: int) -> tuple[I64Array, I64Array]:
    columns = int(packets * spec.columns_per_packet)
    shape = (columns, spec.row.channels, spec.returns)
    bits = 14 if spec.model.startswith("Airy") else 16
    random = np.random.default_rng(3)
    return random.integers(0, 1 << bits, shape), random.integers(0, 256, shape)


def _by_shot(found: Decoded, spec: RobosenseSpec, returns: int) -> tuple[Decoded, I64Array]:
    """Columns of one return each as those of two, where a packet cannot hold both."""
    columns = np.arange(len(found.range_m))
    if returns == spec.returns:
        return found, columns
    joined = [
        np.concatenate([one[0::2], one[1::2]], axis=2) for one in (found.range_m, found.intensity)
    ]
    return replace(found, range_m=joined[0], intensity=joined[1]), columns // 2


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("mode", [STRONGEST, DUAL])
def test_all_comes_back(name: str, mode: str) -> None:
    spec = RobosenseSpec(name, mode, start_deg=357.3)
    raw, levels = _readings(spec, packets=12)
    angles, sent = fan(spec), msop(spec, raw, levels)
    evidence = evidence_of([payload for _, payload in sent], [difop(spec, angles)])
    lidar = built_in(evidence).lidar({}, evidence)
    found, columns = _by_shot(decoded(lidar, evidence.sample), spec, lidar.returns)
    wanted_m = (raw / round(1 / spec.range_unit_m)).astype(np.float32)
    np.testing.assert_array_equal(found.range_m, wanted_m)
    np.testing.assert_array_equal(found.intensity, levels)
    late_ns = np.abs(found.time_ns - firing_times_ns(spec, columns))
    assert late_ns.max() <= (SPLIT_NS if lidar.returns < spec.returns else 0)
    turned_deg = np.degrees(found.angle_rad) - azimuths_deg(spec, columns)
    assert np.abs((turned_deg + 180) % 360 - 180).max() < MOST_DEG
    range_m = wanted_m if lidar.returns == spec.returns else _interleaved(wanted_m)[..., None]
    towards, lens_m = directions(spec, angles, columns), origins(spec, columns)
    wanted_xyz_m = range_m[..., None] * towards[:, :, None] + lens_m[:, :, None]
    allowed_m = range_m * np.radians(MOST_DEG) + 1e-5
    assert (np.abs(found.xyz_m - wanted_xyz_m).max(axis=3) <= allowed_m).all()


def _interleaved(values: F32Array) -> F32Array:
    """(n, channels, 2) as (2 n, channels): a column for each return."""
    return np.ascontiguousarray(values.transpose(0, 2, 1)).reshape(-1, values.shape[1])


@pytest.mark.parametrize(("mode", "kind"), [(STRONGEST, 1), (LAST, 2), (NEAREST, 0)])
@pytest.mark.parametrize("name", ["RS-16", "RS-32", "Bpearl v4", "Helios 16", "Ruby Plus 48"])
def test_mode_of_a_single_return(name: str, mode: str, kind: int) -> None:
    spec = RobosenseSpec(name, mode)
    if mode not in spec.row.modes:
        pytest.skip("the model has no such mode")
    sent = msop(spec, *_readings(spec, packets=8))
    evidence = evidence_of([payload for _, payload in sent], [difop(spec, fan(spec))])
    lidar = built_in(evidence).lidar({}, evidence)
    assert lidar.return_types == (kind,)
    assert lidar.mode == f"single return, {mode.replace(NEAREST, 'first')}"


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("mode", [STRONGEST, DUAL])
def test_point_packets_alone_tell_the_returns(name: str, mode: str) -> None:
    spec = RobosenseSpec(name, mode, start_deg=20.0)
    sent = msop(spec, *_readings(spec, packets=8))
    evidence = evidence_of([payload for _, payload in sent])
    file = robosense.read_calibration(Path("unit.csv"), angles_csv(fan(spec)).encode())
    assert file is not None
    assert file.fit(evidence) == 200
    lidar = file.lidar({}, evidence)
    assert lidar.mode.startswith(f"{'dual' if mode == DUAL else 'single'} return")
    assert set(lidar.return_types) == {0}
    expected = directions(spec, fan(spec), np.arange(1))[0]
    cosine, sine = np.cos(np.radians(20.0)), np.sin(np.radians(20.0))
    direction = lidar.beams.direction
    found = cosine * direction[0] + sine * direction[1] + direction[2]
    np.testing.assert_allclose(found[:, 2], expected[:, 2], atol=1e-6)


@pytest.mark.parametrize("mount", AIRY_MOUNTS)
def test_mounts_of_airy_choose_its_times(mount: str) -> None:
    spec = RobosenseSpec("Airy 96", mount=mount)
    sent = msop(spec, *_readings(spec, packets=4))
    evidence = evidence_of([payload for _, payload in sent], [difop(spec, fan(spec))])
    lidar = built_in(evidence).lidar({}, evidence)
    np.testing.assert_array_equal(lidar.firing_ns[0], spec.firing_ns)


@pytest.mark.parametrize("name", ["Helios 32", "Helios 16"])
def test_distances_of_older_helios_count_in_5_mm(name: str) -> None:
    spec = RobosenseSpec(name, unit_m=0.005)
    raw, levels = _readings(spec, packets=8)
    sent = msop(spec, raw, levels)
    evidence = evidence_of([payload for _, payload in sent], [difop(spec, fan(spec))])
    lidar = built_in(evidence).lidar({}, evidence)
    found = decoded(lidar, evidence.sample)
    np.testing.assert_array_equal(found.range_m, (raw / 200).astype(np.float32))
    assert "5 mm" in " ".join(lidar.notes)


@pytest.mark.parametrize("mode", [STRONGEST, DUAL])
@pytest.mark.parametrize("rpm", [300, 600, 1200])
@pytest.mark.parametrize("name", ["RS-32", "Helios 32", "Airy 96", "Ruby 80", "Ruby Plus 128"])
def test_a_gap_in_the_field_of_view_takes_its_time(name: str, rpm: int, mode: str) -> None:
    """180 degrees without columns after the first column: 50 ms at 600 rpm."""
    start_deg = 270.0 - 0.5 * MODELS[name].round_us * 6e-6 * rpm
    spec = RobosenseSpec(name, mode, rpm=rpm, start_deg=start_deg, view_deg=(90.0, 270.0))
    sent = msop(spec, *(0 * one for one in _readings(spec, packets=20)))
    evidence = evidence_of([payload for _, payload in sent], [difop(spec, fan(spec))])
    lidar = built_in(evidence).lidar({}, evidence)
    found = decoded(lidar, evidence.sample)
    _, columns = _by_shot(found, spec, lidar.returns)
    within_ns = np.ptp(lidar.heads(evidence.sample, evidence.host_ns).stamp_ns, axis=1)
    assert within_ns.max() > 30e9 / rpm
    late_ns = np.abs(found.time_ns - firing_times_ns(spec, columns))
    # A thousandth of the gap: the speed is known from steps of 0.01 degree.
    assert late_ns.max() < 30e9 / rpm / 1000
    turned_deg = np.degrees(found.angle_rad) - azimuths_deg(spec, columns)
    assert np.abs((turned_deg + 180) % 360 - 180).max() < 2 * MOST_DEG


def test_a_bpearl_that_turns_the_other_way() -> None:
    """The driver takes all of the azimuth backwards: the rotor's and the corrections."""
    spec = RobosenseSpec("Bpearl v4", start_deg=40.0, is_reversed=True)
    raw, levels = _readings(spec, packets=6)
    angles, sent = fan(spec), msop(spec, raw, levels)
    evidence = evidence_of([payload for _, payload in sent], [difop(spec, angles)])
    lidar = built_in(evidence).lidar({}, evidence)
    found, columns = decoded(lidar, evidence.sample), np.arange(len(raw))
    np.testing.assert_array_equal(found.time_ns, firing_times_ns(spec, columns))
    mirrored = Angles(angles.elevation_deg, -angles.azimuth_deg)
    wanted_m = (raw[..., :1] / 400) * directions(spec, mirrored, columns) + origins(spec, columns)
    assert np.abs(found.xyz_m[:, :, 0] - wanted_m).max() < 164 * np.radians(MOST_DEG)


def test_without_motion_all_beams_of_a_column_share_its_angle() -> None:
    spec = RobosenseSpec("Helios 32", start_deg=10.0)
    sent = msop(spec, *_readings(spec, packets=6))
    evidence = evidence_of([payload for _, payload in sent], [difop(spec, fan(spec))])
    still = built_in(evidence).lidar({"firing_azimuth": "off"}, evidence)
    found = decoded(still, evidence.sample)
    np.testing.assert_array_equal(found.time_ns, firing_times_ns(spec, np.arange(72)))
    turned_deg = np.degrees(found.angle_rad) - azimuths_deg(spec, np.arange(72))[:, :1]
    assert np.abs(turned_deg).max() < 0.0051
