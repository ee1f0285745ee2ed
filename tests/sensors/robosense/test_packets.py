"""RoboSense packets: hand-worked times and angles, damage, encoded packets."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mlbatch.arrays import F32Array, I64Array, U8Array
from mlbatch.sensors.robosense import sensor as robosense
from mlbatch.sensors.robosense.models import BPEARL_V3, BPEARL_V4
from mlbatch.sensors.robosense.packets import times_ns
from mlbatch.simulate.robosense.encode import (
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
from mlbatch.simulate.robosense.models import AIRY_MOUNTS, DUAL, LAST, MODELS, NEAREST, STRONGEST
from tests.builders.others import filled, robosense_packets, rows
from tests.builders.robosense_decoded import Decoded, built_in, decoded, evidence_of

FIRST, SECOND = bytes.fromhex("55aa050a5aa550a0"), bytes.fromhex("55aa055a")


def _sent(spec: RobosenseSpec, packets: int) -> list[bytes]:
    shape = (int(packets * spec.columns_per_packet), spec.row.channels, spec.returns)
    ranges = np.arange(np.prod(shape)).reshape(shape) % 5000
    return [payload for _, payload in msop(spec, ranges, ranges % 256)]


def _head(parts: dict[int, bytes], cdeg: int) -> bytes:
    """The first 46 bytes as the manual prints them; the blocks that follow are made up."""
    blocks = {
        42 + 100 * block: b"\xff\xee" + struct.pack(">H", cdeg + 20 * block) for block in range(12)
    }
    return filled(1248, {**parts, **blocks})


def test_the_real_head_of_a_bpearl_v4() -> None:
    """Never synchronised: its clock counts from 0, here 4066 s."""
    parts = {0: FIRST, 12: struct.pack(">I", 6062479), 20: struct.pack(">HII", 0, 4066, 355991)}
    packet = _head({**parts, 31: b"\x03\x04"}, 21582)
    after = _head({**parts, 12: struct.pack(">I", 6062480), 31: b"\x03\x04"}, 21822)
    evidence = evidence_of([packet, after])
    lidar = built_in(evidence).lidar({}, evidence)
    assert lidar.model == "RS-Bpearl v4"
    assert lidar.sequence_modulus == 2**32
    assert lidar.sequence(evidence.sample).tolist() == [6062479, 6062480]
    found = decoded(lidar, evidence.sample)
    assert found.time_ns[0, 0] == 4_066_355_991_000
    assert np.degrees(found.angle_rad[0, 0]) == pytest.approx(215.82)


def test_the_real_head_of_a_bpearl_v3() -> None:
    time = bytes((21, 12, 7, 3, 6, 24)) + struct.pack(">HH", 765, 698)
    packet = _head({0: FIRST, 20: time, 30: b"\x03"}, 23577)
    spec = RobosenseSpec("Bpearl v3")
    evidence = evidence_of([packet], [difop(spec, fan(spec))])
    lidar = built_in(evidence).lidar({}, evidence)
    assert lidar.model == "RS-Bpearl v3"
    found = decoded(lidar, evidence.sample)
    # 2021-12-07 03:06:24 UTC
    assert found.time_ns[0, 0] == 1_638_846_384_765_698_000
    assert np.degrees(found.angle_rad[0, 0]) == pytest.approx(235.77)


def _with_time(time: bytes) -> U8Array:
    return rows([filled(1248, {20: time})])


@pytest.mark.parametrize(
    ("date", "wanted_s"),
    [
        ((0, 1, 1, 0, 0, 0), 946_684_800),
        ((24, 2, 29, 23, 59, 59), 1_709_251_199),
        ((38, 1, 19, 3, 14, 7), 2**31 - 1),
        ((24, 12, 31, 23, 59, 60), 1_735_689_600),  # a leap second
    ],
)
def test_calendar_times(date: tuple[int, ...], wanted_s: int) -> None:
    found_ns, good = times_ns(_with_time(bytes(date) + struct.pack(">HH", 999, 999)), BPEARL_V3)
    assert found_ns.tolist() == [wanted_s * 10**9 + 999_999_000]
    assert good.all()


@pytest.mark.parametrize(
    ("place", "value"),
    [(1, 0), (1, 13), (2, 0), (2, 32), (3, 24), (4, 60), (5, 61), (6, 4), (8, 4)],
)
def test_calendar_times_that_do_not_exist(place: int, value: int) -> None:
    time = bytearray(bytes((24, 6, 15, 12, 30, 30)) + bytes(4))
    time[place] = value
    assert not times_ns(_with_time(bytes(time)), BPEARL_V3)[1].any()


def test_second_times_that_do_not_exist() -> None:
    for second, micro in ((1, 1_000_000), (1 << 33, 0), ((1 << 48) - 1, 0)):
        time = second.to_bytes(6, "big") + struct.pack(">I", micro)
        assert not times_ns(_with_time(time), BPEARL_V4)[1].any()
    largest = ((1 << 33) - 1).to_bytes(6, "big") + struct.pack(">I", 999_999)
    found_ns, good = times_ns(_with_time(largest), BPEARL_V4)
    assert good.all()
    assert found_ns.tolist() == [((1 << 33) - 1) * 10**9 + 999_999_000]


def test_damaged_packets_and_blocks() -> None:
    spec = RobosenseSpec("Helios 32")
    evidence = evidence_of(_sent(spec, 6), [difop(spec, fan(spec))])
    lidar = built_in(evidence).lidar({}, evidence)
    packets = evidence.sample.copy()
    packets[1, 2] = 0  # magic
    packets[2, 43] = 0  # id of the first block
    packets[3, 26] = 0x10  # more than a million us
    packets[4, 42 + 500] = 0  # id of block 5
    packets[5, 42 + 302] = 0xFF  # azimuth of block 3: 655 degrees
    assert lidar.faults(packets).tolist() == [0, 2, 2, 2, 0, 0]
    headers = lidar.column_headers(packets, evidence.host_ns)
    whole = lidar.column_headers(evidence.sample, evidence.host_ns)
    assert headers.valid[4].tolist() == [block != 5 for block in range(12)]
    assert headers.valid[5].tolist() == [block != 3 for block in range(12)]
    np.testing.assert_array_equal(headers.stamp_ns[4:], whole.stamp_ns[4:])


def test_an_azimuth_that_is_damaged_moves_no_times() -> None:
    """It jumps there and back again, as no gap does."""
    spec = RobosenseSpec("Helios 32")
    evidence = evidence_of(_sent(spec, 6), [difop(spec, fan(spec))])
    lidar = built_in(evidence).lidar({}, evidence)
    packets = evidence.sample.copy()
    packets[5, 42 + 302] ^= 0x40
    headers = lidar.column_headers(packets, evidence.host_ns)
    np.testing.assert_array_equal(
        headers.stamp_ns, lidar.column_headers(evidence.sample, evidence.host_ns).stamp_ns
    )


def test_heads_depend_on_their_packet_alone() -> None:
    spec = RobosenseSpec("Ruby Plus 80", DUAL, start_deg=359.0)
    evidence = evidence_of(_sent(spec, 9), [difop(spec, fan(spec))])
    lidar = built_in(evidence).lidar({}, evidence)
    whole = lidar.column_headers(evidence.sample, evidence.host_ns)
    for number in range(9):
        alone = lidar.column_headers(evidence.sample[number : number + 1], evidence.host_ns[:1])
        np.testing.assert_array_equal(alone.stamp_ns[0], whole.stamp_ns[number])
        np.testing.assert_array_equal(alone.encoder[0], whole.encoder[number])


@pytest.mark.parametrize("name", ["Ruby 128", "Ruby Plus 128"])
def test_returns_of_128_lines_are_columns_of_one_time(name: str) -> None:
    """Packets contain both returns of a shot and one of the next, or one and both."""
    spec = RobosenseSpec(name, DUAL)
    evidence = evidence_of(_sent(spec, 4), [difop(spec, fan(spec))])
    lidar = built_in(evidence).lidar({}, evidence)
    assert (lidar.returns, lidar.return_types, lidar.columns_per_packet) == (1, (0,), 3)
    assert lidar.mode == "dual return, a column each"
    round_ns = {"Ruby 128": 55_550, "Ruby Plus 128": 55_560}[name]
    stamp_ns = lidar.column_headers(evidence.sample, evidence.host_ns).stamp_ns
    begun_ns = stamp_ns - stamp_ns[:, :1]
    assert begun_ns.tolist() == [[0, 0, round_ns], [0, round_ns, round_ns]] * 2


def test_packets_without_a_count_are_identified_by_content() -> None:
    spec = RobosenseSpec("Helios 32")
    evidence = evidence_of(_sent(spec, 4), [difop(spec, fan(spec))])
    lidar = built_in(evidence).lidar({}, evidence)
    assert lidar.sequence_modulus == 0
    assert len(set(lidar.sequence(evidence.sample).tolist())) == 4


def test_a_bpearl_that_leaves_its_count_at_zero_is_identified_by_content() -> None:
    packets = robosense_packets({0: FIRST, 31: b"\x03\x04"})
    evidence = evidence_of([row.tobytes() for row in packets])
    lidar = built_in(evidence).lidar({}, evidence)
    assert lidar.sequence_modulus == 0
    assert len(set(lidar.sequence(packets).tolist())) == len(packets)


def test_counts_wrap() -> None:
    spec = RobosenseSpec("Bpearl v4", first_counter=2**32 - 2)
    evidence = evidence_of(_sent(spec, 4))
    lidar = built_in(evidence).lidar({}, evidence)
    assert lidar.sequence_modulus == 2**32
    assert lidar.sequence(evidence.sample).tolist() == [2**32 - 2, 2**32 - 1, 0, 1]


def test_a_rotor_at_rest_is_no_error() -> None:
    spec = RobosenseSpec("RS-32", rpm=0)
    evidence = evidence_of(_sent(spec, 4), [difop(spec, fan(spec))])
    lidar = built_in(evidence).lidar({}, evidence)
    assert lidar.mode == "single return, strongest"
    found = decoded(lidar, evidence.sample)
    assert not found.angle_rad.any()
    steps_ns = np.diff(found.time_ns[:, 0])
    assert steps_ns.min() > 54_000
    assert steps_ns.max() < 56_600


# A block's azimuth is rounded to 0.01 degree; two of them give the speed of a short packet.
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
    """Columns of one return each as those of two, where a packet cannot contain both."""
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
def test_point_packets_alone_identify_the_returns(name: str, mode: str) -> None:
    spec = RobosenseSpec(name, mode, start_deg=20.0)
    sent = msop(spec, *_readings(spec, packets=8))
    evidence = evidence_of([payload for _, payload in sent])
    file = robosense.read_calibration(Path("unit.csv"), angles_csv(fan(spec)).encode())
    assert file is not None
    assert file.match_score(evidence) == 200
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


@pytest.mark.parametrize("name", ["Helios 32", "Helios 16", "Helios 32, early type"])
@pytest.mark.parametrize(
    ("byte_17", "option", "unit_m", "is_noted"),
    [
        (1, "", 0.0025, False),
        (0, "", 0.0025, True),  # reserved in current manuals
        (7, "", 0.0025, False),
        (0, "5mm", 0.005, False),
        (1, "5mm", 0.005, False),
        (0, "2.5mm", 0.0025, False),
    ],
)
def test_range_unit_of_helios(
    name: str, byte_17: int, option: str, unit_m: float, is_noted: bool
) -> None:
    spec = RobosenseSpec(name)
    raw, levels = _readings(spec, packets=8)
    sent = [bytearray(payload) for _, payload in msop(spec, raw, levels)]
    for payload in sent:
        payload[17] = byte_17
    evidence = evidence_of([bytes(payload) for payload in sent], [difop(spec, fan(spec))])
    options = {"range_unit": option} if option else {}
    lidar = built_in(evidence).lidar(options, evidence)
    found = decoded(lidar, evidence.sample)
    np.testing.assert_array_equal(found.range_m, (raw / round(1 / unit_m)).astype(np.float32))
    assert ["range_unit=5mm" in note for note in lidar.notes] == [True] * is_noted


@pytest.mark.parametrize("name", ["RS-32", "Bpearl v4", "Airy 96", "Ruby 128"])
def test_range_units_of_other_models_are_their_own(name: str) -> None:
    evidence = evidence_of(_sent(RobosenseSpec(name), 8), [difop_of(name)])
    own, other = (
        decoded(built_in(evidence).lidar(options, evidence), evidence.sample)
        for options in ({}, {"range_unit": "2.5mm"})
    )
    np.testing.assert_array_equal(own.range_m, other.range_m)


def difop_of(name: str) -> bytes:
    """A device packet."""
    spec = RobosenseSpec(name)
    return difop(spec, fan(spec))


@pytest.mark.parametrize("mode", [STRONGEST, DUAL])
@pytest.mark.parametrize("name", ["RS-16", "RS-32", "Helios 32", "Airy 96", "Ruby 80", "Ruby 128"])
def test_an_azimuth_of_36000_is_0(name: str, mode: str) -> None:
    """Packets that pass through 0 exactly, written as 36000 and as 0."""
    spec = RobosenseSpec(name, mode, start_deg=0.0)
    sent = [bytearray(payload) for _, payload in msop(spec, *_readings(spec, packets=8))]
    evidence = evidence_of([bytes(payload) for payload in sent], [difop(spec, fan(spec))])
    lidar = built_in(evidence).lidar({}, evidence)
    changed = evidence.sample.copy()
    stride = 4 + 3 * spec.row.slots
    for block in range(spec.row.blocks):
        at = slice(spec.row.header + block * stride + 2, spec.row.header + block * stride + 4)
        if not changed[0, at].any():
            changed[0, at] = np.frombuffer(struct.pack(">H", 36000), np.uint8)
    assert (changed != evidence.sample).any()
    assert not lidar.faults(changed).any()
    expected, found = (
        lidar.column_headers(packets, evidence.host_ns) for packets in (evidence.sample, changed)
    )
    assert found.valid.all()
    np.testing.assert_array_equal(found.encoder, expected.encoder)
    np.testing.assert_array_equal(found.stamp_ns, expected.stamp_ns)


def test_an_azimuth_above_36000_is_damaged() -> None:
    spec = RobosenseSpec("Helios 32")
    evidence = evidence_of(_sent(spec, 2), [difop(spec, fan(spec))])
    lidar = built_in(evidence).lidar({}, evidence)
    changed = evidence.sample.copy()
    changed[1, 44:46] = np.frombuffer(struct.pack(">H", 36001), np.uint8)
    valid = lidar.column_headers(changed, evidence.host_ns).valid
    assert valid[1].tolist() == [False] + [True] * 11


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
    within_ns = np.ptp(lidar.column_headers(evidence.sample, evidence.host_ns).stamp_ns, axis=1)
    assert within_ns.max() > 30e9 / rpm
    late_ns = np.abs(found.time_ns - firing_times_ns(spec, columns))
    # A thousandth of the gap: the speed is known from steps of 0.01 degree.
    assert late_ns.max() < 30e9 / rpm / 1000
    turned_deg = np.degrees(found.angle_rad) - azimuths_deg(spec, columns)
    assert np.abs((turned_deg + 180) % 360 - 180).max() < 2 * MOST_DEG


@pytest.mark.parametrize("name", ["Bpearl v3", "Bpearl v4"])
def test_a_bpearl_that_turns_the_other_way(name: str) -> None:
    """The driver takes all of the azimuth backwards: the rotor's and the corrections."""
    spec = RobosenseSpec(name, start_deg=40.0, is_reversed=True)
    raw, levels = _readings(spec, packets=6)
    angles, sent = fan(spec), msop(spec, raw, levels)
    evidence = evidence_of([payload for _, payload in sent], [difop(spec, angles)])
    lidar = built_in(evidence).lidar({}, evidence)
    found, columns = decoded(lidar, evidence.sample), np.arange(len(raw))
    np.testing.assert_array_equal(found.time_ns, firing_times_ns(spec, columns))
    mirrored = Angles(angles.elevation_deg, -angles.azimuth_deg)
    range_m = raw[..., :1] * spec.range_unit_m
    wanted_m = range_m * directions(spec, mirrored, columns) + origins(spec, columns)
    assert np.abs(found.xyz_m[:, :, 0] - wanted_m).max() < range_m.max() * np.radians(MOST_DEG)
    assert lidar.notes == ()


def test_without_motion_all_beams_of_a_column_share_its_angle() -> None:
    spec = RobosenseSpec("Helios 32", start_deg=10.0)
    sent = msop(spec, *_readings(spec, packets=6))
    evidence = evidence_of([payload for _, payload in sent], [difop(spec, fan(spec))])
    still = built_in(evidence).lidar({"firing_azimuth": "off"}, evidence)
    found = decoded(still, evidence.sample)
    np.testing.assert_array_equal(found.time_ns, firing_times_ns(spec, np.arange(72)))
    turned_deg = np.degrees(found.angle_rad) - azimuths_deg(spec, np.arange(72))[:, :1]
    assert np.abs(turned_deg).max() < 0.0051
