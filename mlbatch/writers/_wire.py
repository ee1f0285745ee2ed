"""How values of messages become bytes: CDR of ROS 2, and the packed form of ROS 1.

CDR: OMG DDSI-RTPS 2.2 section 10, plain little-endian encapsulation; values are aligned to their
size, counted from the first byte after the 4-byte head. ROS 1: facts/messages.md, section 4.
"""

from __future__ import annotations

import struct
from typing import Protocol

from mlbatch.units import NS_PER_S

_HEAD = b"\x00\x01\x00\x00"


class Wire(Protocol):
    """A message under construction."""

    data: bytearray

    def put(self, code: str, *values: float) -> None:
        """Append values of one type, `code` as in `struct`."""
        ...

    def text(self, value: str) -> None:
        """Append a string."""
        ...

    def header(self, stamp_ns: int, frame_id: str) -> None:
        """Append a std_msgs/Header."""
        ...


class Cdr:
    """A message of ROS 2 under construction."""

    def __init__(self) -> None:
        self.data = bytearray(_HEAD)

    def put(self, code: str, *values: float) -> None:
        """Append values of one type, `code` as in `struct`."""
        size = struct.calcsize(code)
        self.data += bytes((len(_HEAD) - len(self.data)) % size)
        self.data += struct.pack(f"<{len(values)}{code}", *values)

    def text(self, value: str) -> None:
        """Append a string: length with the closing 0, bytes, 0."""
        data = value.encode() + b"\x00"
        self.put("I", len(data))
        self.data += data

    def header(self, stamp_ns: int, frame_id: str) -> None:
        """Append a std_msgs/Header."""
        self.put("i", stamp_ns // NS_PER_S)
        self.put("I", stamp_ns % NS_PER_S)
        self.text(frame_id)


class Ros1:
    """A message of ROS 1 under construction."""

    def __init__(self) -> None:
        self.data = bytearray()

    def put(self, code: str, *values: float) -> None:
        """Append values of one type, `code` as in `struct`."""
        self.data += struct.pack(f"<{len(values)}{code}", *values)

    def text(self, value: str) -> None:
        """Append a string: length, bytes."""
        data = value.encode()
        self.put("I", len(data))
        self.data += data

    def header(self, stamp_ns: int, frame_id: str) -> None:
        """Append a std_msgs/Header; its sequence number is the publisher's, of whom is none."""
        self.put("I", 0, stamp_ns // NS_PER_S, stamp_ns % NS_PER_S)
        self.text(frame_id)
