"""Packets of HESAI lidars as the decoder's tests use them: decoded without windows or files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mlbatch.arrays import F32Array, I64Array, U8Array
from mlbatch.lidar.geometry import Turning
from mlbatch.lidar.interface import Calibration, Evidence, Lidar
from mlbatch.sensors.hesai import sensor as hesai
from mlbatch.types import ColumnHeaders, Pixels, Stream

STREAM = Stream("192.168.1.201", 2368)
EVIDENCE_PACKETS = 16


@dataclass(frozen=True)
class Decoded:
    """All columns of some packets: (n, channels, returns) ranges and levels."""

    lidar: Lidar
    headers: ColumnHeaders
    range_m: F32Array
    intensity: F32Array

    @property
    def stamp_ns(self) -> I64Array:
        return self.headers.stamp_ns.reshape(-1)

    @property
    def encoder(self) -> I64Array:
        return self.headers.encoder.reshape(-1)

    @property
    def time_ns(self) -> I64Array:
        """(n, channels) when each beam fires."""
        table = self.encoder >> 56
        firing_ns: I64Array = np.maximum(self.lidar.firing_ns, 0)[table]
        return self.stamp_ns[:, None] + firing_ns

    def xyz(self) -> F32Array:
        """(n, channels, returns, 3) points in the sensor frame, as conversions make them."""
        count, channels, returns = self.range_m.shape
        projection = self.lidar.projection(np.eye(4), count) or Turning(
            self.lidar.beams, np.maximum(self.lidar.firing_ns, 0), count
        )
        points = np.empty((count, channels, returns, 3), np.float32)
        projection.prepare(np.zeros(count, np.int64), self.encoder)
        for which in range(returns):
            projection.project(np.ascontiguousarray(self.range_m[..., which]), points[:, :, which])
        return points


def rows(payloads: Sequence[bytes]) -> U8Array:
    """Payloads of one size as (k, size)."""
    return np.stack([np.frombuffer(payload, np.uint8) for payload in payloads])


def evidence(packets: U8Array) -> Evidence:
    """What is known of a stream that begins with these packets."""
    sample = packets[:EVIDENCE_PACKETS]
    return Evidence(STREAM, packets.shape[1], sample, np.arange(len(sample)))


def calibration(content: bytes, name: str = "unit.csv") -> Calibration:
    """The calibration in a file."""
    found = hesai.read_calibration(Path(name), content)
    assert found is not None
    return found


def decode(packets: U8Array, content: bytes, options: Mapping[str, str] | None = None) -> Decoded:
    """All columns of the packets (P, size) of one sensor; content: its angle file."""
    lidar = calibration(content).lidar(options or {}, evidence(packets))
    assert not lidar.faults(packets).any()
    records = lidar.records
    count = len(packets) * lidar.columns_per_packet
    starts = records.start + records.stride * np.arange(lidar.columns_per_packet)
    columns = packets[:, starts[:, None] + np.arange(records.size)].reshape(count, -1)
    shape = (count, lidar.channels, lidar.returns)
    range_m = np.empty(shape, np.float32)
    intensity = np.empty(shape, np.float32)
    for which in range(lidar.returns):
        plane = np.empty(shape[:2], np.float32)
        lidar.read(np.ascontiguousarray(columns), which, Pixels(plane, intensity[..., which], None))
        range_m[..., which] = plane
    return Decoded(
        lidar, lidar.column_headers(packets, np.zeros(len(packets), np.int64)), range_m, intensity
    )
