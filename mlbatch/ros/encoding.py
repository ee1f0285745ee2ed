"""Values of messages and their bytes, read and written side by side: CDR (ROS 2) and ROS 1.

CDR: OMG DDSI-RTPS 2.2, section 10, plain CDR version 1, little endian: a head of 4 bytes, then
values aligned to their size, counted from the first byte after the head; strings have a closing
NUL. ROS 1: packed, no head, no NUL (docs/sources/messages.md, section 4).
"""

from __future__ import annotations

import struct
from typing import TypeAlias

from mlbatch.errors import RecordingError
from mlbatch.ros.definitions import PRIMITIVES, SEQUENCE, Definitions, Field
from mlbatch.units import NS_PER_S

ENCODINGS = ("cdr", "ros1")
# Kind of encapsulation, and two bytes of options.
_CDR_HEAD = b"\x00\x01\x00\x00"
_LITTLE_ENDIAN = _CDR_HEAD[:2]
# Big endian, parameter lists, and the kinds of CDR version 2.
_OTHER_KINDS = tuple(bytes([0, kind]) for kind in (0, 2, 3, *range(6, 12)))
_U32 = struct.Struct("<I")
_BYTES = ("uint8", "int8", "byte", "char")
# Definitions come with the recording: they may contain themselves, or count what takes no bytes.
_MOST_STEPS = 1_000_000
_MOST_LEVELS = 32

Leaf: TypeAlias = int | float | str | bytes


class MessageError(RecordingError):
    """Bytes that are no message of their type."""


class EncapsulationError(MessageError):
    """A message in a kind of CDR that ROS 2 does not write."""


# -- reading --------------------------------------------------------------------------------------


class Cursor:
    """Reads the values of one message, `data[begin:end]`, from front to back.

    Every length is checked against the message's end. words: places of all lengths read so far,
    and of the head; their values determine all other places.
    """

    def __init__(self, encoding: str, data: memoryview | bytes, begin: int, end: int) -> None:
        self.is_cdr = encoding == "cdr"
        self.data = data
        self.at = begin
        self.origin = begin
        self.end = end
        self.words: list[int] = []
        if self.is_cdr:
            self.words.append(self.place(len(_CDR_HEAD), 1))
            self.origin = self.at
            head = bytes(data[begin : self.at])
            if head[:2] != _LITTLE_ENDIAN:
                kind = EncapsulationError if head[:2] in _OTHER_KINDS else MessageError
                raise kind(
                    "expected a message of little-endian CDR (00 01 00 00), found "
                    f"{head.hex(' ')}; convert the recording to that encoding"
                )

    def place(self, size: int, align: int) -> int:
        """Begin of the next `size` bytes; the cursor moves behind them."""
        at = self.at
        if self.is_cdr:
            at += (self.origin - at) % align
        if at + size > self.end:
            raise MessageError(
                f"expected {size} bytes at byte {at - self.origin} of a message, found its end; "
                "it was cut off, or is of another type"
            )
        self.at = at + size
        return at

    def number(self, code: str) -> int:
        """An integer; code: as in `struct`."""
        size = struct.calcsize(code)
        value: int = struct.unpack_from("<" + code, self.data, self.place(size, size))[0]
        return value

    def length(self) -> int:
        """A length; MessageError if it exceeds the bytes that follow."""
        at = self.place(_U32.size, _U32.size)
        self.words.append(at)
        value: int = _U32.unpack_from(self.data, at)[0]
        if value > self.end - self.at:
            raise MessageError(
                f"expected a length of at most {self.end - self.at} at byte {at - self.origin} of "
                f"a message, found {value}; it was cut off, or is of another type"
            )
        return value

    def text(self) -> str:
        """A string, without the closing NUL of CDR."""
        size = self.length()
        at = self.place(size, 1)
        raw = bytes(self.data[at : at + size])
        return (raw.removesuffix(b"\0") if self.is_cdr else raw).decode("utf-8", "replace")

    def header(self) -> tuple[int, str]:
        """Stamp (ns; 0 if it is out of range) and frame of a std_msgs/Header, no leading slash."""
        if not self.is_cdr:
            self.number("I")
        seconds = self.number("i")
        nanoseconds = self.number("I")
        is_valid = seconds >= 0 and nanoseconds < NS_PER_S
        stamp_ns = seconds * NS_PER_S + nanoseconds if is_valid else 0
        return stamp_ns, self.text().rstrip("\0").lstrip("/")


