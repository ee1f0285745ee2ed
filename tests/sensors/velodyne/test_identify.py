"""Names of Velodyne packets and their look-alikes (docs/sources/velodyne.md, others.md)."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from tests.builders.others import (
    BB,
    CC,
    DD,
    EE,
    filled,
    rows,
    velodyne_packets,
)
from tests.builders.streams import LACKING, named

# docs/sources/velodyne.md sections 1 and 2: time between the azimuths of a model, us.
VLP_16_US, HDL_32E_US, VLP_32C_US = 110.592, 46.080, 55.296
# Section 1: models that the sheet has no beams or no layout of.
REFUSED = {"VLP-32A/B", "Velarray"}


def with_lack(model: str, text: str) -> str:
    return text + LACKING if model in REFUSED else text


@pytest.mark.parametrize(
    ("product", "row_us", "model"),
    [
        (0x21, HDL_32E_US, "HDL-32E"),
        (0x22, VLP_16_US, "VLP-16"),
        (0x23, VLP_32C_US, "VLP-32A/B"),
        (0x24, VLP_16_US, "Puck Hi-Res"),
        (0x28, VLP_32C_US, "VLP-32C"),
        (0x31, VLP_32C_US, "Velarray"),
    ],
)
@pytest.mark.parametrize(
    ("mode", "azimuths", "returns"),
    [(0x37, 12, "strongest return"), (0x38, 12, "last return"), (0x39, 6, "dual return")],
)
def test_velodyne(
    product: int, row_us: float, model: str, mode: int, azimuths: int, returns: str
) -> None:
    packets = velodyne_packets(bytes((mode, product)), row_us, azimuths=azimuths)
    expected = with_lack(model, f"Velodyne lidar {model}, {returns}")
    assert named(packets) == expected
    assert named(packets[:1]) == expected


@pytest.mark.parametrize(("mode", "azimuths"), [(0x37, 12), (0x39, 6)])
@pytest.mark.parametrize("every", [1, 2, 3])
def test_a_product_byte_contradicted_by_the_pace(mode: int, azimuths: int, every: int) -> None:
    """Also if packets are lost."""
    returns = {0x37: "strongest return", 0x39: "dual return"}[mode]
    packets = velodyne_packets(bytes((mode, 0x21)), VLP_16_US, azimuths=azimuths, count=16)[::every]
    assert named(packets) == f"Velodyne lidar VLP-16 (its product byte says HDL-32E), {returns}"
    packets = velodyne_packets(bytes((mode, 0x22)), HDL_32E_US, azimuths=azimuths, count=16)[
        ::every
    ]
    assert named(packets) == f"Velodyne lidar HDL-32E (its product byte says VLP-16), {returns}"


def test_one_packet_cannot_contradict_its_product_byte() -> None:
    packets = velodyne_packets(b"\x37\x21", VLP_16_US, count=1)
    assert named(packets) == "Velodyne lidar HDL-32E, strongest return"


def test_factory_bytes_that_are_not_set() -> None:
    unset = "(its factory bytes are not set)"
    for row_us, model in ((VLP_16_US, "VLP-16"), (HDL_32E_US, "HDL-32E")):
        for azimuths, returns in ((12, "single"), (6, "dual")):
            packets = velodyne_packets(b"\0\0", row_us, azimuths=azimuths)
            assert named(packets) == f"Velodyne lidar {model} {unset}, {returns} return"
    packets = velodyne_packets(b"\0\0", VLP_32C_US)
    assert named(packets) == f"Velodyne-like lidar, factory bytes 00 00{LACKING}"


def test_other_factory_bytes_are_named_as_they_are() -> None:
    packets = velodyne_packets(b"\x37\x10", VLP_16_US)
    assert named(packets) == f"Velodyne-like lidar, factory bytes 37 10{LACKING}"


@pytest.mark.parametrize("product", [0xA1, 0x63])
def test_vls_128_is_identified_by_its_four_banks(product: int) -> None:
    single = velodyne_packets(bytes((0x38, product)), 55.3, (EE, DD, CC, BB) * 3, azimuths=3)
    assert named(single) == "Velodyne lidar VLS-128, last return"
    banks = (EE, EE, DD, DD, CC, CC, BB, BB)
    dual = velodyne_packets(bytes((0x39, product)), 55.3, banks, azimuths=1)
    assert named(dual) == "Velodyne lidar VLS-128, dual return"


def test_hdl_64e_is_identified_by_its_two_banks() -> None:
    for azimuths, returns in ((6, "single return"), (3, "dual return")):
        packets = velodyne_packets(b"\0\0", 57.6, (EE, DD) * 6, azimuths=azimuths)
        # Status characters and values, another in every packet.
        packets[:, 1204:] = np.frombuffer(b"HaMbScDdNeYfGgTh", np.uint8).reshape(8, 2)
        assert named(packets) == f"Velodyne lidar HDL-64E, {returns}"


def test_look_alikes_of_1212_bytes_are_refused_by_name() -> None:
    packets = velodyne_packets(b"", VLP_16_US, size=1212)
    assert named(packets) == "LSLIDAR-like, 1212 bytes: not supported"


@pytest.mark.parametrize("size", [1206, 1212])
def test_device_packets_of_lslidar(size: int) -> None:
    assert named(rows([filled(size, {0: bytes.fromhex("a5ff005a")})])) == "LSLIDAR device packet"


def test_position_packets() -> None:
    stamp = {198: struct.pack("<I", 1_082_382_961), 202: b"\x02"}
    for text in (b"$GPRMC,081802,A", b"$GPGGA,081802"):
        assert named(rows([filled(512, {**stamp, 206: text})])) == "Velodyne position packet"
    assert named(rows([filled(512, stamp)])) == "Velodyne position packet"
    beyond = {198: struct.pack("<I", 3_600_000_000), 206: b"$GPRMC"}
    assert named(rows([filled(512, beyond)])) is None
    assert named(rows([filled(512, {})])) is None


def test_the_mode_byte_of_a_vls_128_may_be_unset() -> None:
    for banks, azimuths, returns in (
        ((EE, DD, CC, BB) * 3, 3, "single"),
        ((EE, EE, DD, DD, CC, CC, BB, BB), 1, "dual"),
    ):
        packets = velodyne_packets(b"\0\0", 55.3, banks, azimuths=azimuths)
        assert named(packets) == f"Velodyne lidar VLS-128, {returns} return"


@pytest.mark.parametrize(
    "parts",
    [
        {200: EE, 300: b"\x00\x01"},  # a lone flag
        {100 * n: EE + struct.pack("<H", 36001) for n in range(12)},  # no such azimuth
        {**{100 * n: EE for n in range(12)}, 1200: struct.pack("<I", 3_600_000_000)},
    ],
)
def test_1206_bytes_alone_are_not_velodyne(parts: dict[int, bytes]) -> None:
    assert named(rows([filled(1206, parts)])) is None
