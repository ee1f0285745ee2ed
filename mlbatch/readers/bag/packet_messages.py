"""Where the packets are in messages with raw packets of lidars, many at once.

Stamps and traps: docs/sources/messages.md, sections 1 to 4. A message is walked field by
field once per shape: the lengths within a message determine all places, so that messages of the
same length and the same lengths inside are read by adding the offsets of the first.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.errors import RecordingError
from mlbatch.readers.byte_records import records, single
from mlbatch.ros.definitions import (
    PRIMITIVES,
    SEQUENCE,
    Definitions,
    Field,
    definitions_of,
    type_key,
    variants_of,
)
from mlbatch.ros.encoding import ENCODINGS, EncapsulationError, MessageError, MessageReader
from mlbatch.ros.packet_types import PACKET_TYPES, PADDED, Envelope
from mlbatch.types import Topic
from mlbatch.units import NS_PER_S

_CORRECTION_MAGIC = b"\x47\x74\x05\x00"
_CORRECTION_HEAD_BYTES = 8

# -- shapes ---------------------------------------------------------------------------------------

_U32 = np.dtype([("value", "<u4")])
_NONE = np.zeros(0, np.int64)
# A packet's size and stamp: bytes, alignment.
_SIZE = (4, 4)
_STAMP = (8, 4)
# Far more than any packet consists of; a chain of so many nested types is no packet.
_MOST_TYPES = 100


def u32(data: U8Array, at: I64Array) -> I64Array:
    """Little-endian words at bytes `at` of `data`, any shape."""
    if not at.size:
        return np.zeros(at.shape, np.int64)
    words: I64Array = records(data, _U32, at.ravel())["value"].astype(np.int64)
    return words.reshape(at.shape)


@dataclass(frozen=True, slots=True)
class Shape:
    """Places in messages of one shape, counted from their first byte.

    word, value: (w,) int64, places and values of all lengths; start, room: (p,) int64, payloads;
    size_at, stamp_at: (p,) int64, or (0,) where there is none; rest: bytes behind the packets.
    """

    word: I64Array
    value: I64Array
    start: I64Array
    room: I64Array
    size_at: I64Array
    stamp_at: I64Array
    rest: int

    def fits(self, data: U8Array, begin: I64Array) -> BoolArray:
        """True where a message at `begin`, of this shape's length, has the shape."""
        same: BoolArray = (u32(data, begin[:, None] + self.word) == self.value).all(axis=1)
        return same


@dataclass(slots=True)
class _Places:
    """Places of packets as they are found, in bytes of the array."""

    # First byte of the payload.
    start: list[I64Array] = field(default_factory=list)
    # Bytes of its array, used or not.
    room: list[I64Array] = field(default_factory=list)
    # Of a field with the number of used bytes.
    size_at: list[I64Array] = field(default_factory=list)
    # Of the timestamp of the packet.
    stamp_at: list[I64Array] = field(default_factory=list)

    def repeat(self, count: int, stride: int) -> None:
        """`count` packets like the first, `stride` bytes apart."""
        step = np.arange(count, dtype=np.int64) * stride
        for part in (self.start, self.size_at, self.stamp_at):
            part[:] = [part[0] + step] if part else []
        self.room[:] = [np.full(count, self.room[0][0])]


