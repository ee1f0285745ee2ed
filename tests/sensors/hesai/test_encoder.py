"""The encoder of HESAI packets against bytes, times and directions worked by hand.

Source: docs/sources/hesai.md sections 2 to 6.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mlbatch.arrays import I64Array
from mlbatch.simulate.hesai.encode import (
    DUAL,
    TRIPLE,
    HesaiSpec,
    MirrorAngles,
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
    (
        "AT128",
        {"rpm": 201, "mode": 0x38},
        1118,
        # 41.666 us at 201 rpm: 0.05025 deg = 5 x 0.01 deg + 6 / 25600 deg. Tail at 12 + 1030 + 4.
        {0: "eeff04010000800200040209", 12: "968c00" + "01000000", 527: "9b8c06" + "81000000"}
        | {1064: "c900", 1066: US, 1070: "3842", 1072: "00006553f100", 1078: "feffffff"}
        | {1086: "000102"},
    ),
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


def test_mirrors_double_the_angle() -> None:
    mirrors = MirrorAngles((30.0, 150.0, 270.0), [0.0] * 128, [2.4] + [0.0] * 127)
    found = directions(spec("AT128", start_deg=75.0), mirrors, 1, turning=False)[0]
    # 2 x (75 - 30) - 2.4
    assert np.degrees(np.arctan2(found[:2, 0], found[:2, 1])) == pytest.approx([87.6, 90])
    content = mirrors.dat()
    assert len(content) == 47176
    # 30 deg x 25600 = 768000 = 0xbb800; 2.4 deg: 61440 = 0xf000.
    assert content[16:20].hex() == "00b80b00"
    assert content[40:44].hex() == "00f00000"
