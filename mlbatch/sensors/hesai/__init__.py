"""HESAI lidars; `sensor.py` is the plug-in."""

from __future__ import annotations

from mlbatch.arrays import U8Array
from mlbatch.sensors.packet_bytes import any_has_bytes

# Bytes between the start of a payload and the packet of an automotive model.
PREFIX_SIZE = 21
# GPS packets, and Pandar40 without a date, with one, and with a sequence number.
_FLAGGED_SIZES = (512, 1256, 1262, 1266)


def may_send(size: int, packets: U8Array) -> bool:
    """Packets begin with a start marker, a block flag, or the magic of faults or corrections."""
    if size in _FLAGGED_SIZES and any_has_bytes(packets, b"\xff\xee"):
        return True
    marks = ((b"\xee\xff", 0), (b"\xee\xff", PREFIX_SIZE), (b"\xcd\xdc", 0), (b"Gt\5\0", 0))
    return any(any_has_bytes(packets, magic, at) for magic, at in marks)


def may_calibrate(content: bytes) -> bool:
    """Angle files have two titles in ASCII, or the magic of the AT128."""
    words = content.lower()
    return content.startswith(b"\xee\xff\1") or (b"elevation" in words and b"azimuth" in words)
