"""What HESAI packets are called, by docs/sources/hesai.md."""

from __future__ import annotations

import struct

import pytest

from mlbatch.arrays import U8Array
from tests.builders.others import (
    EE,
    filled,
    rows,
)
from tests.builders.streams import LACKING, named


def hesai(size: int, head: str, mode_at: int = 0, mode: int = 0x37) -> U8Array:
    parts = {0: bytes.fromhex(head)}
    if mode_at:
        parts[mode_at] = bytes((mode,))
    return rows([filled(size, parts)] * 2)


# (model, size, header, byte of the return mode) by docs/sources/hesai.md sections 1 to 3; the byte
# is header + blocks x stride + checks + place in the tail, worked by hand.
DECODED = [
    ("Pandar20A or Pandar20B", 1270, "eeff14140004", 1262),  # 8 + 20 x 62 + 14
    ("Pandar64", 1194, "eeff40060004", 1186),  # 8 + 6 x 194 + 14
    ("Pandar64", 1198, "eeff40060004", 1186),
    ("Pandar64", 1388, "eeff40070004", 1380),  # 8 + 7 x 194 + 14
    ("Pandar64", 1392, "eeff40070004", 1380),
    ("Pandar128E3X", 861, "eeff01040000800200040107", 817),  # 12 + 2 x 386 + 21 + 12
    ("Pandar128E3X", 893, "eeff0104000080020004010f", 817),
    ("Pandar128E3X", 844, "eeff01040000800200040103", 800),  # no safety: 12 + 772 + 4 + 12
    ("Pandar128E3X", 1117, "eeff01040000800200040117", 1073),  # 12 + 2 x 514 + 21 + 12
    ("OT128", 861, "eeff01048000800200040107", 817),
    ("OT128", 861, "eeff01048800800200040107", 817),
    ("JT128", 861, "eeff01048900800200040107", 817),
    ("PandarQT64", 1072, "eeff03010000400401040201", 1060),  # 12 + 4 x 258 + 16
    ("PandarQT64", 1068, "eeff03010000400401040200", 1060),
    ("QT128C2X", 1127, "eeff0302030080020104021d", 1073),  # 12 + 2 x 514 + 21 + 12
    ("AT128", 1118, "eeff04010000800200040109", 1070),  # 12 + 2 x 515 + 4 + 24
    ("AT128", 1086, "eeff04030000800200040101", 1070),
    ("PandarXT-16", 568, "eeff06010000100801040201", 550),  # 12 + 8 x 66 + 10
    ("PandarXT-32", 1080, "eeff06010000200801040201", 1062),  # 12 + 8 x 130 + 10
    ("XT32M2X", 820, "eeff06010000200601050301", 802),  # 12 + 6 x 130 + 10
]
NAMED_ONLY = [
    ("Pandar20", 1274, "eeff1414", 0),  # with a sequence number, which no source knows of
    ("Pandar128", 812, "eeff01030000800200040100", 800),  # 12 + 2 x 386 + 16
    ("Pandar128E3X, 64 channels", 477, "eeff01040000400200040107", 433),  # 12 + 388 + 21 + 12
    ("PandarQT32", 560, "eeff03010000200401040201", 548),  # 12 + 4 x 130 + 16
    ("QT128C2X", 1127, "eeff0302030080020104025d", 1073),  # channels of its own choice
    ("PandarXT of 64 channels", 2104, "eeff06010000400801040201", 2086),  # 12 + 8 x 258 + 10
    ("ATX", 1000, "eeff0407", 0),
    ("FT120", 1000, "eeff0702", 0),
]


@pytest.mark.parametrize(("model", "size", "head", "mode_at"), DECODED)
def test_models_that_are_decoded(model: str, size: int, head: str, mode_at: int) -> None:
    name = named(hesai(size, head, mode_at))
    assert name == f"HESAI lidar {model}, strongest return"


@pytest.mark.parametrize(("model", "size", "head", "mode_at"), NAMED_ONLY)
def test_models_without_a_decoder(model: str, size: int, head: str, mode_at: int) -> None:
    mode = ", strongest return" if mode_at else ""
    assert named(hesai(size, head, mode_at)) == f"HESAI lidar {model}{mode}{LACKING}"


