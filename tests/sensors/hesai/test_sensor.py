"""What only HESAI lidars have: optional parts of packets, optical centres, prefixes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mlbatch.arrays import F64Array
from mlbatch.simulate.hesai.encode import HesaiSpec, angles_csv
from tests.builders.decoded import Rotor, projected, readings
from tests.builders.others import filled, rows
from tests.builders.spinning import evidence_of, from_file, stream_of


@pytest.mark.parametrize("flags", [0x00, 0x01, 0x04, 0x05, 0x03, 0x0D, 0x17, 0x7F])
def test_optional_parts_of_the_128_channel_family(flags: int) -> None:
    unit = 3 + bin(flags & 0x70).count("1")
    body = 12 + 2 * (2 + 128 * unit) + 4
    size = body + 26 + 4
    size += sum(more for flag, more in ((1, 4), (2, 22), (4, 17), (8, 32)) if flags & flag)
    tail = body + (17 if flags & 4 else 0)
    parts = {0: bytes.fromhex("eeff010480008002000401") + bytes([flags]), tail + 12: b"\x38"}
    parts |= {tail + 15: bytes([123, 1, 1, 0, 0, 0]), 14 + unit * 127: b"\x64"}
    packets = rows([filled(size, parts)] * 2)
    lidar = from_file(HesaiSpec("OT128").files.content).lidar({}, evidence_of(packets))
    assert (lidar.model, lidar.mode) == ("OT128", "last return")
    assert not lidar.faults(packets).any()
    assert readings(lidar, packets).range_m[0, 127, 0] == np.float32(0.4)
    assert bool(lidar.sequence_modulus) == bool(flags & 1)


def test_packets_behind_a_prefix() -> None:
    plain = stream_of(HesaiSpec("AT128"))
    prefix = np.full((len(plain.packets), 21), 7, np.uint8)
    behind = replace(plain, packets=np.concatenate([prefix, plain.packets], axis=1))
    own, other = plain.lidar(), behind.lidar(crc="check")
    assert other.packet_size == own.packet_size + 21
    assert not other.faults(behind.packets).any()
    expected, found = plain.read(own), behind.read(other)
    np.testing.assert_array_equal(found.stamp_ns, expected.stamp_ns)
    assert found.xyz.tobytes() == expected.xyz.tobytes()
    np.testing.assert_array_equal(other.sequence(behind.packets), own.sequence(plain.packets))


def test_a_file_whose_beams_hardly_fit_is_noted() -> None:
    angles = np.linspace(19.5, -24.9, 64).tolist()
    near = from_file(angles_csv(angles, [0.0] * 64))
    assert near.lidar({}, stream_of(HesaiSpec("Pandar64")).evidence).notes == (
        "unit.csv: expected elevations from about -25 to 15 deg for a Pandar64, found -24.9 to "
        "19.5; check that the file is of this lidar",
    )


TURNED = np.array([[0.0, -1, 0, 1], [0, 0, 1, 2], [-1, 0, 0, 3], [0, 0, 0, 1]])


@pytest.mark.parametrize("body", [np.eye(4), TURNED], ids=["sensor frame", "body frame"])
def test_optical_centre(body: F64Array) -> None:
    """Section 6, refinement 2, beam by beam: point = k u + c, turned, with its range unchanged."""
    spec = HesaiSpec("Pandar64", start_deg=33.0)
    stream = stream_of(spec)
    lidar = stream.lidar(optical_centre="on", firing_azimuth="off")
    column, centre = 17, np.array([-0.012, 0.03873, 0.0])
    range_m = np.linspace(0.3, 60, 64).astype(np.float32)
    range_m[5] = 0.085
    azimuth, elevation = np.radians(spec.beams.aim(np.zeros((1, 64))))[:, 0]
    flat = np.cos(elevation)
    units = np.stack([flat * np.sin(azimuth), flat * np.cos(azimuth), np.sin(elevation)], axis=1)
    rotor = np.radians(spec.azimuths_deg(18)[column])
    expected = []
    for unit, range_one in zip(units, range_m.astype(np.float64), strict=True):
        along = float((unit * centre).sum())
        behind = np.sqrt(along**2 - (centre**2).sum() + range_one**2) - along
        x, y, z = behind * unit + centre if range_one > 0.09 else range_one * unit
        turned = (x * np.cos(rotor) + y * np.sin(rotor), y * np.cos(rotor) - x * np.sin(rotor), z)
        expected.append(body[:3, :3] @ turned + body[:3, 3])
    word = stream.headers(lidar).encoder.reshape(-1)[column : column + 1]
    beams = Rotor(lidar.firing_ns, project=lidar.projection)
    points = projected(beams, word, range_m[None], body)
    assert np.abs(points[0] - expected).max() < 2e-5
    assert stream.lidar(firing_azimuth="off").projection(body) is None


def test_optical_centre_of_a_jt16_is_where_its_ranges_begin() -> None:
    """190 degrees before the angles of the file, as in the SDK: (4.2527, -11.8739) mm."""
    level = from_file(angles_csv([0.0] * 16, [0.0] * 16))
    lidar = level.lidar({"optical_centre": "on"}, stream_of(HesaiSpec("JT16")).evidence)
    assert lidar.projection(np.eye(4)) is None
    # 90 degrees to the right.
    beams = Rotor(lidar.firing_ns, lidar.beams)
    points = projected(beams, np.array([1 << 30]), np.full((1, 16), 2.0, np.float32))
    assert points[0, 3].tolist() == pytest.approx([1.9881261, -0.0042527, 0.003911], abs=1e-6)
