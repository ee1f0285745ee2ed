"""RoboSense lidars; `sensor.py` is the plug-in."""

from __future__ import annotations

from mlbatch.arrays import U8Array
from mlbatch.sensors.packet_bytes import any_has_bytes

# Points, device packets, IMU packets.
_MARKS = (b"\x55\xaa", b"\xa5\xff", b"\xaa\x55")
_MOST_BYTES = 100_000


def may_send(size: int, packets: U8Array) -> bool:
    """Packets begin with magic bytes."""
    return any(any_has_bytes(packets, magic) for magic in _MARKS)


def may_calibrate(content: bytes) -> bool:
    """Angle files are short tables of two columns."""
    if b"," not in content or len(content) > _MOST_BYTES:
        return False
    lines = content.decode("utf-8-sig", errors="replace").splitlines()
    return all(line.count(",") == 1 for line in lines if line.strip())
