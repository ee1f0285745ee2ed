"""The layout of packets within one message, found by walking it once.

Layouts: facts/messages.md, sections 1 and 4. The lengths within a message decide where everything
lies, so that what was found holds for every message of the same length and lengths.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.readers._bytes import records, single
from mlbatch.readers._cdr import Cursor, MessageError
from mlbatch.readers._definitions import PRIMITIVES, SEQUENCE, Definitions, Field
from mlbatch.readers._packet_types import Envelope

_U32 = np.dtype([("value", "<u4")])
_NONE = np.zeros(0, np.int64)
# Bytes of a packet's size and of its stamp, and their alignment.
_SIZE, _STAMP = (4, 4), (8, 4)
# Far more than any packet is made of; a chain of so many nested ones is no packet.
_MOST_TYPES = 100


def u32(data: U8Array, at: I64Array) -> I64Array:
    """Little-endian words at bytes `at` of `data`, any shape."""
    if not at.size:
        return np.zeros(at.shape, np.int64)
    words: I64Array = records(data, _U32, at.ravel())["value"].astype(np.int64)
    return words.reshape(at.shape)


@dataclass(frozen=True, slots=True)
class Shape:
    """Where everything lies in messages of one shape, from their first byte on.

    word, value: (w,) int64, places and values of all lengths; start, room: (p,) int64, payloads;
    size_at, stamp_at: (p,) int64, or (0,) where there is none.
    """

    word: I64Array
    value: I64Array
    start: I64Array
    room: I64Array
    size_at: I64Array
    stamp_at: I64Array

    def fits(self, data: U8Array, begin: I64Array) -> BoolArray:
        """Which of the messages of this shape's length that begin at `begin` have the shape."""
        same: BoolArray = (u32(data, begin[:, None] + self.word) == self.value).all(axis=1)
        return same


@dataclass(slots=True)
class _Places:
    """Places of packets, as they are found; in absolute bytes."""

    start: list[I64Array] = field(default_factory=list)
    room: list[I64Array] = field(default_factory=list)
    size_at: list[I64Array] = field(default_factory=list)
    stamp_at: list[I64Array] = field(default_factory=list)

    def repeat(self, count: int, stride: int) -> None:
        """`count` packets like the first, `stride` bytes apart."""
        step = np.arange(count, dtype=np.int64) * stride
        for part in (self.start, self.size_at, self.stamp_at):
            part[:] = [part[0] + step] if part else []
        self.room[:] = [np.full(count, self.room[0][0])]


class Tracer:
    """Finds the shape of messages of one type.

    Raises MessageError for a definition that has no place for packets. many: a message holds a
    list of packets; stamped: its packets carry the time of their arrival.
    """

    def __init__(self, types: Definitions, encoding: str, root: str, envelope: Envelope) -> None:
        self._types, self._encoding, self._root = types, encoding, root
        self._envelope = envelope
        self._holder = _holder(types, root, envelope)
        self.many = self._holder is not None and self._holder.count is not None
        self.stamped = bool(envelope.stamp) and encoding in envelope.stamped_by
        kind = root if self._holder is None else self._holder.type
        self._alignment = _fixed_alignment(types, kind)

    def trace(self, data: U8Array, begin: int, end: int) -> Shape:
        """Walk the message `data[begin:end]`; MessageError where it is none."""
        cursor = Cursor(self._types, self._encoding, data.data, begin, end)
        places = _Places()
        if self._holder is None:
            self._packet(cursor, self._root, places)
        else:
            for one in cursor.fields(self._root):
                if one.name == self._holder.name:
                    self._packets(cursor, one, places)
                    break
                cursor.skip(one)
        word = np.array(cursor.words, np.int64)
        found = (places.start, places.room, places.size_at, places.stamp_at)
        start, room, size_at, stamp_at = (np.concatenate([_NONE, *part]) for part in found)
        if not {len(size_at), len(stamp_at)} <= {0, len(start)}:
            raise MessageError(
                f"wanted a size and a stamp of each packet in {self._root}, got a definition with "
                "several; this variant of the message is not known"
            )
        return Shape(
            word - begin, u32(data, word), start - begin, room, size_at - begin, stamp_at - begin
        )

    def _packets(self, cursor: Cursor, one: Field, places: _Places) -> None:
        """The packets of a field; those of fixed length follow each other at a constant stride."""
        count = 1 if one.count is None else cursor.count(one)
        for done in range(count):
            self._packet(cursor, one.type, places)
            if done == 1 and self._alignment:
                stride = int(places.start[1][0] - places.start[0][0])
                if stride % self._alignment == 0 and stride > 0:
                    # The last packet has no padding behind it.
                    cursor.place((count - 2) * stride, 1)
                    places.repeat(count, stride)
                    return

    def _packet(self, cursor: Cursor, kind: str, places: _Places) -> None:
        envelope = self._envelope
        cursor.enter(kind)
        for one in cursor.fields(kind):
            if one.name == envelope.payload:
                room = cursor.count(one)
                places.start.append(single(cursor.place(room, 1)))
                places.room.append(single(room))
            elif one.name == envelope.size:
                places.size_at.append(single(cursor.place(*_SIZE)))
            elif one.name == envelope.stamp and self.stamped:
                places.stamp_at.append(single(cursor.place(*_STAMP)))
            else:
                cursor.skip(one)
        cursor.leave()


def _holder(types: Definitions, root: str, envelope: Envelope) -> Field | None:
    """The field that holds the packets (None: the message is one); checks all fields on the way."""
    fields = {one.name: one for one in types.get(root, ())}
    inner, holder = fields, None
    if envelope.inside:
        holder = fields.get(envelope.inside)
        inner = {one.name: one for one in types.get(holder.type, ())} if holder else {}
    payload = inner.get(envelope.payload)
    wanted = ((envelope.size, ("uint32", "int32")), (envelope.stamp, ("time",)))
    unknown = [
        name for name, kinds in wanted if name and inner.get(name, Field("", "")).type not in kinds
    ]
    size = 0 if payload is None else PRIMITIVES.get(payload.type, (0,))[0]
    if payload is None or payload.count is None or size != 1 or unknown:
        path = ".".join(name for name in (envelope.inside, envelope.payload) if name)
        raise MessageError(
            f"wanted packets in the field {path} of {root}, got a definition with "
            f"{', '.join(fields) or 'no field'}; this variant of the message is not known"
        )
    return holder


def _fixed_alignment(types: Definitions, kind: str, known: dict[str, int] | None = None) -> int:
    """The largest alignment within a type of fixed length; 0 where the length varies.

    known: of types that were looked at; one that is met within itself has no length.
    """
    if kind in PRIMITIVES:
        return PRIMITIVES[kind][1]
    known = {} if known is None else known
    if kind not in known and len(known) < _MOST_TYPES:
        known[kind] = 0
        inner = types.get(kind, ())
        parts = [
            0 if f.count == SEQUENCE else _fixed_alignment(types, f.type, known) for f in inner
        ]
        known[kind] = max(parts) if parts and all(parts) else 0
    return known.get(kind, 0)
