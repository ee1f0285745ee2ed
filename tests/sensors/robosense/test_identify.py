"""What ROBOSENSE packets are called, by docs/sources/robosense.md sections 1 to 4 and 7."""

from __future__ import annotations

import numpy as np
import pytest

from mlbatch import sensors
from mlbatch.arrays import U8Array
from mlbatch.sensors.robosense.identify import identify
from mlbatch.sensors.robosense.models import BPEARL_V3, BPEARL_V4, HELIOS_16, HELIOS_32, Model
from tests.builders.others import EE, filled, robosense_packets, rows

FIRST, SECOND = bytes.fromhex("55aa050a5aa550a0"), bytes.fromhex("55aa055a")
DIFOP = filled(1248, {0: bytes.fromhex("a5ff005a11115555"), 1246: b"\x0f\xf0"})
LACKING = ": no decoder in this version"


def named(packets: U8Array) -> str | None:
    """The description of payloads (k, size)."""
    return sensors.describe(packets.shape[1], packets)


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
        # The type where rs_driver has it.
        ({0: SECOND, 30: b"\x07\x00\x00"}, 16, False, "Helios 16"),
        ({0: FIRST, 31: b"\x01"}, 16, True, "RS-LiDAR-16"),
        ({0: FIRST, 31: b"\x02"}, 32, True, "RS-LiDAR-32"),
        ({0: FIRST, 31: b"\x03\x02"}, 32, True, "RS-Bpearl v3"),
        ({0: FIRST, 30: b"\x03\x03\x00"}, 32, True, "RS-Bpearl v3"),
        ({0: FIRST, 30: b"\x03\x03\x04"}, 32, False, "RS-Bpearl v4"),
    ],
)
def test_robosense(head: dict[int, bytes], lines: int, calendar: bool, model: str) -> None:
    """A dual 16-line block is one round, a single one two; dual 32-line blocks come in pairs."""
    single = robosense_packets(head, 111.1 if lines == 16 else 55.5, calendar=calendar)
    dual = robosense_packets(head, 55.5, 12 if lines == 16 else 6, calendar=calendar)
    assert named(single) == f"ROBOSENSE lidar {model}, single return"
    assert named(dual) == f"ROBOSENSE lidar {model}, dual return"


@pytest.mark.parametrize("types", ["06 00 00", "00 06 00", "06 06 09"])
def test_helios_without_a_model_is_identified_by_the_time_of_its_blocks(types: str) -> None:
    """A block is a round of 32 lines, or two of 16; one of 16 with two returns takes as long."""
    head = {0: SECOND, 30: bytes.fromhex(types)}
    assert named(robosense_packets(head, 111.1)) == "ROBOSENSE lidar Helios 16, single return"
    assert named(robosense_packets(head, 55.5, 6)) == "ROBOSENSE lidar Helios 32, dual return"
    wide = robosense_packets(head, 55.5)
    assert named(wide) == "ROBOSENSE lidar Helios 32, single return"
    found = identify(wide)
    assert found is not None
    assert (found.model, found.other) == (HELIOS_32, HELIOS_16)


@pytest.mark.parametrize(
    ("calendar", "model", "other"), [(True, BPEARL_V3, BPEARL_V4), (False, BPEARL_V4, BPEARL_V3)]
)
def test_bpearl_of_model_0_is_identified_by_its_times(
    calendar: bool, model: Model, other: Model
) -> None:
    """Only a v3 sends dates."""
    found = identify(robosense_packets({0: FIRST, 31: b"\x03\x00"}, calendar=calendar))
    assert found is not None
    assert (found.model, found.other) == (model, other)


# Bytes 30 to 32, and which of Ruby and Ruby Plus; True: certainly.
@pytest.mark.parametrize(
    ("stride", "size", "types", "plus", "sure"),
    [
        (244, 1248, "05 02 00", True, True),  # rs_driver: type, model (2: 80, 3: 80v)
        (244, 1248, "05 03 00", True, True),
        (244, 1248, "00 03 00", True, True),
        (244, 1248, "04 02 00", True, True),
        (244, 1248, "00 05 02", True, False),  # manual of the Ruby Plus
        (244, 1248, "00 04 00", False, False),
        (244, 1248, "04 00 00", False, False),
        (244, 1248, "00 00 00", False, False),
        (388, 1248, "05 01 00", True, False),
        (388, 1248, "00 05 00", True, False),
        (388, 1248, "04 03 00", False, False),
        (148, 1268, "05 00 00", True, False),
        (148, 1268, "00 05 00", True, False),
    ],
)
def test_type_bytes_of_ruby(stride: int, size: int, types: str, plus: bool, sure: bool) -> None:
    parts = {0: SECOND, 7: b"\1", 30: bytes.fromhex(types)}
    parts |= {80: b"\xfe\x01", 80 + stride: b"\xfe\x01"}
    found = identify(rows([filled(size, parts)]))
    assert found is not None
    assert found.model is not None
    assert found.model.name.startswith("Ruby Plus") == plus
    assert (found.other is None) == sure