class Tracer:
    """Finds the shape of messages of one type.

    Raises MessageError for a definition without a place for packets. many: a message contains a
    list of packets; stamped: its packets have their receive time.
    """

    def __init__(self, types: Definitions, encoding: str, root: str, envelope: Envelope) -> None:
        self._types = types
        self._encoding = encoding
        self._root = root
        self._holder, self._envelope = _holder(types, root, envelope)
        self.many = self._holder is not None and self._holder.count is not None
        self.stamped = bool(envelope.stamp) and encoding in envelope.stamped_by
        packet_type = root if self._holder is None else self._holder.type
        self._alignment = _fixed_alignment(types, packet_type)

    def trace(self, data: U8Array, begin: int, end: int) -> Shape:
        """Walk the message `data[begin:end]`; MessageError where it is none of its type."""
        reader = MessageReader(self._types, self._encoding, data.data, begin, end)
        places = _Places()
        if self._holder is None:
            self._packet(reader, self._root, places)
        else:
            for one in reader.fields(self._root):
                if one.name == self._holder.name:
                    self._packets(reader, one, places)
                    break
                reader.skip(one)
        word = np.array(reader.words, np.int64)
        start = np.concatenate([_NONE, *places.start])
        room = np.concatenate([_NONE, *places.room])
        size_at = np.concatenate([_NONE, *places.size_at])
        stamp_at = np.concatenate([_NONE, *places.stamp_at])
        if not {len(size_at), len(stamp_at)} <= {0, len(start)}:
            raise MessageError(
                f"expected a size and a stamp of each packet in {self._root}, found a definition "
                "with several; this variant of the message is not supported"
            )
        places_at = (start - begin, room, size_at - begin, stamp_at - begin)
        return Shape(word - begin, u32(data, word), *places_at, end - reader.at)

    def _packets(self, reader: MessageReader, one: Field, places: _Places) -> None:
        """The packets of a field; those of fixed length follow each other at a constant stride."""
        count = 1 if one.count is None else reader.count(one)
        for done in range(count):
            self._packet(reader, one.type, places)
            if done == 1 and self._alignment:
                stride = int(places.start[1][0] - places.start[0][0])
                if stride % self._alignment == 0 and stride > 0:
                    # The last packet has no padding behind it.
                    reader.place((count - 2) * stride, 1)
                    places.repeat(count, stride)
                    return

    def _packet(self, reader: MessageReader, type_name: str, places: _Places) -> None:
        envelope = self._envelope
        reader.enter(type_name)
        for one in reader.fields(type_name):
            if one.name == envelope.payload:
                room = reader.count(one)
                places.start.append(single(reader.place(room, 1)))
                places.room.append(single(room))
            elif one.name == envelope.size:
                places.size_at.append(single(reader.place(*_SIZE)))
            elif one.name == envelope.stamp and self.stamped:
                places.stamp_at.append(single(reader.place(*_STAMP)))
            else:
                reader.skip(one)
        reader.leave()


def _holder(types: Definitions, root: str, envelope: Envelope) -> tuple[Field | None, Envelope]:
    """The field that contains the packets, None if the message is one; checks all fields.

    The envelope is returned without a size if the definition has none and may lack it.
    """
    fields = {one.name: one for one in types.get(root, ())}
    inner = fields
    holder = None
    if envelope.inside:
        holder = fields.get(envelope.inside)
        inner = {one.name: one for one in types.get(holder.type, ())} if holder else {}
    if envelope.may_lack_size and envelope.size not in inner:
        envelope = replace(envelope, size="")
    payload = inner.get(envelope.payload)
    expected = ((envelope.size, ("uint32", "int32")), (envelope.stamp, ("time",)))
    absent = Field("", "")
    unknown = [
        name for name, kinds in expected if name and inner.get(name, absent).type not in kinds
    ]
    size = 0 if payload is None else PRIMITIVES.get(payload.type, (0,))[0]
    if payload is None or payload.count is None or size != 1 or unknown:
        path = ".".join(name for name in (envelope.inside, envelope.payload) if name)
        raise MessageError(
            f"expected packets in the field {path} of {root}, found a definition with "
            f"{', '.join(fields) or 'no field'}; this variant of the message is not supported"
        )
    return holder, envelope


