"""Records of ROS 1 bags, many at once where their headers differ in values alone.

Source: wiki.ros.org/Bags/Format/2.0; facts/messages.md, section 5. A record is a header of
`name=value` fields with a length before it, and data with a length before them.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.readers._bytes import records
from mlbatch.readers._definitions import type_key
from mlbatch.types import Topic
from mlbatch.units import NS_PER_S

_U32 = struct.Struct("<I")
_WORD_BYTES = 4
# The field `op=` with the length of a value of one byte before it.
_OP = b"\x04\0\0\0op="
# A header holds the name of a topic at most.
MAX_HEAD_BYTES = 1 << 20
# The field that tells what a record is.
LEAST_HEAD_BYTES = len(_OP) + 1


# Records may be as short as their lengths: so many are kept at a time.
MOST_RECORDS = 1 << 18


class Op(IntEnum):
    """What a record is."""

    MESSAGE = 2
    BAG = 3
    INDEX = 4
    CHUNK = 5
    CHUNK_INFO = 6
    CONNECTION = 7


class HeadError(ValueError):
    """Bytes that are no header."""


def head_fields(raw: bytes) -> dict[str, bytes]:
    """Fields of a header."""
    return {
        raw[name:begin].rstrip(b"=").decode("latin-1"): raw[begin:end]
        for name, begin, end in _places(raw)
    }


def _places(raw: bytes) -> list[tuple[int, int, int]]:
    """Where the fields of a header lie: begin of the name, begin and end of the value."""
    found, at = [], 0
    while at < len(raw):
        if at + _WORD_BYTES > len(raw):
            raise HeadError("a field without a length")
        end = at + _WORD_BYTES + _U32.unpack_from(raw, at)[0]
        equals = raw.find(b"=", at + _WORD_BYTES, end)
        if end > len(raw) or equals < 0:
            raise HeadError("a field that is longer than its header, or has no value")
        found.append((at + _WORD_BYTES, equals + 1, end))
        at = end
    return found


def number(fields: dict[str, bytes], name: str) -> int:
    """The value of a field that holds a little-endian number."""
    if name not in fields or len(fields[name]) not in (1, 4, 8):
        raise HeadError(f"no number {name!r}")
    return int.from_bytes(fields[name], "little")


def op_of(raw: bytes) -> int:
    """What a record with this header is; quicker than reading all fields."""
    at = raw.find(_OP)
    if at < 0:
        raise HeadError("a record that does not say what it is")
    return raw[at + len(_OP)] if at + len(_OP) < len(raw) else 0


def connection_topic(fields: dict[str, bytes], data: bytes) -> tuple[int, Topic]:
    """Number and topic of a connection, from its record's header and data."""
    about = head_fields(data)
    texts = {name: value.decode("utf-8", "replace") for name, value in about.items()}
    topic = fields.get("topic", about.get("topic", b"")).decode("utf-8", "replace")
    if not topic or "type" not in texts:
        raise HeadError("a connection without topic or type")
    return number(fields, "conn"), Topic(
        topic,
        type_key(texts["type"]),
        "ros1",
        texts.get("message_definition", ""),
        "ros1msg",
        latched=texts.get("latching") == "1",
    )


@dataclass(frozen=True, slots=True)
class Walked:
    """Records in a row, (n,) int64 each: where header and data lie; all before `next` are whole."""

    head: I64Array
    head_size: I64Array
    data: I64Array
    data_size: I64Array
    next: int

    def take(self, index: I64Array) -> Walked:
        """The records at `index`."""
        head, head_size = self.head[index], self.head_size[index]
        return Walked(head, head_size, self.data[index], self.data_size[index], self.next)


def joined(parts: Sequence[Walked]) -> Walked:
    """Records of several stretches of one array."""
    if len(parts) == 1:
        return parts[0]
    none = np.zeros(0, np.int64)
    return Walked(
        np.concatenate([none, *(part.head for part in parts)]),
        np.concatenate([none, *(part.head_size for part in parts)]),
        np.concatenate([none, *(part.data for part in parts)]),
        np.concatenate([none, *(part.data_size for part in parts)]),
        parts[-1].next if parts else 0,
    )


