"""Values of ROS messages: CDR of ROS 2 and the packed encoding of ROS 1.

Sources: OMG DDSI-RTPS 2.2 section 10; docs/sources/messages.md section 4. The generated code of
`rosbags` is not used for messages: it takes 0.3 s to load, and accepts bytes after the last field.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TypeAlias

from mlbatch.outputs.damage import DamageError

Buffer: TypeAlias = "bytes | memoryview"
_CDR_HEAD = b"\x00\x01\x00\x00"
_SIZES = {"B": 1, "I": 4, "i": 4, "d": 8}
_NS = 10**9


@dataclass(slots=True)
class MessageCursor:
    """Reads little-endian values in order."""

    data: memoryview
    at: int = 0
    # CDR: a value begins at a multiple of its size, counted from `base`.
    aligned: bool = False
    base: int = 0

    @classmethod
    def of_message(cls, data: Buffer, encoding: str) -> MessageCursor:
        """A cursor at the first field; encoding: cdr or ros1."""
        view = memoryview(data)
        if encoding == "ros1":
            return cls(view)
        if encoding != "cdr" or bytes(view[:4]) != _CDR_HEAD:
            raise DamageError("little-endian CDR", f"{encoding} {bytes(view[:4]).hex()}")
        return cls(view, 4, True, 4)

    def integer(self, code: str) -> int:
        """One integer; code as in `struct`."""
        value: int = self._values(code, 1)[0]
        return value

    def floats(self, count: int) -> tuple[float, ...]:
        """Float64 values."""
        values: tuple[float, ...] = self._values("d", count)
        return values

    def bytes_of(self, size: int) -> memoryview:
        """The next bytes as they are."""
        end = self.at + size
        if end > len(self.data):
            raise DamageError(f"{size} bytes at byte {self.at}", f"{len(self.data) - self.at}")
        found = self.data[self.at : end]
        self.at = end
        return found

    def text(self) -> str:
        """A string after its length; in CDR with a final 0."""
        data = bytes(self.bytes_of(self.integer("I")))
        if self.aligned:
            if data[-1:] != b"\0":
                raise DamageError("a string that ends with 0", repr(data[:40]))
            data = data[:-1]
        return data.decode("utf-8", "replace")

    def header(self) -> tuple[int, str]:
        """Stamp in ns and frame of a std_msgs/Header; that of ROS 1 begins with a sequence."""
        if not self.aligned:
            self.integer("I")
        seconds = self.integer("i" if self.aligned else "I")
        stamp_ns = seconds * _NS + self.integer("I")
        return stamp_ns, self.text()

    def end(self, name: str) -> None:
        """Check that nothing follows."""
        if self.at != len(self.data):
            raise DamageError(f"{name} of {self.at} bytes", f"{len(self.data)} bytes")

    def _values(self, code: str, count: int) -> tuple[int, ...]:
        size = _SIZES[code]
        if self.aligned:
            self.at += (self.base - self.at) % size
        end = self.at + size * count
        if end > len(self.data):
            expected = f"{size * count} bytes at byte {self.at}"
            raise DamageError(expected, str(max(0, len(self.data) - self.at)))
        values = struct.unpack_from(f"<{count}{code}", self.data, self.at)
        self.at = end
        return values
