"""Points of clouds as a lidar: what its packets are, and where its points go."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mlbatch import sensors
from mlbatch.arrays import F32Array, F64Array, U8Array
from mlbatch.frames.transforms import from_quaternion
from mlbatch.lidar.interface import FAULTS, Calibration, Evidence, Lidar
from mlbatch.ros.point_packets import Layout, Points, pack
from mlbatch.sensors.pointcloud.sensor import BUILT_IN, MODELS
from mlbatch.types import Stream
from tests.builders.decoded import readings
from tests.builders.points import STAMP_NS

TOPIC = Stream(topic="/left/points")
CLOUD, CUSTOM = BUILT_IN


def _points(places: list[tuple[float, float, float]], stamps_ns: list[int]) -> Points:
    reals = np.zeros((4, len(places)), np.float32)
    reals[:3] = np.array(places).T
    reals[3] = np.arange(len(places))
    nothing = np.zeros(len(places), np.uint8)
    stamp_ns = STAMP_NS + np.array(stamps_ns, np.int64)
    return Points(stamp_ns, reals, None, nothing, nothing)


# Ranges by Pythagoras: 3, 7, 9, 11 and 13; the third column has one point.
PLACES = [(1.0, 2.0, 2.0), (2.0, 3.0, -6.0), (4.0, -4.0, 7.0), (6.0, 6.0, 7.0), (-3.0, 4.0, 12.0)]
STAMPS_NS = [0, 0, 50, 50, 90]
RANGES_M = [[3, 7], [9, 11], [13, 0]]


def _packets(kind: int = 0) -> tuple[U8Array, Layout]:
    points = _points(PLACES, STAMPS_NS)
    layout = Layout(kind, 2)
    return pack(points, layout, 0), layout


def _evidence(packets: U8Array, stream: Stream = TOPIC) -> Evidence:
    return Evidence(stream, packets.shape[1], packets, np.zeros(len(packets), np.int64))


def _lidar(calibration: Calibration = CLOUD, kind: int = 0) -> Lidar:
    return calibration.lidar({}, _evidence(_packets(kind)[0]))


def test_packets_identify_their_clouds() -> None:
    for kind, one in enumerate(BUILT_IN):
        fits = [c.match_score(_evidence(_packets(kind)[0])) for c in sensors.built_in()]
        assert [c for c, fit in zip(sensors.built_in(), fits, strict=True) if fit] == [one]
        assert (one.model, one.path, one.serial, one.is_shared) == (
            *(MODELS[kind].name, None, ""),
            True,
        )


def test_other_packets_are_not_recognised() -> None:
    packets, _ = _packets()
    others = [np.zeros_like(packets), packets[:, :20], packets[:, :-8], packets[:0]]
    for at, value in ((0, 0), (4, 2), (5, 9), (6, 0), (6, 3), (7, 9)):
        wrong = packets.copy()
        wrong[:, at] = value
        others.append(wrong)
    for other in others:
        assert CLOUD.match_score(_evidence(other)) == 0
        assert sensors.describe(other.shape[1], other) is None or not len(other)
    # Whatever a datagram contains, it is no message of a topic.
    assert CLOUD.match_score(_evidence(packets, Stream("10.0.0.1", 2368))) == 0


def test_one_damaged_packet_hides_no_stream() -> None:
    packets, _ = _packets()
    packets[2] = 0
    assert CLOUD.match_score(_evidence(packets)) == 100


@pytest.mark.parametrize("by_ring", [False, True])
def test_no_vendor_claims_cloud_packets(by_ring: bool) -> None:
    """Lengths may coincide: 1206 and 1248 bytes are no multiples of 8, but others could be."""
    count = 300
    reals = np.ones((4, count), np.float32)
    ring = np.arange(count, dtype=np.uint16) % 8
    nothing = np.zeros(count, np.uint8)
    stamp_ns = STAMP_NS + np.arange(count, dtype=np.int64) // 8 * 4167
    points = Points(stamp_ns, reals, ring, nothing, nothing)
    for slots in range(8, 257):
        packets = pack(points, Layout(0, slots, by_ring), 0)
        words = sensors.describe(packets.shape[1], packets)
        assert words is not None
        assert words.startswith("lidar points")
        fits = {c.model: c.match_score(_evidence(packets)) for c in sensors.built_in()}
        assert {model for model, fit in fits.items() if fit} == {"PointCloud2"}


def test_columns_have_the_stamp_of_their_points() -> None:
    packets, layout = _packets()
    lidar = _lidar()
    headers = lidar.column_headers(packets, np.zeros(3, np.int64))
    assert (headers.stamp_ns - STAMP_NS).tolist() == [[0], [50], [90]]
    assert headers.valid.all()
    assert (lidar.packet_size, lidar.columns_per_packet) == (layout.size, 1)
    assert (lidar.channels, lidar.returns, lidar.return_types) == (2, 1, (0,))
    assert not lidar.firing_ns.any()
    assert lidar.channel.tolist() == [0, 1]
    assert not lidar.sends_twice
    assert not lidar.has_reflectivity
    # A cloud does not say how many columns were measured in a second.
    assert lidar.columns_per_s == 0


def test_packets_of_another_layout_are_faults() -> None:
    packets, _ = _packets()
    packets[1, 6] = 3
    assert [FAULTS[fault] for fault in _lidar().faults(packets)] == ["", "bad_header", ""]


def test_equal_columns_of_a_message_are_two_and_of_two_messages_one() -> None:
    lidar = _lidar()
    same = pack(_points([(1.0, 2.0, 2.0)] * 4, [0] * 4), Layout(0, 2), 0)
    assert len(set(lidar.sequence(same).tolist())) == 2
    again = np.concatenate([same, same])
    assert len(set(lidar.sequence(again).tolist())) == 2


def _decoded(pose: F64Array) -> tuple[F32Array, F32Array, F32Array]:
    """Ranges (n, B), places (n, B, 3) and levels (n, B)."""
    packets, _ = _packets()
    found = readings(_lidar(), packets, body_from_sensor=pose)
    return found.range_m[..., 0], found.xyz[..., 0, :], found.intensity[..., 0]


def test_points_stay_where_they_are_in_their_own_frame() -> None:
    range_m, xyz, level = _decoded(np.eye(4))
    assert range_m.tolist() == RANGES_M
    found = [*xyz[0], *xyz[1], xyz[2, 0]]
    assert [tuple(map(float, one)) for one in found] == PLACES
    assert level.tolist() == [[0, 1], [2, 3], [4, 0]]


def test_points_are_turned_and_moved_into_the_body_frame() -> None:
    """A rotation by 90 degrees to the left maps x to y and y to -x; then (10, 20, 30) is added."""
    half = math.sqrt(0.5)
    pose = from_quaternion((10, 20, 30), (0, 0, half, half))
    range_m, xyz, _ = _decoded(pose)
    assert range_m.tolist() == RANGES_M
    expected = [(10 - y, 20 + x, 30 + z) for x, y, z in PLACES]
    np.testing.assert_allclose([*xyz[0], *xyz[1], xyz[2, 0]], expected, atol=2e-6)
