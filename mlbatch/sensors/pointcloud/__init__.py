"""Decoded point clouds as a lidar; `sensor.py` is the plug-in."""

from __future__ import annotations

from mlbatch.arrays import U8Array
from mlbatch.sensors.packet_bytes import any_has_bytes


def may_send(size: int, packets: U8Array) -> bool:
    """Clouds as packets begin with their magic, `MAGIC` in ros/point_packets.py."""
    return any_has_bytes(packets, b"MLPC")


def may_calibrate(content: bytes) -> bool:
    """False: there are no calibration files."""
    return False
