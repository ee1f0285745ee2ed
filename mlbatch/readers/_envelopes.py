"""Where UDP payloads lie in the messages of bags, by message type, for many messages at once.

Types, stamps and traps: facts/messages.md, sections 1 to 4. Messages are walked once per shape:
the lengths within a message decide where everything lies, so that messages which share length and
lengths with one that was walked are found by adding its offsets (`_shapes`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mlbatch.arrays import I64Array, U8Array
from mlbatch.errors import RecordingError
from mlbatch.readers._cdr import ENCODINGS, EncapsulationError, MessageError
from mlbatch.readers._definitions import definitions_of, type_key
from mlbatch.readers._knowledge import decode_bytes, decode_string, decode_transforms
from mlbatch.readers._packet_types import PACKET_TYPES, Envelope
from mlbatch.readers._shapes import Shape, Tracer, u32
from mlbatch.types import Topic
from mlbatch.units import NS_PER_S

__all__ = [
    "CORRECTION_TYPE",
    "PACKET_TYPES",
    "Envelope",
    "Found",
    "MessageError",
    "Unpacker",
    "decode_bytes",
    "decode_string",
    "decode_transforms",
]


# What a calibration found among the packets is handed over as: a topic type of our own.
CORRECTION_TYPE = "mlbatch/HesaiCorrection"

_CORRECTION_MAGIC = b"\x47\x74\x05\x00"
_CORRECTION_HEAD_BYTES = 8
# First bytes of RoboSense packets that are shorter than the field, and their length.
_PADDED = ((b"\x55\xaa\x5a\xa5", 1210), (b"\xa5\xff\x00\x5a", 256))
_MOST_SHAPES = 64


@dataclass(frozen=True, slots=True)
class Found:
    """UDP payloads found in messages, in their order.

    start, size: (p,) int64, in the bytes given; host_ns: (p,) int64, arrival; message: (p,) int64,
    index of the message; untimed: packets took the log time of a message that holds many; faults:
    messages that could not be read, with why; corrections: message and bytes of calibrations;
    empty: packets without a byte.
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
                f"{topic.name}: wanted messages encoded as {' or '.join(ENCODINGS)}, "
                f"got {topic.encoding!r}; convert the recording"
            )
        try:
            types = definitions_of(topic)
            self._tracer = Tracer(types, topic.encoding, root, self._envelope)
        except MessageError as err:
            raise MessageError(f"{topic.name}: {err}") from err
        self._shapes: dict[int, list[Shape]] = {}
        self._known = 0

    def find(self, data: U8Array, begin: int, end: int, log_ns: int) -> Found:
        """The payloads of one message, `data[begin:end]`; MessageError where it is none."""
        one = (np.array([value], np.int64) for value in (begin, end, log_ns))
        found = self.find_many(data, *one)
        if found.faults:
            raise MessageError(f"{self.topic.name}: {found.faults[0][1]}")
        return found

    def find_many(self, data: U8Array, begin: I64Array, end: I64Array, log_ns: I64Array) -> Found:
        """The payloads of n messages `data[begin[i]:end[i]]`, recorded at `log_ns` (n,)."""
        parts: list[Found] = []
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
        """The shape of a message that fits none that is known; it is remembered."""
        try:
            shape = self._tracer.trace(data, begin, end)
        except EncapsulationError as err:
            # A topic that begins in another encoding holds nothing else.
            if not self._known:
                raise RecordingError(f"{self.topic.name}: {err}") from err
            raise
        if self._known % _MOST_SHAPES == 0:
            self._shapes = {}
        self._known += 1
        self._shapes.setdefault(end - begin, []).append(shape)
        return shape

    def _packets(
        self, data: U8Array, begin: I64Array, row: I64Array, shape: Shape, log_ns: I64Array
    ) -> Found:
        """The packets of messages `row` of one shape, which begin at `begin`."""
        count = len(shape.start)
        size = np.broadcast_to(shape.room, (len(row), count))
        if len(shape.size_at):
            # Packets never reach beyond the bytes that are there, whatever their size claims.
            size = np.minimum(u32(data, begin[:, None] + shape.size_at), size)
        host_ns = np.broadcast_to(log_ns[row, None], (len(row), count))
        untimed = self._tracer.many and host_ns.size > 0
        if len(shape.stamp_at):
            at = begin[:, None] + shape.stamp_at
            stamp_ns = u32(data, at) * NS_PER_S + u32(data, at + 4)
            untimed = self._tracer.many and bool((stamp_ns == 0).any())
            host_ns = np.where(stamp_ns == 0, host_ns, stamp_ns)
        start = (begin[:, None] + shape.start).ravel()
        return Found(start, size.ravel(), host_ns.ravel(), np.repeat(row, count), untimed)

    def _without_others(self, data: U8Array, found: Found) -> Found:
        """What was found without calibrations, padding and empty packets."""
        size = found.size
        if self._envelope.padded:
            size = _unpadded(data, found.start, size)
        keep = size > 0
        empty = len(keep) - int(keep.sum())
        corrections = []
        if self._envelope.corrections:
            for at in _begins_with(data, found.start, size, _CORRECTION_MAGIC).tolist():
                begin = int(found.start[at]) + _CORRECTION_HEAD_BYTES
                # The size counts the text alone, which stands behind the head.
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


def _joined(parts: Sequence[Found], faults: Sequence[tuple[int, str]]) -> Found:
    """Parts as one, in the order of messages."""
    none = np.zeros(0, np.int64)
    message = np.concatenate([none, *(part.message for part in parts)])
    order = np.argsort(message, kind="stable") if len(parts) > 1 else slice(None)
    return Found(
        np.concatenate([none, *(part.start for part in parts)])[order],
        np.concatenate([none, *(part.size for part in parts)])[order],
        np.concatenate([none, *(part.host_ns for part in parts)])[order],
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
    for magic, length in _PADDED:
        for at in _begins_with(data, start, size, magic).tolist():
            begin, end = int(start[at]) + length, int(start[at] + size[at])
            if not data[begin:end].any():
                size[at] = min(length, int(size[at]))
    return size
