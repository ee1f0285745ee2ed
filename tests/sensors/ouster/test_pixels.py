"""Pixels and packets of every profile: hand-worked bytes, and encode then decode is identity."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mlbatch.arrays import U8Array
from mlbatch.lidar.interface import Lidar
from mlbatch.sensors.ouster.profiles import HEADER_TYPES, HEADERS, OFF, PROFILES, PacketLayout
from mlbatch.simulate.ouster.encode import IntLike, OusterSpec, encode_packets
from tests.builders.decoded import readings
from tests.builders.others import rows
from tests.builders.spinning import ouster_calibration
from tests.reference import ouster as reference

# One pixel a profile, worked by hand from the sheet. Words that occur again and again:
# d2 84: raw range 1234 (04d2) with the flag bit above it; 5a: reflectivity 90; 33: near IR.
# 09 03: raw range 777; 11: reflectivity 17; 77: window.
# 31 d4 a8: range 54321 mm (0d431) with flags 21 from bit 19 (a80000); c8: reflectivity 200.
# 4e 46 1d: range 345678 mm (5464e) with flags 3 (180000); 63: reflectivity 99.
# 34 12: signal 4660; 67 05: signal 1383; 21 03: near IR; ef be: zone mask; ee, ff: junk.
# 41 42 0f 90: range 1000001 mm in 20 bits (f4241), flags 9 from bit 28.
_LOW = (9872, 90, 90)
_FULL = (54321, 200, 4660)
_SECOND = (345678, 99, 1383)
BY_HAND: dict[str, tuple[str, list[tuple[int, int, int]]]] = {
    "LEGACY": ("41420f90 c8003412 21030000", [(1000001, 200, 4660)]),
    "RNG19_RFL8_SIG16_NIR16": ("31d4a800 c8ee3412 21030077", [_FULL]),
    "RNG19_RFL8_SIG16_NIR16_DUAL": ("31d4a8c8 4e461d63 34126705 21030077", [_FULL, _SECOND]),
    "RNG15_RFL8_NIR8": ("d2845a33", [_LOW]),
    "RNG15_RFL8_WIN8": ("d2845a77", [_LOW]),
    "RNG15_RFL8_NIR8_DUAL": ("d2845a33 09031177", [_LOW, (6216, 17, 17)]),
    "FUSA_RNG15_RFL8_NIR8_DUAL": ("d2845a33 09031177", [_LOW, (6216, 17, 17)]),
    "RNG15_RFL8_NIR8_ZONE16": ("d2845a33 efbe7700", [_LOW]),
    "RNG19_RFL8_SIG16_NIR16_ZONE16": ("31d4a800 c8773412 2103efbe", [_FULL]),
    "RNG19_RFL8_SIG16_ZONE16_DUAL": ("31d4a8c8 4e461d63 34126705 efbe0077", [_FULL, _SECOND]),
    "RNG19_RFL8_SIG16_NIR16_RGB16": ("31d4a8c8 34122103 003c0040 0042ffff", [_FULL]),
    "RNG19_RFL8_SIG16_NIR16_RGB16_DUAL": (
        "31d4a8c8 4e461d63 34126705 2103003c 00400042",
        [_FULL, _SECOND],
    ),
    "FIVE_WORD_PIXEL": ("31d4a8c8 4e461d63 34126705 2103ffff ffffffff", [_FULL, _SECOND]),
}
NAMES = tuple(name for name in PROFILES if name != "OFF")
# Section 4: bytes of a packet of 16 columns by beam count.
SIZES = {
    "LEGACY": {16: 3392, 32: 6464, 64: 12608, 128: 24896, 256: 49472},
    "RNG19_RFL8_SIG16_NIR16": {16: 3328, 32: 6400, 64: 12544, 128: 24832, 256: 49408},
    "RNG19_RFL8_SIG16_NIR16_ZONE16": {16: 3328, 32: 6400, 64: 12544, 128: 24832, 256: 49408},
    "RNG19_RFL8_SIG16_NIR16_DUAL": {16: 4352, 32: 8448, 64: 16640, 128: 33024},
    "RNG19_RFL8_SIG16_ZONE16_DUAL": {16: 4352, 32: 8448, 64: 16640, 128: 33024},
    "RNG19_RFL8_SIG16_NIR16_RGB16": {16: 4352, 32: 8448, 64: 16640, 128: 33024},
    "RNG19_RFL8_SIG16_NIR16_RGB16_DUAL": {16: 5376, 32: 10496, 64: 20736, 128: 41216},
    "FIVE_WORD_PIXEL": {16: 5376, 32: 10496, 64: 20736, 128: 41216},
    "RNG15_RFL8_NIR8": {16: 1280, 32: 2304, 64: 4352, 128: 8448, 256: 16640},
    "RNG15_RFL8_WIN8": {16: 1280, 32: 2304, 64: 4352, 128: 8448, 256: 16640},
    "RNG15_RFL8_NIR8_DUAL": {16: 2304, 32: 4352, 64: 8448, 128: 16640, 256: 33024},
    "FUSA_RNG15_RFL8_NIR8_DUAL": {16: 2304, 32: 4352, 64: 8448, 128: 16640, 256: 33024},
    "RNG15_RFL8_NIR8_ZONE16": {16: 2304, 32: 4352, 64: 8448, 128: 16640, 256: 33024},
}


def lidar_of(spec: OusterSpec) -> Lidar:
    return ouster_calibration(spec).lidar({"crc": "check"}, None)


def test_all_profiles_are_checked_by_hand() -> None:
    assert set(BY_HAND) == set(NAMES) == set(SIZES)


def test_every_field_of_a_pixel_is_where_the_document_has_it() -> None:
    """Those that are not decoded, too: the encoder takes them from the same table."""
    found = {
        name: (profile.pixel_size, {field: tuple(at) for field, at in profile.fields.items()})
        for name, profile in PROFILES.items()
        if name != OFF
    }
    assert found == reference.pixels()


@pytest.mark.parametrize("kind", HEADER_TYPES)
def test_fields_of_headers_are_where_the_document_has_them(kind: str) -> None:
    wanted = reference.header_fields(kind)
    names = ("packet type", "frame id", "init id", "serial number", "alert flags")
    assert tuple(HEADERS[kind]) == tuple(wanted[name] for name in names)


@pytest.mark.parametrize("name", NAMES)
def test_sizes_of_packets(name: str) -> None:
    layouts = {beams: PacketLayout(PROFILES[name], beams, 16) for beams in SIZES[name]}
    assert {beams: layout.packet_size for beams, layout in layouts.items()} == SIZES[name]


@pytest.mark.parametrize("name", NAMES)
def test_a_pixel_worked_by_hand(name: str) -> None:
    text, returns = BY_HAND[name]
    pixel = bytes.fromhex(text)
    spec = OusterSpec(profile=name, beams=16)
    lidar, at = lidar_of(spec), 5
    packets = two_packets(spec)
    head = 16 if name == "LEGACY" else 12
    columns = packets[:, lidar.records.start :][:, : 16 * lidar.records.size].reshape(2, 16, -1)
    columns[:, :, head : head + 16 * len(pixel)] = 0
    first = head + at * len(pixel)
    columns[1, 3, first : first + len(pixel)] = np.frombuffer(pixel, np.uint8)
    found = readings(lidar, packets)
    assert found.reflectivity is not None
    assert found.range_m.shape == (32, 16, len(returns))
    for which, (range_mm, reflectivity, intensity) in enumerate(returns):
        assert found.range_m[19, at, which] == np.float32(range_mm / 1000)
        assert found.reflectivity[19, at, which] == reflectivity
        assert found.intensity[19, at, which] == intensity
    for plane in (found.range_m, found.reflectivity, found.intensity):
        assert np.count_nonzero(plane) == len(returns)


def test_every_coarse_range_is_rounded_correctly() -> None:
    spec = OusterSpec(profile="RNG15_RFL8_NIR8", beams=128)
    raw = np.arange(2**15).reshape(-1, 128)
    mids = np.arange(len(raw))
    sent = encode_packets(spec, mids, mids, np.zeros(len(raw), np.int64), {"RANGE": raw << 3})
    found = readings(lidar_of(spec), rows(sent)).range_m
    # Python divides the exact integers; the second rounding cannot err, 53 bits being enough.
    expected = [float(np.float32(8 * value / 1000)) for value in raw.ravel().tolist()]
    assert found.ravel().tolist() == expected
    assert found.max() == np.float32(262.136)


def combinations() -> list[OusterSpec]:
    specs = [
        OusterSpec(profile=name, beams=beams, header=header, serial=122247000785)
        for name, beams, header in product(NAMES, (16, 32, 64, 128), ("STANDARD", "FUSA"))
        if not (name == "LEGACY" and header == "FUSA")
    ]
    return [*specs, OusterSpec(profile="RNG15_RFL8_NIR8", beams=256)]


@pytest.mark.parametrize(
    "spec", combinations(), ids=lambda spec: f"{spec.profile}-{spec.beams}-{spec.header_type}"
)
@settings(max_examples=3)
@given(seed=st.integers(0, 2**32), frame=st.integers(0, 2**16 - 1), block=st.integers(0, 62))
def test_encode_then_decode_is_identity(
    spec: OusterSpec, seed: int, frame: int, block: int
) -> None:
    rng = np.random.default_rng(seed)
    lidar, columns = lidar_of(spec), 32
    shape = (columns, spec.beams)
    fields: dict[str, IntLike] = {
        name: rng.integers(0, 2**place.width, shape) << place.shift
        for name, place in PROFILES[spec.profile].fields.items()
    }
    stamps = rng.integers(0, 2**62, columns)
    mids = block * 16 + np.arange(columns)
    valid = rng.random(columns) < 0.8
    sent = encode_packets(spec, stamps, mids, np.full(columns, frame), fields, valid)
    packets = rows(sent)
    assert packets.shape == (2, SIZES[spec.profile][spec.beams]) == (2, lidar.packet_size)
    assert lidar.faults(packets).tolist() == [0, 0]
    assert lidar.sent_by_me(packets).all()
    assert lidar.sequence(packets).tolist() == [frame * 64 + block, frame * 64 + block + 1]
    headers = lidar.column_headers(packets, np.zeros(len(packets), np.int64))
    assert np.array_equal(headers.stamp_ns.ravel(), stamps)
    assert np.array_equal(headers.encoder.ravel(), mids)
    assert np.array_equal(headers.valid.ravel(), valid)
    found = readings(lidar, packets)
    assert found.reflectivity is not None
    for which, suffix in enumerate(("", "2")[: lidar.returns]):
        range_m = (fields[f"RANGE{suffix}"] / 1000).astype(np.float32)
        intensity = fields.get(f"SIGNAL{suffix}", fields[f"REFLECTIVITY{suffix}"])
        assert np.array_equal(found.range_m[..., which], range_m)
        # Slots without a return are empty.
        is_met = range_m > 0
        assert np.array_equal(found.intensity[..., which], intensity * is_met)
        levels = fields[f"REFLECTIVITY{suffix}"] * is_met
        assert np.array_equal(found.reflectivity[..., which], levels)


def two_packets(spec: OusterSpec, frame: int = 7, first: int = 0) -> U8Array:
    mids = first + np.arange(2 * spec.columns_per_packet)
    return rows(encode_packets(spec, mids * 97_656, mids, np.full(len(mids), frame), {}))


def test_columns_beyond_the_frame_are_not_valid() -> None:
    spec = OusterSpec(beams=16, columns_per_frame=512)
    valid = lidar_of(spec).column_headers(two_packets(spec, first=496), np.zeros(2, np.int64)).valid
    assert valid.tolist() == [[True] * 16, [False] * 16]


@pytest.mark.parametrize(("header", "frames"), [("STANDARD", 2**16), ("FUSA", 2**32)])
def test_the_count_of_frames_wraps(header: str, frames: int) -> None:
    spec = OusterSpec(beams=16, header=header)
    lidar = lidar_of(spec)
    assert lidar.sequence_modulus == frames * 64
    last = lidar.sequence(two_packets(spec, frames - 1, 62 * 16))[1]
    first = lidar.sequence(two_packets(spec, frames))[0]
    assert (first - last) % lidar.sequence_modulus == 1


@pytest.mark.parametrize(
    ("window", "packets", "blocks"),
    [
        ((1, 256), 17, [*range(17)]),
        ((370, 85), 15, [*range(6), *range(23, 32)]),
        ((40, 35), 32, [*range(32)]),
        ((0, 511), 32, [*range(32)]),
        ((100, 111), 1, [6]),
    ],
)
def test_packets_of_a_window_are_numbered_without_gaps(
    window: tuple[int, int], packets: int, blocks: list[int]
) -> None:
    spec = OusterSpec(beams=16, columns_per_frame=512, window=window)
    lidar = lidar_of(spec)
    mids = np.arange(512)
    revolution = rows(encode_packets(spec, mids, mids, np.full(512, 3), {}))
    numbers = lidar.sequence(revolution)
    assert lidar.sequence_modulus == packets * 2**16
    assert numbers[blocks].tolist() == [3 * packets + rank for rank in range(packets)]
    others = np.delete(numbers, blocks)
    assert (others < 0).all()
    assert len(set(others.tolist())) == 32 - packets


def test_a_standard_packet_with_the_other_layout_is_read_by_its_serial_number() -> None:
    result = OusterSpec(beams=16, header="STANDARD")
    sent = OusterSpec(beams=16, header="FUSA")
    lidar = lidar_of(result)
    packets = two_packets(sent, frame=65536 + 9)
    assert lidar.sent_by_me(packets).all()
    # The packets have no checksum, as those of FUSA do.
    assert lidar.faults(packets).tolist() == [0, 0]
    assert lidar.sequence(packets).tolist() == [9 * 64, 9 * 64 + 1]


def test_packets_of_another_sensor_or_kind_are_distinguished() -> None:
    spec = OusterSpec(beams=16, serial=111, with_crc=False)
    lidar = lidar_of(spec)
    packets = two_packets(spec)
    packets[1, 7] = 112
    assert lidar.sent_by_me(packets).tolist() == [True, False]
    packets[1, 7:12] = 0
    assert lidar.sent_by_me(packets).tolist() == [True, True]
    packets[0, 0] = 2
    assert lidar.faults(packets).tolist() == [2, 0]


def test_footers_of_old_firmware_are_no_wrong_checksums() -> None:
    spec = OusterSpec(beams=16, with_crc=False)
    packets = two_packets(spec)
    packets[1, -8:] = np.frombuffer(bytes.fromhex("dec00000efbeadde"), np.uint8)
    assert lidar_of(spec).faults(packets).tolist() == [0, 0]
    packets[1, -1] = 1
    assert lidar_of(spec).faults(packets).tolist() == [0, 3]


def test_columns_of_a_legacy_packet_must_belong_together() -> None:
    spec = OusterSpec(profile="LEGACY", beams=16)
    lidar = lidar_of(spec)
    size = 16 + 12 * 16 + 4
    frame, mid, invalid = (two_packets(spec) for _ in range(3))
    frame[1, 5 * size + 10] += 1
    mid[1, 5 * size + 9] += 2
    invalid[1, 5 * size : 5 * size + 16] = 0
    invalid[1, 6 * size - 4 : 6 * size] = 0
    assert [lidar.faults(packets).tolist() for packets in (frame, mid, invalid)] == [
        [0, 2],
        [0, 2],
        [0, 0],
    ]