class MessageReader(Cursor):
    """Reads one message field by field, by the definitions of its types."""

    def __init__(
        self,
        types: Definitions,
        encoding: str,
        data: memoryview | bytes,
        begin: int,
        end: int,
    ) -> None:
        super().__init__(encoding, data, begin, end)
        self.types = types
        self._steps = 0
        self._levels = 0

    def fields(self, name: str) -> tuple[Field, ...]:
        """Fields of a type; MessageError if it is not defined."""
        fields = self.types.get(name)
        if fields is None:
            raise MessageError(f"expected the definition of {name}, found none; record it again")
        return fields

    def count(self, field: Field) -> int:
        """Number of elements of an array."""
        return self.length() if field.count == SEQUENCE else field.count or 0

    def step(self) -> None:
        """Count a part of the message; MessageError for more parts than any message has."""
        self._steps += 1
        if self._steps > _MOST_STEPS:
            raise MessageError(
                f"expected at most {_MOST_STEPS} parts in a message, found more by its definition; "
                "the definition is damaged"
            )

    def skip(self, field: Field) -> None:
        """Skip a field."""
        if field.count is None:
            self._skip_one(field.type)
            return
        count = self.count(field)
        primitive = PRIMITIVES.get(field.type)
        if primitive is None:
            for _ in range(count):
                self._skip_one(field.type)
        elif count:  # An empty array is not aligned.
            self.place(primitive[0] * count, primitive[1])

    def _skip_one(self, type_name: str) -> None:
        self.step()
        if type_name in PRIMITIVES:
            self.place(*PRIMITIVES[type_name][:2])
        elif type_name == "string":
            self.place(self.length(), 1)
        else:
            self.enter(type_name)
            for field in self.fields(type_name):
                self.skip(field)
            self.leave()

    def enter(self, type_name: str) -> None:
        """Begin a nested message; one without fields takes one byte in CDR."""
        self.step()
        self._levels += 1
        if self._levels > _MOST_LEVELS:
            raise MessageError(
                f"expected at most {_MOST_LEVELS} nested messages, found {type_name} in more by "
                "its definition; the definition is damaged"
            )
        if self.is_cdr and not self.fields(type_name):
            self.place(1, 1)

    def leave(self) -> None:
        """End a nested message."""
        self._levels -= 1

    def leaves(self, type_name: str, prefix: str = "") -> dict[str, Leaf]:
        """All values of a message by their dotted names; arrays: `name.0`, `name` for bytes."""
        found: dict[str, Leaf] = {}
        self.enter(type_name)
        for field in self.fields(type_name):
            name = prefix + field.name
            if field.count is None:
                self._leaf(field.type, name, found)
            elif field.type in _BYTES:
                size = self.count(field)
                at = self.place(size, 1)
                found[name] = bytes(self.data[at : at + size])
            else:
                for number in range(self.count(field)):
                    self._leaf(field.type, f"{name}.{number}", found)
        self.leave()
        return found

    def _leaf(self, type_name: str, name: str, found: dict[str, Leaf]) -> None:
        self.step()
        if type_name in PRIMITIVES:
            size, align, code = PRIMITIVES[type_name]
            values = struct.unpack_from("<" + code, self.data, self.place(size, align))
            found[name] = values[0] if len(values) == 1 else values[0] * NS_PER_S + values[1]
        elif type_name == "string":
            found[name] = self.text()
        else:
            found.update(self.leaves(type_name, f"{name}."))


# -- writing --------------------------------------------------------------------------------------


class Wire:
    """A message under construction; encoding: one of ENCODINGS."""

    def __init__(self, encoding: str = "cdr") -> None:
        self._is_cdr = encoding == "cdr"
        self.data = bytearray(_CDR_HEAD if self._is_cdr else b"")

    def put(self, code: str, *values: float) -> None:
        """Append values of one type, `code` as in `struct`."""
        if self._is_cdr:
            self.data += bytes((len(_CDR_HEAD) - len(self.data)) % struct.calcsize(code))
        self.data += struct.pack(f"<{len(values)}{code}", *values)

    def text(self, value: str) -> None:
        """Append a string: length, bytes, and in CDR a NUL that the length counts."""
        data = value.encode() + b"\x00" * self._is_cdr
        self.put("I", len(data))
        self.data += data

    def header(self, stamp_ns: int, frame_id: str) -> None:
        """Append a std_msgs/Header; in ROS 1 of number 0, since a publisher would set it."""
        if not self._is_cdr:
            self.put("I", 0)
        self.put("i", stamp_ns // NS_PER_S)
        self.put("I", stamp_ns % NS_PER_S)
        self.text(frame_id)
