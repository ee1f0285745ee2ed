"""pcapng files: sections of either byte order, interfaces of any link type and time resolution.

Layout: draft-ietf-opsawg-pcapng; sections 4.1 (section header), 4.2 (interface), 4.3 (enhanced
packet), 4.4 (simple packet), appendix A (old packet). Other blocks are skipped by their length.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import I64Array, U8Array
from mlbatch.readers.byte_records import records
from mlbatch.readers.capture.frames import NO_LINK, Frames
from mlbatch.readers.capture.recording import MAX_BLOCK_BYTES, CaptureRecording, Walk
from mlbatch.readers.source import read_head
from mlbatch.types import Recording, StreamTable
from mlbatch.units import NS_PER_S

CONTAINER = "pcapng"

U64Array: TypeAlias = npt.NDArray[np.uint64]

# Block types.
_SECTION = 0x0A0D0D0A
_INTERFACE = 1
_OLD_PACKET = 2
_SIMPLE = 3
_ENHANCED = 6
_PACKETS = frozenset((_OLD_PACKET, _SIMPLE, _ENHANCED))
_NEEDED = _PACKETS | {_SECTION, _INTERFACE}
_ORDERS = {b"\x4d\x3c\x2b\x1a": "<", b"\x1a\x2b\x3c\x4d": ">"}
_MAGIC_AT = 8
_LEAST_BLOCK_BYTES = 12
_OPTIONS_AT = 16
# Options if_tsresol and if_tsoffset (section 4.2).
_TSRESOL = 9
_TSOFFSET = 14
# Bytes of a packet block around its frame, and place of the frame.
_ENHANCED_BYTES = 32
_ENHANCED_FRAME_AT = 28
_SIMPLE_BYTES = 16
_SIMPLE_FRAME_AT = 12
# if_tsresol: exponent of 2 instead of 10.
_BINARY = 0x80
# Up to here the nanoseconds of a second times the ticks of a second are below 2^64.
_MOST_EXACT = 1 << 34
# Stamps beyond int64 nanoseconds come from damaged files; they are set to the bound.
_MOST_S = (1 << 63) // NS_PER_S - 1


def recognises(head: bytes) -> bool:
    """Whether a file that begins with `head` is a pcapng file."""
    return head[:4] == _SECTION.to_bytes(4, "big") and head[_MAGIC_AT:12] in _ORDERS


def open_packets(path: Path, streams: StreamTable) -> Recording:
    """Open a pcapng file; its payloads come from streams (source IP, destination port)."""
    read_head(path)
    size_bytes = path.stat().st_size
    return CaptureRecording(path, CONTAINER, size_bytes, _Walker, streams)


@dataclass(frozen=True, slots=True)
class Resolution:
    """Time resolution of an interface: ticks in a second, and the seconds at tick 0."""

    per_second: int
    offset_s: int

    @classmethod
    def of(cls, code: int, offset_s: int) -> Resolution:
        """From if_tsresol: n for 10^-n s, or 0x80 | n for 2^-n s."""
        exponent = code & ~_BINARY
        return cls((2 if code & _BINARY else 10) ** exponent, offset_s)

    def ns(self, ticks: U64Array) -> I64Array:
        """(n,) int64 nanoseconds of (n,) ticks, exact, rounded down."""
        if self.per_second > _MOST_EXACT:
            return self._slow_ns(ticks)
        per_second = np.uint64(self.per_second)
        seconds = ticks // per_second
        rest_ns = (ticks % per_second) * np.uint64(NS_PER_S) // per_second
        # Bounded so that the sum of both stays within int64.
        whole = np.minimum(seconds, np.uint64(1 << 62)).astype(np.int64)
        offset_s = min(max(self.offset_s, -(1 << 61)), 1 << 61)
        whole_ns: I64Array = np.clip(whole + offset_s, -_MOST_S, _MOST_S) * NS_PER_S
        whole_ns += rest_ns.astype(np.int64)
        return whole_ns

    def _slow_ns(self, ticks: U64Array) -> I64Array:
        bound_ns = _MOST_S * NS_PER_S
        exact = [
            tick * NS_PER_S // self.per_second + self.offset_s * NS_PER_S for tick in ticks.tolist()
        ]
        return np.array([min(max(ns, -bound_ns), bound_ns) for ns in exact], np.int64)


@dataclass(frozen=True, slots=True)
class _Interface:
    """An interface; snaplen 0 means no limit."""

    link: int
    snaplen: int
    resolution: Resolution


@dataclass(slots=True)
class _Walker:
    """Steps from block to block; keeps the section's byte order and interfaces."""

    order: str = "<"
    interfaces: list[_Interface] = field(default_factory=list)

    def walk(self, data: U8Array, begin: int, end: int) -> Walk:
        """The frames of `data[begin:end]`, at most up to the end of a section."""
        starts: list[int] = []
        stop = self._step(data.data, begin, end, starts)
        stop.frames = self._frames(data, np.array(starts, np.int64))
        return stop

    def _step(self, view: memoryview, begin: int, end: int, starts: list[int]) -> Walk:
        """Add the packet blocks from `begin` on to `starts`; where and why this ends."""
        at = begin
        head = struct.Struct(self.order + "II").unpack_from
        while at + _LEAST_BLOCK_BYTES <= end:
            kind, length = head(view, at)
            if kind == _SECTION:
                if starts:
                    # Its interfaces replace those of the frames before it.
                    break
                self.order = _ORDERS.get(bytes(view[at + _MAGIC_AT : at + 12]), self.order)
                head = struct.Struct(self.order + "II").unpack_from
                kind, length = head(view, at)
            if length < _LEAST_BLOCK_BYTES or length % 4:
                return Walk(at, fault=f"expected the length of a block, found {length}")
            if kind in _NEEDED:
                if length > MAX_BLOCK_BYTES:
                    fault = f"expected a block of at most {MAX_BLOCK_BYTES} bytes, found {length}"
                    return Walk(at, fault=fault)
                if at + length > end:
                    return Walk(at, length, kind in _PACKETS)
                if kind in _PACKETS:
                    starts.append(at)
                else:
                    self._learn(kind, bytes(view[at : at + length]))
            at += length
        need = 0 if starts and at + _LEAST_BLOCK_BYTES <= end else _LEAST_BLOCK_BYTES
        return Walk(at, need, is_frame=False)

    def _learn(self, kind: int, block: bytes) -> None:
        if kind == _SECTION:
            self.interfaces = []
        elif len(block) >= _OPTIONS_AT + 4:
            link, _, snaplen = struct.unpack_from(self.order + "HHI", block, 8)
            resolution = self._resolution(block[_OPTIONS_AT:-4])
            self.interfaces.append(_Interface(link, snaplen, resolution))

    def _resolution(self, options: bytes) -> Resolution:
        resolution = 6
        offset_s = 0
        at = 0
        while at + 4 <= len(options):
            code, length = struct.unpack_from(self.order + "HH", options, at)
            value = options[at + 4 : at + 4 + length]
            if code == _TSRESOL and len(value) == 1:
                resolution = value[0]
            elif code == _TSOFFSET and len(value) == 8:
                offset_s = struct.unpack(self.order + "q", value)[0]
            at += 4 + length + -length % 4
        return Resolution.of(resolution, offset_s)

    def _frames(self, data: U8Array, at: I64Array) -> Frames:
        names = ("kind", "length", "interface", "high", "low", "captured", "original")
        block = records(data, np.dtype([(name, self.order + "u4") for name in names]), at)
        field = {name: block[name].astype(np.int64) for name in names}
        interface = field["interface"]
        start = at + _ENHANCED_FRAME_AT
        room = field["length"] - _ENHANCED_BYTES
        simple = field["kind"] == _SIMPLE
        if simple.any():
            field["original"][simple] = interface[simple]
            interface[simple] = 0
            start[simple] = at[simple] + _SIMPLE_FRAME_AT
            room[simple] = field["length"][simple] - _SIMPLE_BYTES
            field["captured"][simple] = self._simple_sizes(field["original"][simple], room[simple])
        old = field["kind"] == _OLD_PACKET
        if old.any():
            # A 16-bit number and a 16-bit drop count in place of the 32-bit number.
            interface[old] = interface[old] >> 16 if self.order == ">" else interface[old] & 0xFFFF
        # A block that claims more bytes than it has is cut: it counts as truncated.
        captured = np.clip(field["captured"], 0, np.maximum(room, 0))
        field["original"] = np.maximum(field["original"], field["captured"])
        ticks = block["high"].astype(np.uint64) << np.uint64(32) | block["low"].astype(np.uint64)
        host_ns = self._host_ns(interface, ticks)
        host_ns[simple] = 0
        return Frames(start, captured, field["original"], self._links(interface), host_ns)

    def _simple_sizes(self, original: I64Array, room: I64Array) -> I64Array:
        """Captured bytes of simple packets, which do not state them and may be padded."""
        limit = self.interfaces[0].snaplen if self.interfaces else 0
        size = np.minimum(original, room)
        return np.minimum(size, limit) if limit else size

    def _links(self, interface: I64Array) -> I64Array:
        table = np.array([*(known.link for known in self.interfaces), NO_LINK], np.int64)
        links: I64Array = table[np.minimum(interface, len(self.interfaces))]
        return links

    def _host_ns(self, interface: I64Array, ticks: U64Array) -> I64Array:
        host_ns = np.zeros(len(ticks), np.int64)
        for number in np.unique(interface).tolist():
            if number < len(self.interfaces):
                rows = interface == number
                host_ns[rows] = self.interfaces[number].resolution.ns(ticks[rows])
        return host_ns
