"""A sensor as decoding sees it."""

from __future__ import annotations

from dataclasses import dataclass

from mlbatch.arrays import F64Array
from mlbatch.decode.packet_ring import PacketRing
from mlbatch.lidar.interface import Lidar


@dataclass(slots=True)
class Source:
    """Lidar, raw packets, pose and limits of a sensor.

    body_from_sensor: (4, 4) float64, m; ring_base: number of its first channel in the output;
    keep_repeated: keep duplicate returns.
    """

    lidar: Lidar
    ring: PacketRing
    body_from_sensor: F64Array
    ring_base: int
    min_range_m: float = 0.0
    max_range_m: float = float("inf")
    keep_repeated: bool = False

    @property
    def slots(self) -> int:
        """Slots of a column: channels times returns."""
        return self.lidar.channels * self.lidar.returns