def walk(data: U8Array, begin: int, end: int) -> Walked:
    """The whole records of `data[begin:end]`, at most MOST_RECORDS of them."""
    heads, bodies = [], []
    view, length_at, at = data.data, _U32.unpack_from, begin
    for _ in range(MOST_RECORDS):
        if at + _WORD_BYTES > end:
            break
        head_size = length_at(view, at)[0]
        body = at + _WORD_BYTES + head_size
        # Zeros would be records without a header, very many of them.
        if body + _WORD_BYTES > end or head_size < LEAST_HEAD_BYTES:
            break
        after = body + _WORD_BYTES + length_at(view, body)[0]
        if after > end:
            break
        heads.append(at)
        bodies.append(body)
        at = after
    head = np.array(heads, np.int64) + _WORD_BYTES
    body_at = np.array(bodies, np.int64)
    data_at = body_at + _WORD_BYTES
    following = np.append(head[1:] - _WORD_BYTES, at)[: len(head)]
    return Walked(head, body_at - head, data_at, following - data_at, at)


@dataclass(frozen=True, slots=True)
class _Template:
    """A header of a message; others of its length with the same fixed bytes are read like it."""

    fixed: I64Array
    value: U8Array
    connection_at: int
    time_at: int

    @classmethod
    def of(cls, raw: bytes) -> _Template | None:
        """From one header; None if it is not that of a message."""
        places = {raw[name : begin - 1]: (begin, end) for name, begin, end in _places(raw)}
        connection, time = places.get(b"conn", (0, 0)), places.get(b"time", (0, 0))
        op = places.get(b"op", (0, 0))
        if raw[op[0] : op[1]] != bytes([Op.MESSAGE]):
            return None
        if connection[1] - connection[0] != 4 or time[1] - time[0] != 8:
            raise HeadError("a message without connection or time")
        fixed = np.ones(len(raw), bool)
        fixed[slice(*connection)] = fixed[slice(*time)] = False
        at = np.flatnonzero(fixed)
        return cls(at, np.frombuffer(raw, np.uint8)[at], connection[0], time[0])


@dataclass(frozen=True, slots=True)
class Heads:
    """What the headers of n records say: is_message (n,) bool; connection, log_ns: (n,) int64."""

    is_message: BoolArray
    connection: I64Array
    log_ns: I64Array


@dataclass(slots=True)
class HeadReader:
    """Reads headers, and remembers those of messages by their length."""

    _templates: dict[int, list[_Template]] = field(default_factory=dict)

    def read(self, data: U8Array, walked: Walked) -> Heads:
        """Headers of records; HeadError where one is damaged."""
        count = len(walked.head)
        heads = Heads(np.zeros(count, bool), np.zeros(count, np.int64), np.zeros(count, np.int64))
        for size in np.unique(walked.head_size).tolist():
            rows = np.flatnonzero(walked.head_size == size)
            if size:
                self._read_equal(data, walked.head[rows], size, rows, heads)
        return heads

    def _read_equal(
        self, data: U8Array, begin: I64Array, size: int, rows: I64Array, heads: Heads
    ) -> None:
        """Headers of one length."""
        raw = records(data, np.dtype([("byte", "u1", (size,))]), begin)["byte"]
        known = self._templates.setdefault(size, [])
        tried = 0
        while len(rows):
            if tried == len(known):
                template = _Template.of(raw[0].tobytes())
                if template is None:
                    raw, rows = raw[1:], rows[1:]
                    continue
                known.append(template)
            template = known[tried]
            tried += 1
            fits = (raw[:, template.fixed] == template.value).all(axis=1)
            words = np.ascontiguousarray(raw[fits])
            heads.is_message[rows[fits]] = True
            heads.connection[rows[fits]] = _u32(words, template.connection_at)
            seconds, rest_ns = (_u32(words, template.time_at + part) for part in (0, 4))
            heads.log_ns[rows[fits]] = seconds * NS_PER_S + rest_ns
            raw, rows = raw[~fits], rows[~fits]


def _u32(rows: U8Array, at: int) -> I64Array:
    """Little-endian words at byte `at` of each row."""
    word: I64Array = np.ascontiguousarray(rows[:, at : at + 4]).view("<u4")[:, 0].astype(np.int64)
    return word
