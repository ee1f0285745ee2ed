"""HESAI calibrations and packets: what fits, what is refused, what the encoder sent comes back."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from mlbatch.arrays import F64Array, I64Array, U8Array
from mlbatch.errors import MlbatchError, RigError, UsageError
from mlbatch.lidar.interface import FAULTS
from mlbatch.sensors import crc
from mlbatch.sensors.hesai import sensor as hesai
from mlbatch.simulate.hesai import encode as builder
from mlbatch.simulate.hesai.angles import Angles, Beams, MirrorAngles, angles_csv, fan
from mlbatch.simulate.hesai.encode import HesaiSpec, encode_packets
from tests.builders.decoded import Rotor, projected
from tests.builders.hesai_decoded import calibration, decode, evidence, rows

COLUMNS = 420
MODELS = (
    *("Pandar40P", "Pandar64", "Pandar64-7", "PandarQT64", "QT128C2X", "PandarXT-16"),
    *("PandarXT-32", "XT32M2X", "Pandar128E3X", "OT128", "JT128", "AT128", "JT16"),
)
DUAL, TRIPLE = 0x39, 0x3D
MODES = (
    *((model, 0x37) for model in MODELS),
    *((model, DUAL) for model in MODELS if model not in ("Pandar64-7", "JT16")),
    ("XT32M2X", TRIPLE),
)


def _beams(channels: int, model: str = "") -> tuple[Beams, bytes]:
    """Some beams, and their file; model: by default one of as many channels."""
    usual = {32: "PandarXT-32", 40: "Pandar40P", 64: "Pandar64", 128: "OT128"}
    elevation, azimuth = fan(model or usual.get(channels, ""), channels)
    if model == "AT128":
        beams = MirrorAngles((20.0, 140.0, 260.0), elevation, azimuth)
        return beams, beams.dat()
    return Angles(elevation, azimuth), angles_csv(elevation, azimuth)


def _encoded(spec: HesaiSpec) -> tuple[U8Array, I64Array, I64Array]:
    """Packets, and their ranges and levels."""
    random = np.random.default_rng(7)
    shape = (COLUMNS // spec.groups * spec.groups, spec.row.channels, spec.returns)
    raw = random.integers(100, 30000, shape)
    raw[random.random(shape) < 0.1] = 0
    raw *= builder.fires(spec, shape[0])[:, :, None]
    levels = random.integers(0, 256, shape)
    return rows(encode_packets(spec, raw, levels)), raw, levels


@pytest.mark.parametrize(("model", "mode"), MODES)
def test_what_was_sent_comes_back(model: str, mode: int) -> None:
    # No column is where one mirror of an AT128 takes over from another.
    spec = HesaiSpec(model, mode=mode, start_deg=350.07, rpm=600)
    packets, raw, levels = _encoded(spec)
    beams, content = _beams(spec.row.channels, model)
    found = decode(packets, content)
    count = len(raw)
    assert found.lidar.returns == spec.returns
    assert (found.range_m == (raw * spec.row.unit_mm / 1000).astype(np.float32)).all()
    fired = builder.fires(spec, count)
    is_return = raw > 0
    assert (found.intensity[is_return] == levels[is_return]).all()
    wanted_ns = builder.firing_times_ns(spec, count)
    assert (found.time_ns[fired] == wanted_ns[fired]).all()
    first_ns = np.where(fired, wanted_ns, wanted_ns.max()).min(axis=1)
    assert (found.stamp_ns == first_ns).all()
    direction = builder.directions(spec, beams, count, turning=model != "JT16")
    expected = found.range_m[..., None] * direction[:, :, None, :]
    # float32 at up to 120 m, and what the series of the rotor's motion leaves out.
    assert np.abs(found.xyz() - expected)[is_return].max() < 1e-4


@pytest.mark.parametrize("mode", [0x37, DUAL])
@pytest.mark.parametrize(
    ("model", "operation"),
    [("OT128", "standard"), ("Pandar128E3X", "standard"), ("Pandar128E3X", "saving")],
)
def test_operation_modes_choose_the_firing_times(model: str, operation: str, mode: int) -> None:
    spec = HesaiSpec(model, mode=mode, operation=operation)
    packets, _, _ = _encoded(spec)
    found = decode(packets, _beams(128)[1])
    fired = builder.fires(spec, len(found.stamp_ns))
    assert (found.time_ns[fired] == builder.firing_times_ns(spec, len(fired))[fired]).all()


@pytest.mark.parametrize("model", ["Pandar64", "PandarXT-32", "QT128C2X"])
def test_a_rotor_that_turns_the_other_way(model: str) -> None:
    spec = HesaiSpec(model, rpm=-600, start_deg=10.0)
    packets, _, _ = _encoded(spec)
    # The speed field has no sign.
    tail = {"Pandar64": 1180, "PandarXT-32": 1063, "QT128C2X": 1074}[model]
    packets = packets.copy()
    packets[:, tail : tail + 2] = np.frombuffer(struct.pack("<H", 600), np.uint8)
    beams, content = _beams(spec.row.channels, spec.model)
    found = decode(packets, content)
    count = len(found.stamp_ns)
    expected = found.range_m[..., None] * builder.directions(spec, beams, count)[:, :, None, :]
    if model == "QT128C2X":  # Its checksums are wrong now, but not checked.
        assert calibration(content).lidar({"crc": "check"}, evidence(packets)).faults(packets).all()
    assert np.abs(found.xyz() - expected)[found.range_m > 0].max() < 1e-4


@pytest.mark.parametrize(
    ("model", "size"),
    [
        ("Pandar40P", 1262),
        ("PandarXT-16", 568),
        ("PandarQT64", 1072),
        ("QT128C2X", 1127),
        ("OT128", 893),
        ("AT128", 1118),
        ("JT16", 80),
    ],
)
def test_sequence_numbers_and_sizes(model: str, size: int) -> None:
    modulus = {"Pandar40P": 0, "JT16": 2**16}.get(model, 2**32)
    spec = HesaiSpec(model, sequence=max(modulus, 2**16) - 2)
    packets, _, _ = _encoded(spec)
    content = _beams(spec.row.channels, model)[1]
    lidar = calibration(content).lidar({}, evidence(packets))
    numbers = lidar.sequence(packets)
    assert (lidar.packet_size, lidar.sequence_modulus) == (size, modulus)
    assert (numbers >= 0).all()
    if modulus:
        assert numbers[:4].tolist() == [modulus - 2, modulus - 1, 0, 1]
    assert len(np.unique(numbers)) == len(packets)


@pytest.mark.parametrize("flags", [0x00, 0x01, 0x04, 0x05, 0x03, 0x0D, 0x17, 0x7F])
def test_optional_parts_of_the_128_channel_family(flags: int) -> None:
    unit = 3 + bin(flags & 0x70).count("1")
    size = 12 + 2 * (2 + 128 * unit) + 4 + 26 + 4
    size += sum(more for flag, more in ((1, 4), (2, 22), (4, 17), (8, 32)) if flags & flag)
    packet = bytearray(size)
    packet[:12] = bytes.fromhex("eeff010480008002000401") + bytes([flags])
    tail = 12 + 2 * (2 + 128 * unit) + 4 + (17 if flags & 4 else 0)
    packet[tail + 12] = 0x38
    packet[tail + 15 : tail + 21] = bytes([123, 1, 1, 0, 0, 0])
    packet[14 + unit * 127] = 100
    found = decode(rows([bytes(packet)] * 2), _beams(128)[1])
    assert (found.lidar.model, found.lidar.mode) == ("OT128", "last return")
    assert found.range_m[0, 127, 0] == np.float32(0.4)
    assert bool(found.lidar.sequence_modulus) == bool(flags & 1)


def test_crc_of_the_catalogue() -> None:
    """The check value that catalogues of checksums give for CRC-32/MPEG-2."""
    message = np.frombuffer(b"123456789", np.uint8)
    assert crc.crc32(np.stack([message] * 300)).tolist() == [0x0376E6E7] * 300


@pytest.mark.parametrize("model", ["QT128C2X", "Pandar128E3X", "OT128", "AT128", "JT16"])
def test_checksums(model: str) -> None:
    spec = HesaiSpec(model)
    packets, _, _ = _encoded(spec)
    content = _beams(spec.row.channels, model)[1]
    lidar = calibration(content).lidar({"crc": "check"}, evidence(packets))
    assert not lidar.faults(packets).any()
    damaged = packets[:3].copy()
    damaged[0, 40] ^= 1  # a channel
    damaged[1, 72 if model == "JT16" else -37] ^= 0x80  # in the tail or its checksum
    verdicts = [FAULTS[number] for number in lidar.faults(damaged)]
    assert verdicts == ["bad_crc", "bad_crc", ""]
    unchecked = calibration(content).lidar({}, evidence(packets))
    assert not unchecked.faults(damaged).any()


@pytest.mark.parametrize(
    ("at", "value"),
    [
        (0, 0),  # marker
        (3, 2),  # version
        (6, 16),  # lasers
        (7, 6),  # blocks
        (9, 5),  # distance unit
        (11, 0),  # flags
        (13, 0xFF),  # azimuth of the first block
        (143, 0x10),  # azimuth of the second block, which is of the first one's group
        (1062, 0x37),  # another number of returns
        (1062, 0x3D),
        (1062, 0x99),
        (1066, 13),  # month
        (1067, 0),  # day
        (1068, 24),  # hour
        (1074, 0x10),  # microseconds
    ],
)
def test_damaged_packets_have_a_bad_header(at: int, value: int) -> None:
    spec = HesaiSpec("PandarXT-32", mode=DUAL)
    packets, _, _ = _encoded(spec)
    lidar = calibration(_beams(32)[1]).lidar({}, evidence(packets))
    damaged = packets[:2].copy()
    damaged[0, at] = value
    assert [FAULTS[number] for number in lidar.faults(damaged)] == ["bad_header", ""]
    # What is damaged is never a reason to stop.
    assert lidar.column_headers(damaged, np.zeros(2, np.int64)).stamp_ns.shape == (2, 4)


def test_every_block_of_a_pandar40p_bears_its_flag() -> None:
    packets, _, _ = _encoded(HesaiSpec("Pandar40P"))
    lidar = calibration(_beams(40)[1]).lidar({}, evidence(packets))
    damaged = packets[:2].copy()
    damaged[0, 9 * 124] = 0
    assert [FAULTS[number] for number in lidar.faults(damaged)] == ["bad_header", ""]


def test_dual_modes_may_change_but_not_the_number_or_type_of_returns() -> None:
    packets, _, _ = _encoded(HesaiSpec("PandarXT-32", mode=DUAL))
    lidar = calibration(_beams(32)[1]).lidar({}, evidence(packets))
    packets = packets.copy()
    packets[1, 1062] = 0x3B
    assert not lidar.faults(packets).any()
    assert (lidar.return_types, lidar.typed_by, lidar.sends_twice) == ((0, 0), "level", True)


@pytest.mark.parametrize(
    ("mode", "types", "text"),
    [
        (0x37, (1,), "strongest return"),
        (0x38, (2,), "last return"),
        (0x33, (0,), "first return"),
        (0x3D, (0, 0, 0), "triple return, first, last and strongest"),
    ],
)
def test_return_types(mode: int, types: tuple[int, ...], text: str) -> None:
    packets, _, _ = _encoded(HesaiSpec("XT32M2X", mode=mode))
    lidar = calibration(_beams(32, "XT32M2X")[1]).lidar({}, evidence(packets))
    assert (lidar.return_types, lidar.mode) == (types, text)


@pytest.mark.parametrize("body", [np.eye(4), None], ids=["sensor frame", "body frame"])
def test_optical_centre(body: F64Array | None) -> None:
    """Section 6, refinement 2, beam by beam: point = k u + c, turned, with its range unchanged."""
    spec = HesaiSpec("Pandar64", rpm=600, start_deg=33.0)
    packets, _, _ = _encoded(spec)
    beams, content = _beams(64)
    found = decode(packets, content, {"optical_centre": "on", "firing_azimuth": "off"})
    if body is None:
        body = np.array([[0.0, -1, 0, 1], [0, 0, 1, 2], [-1, 0, 0, 3], [0, 0, 0, 1]])
    column, centre = 17, np.array([-0.012, 0.03873, 0.0])
    range_m = np.linspace(0.3, 60, 64).astype(np.float32)
    range_m[5] = 0.085
    elevation, azimuth = np.radians(beams.aim(np.zeros((1, 64)))[::-1])[:, 0]
    unit = np.stack(
        [
            np.cos(elevation) * np.sin(azimuth),
            np.cos(elevation) * np.cos(azimuth),
            np.sin(elevation),
        ],
        axis=1,
    )
    rotor = np.radians(builder.azimuths_deg(spec, 18)[column])
    expected = []
    for one, range_one in zip(unit, range_m.astype(np.float64), strict=True):
        along = float((one * centre).sum())
        behind = np.sqrt(along**2 - (centre**2).sum() + range_one**2) - along
        x, y, z = behind * one + centre if range_one > 0.09 else range_one * one
        turned = (x * np.cos(rotor) + y * np.sin(rotor), y * np.cos(rotor) - x * np.sin(rotor), z)
        expected.append(body[:3, :3] @ turned + body[:3, 3])
    rotor_beams = Rotor(found.lidar.firing_ns, project=found.lidar.projection)
    word = found.encoder[column : column + 1]
    points = projected(rotor_beams, word, range_m[None], body)
    assert np.abs(points[0] - expected).max() < 2e-5
    plain = decode(packets, content, {"firing_azimuth": "off"}).lidar
    assert plain.projection(body) is None


def test_optical_centre_of_a_jt16_is_where_its_ranges_begin() -> None:
    """190 degrees before the angles of the file, as in the SDK: (4.2527, -11.8739) mm."""
    packets, _, _ = _encoded(HesaiSpec("JT16"))
    lidar = decode(packets, angles_csv([0.0] * 16, [0.0] * 16), {"optical_centre": "on"}).lidar
    assert lidar.projection(np.eye(4)) is None
    # 90 degrees to the right.
    rotor_beams = Rotor(lidar.firing_ns, lidar.beams)
    points = projected(rotor_beams, np.array([1 << 30]), np.full((1, 16), 2.0, np.float32))
    assert points[0, 3].tolist() == pytest.approx([1.9881261, -0.0042527, 0.003911], abs=1e-6)


def test_files_are_identified_by_content() -> None:
    assert hesai.read_calibration(Path("a.json"), b'{"lidar_mode": 1}') is None
    assert hesai.read_calibration(Path("topic"), b"elevation,azimuth\n1,2\n") is None
    csv = calibration(_beams(64)[1])
    assert (csv.serial, csv.is_shared, csv.path) == ("", False, Path("unit.csv"))
    dat = calibration(_beams(128, "AT128")[1])
    assert (dat.model, dat.is_shared) == ("AT128", False)
    assert hesai.BUILT_IN == ()


def test_fit_is_by_channels_then_by_where_beams_look() -> None:
    packets, _, _ = _encoded(HesaiSpec("Pandar64"))
    seen = evidence(packets)
    own = calibration(angles_csv(np.linspace(14.9, -24.9, 64).tolist(), [0.0] * 64))
    qt64 = calibration(angles_csv(np.linspace(-52.1, 52.1, 64).tolist(), [0.0] * 64))
    assert own.match_score(seen) > qt64.match_score(seen) > 0
    assert calibration(_beams(40)[1]).match_score(seen) == 0
    assert calibration(_beams(128, "AT128")[1]).match_score(seen) == 0
    assert own.lidar({}, seen).notes == ()
    with pytest.raises(RigError) as caught:
        qt64.lidar({}, seen)
    assert str(caught.value) == (
        "unit.csv: expected elevations of a Pandar64, -25 to 15 deg, found -52.1 to 52.1, the file "
        "of another model; give the one of this lidar"
    )
    near = calibration(angles_csv(np.linspace(19.5, -24.9, 64).tolist(), [0.0] * 64))
    (note,) = near.lidar({}, seen).notes
    assert note == (
        "unit.csv: expected elevations from about -25 to 15 deg for a Pandar64, found -24.9 to "
        "19.5; check that the file is of this lidar"
    )


def test_packets_without_a_decoder_fit_nothing() -> None:
    packets = _encoded(HesaiSpec("XT32M2X"))[0].copy()
    packets[:, 802] = 0x40
    assert calibration(_beams(32)[1]).match_score(evidence(packets)) == 0
    assert hesai.describe(820, packets) == "HESAI lidar XT32M2X: no decoder in this version"
    assert hesai.describe(820, packets[:0]) is None


@pytest.mark.parametrize(
    ("model", "file", "text"),
    [
        (
            "Pandar64",
            "Pandar40P",
            "expected 64 channels for the packets of a Pandar64, found 40; give",
        ),
        (
            "Pandar64",
            "AT128",
            "expected the csv of a Pandar64 for these packets, found the file of",
        ),
        ("AT128", "OT128", "HESAI AT128: expected its correction file (.dat), found a csv"),
    ],
)
def test_a_file_of_another_lidar_is_refused(model: str, file: str, text: str) -> None:
    packets, _, _ = _encoded(HesaiSpec(model))
    content = _beams(HesaiSpec(file).row.channels, file)[1]
    with pytest.raises(RigError) as caught:
        calibration(content).lidar({}, evidence(packets))
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("file", ["Pandar64", "AT128"])
def test_a_lidar_that_was_not_seen_is_refused(file: str) -> None:
    content = _beams(HesaiSpec(file).row.channels, file)[1]
    with pytest.raises(
        RigError, match=r"expected packets of the lidar in the first 10 seconds.*found none"
    ):
        calibration(content).lidar({}, None)


def test_unknown_options_are_refused() -> None:
    packets, _, _ = _encoded(HesaiSpec("Pandar64"))
    with pytest.raises(UsageError):
        calibration(_beams(64)[1]).lidar({"optical_center": "on"}, evidence(packets))


@pytest.mark.parametrize(
    "content", [b"Laser id,Elevation,Azimuth\n1,2\n", b"\xee\xff\x01\x05\x80" + bytes(99)]
)
def test_damaged_files_are_refused(content: bytes) -> None:
    with pytest.raises(MlbatchError):
        hesai.read_calibration(Path("unit"), content)


def test_packets_behind_a_prefix() -> None:
    spec = HesaiSpec("AT128")
    packets, _, _ = _encoded(spec)
    content = _beams(128, "AT128")[1]
    behind = np.concatenate([np.full((len(packets), 21), 7, np.uint8), packets], axis=1)
    plain, prefixed = decode(packets, content), decode(behind, content, {"crc": "check"})
    assert prefixed.lidar.packet_size == plain.lidar.packet_size + 21
    assert (plain.time_ns == prefixed.time_ns).all()
    assert plain.xyz().tobytes() == prefixed.xyz().tobytes()
    assert (prefixed.lidar.sequence(behind) == plain.lidar.sequence(packets)).all()
