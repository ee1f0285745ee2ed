"""Sensors with rotor words decoded together give the same points as each one alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest

from mlbatch.arrays import I64Array
from mlbatch.decode.decoder import Decoder, ScanHeader, Source, WindowColumns
from mlbatch.frames.transforms import from_rpy_deg
from mlbatch.native.arena import PacketArena
from mlbatch.pipeline.sensor import new_ring
from mlbatch.simulate.velodyne.encode import VelodyneSpec
from mlbatch.types import RunInfo, Scan, SensorInfo
from tests.builders.velodyne_streams import Seen, made_of

_POSES = (np.eye(4), from_rpy_deg((0, 0.8, 1.6), (0, 0, 60)), from_rpy_deg((-1, 0, 2), (3, 9, 180)))
_NONE = np.empty((0, 6))


@dataclass
class Sensor:
    """A sensor with its columns in its ring."""

    source: Source
    stamp_ns: I64Array
    ring_index: I64Array
    encoder: I64Array


def _sensor(number: int, seen: Seen) -> Sensor:
    lidar = seen.lidar
    sent = seen.sent
    ring = new_ring(lidar, PacketArena())
    start = np.arange(len(sent.payloads), dtype=np.int64) * lidar.packet_size
    first = ring.keep(sent.payloads.reshape(-1).copy(), start).ring_index
    place = (first[:, None] + ring.column_offsets(lidar.columns_per_packet)).reshape(-1)
    headers = lidar.column_headers(sent.payloads, sent.host_ns)
    source = Source(lidar, ring, _POSES[number], number * lidar.channels, 1.0 + number, 90.0)
    return Sensor(source, headers.stamp_ns.reshape(-1), place, headers.encoder.reshape(-1))


def _scan(sensors: Sequence[Sensor], only: int | None = None) -> Scan:
    info = RunInfo(
        tuple(
            SensorInfo(f"s{number}", "", 16, 1, 16 * number, np.eye(4))
            for number in range(len(_POSES))
        ),
        "base_link",
        "10",
        "utc",
    )
    sensor = np.concatenate(
        [np.full(len(one.ring_index), number) for number, one in enumerate(sensors)]
    )
    stamp_ns = np.concatenate([one.stamp_ns for one in sensors])
    order = np.argsort(stamp_ns, kind="stable")
    due = WindowColumns(
        stamp_ns[order],
        sensor[order],
        np.concatenate([one.ring_index for one in sensors])[order],
        np.concatenate([one.encoder for one in sensors])[order],
    )
    start_ns = int(stamp_ns.min()) // 10**9 * 10**9
    decoder = Decoder(info, [one.source for one in sensors], _NONE, only=only)
    return decoder.scan(due, ScanHeader(0, 0, start_ns, start_ns + 10**9, True, 0))


@pytest.mark.parametrize(
    "modes",
    [
        ("strongest",) * 3,
        ("strongest", "last", "strongest"),
        ("dual",) * 3,
        ("last", "dual", "last"),
    ],
    ids=" ".join,
)
def test_points_are_those_of_each_sensor_alone(modes: tuple[str, ...]) -> None:
    sensors = [
        _sensor(
            number,
            made_of(VelodyneSpec("VLP-16", mode, start_us=1e6 + 17 * number, start_azimuth_deg=60)),
        )
        for number, mode in enumerate(modes)
    ]
    together = _scan(sensors)
    for number, one in enumerate(sensors):
        own = together.lidar_id == number
        alone = _scan([one], only=number)
        assert alone.points == np.count_nonzero(own) > 0
        assert together.xyz[own].tobytes() == alone.xyz.tobytes()
        assert together.intensity[own].tobytes() == alone.intensity.tobytes()
        assert together.time_ns[own].tolist() == alone.time_ns.tolist()
        assert together.ring[own].tolist() == alone.ring.tolist()
        assert together.return_type[own].tolist() == alone.return_type.tolist()