@pytest.mark.parametrize(
    ("size", "model"),
    [(1256, "Pandar40"), (1262, "Pandar40P or Pandar40M"), (1266, "Pandar40P or Pandar40M")],
)
def test_pandar40_bears_a_flag_at_every_block(size: int, model: str) -> None:
    parts = {124 * block: EE for block in range(10)}
    parts[1240 + 14] = b"\x38"
    # The Pandar40 has no date.
    lacking = LACKING if model == "Pandar40" else ""
    assert named(rows([filled(size, parts)])) == f"HESAI lidar {model}, last return{lacking}"
    assert named(rows([filled(size, {0: EE})])) is None


@pytest.mark.parametrize(
    ("mode", "text"),
    [
        (0x33, "first return"),
        (0x34, "second return"),
        (0x37, "strongest return"),
        (0x38, "last return"),
        (0x39, "dual return, last and strongest"),
        (0x3A, "dual return, first and second"),
        (0x3B, "dual return, first and last"),
        (0x3C, "dual return, first and strongest"),
        (0x3D, "triple return, first, last and strongest"),
        (0x3E, "dual return, strongest and second strongest"),
    ],
)
def test_return_modes_of_hesai(mode: int, text: str) -> None:
    packets = hesai(820, "eeff06010000200601050301", 802, mode)
    assert named(packets) == f"HESAI lidar XT32M2X, {text}"


def test_an_unknown_return_mode_of_hesai_is_not_guessed() -> None:
    packets = hesai(820, "eeff06010000200601050301", 802, 0x40)
    assert named(packets) == f"HESAI lidar XT32M2X{LACKING}"


@pytest.mark.parametrize(
    ("size", "head", "mode_at", "mode", "text"),
    [
        (1392, "eeff40070004", 1380, 0x39, "Pandar64, dual return, last and strongest"),
        (568, "eeff06010000100801040201", 550, 0x3D, "PandarXT-16, triple return, first, last"),
    ],
)
def test_returns_that_do_not_fill_the_blocks(
    size: int, head: str, mode_at: int, mode: int, text: str
) -> None:
    name = named(hesai(size, head, mode_at, mode)) or ""
    assert name.startswith(f"HESAI lidar {text}")
    assert name.endswith(LACKING)


def test_automotive_hesai_behind_a_prefix() -> None:
    behind = {21: bytes.fromhex("eeff04030000800200040101"), 21 + 1070: b"\x39"}
    packets = rows([filled(21 + 1086, behind)])
    assert named(packets) == "HESAI lidar AT128, dual return, last and strongest"
    packets = rows([filled(21 + 568, {21: bytes.fromhex("eeff06010000100801040201")})])
    assert named(packets) is None


def test_other_packets_of_hesai() -> None:
    gps = {0: EE + b"712190403180", 18: b"$GPRMC"}
    assert named(rows([filled(512, gps)])) == "HESAI GPS packet"
    assert named(rows([filled(512, {0: EE})])) is None
    assert named(rows([filled(99, {0: b"\xcd\xdc"})])) == "HESAI fault packet"
    assert named(rows([filled(34, {0: bytes.fromhex("eeff0108")})])) == "HESAI IMU packet, JT16"
    points = rows([filled(80, {0: bytes.fromhex("eeff0108")})])
    assert named(points) == "HESAI lidar JT16, single return"
    table = b"Laser id,Elevation,Azimuth\n1,14.9,-1.0\n"
    correction = bytes.fromhex("47740500") + struct.pack(">I", len(table)) + table
    assert named(rows([correction])) == "HESAI correction"


@pytest.mark.parametrize(
    ("size", "head"),
    [
        (1198, "eeff0909"),  # no such protocol
        (300, "eeff06010000200801040201"),  # shorter than its blocks
        (4, "eeff0601"),
    ],
)
def test_other_packets_that_begin_like_hesai(size: int, head: str) -> None:
    assert named(hesai(size, head)) is None
