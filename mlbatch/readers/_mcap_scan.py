"""The records in a stretch of an MCAP file: messages are found, channels learnt, the rest skipped.

Source: MCAP specification (mcap.dev/spec), facts/messages.md section 5.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.readers._bytes import records
from mlbatch.readers._mcap_bytes import MAX_RECORD_BYTES
from mlbatch.readers._mcap_records import HEAD, MESSAGE_HEAD_BYTES, Channels, Op
from mlbatch.types import Topic

_CHANNEL = struct.Struct("<H")
_MESSAGE = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_ns", "<i8"),
        ("publish_ns", "<i8"),
    ]
)
_MAX_DEFINITION_BYTES = 1 << 24
# Messages may be as short as their heads: so many places are kept at a time.
_MOST_STARTS = 1 << 18
# Records that stand outside chunks; the others may stand anywhere.
_OF_THE_FILE = (Op.CHUNK, Op.DATA_END, Op.FOOTER)
_SKIPPED = range(Op.CHUNK + 1, Op.DATA_END)


@dataclass(slots=True)
class Messages:
    """Messages of wanted channels in file order, (n,) int64 each.

    Message i is `data[begin[i] : end[i]]`; valid until the next ones are asked for.
    """

    data: U8Array
    channel: I64Array
    begin: I64Array
    end: I64Array
    log_ns: I64Array


@dataclass(slots=True)
class Stretch:
    """How far records could be walked: to byte `next`, which may lie behind the stretch.

    need: bytes that the record there takes, 0 if nothing is known to be missing; opcode: of a
    record there that only stands outside chunks, or 0; fault: why there is no going on; full: the
    messages found so far have to be gathered first.
    """

    next: int
    need: int = 0
    opcode: int = 0
    length: int = 0
    fault: str = ""
    full: bool = False


@dataclass(slots=True)
class Scanner:
    """Finds messages in bytes; `wants` tells which topics' messages are asked for."""

    wants: Callable[[Topic], bool]
    channels: Channels
    _wanted: BoolArray = field(default_factory=lambda: np.zeros(1 << 16, bool))

    def __post_init__(self) -> None:
        for number, topic in self.channels.topics.items():
            self._wanted[number] = self.wants(topic)

    def scan(self, data: U8Array, at: int, end: int, starts: list[int]) -> Stretch:
        """Walk over `data[at:end]`; places of whole messages are added to `starts`."""
        view = data.data
        while True:
            at = _messages(view, at, end, starts)
            if len(starts) >= _MOST_STARTS:
                return Stretch(at, full=True)
            if at + HEAD.size > end:
                return Stretch(at, HEAD.size if at < end else 0)
            opcode, length = HEAD.unpack_from(view, at)
            size = HEAD.size + length
            if opcode == Op.MESSAGE:
                if length < MESSAGE_HEAD_BYTES:
                    return Stretch(at, fault=f"wanted a message, got a record of {length} bytes")
                if at + HEAD.size + _CHANNEL.size > end:
                    return Stretch(at, size)
                [channel] = _CHANNEL.unpack_from(view, at + HEAD.size)
                if self._wanted[channel]:
                    return Stretch(at, size, fault=too_long(length, MAX_RECORD_BYTES))
            elif opcode in (Op.SCHEMA, Op.CHANNEL):
                if at + size > end:
                    return Stretch(at, size, fault=too_long(length, _MAX_DEFINITION_BYTES))
                if not self._learn(opcode, bytes(view[at + HEAD.size : at + size])):
                    return Stretch(at, fault=f"wanted a {Op(opcode).name.lower()}, got garbage")
            elif opcode in _OF_THE_FILE:
                return Stretch(at, opcode=opcode, length=length)
            elif opcode not in _SKIPPED and opcode != Op.HEADER and opcode < Op.PRIVATE:
                return Stretch(at, fault=f"wanted a record, got one of kind 0x{opcode:02x}")
            at += size

    def gather(self, data: U8Array, starts: list[int]) -> Iterator[Messages]:
        """Those of the messages at `starts` that are wanted; `starts` is then empty."""
        if not starts:
            return
        at = np.array(starts, np.int64)
        starts.clear()
        head = records(data, _MESSAGE, at)
        wanted = self._wanted[head["channel"]]
        if not wanted.all():
            at, head = at[wanted], head[wanted]
        if len(at):
            end = at + head["length"].astype(np.int64) + HEAD.size
            channel = head["channel"].astype(np.int64)
            log_ns = head["log_ns"].astype(np.int64)
            yield Messages(data, channel, at + _MESSAGE.itemsize, end, log_ns)

    def _learn(self, opcode: int, body: bytes) -> bool:
        """Take in a schema or a channel; False if it is none."""
        # Many recorders repeat them in every chunk.
        if self.channels.knows(opcode, body):
            return True
        if not self.channels.add(opcode, body):
            return False
        if opcode == Op.CHANNEL:
            [number] = _CHANNEL.unpack_from(body)
            self._wanted[number] = self.wants(self.channels.topics[number])
        return True


def _messages(view: memoryview, at: int, end: int, starts: list[int]) -> int:
    """Step over whole messages from `at` on; the place of the first record that is none."""
    head_at, last = HEAD.unpack_from, end - HEAD.size - MESSAGE_HEAD_BYTES
    for _ in range(_MOST_STARTS - len(starts)):
        if at > last:
            break
        opcode, length = head_at(view, at)
        after = at + 9 + length
        if opcode != 5 or after > end or length < MESSAGE_HEAD_BYTES:
            break
        starts.append(at)
        at = after
    return at


def too_long(length: int, limit: int) -> str:
    """What is wrong with a record of this length; empty if nothing is."""
    if length <= limit:
        return ""
    return f"wanted a record of at most {limit} bytes, got one of {length}"
