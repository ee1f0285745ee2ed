"""The encoder of HESAI packets against bytes, times and directions worked by hand.

Source: docs/sources/hesai.md sections 2 to 6.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mlbatch.types import I64Array
from tests.builders.hesai import (
    DUAL,
    TRIPLE,
    Angles,
    HesaiSpec,
    MirrorAngles,
    block_times_ns,
    crc32_mpeg2,
    directions,
    encode_packets,
)

# 2023-11-14 22:13:20 UTC (1 700 000 000 s) and 999 999.5 us.
START_NS = 1_700_000_000_999_999_500
US, DATE, DATE_2000 = "3f420f00", "7b0b0e160d14", "170b0e160d14"
BASE = HesaiSpec("", start_deg=359.9, start_ns=START_NS, sequence=2**32 - 2)


def spec(model: str, **chosen: Any) -> HesaiSpec:
    return replace(BASE, model=model, **chosen)


def readings(one: HesaiSpec, packets: int = 2) -> tuple[I64Array, I64Array]:
    """Range 1 + channel + 128 x column + 32768 x return, level channel + return."""
    columns, channels = packets * one.groups, one.row.channels
    column, channel, which = np.indices((columns, channels, one.returns))
    return (1 + channel + 128 * column + 32768 * which) % 65536, channel + which


# Model, what the spec chooses, packet size, then first byte and bytes of packet 0.
# The first azimuth is 35990 (968c), in 0.01 deg; 600 rpm: 5802, so 0.0036 deg a us.
PACKETS: list[tuple[str, dict[str, Any], int, dict[int, str]]] = [
    (
        "Pandar40P",
        {},
        1262,
        # 55.56 us: 0.20 deg on. 4 + 39 x 3 = 121. Tail at 10 x 124 = 1240, without sequence.
        {0: "ffee968c010000020001", 121: "280027", 124: "ffee0a00810000", 1248: "5802"}
        | {1250: US, 1254: "3742", 1256: DATE_2000},
    ),
    ("Pandar40P", {"flags": 1}, 1266, {1256: DATE_2000, 1262: "feffffff"}),
    (
        "Pandar64",
        {"mode": DUAL},
        1198,
        # Two blocks of a group. Tail at 8 + 6 x 194 = 1172.
        {0: "eeff400601040000", 8: "968c010000", 202: "968c018001", 396: "0a00810000"}
        | {1180: "5802", 1182: US, 1186: "3942", 1188: DATE, 1194: "feffffff"},
    ),
    # Tail at 8 + 7 x 194 = 1366.
    ("Pandar64-7", {}, 1392, {0: "eeff400700040000", 8: "968c", 1380: "3742", 1388: "feffffff"}),
    (
        "PandarQT64",
        {"mode": 0x3B},
        1072,
        # The header of the recording. 166.67 us: 0.60 deg on. Tail at 12 + 4 x 258 = 1044.
        {0: "eeff03010000400401040201", 12: "968c010000000200", 270: "968c01800100"}
        | {528: "3200", 1054: "5802", 1056: US, 1060: "3b42", 1062: DATE, 1068: "feffffff"},
    ),
    (
        "QT128C2X",
        {"mode": DUAL},
        1127,
        # The header of the recording; channel 33 is the first of loop 1: 14 + 32 x 4 = 142. Tail at
        # 12 + 2 x 514 + 21 = 1061, signature behind its checksum.
        {0: "eeff0302030080020104021d", 12: "968c", 14: "00" * 128, 142: "21002000"}
        | {526: "968c", 656: "21802100", 1066: "01", 1073: "395802", 1076: DATE, 1082: US}
        | {1086: "42feffffff", 1095: "000102", 1126: "1f"},
    ),
    ("QT128C2X", {"flags": 0x15}, 1095, {0: "eeff03020300800200040215", 1066: "01"}),
    (
        "PandarXT-16",
        {"mode": DUAL},
        568,
        # The header of the recording. 50 us: 0.18 deg on. Tail at 12 + 8 x 66 = 540.
        {0: "eeff06010000100801040201", 12: "968c0100000002000100", 74: "10000f", 78: "968c"}
        | {144: "0800", 550: "395802", 553: DATE, 559: US, 563: "42feffffff"},
    ),
    (
        "PandarXT-32",
        {"mode": DUAL},
        1080,
        {0: "eeff06010000200801040201", 142: "968c01800100", 272: "08008100", 1062: "395802"}
        | {1065: DATE, 1071: US, 1075: "42feffffff"},
    ),
    (
        "XT32M2X",
        {"mode": TRIPLE},
        820,
        # Three blocks of a group, 5 mm; the third return's range: 1 + 65536 is cut to 1.
        {0: "eeff06010000200601050301", 12: "968c0100", 142: "968c018001", 272: "968c010002"}
        | {402: "08008100", 802: "3d5802", 805: DATE, 811: US, 815: "42feffffff"},
    ),
    (
        "Pandar128E3X",
        {},
        893,
        # Channel 2 is silent in azimuth state 0. 27.778 us: 0.10 deg on. Tail at 12 + 772 + 21 =
        # 805; states 0 and 1: 0x1000. IMU block at 835, checksum at 857.
        {0: "eeff0104030080020004020f", 12: "968c" + "010000" + "000000" + "030002"}
        | {398: "0000" + "000000" + "820001", 814: "0010" + "00" + "375802", 820: DATE}
        | {826: US, 830: "42feffffff", 835: "00" * 22, 861: "000102"},
    ),
    # One byte more a channel: 12 + 2 x 514 + 4 + 26 + 4 + 4; tail at 1044.
    ("Pandar128E3X", {"flags": 0x11}, 1078, {12: "968c01000000", 1056: "37", 1070: "feffffff"}),
    (
        "OT128",
        {"operation": "standard", "flags": 0x01},
        822,
        # All channels fire. 55.556 us: 0.20 deg on. Tail at 12 + 772 + 4 = 788.
        {0: "eeff01048000800200040201", 12: "968c" + "010000" + "020001", 398: "0a00" + "810000"}
        | {797: "0010" + "02" + "375802", 814: "feffffff"},
    ),
    (
        "AT128",
        {"rpm": 201, "mode": 0x38},
        1118,
        # 41.666 us at 201 rpm: 0.05025 deg = 5 x 0.01 deg + 6 / 25600 deg. Tail at 12 + 1030 + 4.
        {0: "eeff04010000800200040209", 12: "968c00" + "01000000", 527: "9b8c06" + "81000000"}
        | {1064: "c900", 1066: US, 1070: "3842", 1072: "00006553f100", 1078: "feffffff"}
        | {1086: "000102"},
    ),
    # 0.1 rpm.
    ("JT128", {}, 893, {0: "eeff0104890080020004020f", 818: "7017"}),
    (
        "JT16",
        {"sequence": 258},
        80,
        {0: "eeff01080000", 6: DATE, 12: US, 16: "968c" + "010000" + "020001", 63: "10000f"}
        | {74: "0201"},
    ),
]


@pytest.mark.parametrize(("model", "chosen", "size", "parts"), PACKETS)
def test_bytes_worked_by_hand(
    model: str, chosen: dict[str, Any], size: int, parts: dict[int, str]
) -> None:
    one = spec(model, **chosen)
    first, second = encode_packets(one, *readings(one))
    assert len(first) == len(second) == size
    found = {at: first[at : at + len(part) // 2].hex() for at, part in parts.items()}
    assert found == parts


def test_second_packet_counts_on() -> None:
    one = spec("QT128C2X", mode=DUAL)
    _, second, third = encode_packets(one, *readings(one, packets=3))
    # 111.11 us later, in the next second; loop 2 leaves channels 33 to 64 out.
    assert second[1082:1086].hex() == "6e000000"
    assert second[1076:1082].hex() == "7b0b0e160d15"
    assert (second[1066], third[1066]) == (0, 1)
    assert second[14 : 14 + 4].hex() == "81000000"
    assert second[142 : 142 + 128] == bytes(128)
    assert (second[1087:1091].hex(), third[1087:1091].hex()) == ("ffffffff", "00000000")


def test_azimuth_states_count_on() -> None:
    one = spec("Pandar128E3X")
    _, second = encode_packets(one, *readings(one))
    # States 2 and 3: 2 << 14 | 3 << 12.
    assert second[814:816].hex() == "00b0"
    dual = spec("OT128", mode=DUAL)
    _, second = encode_packets(dual, *readings(dual))
    # Both blocks are of state 1: 1 << 14 | 1 << 12.
    assert second[814:816].hex() == "0050"


def checksum(message: bytes) -> int:
    """CRC-32/MPEG-2, bit by bit."""
    register = 0xFFFFFFFF
    for byte in message:
        register ^= byte << 24
        for _ in range(8):
            register = register << 1 ^ (0x104C11DB7 if register >> 31 else 0)
    return register


def test_checksum_has_the_published_check_value() -> None:
    assert crc32_mpeg2(b"123456789") == checksum(b"123456789") == 0x0376E6E7


def test_checksums_of_qt128() -> None:
    one = spec("QT128C2X")
    packet, _ = encode_packets(one, *readings(one))
    # Body 12 .. 1040; the 12 bytes after the safety's version; tail and sequence, 30 bytes.
    for begin, end in ((12, 1040), (1045, 1057), (1061, 1091)):
        stored = int.from_bytes(packet[end : end + 4], "little")
        assert stored == checksum(packet[begin:end])


# The first packet is sent at 999 999.5 us of a second and states 999 999.
TIMED = HesaiSpec("", start_deg=359.9, start_ns=1_700_000_000_999_999_500)
T_NS = 1_700_000_000_999_999_000


def timed(model: str, **chosen: Any) -> HesaiSpec:
    return replace(TIMED, model=model, **chosen)


# Times of the first columns after the packet's, by section 5.
BLOCKS = [
    ("Pandar40P", {}, {0: -28580 - 9 * 55560, 8: -84140, 9: -28580}),
    ("Pandar40P", {"mode": DUAL}, {0: -28580 - 4 * 55560, 4: -28580}),
    ("Pandar64", {}, {0: -42580 - 5 * 55560, 5: -42580}),
    ("Pandar64-7", {}, {0: -42580 - 6 * 55560, 6: -42580}),
    ("PandarQT64", {}, {0: 25710, 1: 192376, 2: 359043, 3: 525710}),
    ("QT128C2X", {}, {0: 9000, 1: 120110}),
    ("PandarXT-16", {"mode": DUAL}, {0: 5632 - 150000, 3: 5632}),
    ("PandarXT-32", {}, {0: 5632 - 350000, 7: 5632}),
    ("XT32M2X", {"mode": TRIPLE}, {0: -44368, 1: 5632}),
    ("Pandar128E3X", {}, {0: -24630, 1: 3148}),
    ("Pandar128E3X", {"operation": "standard"}, {0: -52408, 1: 3148}),
    ("Pandar128E3X", {"mode": DUAL}, {0: 3148}),
    ("OT128", {"operation": "standard"}, {0: -55556, 1: 0}),
    ("AT128", {}, {0: -92581, 1: -50915}),
    ("AT128", {"mode": DUAL}, {0: -50915}),
    ("JT16", {}, {0: 0}),
]


@pytest.mark.parametrize(("model", "chosen", "after"), BLOCKS)
def test_times_of_blocks(model: str, chosen: dict[str, Any], after: dict[int, int]) -> None:
    one = timed(model, **chosen)
    times = block_times_ns(one, one.groups) - T_NS
    assert one.groups == max(after) + 1
    assert {column: int(times[column]) for column in after} == after


def test_beams_look_where_the_rotor_is_when_they_fire() -> None:
    beams = Angles([0.0] * 31 + [30.0], [10.0] + [0.0] * 31)
    one = timed("PandarXT-32", start_deg=80.0)
    found = directions(one, beams, 1)[0]
    # Channel 1 after 0.368 us: 0.0013248 deg; channel 32 after 47.24 us: 0.170064 deg.
    azimuth = np.degrees(np.arctan2(found[:, 0], found[:, 1]))
    assert azimuth[0] == pytest.approx(90.0013248)
    assert azimuth[31] == pytest.approx(80.170064)
    assert found[31, 2] == pytest.approx(0.5)
    still = directions(one, beams, 1, turning=False)[0]
    assert still[0].tolist() == pytest.approx([1, 0, 0], abs=1e-12)
    # cos 30 deg x sin and cos of 80 deg.
    assert still[31].tolist() == pytest.approx([0.852868532, 0.150383733, 0.5])


def test_mirrors_double_the_angle() -> None:
    mirrors = MirrorAngles((30.0, 150.0, 270.0), [0.0] * 128, [2.4] + [0.0] * 127)
    found = directions(timed("AT128", start_deg=75.0), mirrors, 1, turning=False)[0]
    # 2 x (75 - 30) - 2.4
    assert np.degrees(np.arctan2(found[:2, 0], found[:2, 1])) == pytest.approx([87.6, 90])
    content = mirrors.dat()
    assert len(content) == 47176
    # 30 deg x 25600 = 768000 = 0xbb800; 2.4 deg: 61440 = 0xf000.
    assert content[16:20].hex() == "00b80b00"
    assert content[40:44].hex() == "00f00000"
