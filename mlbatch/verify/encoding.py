"""Values one after the other: CDR of ROS 2, the packed form of ROS 1 and of MCAP records.

CDR: OMG DDSI-RTPS 2.2 section 10; ROS 1: facts/messages.md section 4; MCAP: mcap.dev/spec.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias, TypeVar

from mlbatch.verify.verdict import DamageError

Item = TypeVar("Item")
Real: TypeAlias = float
_CDR_HEAD = b"\x00\x01\x00\x00"
_SIZES = {"B": 1, "H": 2, "I": 4, "i": 4, "Q": 8, "d": 8}
_NS = 10**9


@dataclass(slots=True)
class Cursor:
    """Reads little-endian values; aligned: each to a multiple of its size, counted from `base`."""

    data: memoryview
    at: int = 0
    aligned: bool = False
    base: int = 0

    @classmethod
    def of_message(cls, data: memoryview, encoding: str) -> Cursor:
        """A cursor at the first value of a message."""
        if encoding == "ros1":
            return cls(data)
        if encoding != "cdr" or bytes(data[:4]) != _CDR_HEAD:
            raise DamageError("little-endian CDR", f"{encoding} {bytes(data[:4]).hex()}")
        return cls(data, 4, True, 4)

    def whole(self, code: str) -> int:
        """One whole number; code as in `struct`."""
        value: int = self._take(code, 1)[0]
        return value

    def reals(self, count: int) -> tuple[Real, ...]:
        """Float64 values."""
        values: tuple[Real, ...] = self._take("d", count)
        return values

    def raw(self, size: int) -> memoryview:
        """The next bytes as they are."""
        end = self.at + size
        if end > len(self.data):
            raise DamageError(f"{size} bytes at byte {self.at}", f"{len(self.data) - self.at}")
        found = self.data[self.at : end]
        self.at = end
        return found

    def text(self) -> str:
        """A string with its length before it; that of CDR counts a closing 0."""
        data = bytes(self.raw(self.whole("I")))
        if self.aligned:
            if data[-1:] != b"\0":
                raise DamageError("a string that ends with 0", repr(data[:40]))
            data = data[:-1]
        return data.decode("utf-8", "replace")

    def stamp_ns(self) -> int:
        """A time of two words."""
        seconds = self.whole("i" if self.aligned else "I")
        return seconds * _NS + self.whole("I")

    def header(self) -> tuple[int, str]:
        """Stamp and frame of a std_msgs/Header."""
        if not self.aligned:
            self.whole("I")
        return self.stamp_ns(), self.text()

    def part(self, code: str = "I") -> Cursor:
        """A cursor over the next bytes, whose number stands before them."""
        return Cursor(self.raw(self.whole(code)))

    def pairs(self, item: Callable[[Cursor], Item]) -> list[Item]:
        """Items up to the end of the data."""
        found = []
        while self.at < len(self.data):
            found.append(item(self))
        return found

    def end(self, what: str) -> None:
        """Nothing may follow."""
        if self.at != len(self.data):
            raise DamageError(f"{what} of {self.at} bytes", f"{len(self.data)} bytes")

    def _take(self, code: str, count: int) -> tuple[int, ...]:
        size = _SIZES[code]
        if self.aligned:
            self.at += (self.base - self.at) % size
        end = self.at + size * count
        if end > len(self.data):
            wanted = f"{size * count} bytes at byte {self.at}"
            raise DamageError(wanted, f"{max(0, len(self.data) - self.at)}")
        values = struct.unpack_from(f"<{count}{code}", self.data, self.at)
        self.at = end
        return values
