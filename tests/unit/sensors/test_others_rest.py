"""ROBOSENSE and Livox packets by facts/robosense.md and facts/others.md."""

from __future__ import annotations

import numpy as np
import pytest

from tests.builders.others import (
    EE,
    filled,
    livox1_packets,
    livox2_packets,
    robosense_packets,
    rows,
)
from tests.unit.sensors.naming import lidar, named

FIRST, SECOND = bytes.fromhex("55aa050a5aa550a0"), bytes.fromhex("55aa055a")


@pytest.mark.parametrize(
    ("head", "lines", "calendar", "model"),
    [
        ({0: FIRST, 30: b"\x01"}, 16, True, "RS-LiDAR-16"),
        ({0: FIRST, 30: b"\x02"}, 32, True, "RS-LiDAR-32"),
        ({0: FIRST, 30: b"\x03"}, 32, True, "RS-Bpearl v3"),
        ({0: FIRST, 31: b"\x03\x04"}, 32, False, "RS-Bpearl v4"),
        ({0: FIRST, 31: b"\x03\x00"}, 32, False, "RS-Bpearl v4"),
        ({0: SECOND, 31: b"\x06\x01"}, 32, False, "Helios 32, 70 degrees"),
        ({0: SECOND, 31: b"\x06\x02"}, 32, False, "Helios 32, 31 degrees"),
        ({0: SECOND, 31: b"\x06\x04"}, 32, False, "Helios 32, 26 degrees"),
        ({0: SECOND, 31: b"\x06\x03"}, 16, False, "Helios 16"),
        ({0: SECOND, 31: b"\x07\x00"}, 16, False, "Helios 16"),
    ],
)
def test_robosense(head: dict[int, bytes], lines: int, calendar: bool, model: str) -> None:
    """A dual 16-line block is one round, a single one two; dual 32-line blocks come in pairs."""
    single = robosense_packets(head, 111.1 if lines == 16 else 55.5, calendar=calendar)
    dual = robosense_packets(head, 55.5, 12 if lines == 16 else 6, calendar=calendar)
    assert lidar(single) == f"ROBOSENSE lidar {model}, single return"
    assert lidar(dual) == f"ROBOSENSE lidar {model}, dual return"


def test_returns_of_robosense_that_a_packet_alone_does_not_tell() -> None:
    packets = robosense_packets({0: FIRST, 30: b"\x01"}, count=1)
    assert lidar(packets) == "ROBOSENSE lidar RS-LiDAR-16"


def test_robosense_of_unknown_type() -> None:
    packets = robosense_packets({0: FIRST, 30: b"\x09\x08"})
    assert lidar(packets) == "ROBOSENSE lidar of unknown model (type bytes 09 08)"
    packets = robosense_packets({0: SECOND, 31: b"\x0a\x0b"})
    assert lidar(packets) == "ROBOSENSE lidar of unknown model (type bytes 0A 0B)"


@pytest.mark.parametrize(("kind", "lines"), [(1, 48), (2, 96), (3, 192)])
@pytest.mark.parametrize(("mode", "returns"), [(0, "single"), (3, "dual")])
def test_airy(kind: int, lines: int, mode: int, returns: str) -> None:
    parts = {0: SECOND, 17: bytes((mode,)), 31: bytes((0x31, kind)), 42: EE, 42 + 148: EE}
    packets = rows([filled(1248, parts)])
    assert lidar(packets) == f"ROBOSENSE lidar Airy {lines}, {returns} return"


@pytest.mark.parametrize(
    ("stride", "size", "model"),
    [
        (388, 1248, "Ruby 128 or Ruby Plus 128"),
        (244, 1248, "Ruby 80 or Plus 80"),
        (148, 1268, "Ruby 48 or Plus 48"),
    ],
)
@pytest.mark.parametrize(("mode", "returns"), [(1, "single"), (3, "dual")])
def test_ruby(stride: int, size: int, model: str, mode: int, returns: str) -> None:
    parts = {0: SECOND, 7: bytes((mode,)), 80: b"\xfe\x01", 80 + stride: b"\xfe\x01"}
    packets = rows([filled(size, parts)])
    assert lidar(packets) == f"ROBOSENSE lidar {model}, {returns} return"


@pytest.mark.parametrize(
    ("size", "model"),
    [(1210, "M1"), (1342, "M2"), (1448, "M3"), (1404, "MX"), (1200, "E1"), (812, "EM")],
)
def test_solid_state_robosense(size: int, model: str) -> None:
    packets = rows([filled(size, {0: bytes.fromhex("55aa5aa5")})])
    assert lidar(packets) == f"ROBOSENSE lidar {model}"


def test_packets_beside_those_of_robosense() -> None:
    difop = filled(1248, {0: bytes.fromhex("a5ff005a11115555"), 1246: b"\x0f\xf0"})
    assert named(rows([difop])) == "ROBOSENSE DIFOP packet"
    assert named(rows([filled(51, {0: bytes.fromhex("aa555a05")})])) == "ROBOSENSE IMU packet, Airy"
    assert named(rows([filled(1248, {0: FIRST})])) is None


@pytest.mark.parametrize(
    ("kind", "size", "what"),
    [
        (1, 14, "Cartesian 32 bit, single return"),
        (2, 8, "Cartesian 16 bit, single return"),
        (3, 10, "spherical, single return"),
        (0x11, 28, "Cartesian 32 bit, dual return"),
    ],
)
def test_livox_of_the_second_kind(kind: int, size: int, what: str) -> None:
    packets = livox2_packets(kind, size, 96)
    assert lidar(packets) == f"Livox lidar (SDK2), {what}"
    assert named(np.hstack([packets, packets[:, :1]])) is None


@pytest.mark.parametrize(
    ("kind", "size", "what"),
    [
        (0, 1318, "Cartesian, single return"),
        (1, 918, "spherical, single return"),
        (2, 1362, "Cartesian with tags, single return"),
        (3, 978, "spherical with tags, single return"),
        (4, 1362, "Cartesian, dual return"),
        (5, 786, "spherical, dual return"),
        (7, 1278, "Cartesian, triple return"),
        (8, 678, "spherical, triple return"),
    ],
)
@pytest.mark.parametrize(("time_type", "step"), [(0, 400_000), (1, 400_000), (3, 400), (4, 400)])
def test_livox_of_the_first_kind(
    kind: int, size: int, what: str, time_type: int, step: int
) -> None:
    packets = livox1_packets(kind, size, time_type, step)
    assert lidar(packets) == f"Livox lidar (SDK1), {what}"
    assert named(packets[:1]) is None
    assert named(packets[[0, 0, 0]]) is None


def test_imu_packets_of_livox() -> None:
    assert named(livox2_packets(0, 24, 1)) == "Livox IMU packet"
    assert named(livox1_packets(6, 42)) == "Livox IMU packet"
