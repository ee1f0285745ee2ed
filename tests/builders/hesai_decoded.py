"""Packets of HESAI lidars as the decoder's tests use them: decoded without windows or files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mlbatch.arrays import F32Array, I64Array, U8Array
from mlbatch.lidar.interface import Calibration, Evidence, Lidar
from mlbatch.sensors.hesai import sensor as hesai
from mlbatch.types import ColumnHeaders, Stream
from tests.builders.decoded import Readings, readings

STREAM = Stream("192.168.1.201", 2368)
EVIDENCE_PACKETS = 16


@dataclass(frozen=True)
class Decoded:
    """All columns of some packets."""

    lidar: Lidar
    readings: Readings

    @property
    def range_m(self) -> F32Array:
        return self.readings.range_m

    @property
    def intensity(self) -> F32Array:
        return self.readings.intensity

    @property
    def headers(self) -> ColumnHeaders:
        return self.readings.headers

    @property
    def stamp_ns(self) -> I64Array:
        return self.readings.stamp_ns

    @property
    def encoder(self) -> I64Array:
        return self.readings.encoder

    @property
    def time_ns(self) -> I64Array:
        """(n, channels) when each beam fires."""
        table = self.encoder >> 56
        firing_ns: I64Array = np.maximum(self.lidar.firing_ns, 0)[table]
        return self.stamp_ns[:, None] + firing_ns

    def xyz(self) -> F32Array:
        """(n, channels, returns, 3) points in the sensor frame, as conversions make them."""
        return self.readings.xyz


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
    return Decoded(lidar, readings(lidar, packets))
