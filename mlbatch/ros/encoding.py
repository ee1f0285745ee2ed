"""Messages field by field, by their definition: CDR (little endian) and the ROS 1 encoding.

Layouts: facts/messages.md, section 4; CDR is that of OMG DDSI-RTPS 2.2, section 10, with the
alignment of plain CDR version 1. Every length is checked against the message's end.
"""

from __future__ import annotations

import struct
from typing import Protocol, TypeAlias

from mlbatch.errors import RecordingError
from mlbatch.ros.definitions import PRIMITIVES, SEQUENCE, Definitions, Field
from mlbatch.units import NS_PER_S

Leaf: TypeAlias = int | float | str | bytes
ENCODINGS = ("cdr", "ros1")
_LITTLE_ENDIAN = b"\x00\x01"
# Big endian, parameter lists, and the kinds of CDR version 2.
_OTHER_KINDS = tuple(bytes([0, kind]) for kind in (0, 2, 3, *range(6, 12)))
_ENCAPSULATION_BYTES = 4
_U32 = struct.Struct("<I")
_BYTES = ("uint8", "int8", "byte", "char")
# Definitions come with the recording: they may hold themselves, or count what takes no bytes.
_MOST_STEPS, _MOST_LEVELS = 1_000_000, 32


class MessageError(RecordingError):
    """Bytes that are no message of their type."""


class EncapsulationError(MessageError):
    """A message in a kind of CDR that no recorder of ROS 2 writes."""


class Cursor:
    """Reads one message, `data[begin:end]`, from its front on.

    words: places of all lengths read so far (and of the encapsulation), which together decide
    where everything lies.
    """

    def __init__(
        self, types: Definitions, encoding: str, data: memoryview, begin: int, end: int
    ) -> None:
        self.types, self.aligned = types, encoding == "cdr"
        self.data, self.at, self.origin, self.end = data, begin, begin, end
        self.words: list[int] = []
        self._steps = self._levels = 0
        if self.aligned:
            self.words.append(self.place(_ENCAPSULATION_BYTES, 1))
            self.origin = self.at
            head = bytes(data[begin : self.at])
            if head[:2] != _LITTLE_ENDIAN:
                kind = EncapsulationError if head[:2] in _OTHER_KINDS else MessageError
                raise kind(
                    f"wanted a message of little-endian CDR (00 01 00 00), got {head.hex(' ')}; "
                    "convert the recording to that encoding"
                )

    def place(self, size: int, align: int) -> int:
        """Where the next `size` bytes begin; the cursor stands behind them then."""
        at = self.at
        if self.aligned:
            at += (self.origin - at) % align
        if at + size > self.end:
            raise MessageError(
                f"wanted {size} bytes at byte {at - self.origin} of a message, got its end; "
                "it was cut off, or is of another type"
            )
        self.at = at + size
        return at

    def length(self) -> int:
        """A length; larger ones than the bytes that follow are refused."""
        at = self.place(_U32.size, _U32.size)
        self.words.append(at)
        value: int = _U32.unpack_from(self.data, at)[0]
        if value > self.end - self.at:
            raise MessageError(
                f"wanted a length of at most {self.end - self.at} at byte {at - self.origin} of a "
                f"message, got {value}; it was cut off, or is of another type"
            )
        return value

    def fields(self, name: str) -> tuple[Field, ...]:
        """Fields of a type."""
        found = self.types.get(name)
        if found is None:
            raise MessageError(f"wanted the definition of {name}, got none; record it again")
        return found

    def count(self, field: Field) -> int:
        """Number of elements of an array."""
        return self.length() if field.count == SEQUENCE else field.count or 0

    def step(self) -> None:
        """Count a part of the message; there are never as many as a definition may claim."""
        self._steps += 1
        if self._steps > _MOST_STEPS:
            raise MessageError(
                f"wanted at most {_MOST_STEPS} parts in a message, got more by its definition; "
                "the definition is damaged"
            )

    def skip(self, field: Field) -> None:
        """Pass over a field."""
        if field.count is None:
            self._skip_one(field.type)
            return
        count = self.count(field)
        primitive = PRIMITIVES.get(field.type)
        if primitive is None:
            for _ in range(count):
                self._skip_one(field.type)
        elif count:  # Nothing is aligned for elements that are not there.
            self.place(primitive[0] * count, primitive[1])

    def _skip_one(self, kind: str) -> None:
        self.step()
        if kind in PRIMITIVES:
            self.place(*PRIMITIVES[kind][:2])
        elif kind == "string":
            self.place(self.length(), 1)
        else:
            self.enter(kind)
            for field in self.fields(kind):
                self.skip(field)
            self.leave()

    def enter(self, kind: str) -> None:
        """Begin a nested message; CDR gives one without fields a byte of its own."""
        self.step()
        self._levels += 1
        if self._levels > _MOST_LEVELS:
            raise MessageError(
                f"wanted at most {_MOST_LEVELS} messages within each other, got {kind} in more by "
                "its definition; the definition is damaged"
            )
        if self.aligned and not self.fields(kind):
            self.place(1, 1)

    def leave(self) -> None:
        """End a nested message."""
        self._levels -= 1

    def leaves(self, kind: str, prefix: str = "") -> dict[str, Leaf]:
        """All values of a message by their dotted names; arrays: `name.0`, and `name` for bytes."""
        found: dict[str, Leaf] = {}
        self.enter(kind)
        for field in self.fields(kind):
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

    def _leaf(self, kind: str, name: str, found: dict[str, Leaf]) -> None:
        self.step()
        if kind in PRIMITIVES:
            size, align, code = PRIMITIVES[kind]
            values = struct.unpack_from("<" + code, self.data, self.place(size, align))
            found[name] = values[0] if len(values) == 1 else values[0] * NS_PER_S + values[1]
        elif kind == "string":
            size = self.length()
            at = self.place(size, 1)
            raw = bytes(self.data[at : at + size])
            # CDR counts the closing NUL.
            text = raw.removesuffix(b"\0") if self.aligned else raw
            found[name] = text.decode("utf-8", "replace")
        else:
            found.update(self.leaves(kind, f"{name}."))


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