def test_returns_of_robosense_that_a_packet_alone_does_not_identify() -> None:
    packets = robosense_packets({0: FIRST, 30: b"\x01"}, count=1)
    assert named(packets) == "ROBOSENSE lidar RS-LiDAR-16"


def test_robosense_of_unknown_type() -> None:
    packets = robosense_packets({0: FIRST, 30: b"\x09\x08"})
    assert named(packets) == "ROBOSENSE lidar of unknown model (type bytes 09 08 00)" + LACKING
    packets = robosense_packets({0: SECOND, 31: b"\x0a\x0b"})
    assert named(packets) == "ROBOSENSE lidar of unknown model (type bytes 00 0A 0B)" + LACKING


@pytest.mark.parametrize(("kind", "lines"), [(1, 48), (2, 96)])
@pytest.mark.parametrize(("mode", "returns"), [(0, "single"), (3, "dual")])
def test_airy(kind: int, lines: int, mode: int, returns: str) -> None:
    parts = {0: SECOND, 17: bytes((mode,)), 31: bytes((0x31, kind)), 42: EE, 42 + 148: EE}
    packets = rows([filled(1248, parts)])
    assert named(packets) == f"ROBOSENSE lidar Airy {lines}, {returns} return"


@pytest.mark.parametrize(
    ("stride", "size", "model"),
    [
        (388, 1248, "Ruby 128 or Ruby Plus 128"),
        (244, 1248, "Ruby 80 or Ruby Plus 80"),
        (148, 1268, "Ruby 48 or Ruby Plus 48"),
    ],
)
@pytest.mark.parametrize(("mode", "returns"), [(1, "single"), (3, "dual")])
def test_ruby(stride: int, size: int, model: str, mode: int, returns: str) -> None:
    parts = {0: SECOND, 7: bytes((mode,)), 80: b"\xfe\x01", 80 + stride: b"\xfe\x01"}
    packets = rows([filled(size, parts)])
    assert named(packets) == f"ROBOSENSE lidar {model}, {returns} return"


@pytest.mark.parametrize(
    ("size", "model"),
    [(1210, "M1"), (1342, "M2"), (1448, "M3"), (1404, "MX"), (1200, "E1"), (812, "EM")],
)
def test_solid_state_robosense(size: int, model: str) -> None:
    packets = rows([filled(size, {0: bytes.fromhex("55aa5aa5")})])
    assert named(packets) == f"ROBOSENSE lidar {model}{LACKING}"


def test_other_packets_of_robosense() -> None:
    assert named(rows([DIFOP])) == "ROBOSENSE DIFOP packet"
    assert named(rows([filled(51, {0: bytes.fromhex("aa555a05")})])) == "ROBOSENSE IMU packet, Airy"
    assert named(rows([filled(1248, {0: FIRST})])) is None


def test_airy_of_192_lines_has_no_decoder() -> None:
    parts = {0: SECOND, 31: b"\x31\x03", 42: EE, 42 + 148: EE}
    assert named(rows([filled(1248, parts)])) == f"ROBOSENSE lidar Airy 192{LACKING}"


def test_device_packets_between_point_packets_do_not_hide_them() -> None:
    points = robosense_packets({0: SECOND, 31: b"\x06\x01"})
    mixed = np.concatenate([rows([DIFOP]), points[:3], rows([DIFOP]), points[3:]])
    assert named(mixed) == "ROBOSENSE lidar Helios 32, 70 degrees, single return"


def test_a_damaged_packet_does_not_hide_a_stream() -> None:
    packets = robosense_packets({0: FIRST, 30: b"\x02"}, calendar=True)
    packets[1] = np.random.default_rng(5).integers(0, 256, packets.shape[1], np.uint8)
    assert named(packets) == "ROBOSENSE lidar RS-LiDAR-32, single return"
    devices = rows([DIFOP] * 3)
    devices[1, 0] = 0
    assert named(devices) == "ROBOSENSE DIFOP packet"
