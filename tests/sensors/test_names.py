"""What packets are called, by the facts of docs/sources: a row is what they contain.

Packets that no vendor knows, or that look like others': `test_sensors.py`.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from mlbatch.arrays import U8Array
from mlbatch.sensors.livox import sensor as livox
from mlbatch.sensors.robosense.identify import identify
from mlbatch.sensors.robosense.models import BPEARL_V3, BPEARL_V4, HELIOS_16, HELIOS_32, Model
from tests.builders.others import (
    EE,
    filled,
    livox1_packets,
    livox2_packets,
    robosense_packets,
    rows,
    velodyne_packets,
)
from tests.builders.vendors import LACKING, named

Parts = Mapping[int, bytes]


def one(size: int, parts: Parts, count: int = 1) -> U8Array:
    """Equal packets with these bytes."""
    return rows([filled(size, dict(parts))] * count)


def check(table: Sequence[tuple[U8Array, str | None]]) -> None:
    """Packets, and their name."""
    for packets, name in table:
        assert named(packets) == name


# -- Velodyne: docs/sources/velodyne.md sections 1 and 2, others.md -------------------------------


@pytest.mark.parametrize(
    ("product", "pace", "model", "lack"),
    [
        (0x21, "HDL-32E", "HDL-32E", ""),
        (0x22, "VLP-16", "VLP-16", ""),
        # Models that the sheet has no beams or no layout of.
        (0x23, "VLP-32C", "VLP-32A/B", LACKING),
        (0x24, "VLP-16", "Puck Hi-Res", ""),
        (0x28, "VLP-32C", "VLP-32C", ""),
        (0x31, "VLP-32C", "Velarray", LACKING),
    ],
)
@pytest.mark.parametrize(("byte", "mode"), [(0x37, "strongest"), (0x38, "last"), (0x39, "dual")])
def test_velodyne(product: int, pace: str, model: str, lack: str, byte: int, mode: str) -> None:
    packets = velodyne_packets(bytes((byte, product)), pace, mode)
    name = f"Velodyne lidar {model}, {mode} return{lack}"
    check([(packets, name), (packets[:1], name)])


@pytest.mark.parametrize(("byte", "mode"), [(0x37, "strongest"), (0x39, "dual")])
def test_a_product_byte_contradicted_by_the_pace(byte: int, mode: str) -> None:
    for product, model, other in ((0x21, "VLP-16", "HDL-32E"), (0x22, "HDL-32E", "VLP-16")):
        packets = velodyne_packets(bytes((byte, product)), model, mode, count=16)
        name = f"Velodyne lidar {model} (its product byte says {other}), {mode} return"
        # Also if packets are lost; a single one cannot contradict.
        check([(packets[::every], name) for every in (1, 2, 3)])
        check([(packets[:1], f"Velodyne lidar {other}, {mode} return")])


def test_other_packets_of_velodyne() -> None:
    for mode, word in (("strongest", "single"), ("dual", "dual")):
        check(
            [
                (
                    velodyne_packets(b"\0\0", model, mode),
                    f"Velodyne lidar {model} (its factory bytes are not set), {word} return",
                )
                for model in ("VLP-16", "HDL-32E")
            ]
        )
    like = "Velodyne-like lidar, factory bytes"
    check(
        [
            (velodyne_packets(b"\0\0", "VLP-32C"), f"{like} 00 00{LACKING}"),
            (velodyne_packets(b"\x37\x10", "VLP-16"), f"{like} 37 10{LACKING}"),
        ]
    )
    # A VLS-128 by its four banks, an HDL-64E by two; the last bytes of that are a status.
    for product in (0xA1, 0x63):
        check(
            [
                (velodyne_packets(bytes((byte, last)), "VLS-128", mode), f"Velodyne lidar {name}")
                for byte, last, mode, name in (
                    (0x38, product, "last", "VLS-128, last return"),
                    (0x39, product, "dual", "VLS-128, dual return"),
                    (0, 0, "last", "VLS-128, single return"),
                    (0, 0, "dual", "VLS-128, dual return"),
                )
            ]
        )
    for mode, word in (("last", "single"), ("dual", "dual")):
        packets = velodyne_packets(b"\0\0", "HDL-64E S3", mode)
        packets[:, 1204:] = np.frombuffer(b"HaMbScDdNeYfGgTh", np.uint8).reshape(8, 2)
        check([(packets, f"Velodyne lidar HDL-64E, {word} return")])


STAMP = {198: struct.pack("<I", 1_082_382_961), 202: b"\x02"}
HOUR = struct.pack("<I", 3_600_000_000)
FLAGS = {100 * n: EE for n in range(12)}
# -- HESAI: docs/sources/hesai.md sections 1 to 3 -------------------------------------------------

# (model, size, header, byte of the return mode); the byte is header + blocks x stride + checks +
# place in the tail, worked by hand.
HESAI: list[tuple[str, int, str, int]] = [
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
HESAI_LACKING: list[tuple[str, int, str, int]] = [
    ("Pandar20", 1274, "eeff1414", 0),  # with a sequence number, which no source knows of
    ("Pandar128", 812, "eeff01030000800200040100", 800),  # 12 + 2 x 386 + 16
    ("Pandar128E3X, 64 channels", 477, "eeff01040000400200040107", 433),  # 12 + 388 + 21 + 12
    ("PandarQT32", 560, "eeff03010000200401040201", 548),  # 12 + 4 x 130 + 16
    ("QT128C2X", 1127, "eeff0302030080020104025d", 1073),  # channels of its own choice
    ("PandarXT of 64 channels", 2104, "eeff06010000400801040201", 2086),  # 12 + 8 x 258 + 10
    ("ATX", 1000, "eeff0407", 0),
    ("FT120", 1000, "eeff0702", 0),
]
TRIPLE = "triple return, first, last and strongest"
HESAI_MODES = {
    0x33: "first return",
    0x34: "second return",
    0x37: "strongest return",
    0x38: "last return",
    0x39: "dual return, last and strongest",
    0x3A: "dual return, first and second",
    0x3B: "dual return, first and last",
    0x3C: "dual return, first and strongest",
    0x3D: TRIPLE,
    0x3E: "dual return, strongest and second strongest",
}
XT32M2X, XT16 = "eeff06010000200601050301", "eeff06010000100801040201"
AT128 = bytes.fromhex("eeff04030000800200040101")
CORRECTION = b"Laser id,Elevation,Azimuth\n1,14.9,-1.0\n"


def hesai(size: int, head: str, mode_at: int = 0, mode: int = 0x37) -> U8Array:
    return one(size, {mode_at: bytes((mode,)), 0: bytes.fromhex(head)}, 2)


def pandar40(size: int) -> U8Array:
    return one(size, {**{124 * block: EE for block in range(10)}, 1254: b"\x38"})


# -- ROBOSENSE: docs/sources/robosense.md sections 1 to 4 and 7 -----------------------------------

FIRST, SECOND = bytes.fromhex("55aa050a5aa550a0"), bytes.fromhex("55aa055a")
DIFOP = filled(1248, {0: bytes.fromhex("a5ff005a11115555"), 1246: b"\x0f\xf0"})
TYPES: list[tuple[bytes, str, int, bool, str]] = [
    (FIRST, "01", 16, True, "RS-LiDAR-16"),
    (FIRST, "02", 32, True, "RS-LiDAR-32"),
    (FIRST, "03", 32, True, "RS-Bpearl v3"),
    (FIRST, "000304", 32, False, "RS-Bpearl v4"),
    (FIRST, "000300", 32, False, "RS-Bpearl v4"),
    (SECOND, "000601", 32, False, "Helios 32, 70 degrees"),
    (SECOND, "000602", 32, False, "Helios 32, 31 degrees"),
    (SECOND, "000604", 32, False, "Helios 32, 26 degrees"),
    (SECOND, "000603", 16, False, "Helios 16"),
    (SECOND, "000700", 16, False, "Helios 16"),
    # The type where rs_driver has it.
    (SECOND, "070000", 16, False, "Helios 16"),
    (FIRST, "0001", 16, True, "RS-LiDAR-16"),
    (FIRST, "0002", 32, True, "RS-LiDAR-32"),
    (FIRST, "000302", 32, True, "RS-Bpearl v3"),
    (FIRST, "030300", 32, True, "RS-Bpearl v3"),
    (FIRST, "030304", 32, False, "RS-Bpearl v4"),
]
RUBY = [
    (388, 1248, "Ruby 128 or Ruby Plus 128"),
    (244, 1248, "Ruby 80 or Ruby Plus 80"),
    (148, 1268, "Ruby 48 or Ruby Plus 48"),
]


@pytest.mark.parametrize(("head", "types", "lines", "calendar", "model"), TYPES)
def test_robosense(head: bytes, types: str, lines: int, calendar: bool, model: str) -> None:
    """A dual 16-line block is one round, a single one two; dual 32-line blocks come in pairs."""
    parts = {0: head, 30: bytes.fromhex(types)}
    for mode, word in (("strongest", "single"), ("dual", "dual")):
        packets = robosense_packets(parts, lines, mode, calendar=calendar)
        check([(packets, f"ROBOSENSE lidar {model}, {word} return")])


@pytest.mark.parametrize("types", ["060000", "000600", "060609"])
def test_helios_without_a_model_is_identified_by_the_time_of_its_blocks(types: str) -> None:
    """A block is a round of 32 lines, or two of 16; one of 16 with two returns takes as long."""
    head = {0: SECOND, 30: bytes.fromhex(types)}
    wide = robosense_packets(head)
    check(
        [
            (robosense_packets(head, 16), "ROBOSENSE lidar Helios 16, single return"),
            (robosense_packets(head, 32, "dual"), "ROBOSENSE lidar Helios 32, dual return"),
            (wide, "ROBOSENSE lidar Helios 32, single return"),
        ]
    )
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
    found = identify(one(size, {**parts, 80: b"\xfe\x01", 80 + stride: b"\xfe\x01"}))
    assert found is not None
    assert found.model is not None
    assert found.model.name.startswith("Ruby Plus") == plus
    assert (found.other is None) == sure


def ruby(stride: int, size: int, mode: int) -> U8Array:
    parts = {0: SECOND, 7: bytes((mode,))}
    return one(size, {**parts, 80: b"\xfe\x01", 80 + stride: b"\xfe\x01"})


def airy(kind: int, mode: int = 0) -> U8Array:
    return one(1248, {0: SECOND, 17: bytes((mode,)), 31: bytes((0x31, kind)), 42: EE, 190: EE})


def test_device_packets_and_damaged_ones_between_points_do_not_hide_them() -> None:
    points = robosense_packets({0: SECOND, 31: b"\x06\x01"})
    mixed = np.concatenate([rows([DIFOP]), points[:3], rows([DIFOP]), points[3:]])
    packets = robosense_packets({0: FIRST, 30: b"\x02"}, calendar=True)
    packets[1] = np.random.default_rng(5).integers(0, 256, packets.shape[1], np.uint8)
    devices = rows([DIFOP] * 3)
    devices[1, 0] = 0
    check(
        [
            (mixed, "ROBOSENSE lidar Helios 32, 70 degrees, single return"),
            (packets, "ROBOSENSE lidar RS-LiDAR-32, single return"),
            (devices, "ROBOSENSE DIFOP packet"),
        ]
    )


# -- single packets -------------------------------------------------------------------------------

NAMES: list[tuple[U8Array, str | None]] = [
    (velodyne_packets(b"", "VLP-16", size=1212), "LSLIDAR-like, 1212 bytes: not supported"),
    *(
        (one(size, {0: bytes.fromhex("a5ff005a")}), "LSLIDAR device packet")
        for size in (1206, 1212)
    ),
    *(
        (one(512, {**STAMP, 206: text}), "Velodyne position packet")
        for text in (b"$GPRMC,081802,A", b"$GPGGA,081802", b"")
    ),
    (one(512, {198: HOUR, 206: b"$GPRMC"}), None),
    (one(512, {}), None),
    (one(1206, {200: EE, 300: b"\x00\x01"}), None),  # a lone flag
    (one(1206, {100 * n: EE + struct.pack("<H", 36001) for n in range(12)}), None),
    (one(1206, {**FLAGS, 1200: HOUR}), None),
    *(
        (hesai(size, head, mode_at), f"HESAI lidar {model}, strongest return")
        for model, size, head, mode_at in HESAI
    ),
    *(
        (
            hesai(size, head, mode_at),
            f"HESAI lidar {model}{', strongest return' if mode_at else ''}{LACKING}",
        )
        for model, size, head, mode_at in HESAI_LACKING
    ),
    *(
        (hesai(820, XT32M2X, 802, mode), f"HESAI lidar XT32M2X, {text}")
        for mode, text in HESAI_MODES.items()
    ),
    # An unknown mode is not guessed; returns have to fill the blocks.
    (hesai(820, XT32M2X, 802, 0x40), f"HESAI lidar XT32M2X{LACKING}"),
    (
        hesai(1392, "eeff40070004", 1380, 0x39),
        f"HESAI lidar Pandar64, dual return, last and strongest{LACKING}",
    ),
    (hesai(568, XT16, 550, 0x3D), f"HESAI lidar PandarXT-16, {TRIPLE}{LACKING}"),
    # Every block of a Pandar40 bears its flag; the first one has no date.
    (pandar40(1256), f"HESAI lidar Pandar40, last return{LACKING}"),
    *((pandar40(size), "HESAI lidar Pandar40P or Pandar40M, last return") for size in (1262, 1266)),
    *((one(size, {0: EE}), None) for size in (1256, 1262, 1266, 512)),
    # Automotive models behind a prefix.
    (one(1107, {21: AT128, 1091: b"\x39"}), "HESAI lidar AT128, dual return, last and strongest"),
    (one(589, {21: bytes.fromhex(XT16)}), None),
    (one(512, {0: EE + b"712190403180", 18: b"$GPRMC"}), "HESAI GPS packet"),
    (one(99, {0: b"\xcd\xdc"}), "HESAI fault packet"),
    (one(34, {0: bytes.fromhex("eeff0108")}), "HESAI IMU packet, JT16"),
    (one(80, {0: bytes.fromhex("eeff0108")}), "HESAI lidar JT16, single return"),
    (
        rows([bytes.fromhex("47740500") + struct.pack(">I", len(CORRECTION)) + CORRECTION]),
        "HESAI correction",
    ),
    (hesai(1198, "eeff0909"), None),  # no such protocol
    (hesai(300, "eeff06010000200801040201"), None),  # shorter than its blocks
    (hesai(4, "eeff0601"), None),
    (hesai(820, XT32M2X, 802)[:0], None),
    *(
        (ruby(stride, size, mode), f"ROBOSENSE lidar {model}, {word} return")
        for stride, size, model in RUBY
        for mode, word in ((1, "single"), (3, "dual"))
    ),
    *(
        (airy(kind, mode), f"ROBOSENSE lidar Airy {lines}, {word} return")
        for kind, lines in ((1, 48), (2, 96))
        for mode, word in ((0, "single"), (3, "dual"))
    ),
    (airy(3), f"ROBOSENSE lidar Airy 192{LACKING}"),
    *(
        (one(size, {0: bytes.fromhex("55aa5aa5")}), f"ROBOSENSE lidar {model}{LACKING}")
        for size, model in (
            *((1210, "M1"), (1342, "M2"), (1448, "M3"), (1404, "MX"), (1200, "E1"), (812, "EM")),
        )
    ),
    (rows([DIFOP]), "ROBOSENSE DIFOP packet"),
    (one(51, {0: bytes.fromhex("aa555a05")}), "ROBOSENSE IMU packet, Airy"),
    (one(1248, {0: FIRST}), None),
    # A packet alone does not identify the returns.
    (robosense_packets({0: FIRST, 30: b"\x01"}, count=1), "ROBOSENSE lidar RS-LiDAR-16"),
    *(
        (
            robosense_packets({0: head, 30: bytes.fromhex(types)}),
            f"ROBOSENSE lidar of unknown model (type bytes {types}){LACKING}",
        )
        for head, types in ((FIRST, "09 08 00"), (SECOND, "00 0A 0B"))
    ),
    (livox2_packets(0, 24, 1), "Livox IMU packet"),
    (livox1_packets(6, 42), "Livox IMU packet"),
]


@pytest.mark.parametrize(("packets", "name"), NAMES)
def test_names(packets: U8Array, name: str | None) -> None:
    assert named(packets) == name


# -- Livox: docs/sources/others.md ----------------------------------------------------------------


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
    longer = np.hstack([packets, packets[:, :1]])
    check([(packets, f"Livox lidar (SDK2), {what}"), (longer, None)])
    assert livox.describe(packets.shape[1] + 1, packets) is None
    assert livox.describe(packets.shape[1], packets[:0]) is None


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
    check([(packets, f"Livox lidar (SDK1), {what}{LACKING}")])
    check([(packets[:1], None), (packets[[0, 0, 0]], None)])
