"""Values of the messages of outputs as they are: what recordings are forgiven is damage here.

The generated code of `rosbags` is not used for messages: it takes 0.3 s to load, and accepts bytes
after the last field.
"""

from __future__ import annotations

import struct

from mlbatch.outputs.damage import DamageError
from mlbatch.ros.encoding import ENCODINGS, Cursor, MessageError
from mlbatch.units import NS_PER_S

_CDR_HEAD = b"\x00\x01\x00\x00"


class MessageCursor(Cursor):
    """Reads little-endian values in order; DamageError for others."""

    @classmethod
    def of_message(cls, data: bytes | memoryview, encoding: str) -> MessageCursor:
        """A cursor at the first field; encoding: cdr or ros1."""
        view = memoryview(data)
        head = bytes(view[: len(_CDR_HEAD)])
        if encoding not in ENCODINGS or (encoding == "cdr" and head != _CDR_HEAD):
            raise DamageError("little-endian CDR", f"{encoding} {head.hex()}")
        return cls(encoding, view, 0, len(view))

    def place(self, size: int, align: int) -> int:
        """Begin of the next `size` bytes; the cursor moves behind them."""
        try:
            return super().place(size, align)
        except MessageError as err:
            raise DamageError(f"{size} bytes at byte {self.at}", str(self.end - self.at)) from err

    def floats(self, count: int) -> tuple[float, ...]:
        """Float64 values."""
        return struct.unpack_from(f"<{count}d", self.data, self.place(8 * count, 8))

    def bytes_of(self, size: int) -> memoryview:
        """The next bytes as they are."""
        at = self.place(size, 1)
        return memoryview(self.data)[at : at + size]

    def text(self) -> str:
        """A string after its length; in CDR with a final 0."""
        data = bytes(self.bytes_of(self.number("I")))
        if self.is_cdr and data[-1:] != b"\0":
            raise DamageError("a string that ends with 0", repr(data[:40]))
        return data[: len(data) - self.is_cdr].decode("utf-8", "replace")

    def header(self) -> tuple[int, str]:
        """Stamp in ns and frame of a std_msgs/Header; that of ROS 1 begins with a sequence."""
        if not self.is_cdr:
            self.number("I")
        seconds = self.number("i" if self.is_cdr else "I")
        return seconds * NS_PER_S + self.number("I"), self.text()

    def finish(self, name: str) -> None:
        """Check that nothing follows."""
        if self.at != self.end:
            raise DamageError(f"{name} of {self.at} bytes", f"{self.end} bytes")
