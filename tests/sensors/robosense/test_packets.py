"""ROBOSENSE point packets: real heads, times, damage, counts, returns that are columns."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from mlbatch.sensors.robosense.models import BPEARL_V3, BPEARL_V4
from mlbatch.sensors.robosense.packets import times_ns
from mlbatch.types import U8Array
from tests.builders.others import filled, robosense_packets, rows
from tests.builders.robosense import RobosenseSpec, difop, fan, msop
from tests.builders.robosense_decoded import built_in, decoded, evidence_of
from tests.builders.robosense_models import DUAL

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
    """Never synchronised: its clock says 4066 s, which stays as it is."""
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
    heads = lidar.heads(packets, evidence.host_ns)
    whole = lidar.heads(evidence.sample, evidence.host_ns)
    assert heads.valid[4].tolist() == [block != 5 for block in range(12)]
    assert heads.valid[5].tolist() == [block != 3 for block in range(12)]
    np.testing.assert_array_equal(heads.stamp_ns[4:], whole.stamp_ns[4:])


def test_an_azimuth_that_is_damaged_moves_no_times() -> None:
    """It jumps there and back again, as no gap does."""
    spec = RobosenseSpec("Helios 32")
    evidence = evidence_of(_sent(spec, 6), [difop(spec, fan(spec))])
    lidar = built_in(evidence).lidar({}, evidence)
    packets = evidence.sample.copy()
    packets[5, 42 + 302] ^= 0x40
    heads = lidar.heads(packets, evidence.host_ns)
    np.testing.assert_array_equal(
        heads.stamp_ns, lidar.heads(evidence.sample, evidence.host_ns).stamp_ns
    )


def test_heads_depend_on_their_packet_alone() -> None:
    spec = RobosenseSpec("Ruby Plus 80", DUAL, start_deg=359.0)
    evidence = evidence_of(_sent(spec, 9), [difop(spec, fan(spec))])
    lidar = built_in(evidence).lidar({}, evidence)
    whole = lidar.heads(evidence.sample, evidence.host_ns)
    for number in range(9):
        alone = lidar.heads(evidence.sample[number : number + 1], evidence.host_ns[:1])
        np.testing.assert_array_equal(alone.stamp_ns[0], whole.stamp_ns[number])
        np.testing.assert_array_equal(alone.encoder[0], whole.encoder[number])


@pytest.mark.parametrize("name", ["Ruby 128", "Ruby Plus 128"])
def test_returns_of_128_lines_are_columns_of_one_time(name: str) -> None:
    """Packets hold both returns of a shot and one of the next, or one and both."""
    spec = RobosenseSpec(name, DUAL)
    evidence = evidence_of(_sent(spec, 4), [difop(spec, fan(spec))])
    lidar = built_in(evidence).lidar({}, evidence)
    assert (lidar.returns, lidar.return_types, lidar.columns_per_packet) == (1, (0,), 3)
    assert lidar.mode == "dual return, a column each"
    round_ns = {"Ruby 128": 55_550, "Ruby Plus 128": 55_560}[name]
    stamp_ns = lidar.heads(evidence.sample, evidence.host_ns).stamp_ns
    begun_ns = stamp_ns - stamp_ns[:, :1]
    assert begun_ns.tolist() == [[0, 0, round_ns], [0, round_ns, round_ns]] * 2


def test_packets_without_a_count_are_told_by_content() -> None:
    spec = RobosenseSpec("Helios 32")
    evidence = evidence_of(_sent(spec, 4), [difop(spec, fan(spec))])
    lidar = built_in(evidence).lidar({}, evidence)
    assert lidar.sequence_modulus == 0
    assert len(set(lidar.sequence(evidence.sample).tolist())) == 4


def test_a_bpearl_that_leaves_its_count_at_zero_is_told_by_content() -> None:
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