def _fixed_alignment(
    types: Definitions, type_name: str, known: dict[str, int] | None = None
) -> int:
    """The largest alignment within a type of fixed length; 0 where the length varies.

    known: of types already visited; one that contains itself has no fixed length.
    """
    if type_name in PRIMITIVES:
        return PRIMITIVES[type_name][1]
    known = {} if known is None else known
    if type_name not in known and len(known) < _MOST_TYPES:
        known[type_name] = 0
        parts = [
            0 if one.count == SEQUENCE else _fixed_alignment(types, one.type, known)
            for one in types.get(type_name, ())
        ]
        known[type_name] = max(parts) if parts and all(parts) else 0
    return known.get(type_name, 0)


# -- packets --------------------------------------------------------------------------------------

_MOST_SHAPES = 64
# Middleware may fill messages up to a multiple of it.
_END_PADDING = 4


@dataclass(frozen=True, slots=True)
class PacketsFound:
    """UDP payloads in messages, in their order.

    start, size: (p,) int64, in the bytes given; host_ns: (p,) int64, receive time; message: (p,)
    int64, index of the message; untimed: packets have the log time of a message with many packets;
    faults: index of each unreadable message, and why; corrections: index and bytes of calibrations;
    empty: packets of 0 bytes.
    """

    start: I64Array
    size: I64Array
    host_ns: I64Array
    message: I64Array
    untimed: bool = False
    faults: tuple[tuple[int, str], ...] = ()
    corrections: tuple[tuple[int, bytes], ...] = ()
    empty: int = 0


class Unpacker:
    """Finds the payloads in the messages of one topic.

    Raises MessageError for a topic whose definition has no place for packets.
    """

    def __init__(self, topic: Topic) -> None:
        self.topic = topic
        root = type_key(topic.type)
        self._envelope = PACKET_TYPES[root]
        if topic.encoding not in ENCODINGS:
            raise MessageError(
                f"{topic.name}: expected messages encoded as {' or '.join(ENCODINGS)}, "
                f"found {topic.encoding!r}; convert the recording"
            )
        try:
            self._tracer = Tracer(definitions_of(topic), topic.encoding, root, self._envelope)
            self._variants = [
                Tracer(types, topic.encoding, root, self._envelope) for types in variants_of(topic)
            ]
        except MessageError as err:
            raise MessageError(f"{topic.name}: {err}") from err
        # By length of the message.
        self._shapes: dict[int, list[Shape]] = {}
        self._known = 0

    def find_many(
        self, data: U8Array, begin: I64Array, end: I64Array, log_ns: I64Array
    ) -> PacketsFound:
        """The payloads of n messages `data[begin[i]:end[i]]`, recorded at `log_ns` (n,)."""
        parts: list[PacketsFound] = []
        faults: list[tuple[int, str]] = []
        length = end - begin
        for size in dict.fromkeys(length.tolist()):
            rows = np.flatnonzero(length == size)
            untried = list(self._shapes.get(size, ()))
            while len(rows):
                if untried:
                    shape = untried.pop()
                else:
                    first = int(rows[0])
                    try:
                        shape = self._new_shape(data, int(begin[first]), int(end[first]))
                    except MessageError as err:
                        faults.append((first, str(err)))
                        rows = rows[1:]
                        continue
                fits = shape.fits(data, begin[rows])
                parts.append(self._packets(data, begin[rows[fits]], rows[fits], shape, log_ns))
                rows = rows[~fits]
        return self._without_others(data, _joined(parts, sorted(faults)))

    def _new_shape(self, data: U8Array, begin: int, end: int) -> Shape:
        """The shape of a message that has none of the known ones; it is added to them."""
        try:
            shape = self._trace(data, begin, end)
        except EncapsulationError as err:
            # A topic that begins in another encoding has no other messages.
            if not self._known:
                raise RecordingError(f"{self.topic.name}: {err}") from err
            raise
        if self._known % _MOST_SHAPES == 0:
            self._shapes = {}
        self._known += 1
        self._shapes.setdefault(end - begin, []).append(shape)
        return shape

    def _trace(self, data: U8Array, begin: int, end: int) -> Shape:
        """The shape of a message; of several forms of its type, by that which fills it."""
        if not self._variants:
            return self._tracer.trace(data, begin, end)
        for tracer in (self._tracer, *self._variants):
            with suppress(MessageError):
                shape = tracer.trace(data, begin, end)
                if shape.rest < _END_PADDING:
                    return shape
        rest = self._tracer.trace(data, begin, end).rest
        raise MessageError(
            f"expected packets up to the end of a message, found {rest} bytes behind them; it was "
            "cut off, or is of another type"
        )

    def _packets(
        self, data: U8Array, begin: I64Array, row: I64Array, shape: Shape, log_ns: I64Array
    ) -> PacketsFound:
        """The packets of messages `row` of one shape, which begin at `begin`."""
        count = len(shape.start)
        size = np.broadcast_to(shape.room, (len(row), count))
        if len(shape.size_at):
            # Packets never reach beyond the bytes of their field, whatever their size claims.
            size = np.minimum(u32(data, begin[:, None] + shape.size_at), size)
        host_ns = np.broadcast_to(log_ns[row, None], (len(row), count))
        untimed = self._tracer.many and host_ns.size > 0
        if len(shape.stamp_at):
            at = begin[:, None] + shape.stamp_at
            stamp_ns = u32(data, at) * NS_PER_S + u32(data, at + 4)
            untimed = self._tracer.many and bool((stamp_ns == 0).any())
            host_ns = np.where(stamp_ns == 0, host_ns, stamp_ns)
        start = (begin[:, None] + shape.start).ravel()
        return PacketsFound(start, size.ravel(), host_ns.ravel(), np.repeat(row, count), untimed)

    def _without_others(self, data: U8Array, found: PacketsFound) -> PacketsFound:
        """Without calibrations, padding and empty packets."""
        size = found.size
        if self._envelope.padded:
            size = _unpadded(data, found.start, size)
        keep = size > 0
        empty = len(keep) - int(keep.sum())
        corrections = []
        if self._envelope.corrections:
            for at in _begins_with(data, found.start, size, _CORRECTION_MAGIC).tolist():
                begin = int(found.start[at]) + _CORRECTION_HEAD_BYTES
                # The size counts only the text, which follows the head.
                text = data[begin : begin + int(size[at])].tobytes()
                corrections.append((int(found.message[at]), text))
                keep[at] = False
        return replace(
            found,
            start=found.start[keep],
            size=size[keep],
            host_ns=found.host_ns[keep],
            message=found.message[keep],
            corrections=tuple(corrections),
            empty=empty,
        )


