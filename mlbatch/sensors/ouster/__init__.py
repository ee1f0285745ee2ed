"""Ouster lidars; `sensor.py` is the plug-in."""

from __future__ import annotations

from mlbatch.arrays import U8Array
from mlbatch.sensors.packet_bytes import any_has_bytes

# Without packet type: IMU packets, and 16 columns of 16 to 256 beams.
_LEGACY_SIZES = frozenset({48} | {16 * (20 + 12 * beams) for beams in (16, 32, 64, 128, 256)})
# Lidar, IMU and zone packets.
_TYPES = (b"\1", b"\2", b"\3")


def may_send(size: int, packets: U8Array) -> bool:
    """Packets have a legacy size, maybe with the byte that old ROS drivers append, or a type."""
    is_legacy = not _LEGACY_SIZES.isdisjoint((size, size - 1))
    return is_legacy or any(any_has_bytes(packets, kind) for kind in _TYPES)


def may_calibrate(content: bytes) -> bool:
    """Metadata are a JSON document."""
    return content.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{")