def _joined(parts: Sequence[PacketsFound], faults: Sequence[tuple[int, str]]) -> PacketsFound:
    """Parts as one, in the order of messages."""
    message = np.concatenate([_NONE, *(part.message for part in parts)])
    order = np.argsort(message, kind="stable") if len(parts) > 1 else slice(None)
    return PacketsFound(
        np.concatenate([_NONE, *(part.start for part in parts)])[order],
        np.concatenate([_NONE, *(part.size for part in parts)])[order],
        np.concatenate([_NONE, *(part.host_ns for part in parts)])[order],
        message[order],
        any(part.untimed for part in parts),
        tuple(faults),
    )


def _begins_with(data: U8Array, start: I64Array, size: I64Array, magic: bytes) -> I64Array:
    """Indices of packets that begin with `magic`, of four bytes."""
    long = np.flatnonzero(size >= len(magic))
    found: I64Array = long[u32(data, start[long]) == int.from_bytes(magic, "little")]
    return found


def _unpadded(data: U8Array, start: I64Array, size: I64Array) -> I64Array:
    """Sizes without the zeros that fill a field up to its fixed length."""
    size = size.copy()
    for magic, length in PADDED:
        for at in _begins_with(data, start, size, magic).tolist():
            begin = int(start[at]) + length
            end = int(start[at] + size[at])
            if not data[begin:end].any():
                size[at] = min(length, int(size[at]))
    return size
