"""The literal dissector: captured frames to UDP datagrams, one at a time, on plain bytes.

Headers: RFC 791 (IPv4), 8200 (IPv6), 4302 (authentication header), 6946 (atomic fragments), 768
(UDP), tcpdump.org/linktypes.html. Rules of fragments: the head of `readers/capture/dissector.py`.
"""

from __future__ import annotations

import ipaddress
import struct
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

SECOND_NS = 1_000_000_000
MAX_SETS = 2048
MAX_DATAGRAM = 65535
MAX_FRAME = 262144
TAGS = (0x8100, 0x88A8, 0x9100)
VERSIONS = {0x0800: 4, 0x86DD: 6}
# By the first or the last of four bytes.
FAMILIES = {2: 4, 10: 6, 24: 6, 28: 6, 30: 6}
# Bytes of the header, and place of the ethertype.
TYPED_LINKS = {1: (14, 12), 113: (16, 14), 276: (20, 0)}
FAMILY_LINKS = (0, 108)
RAW_LINKS = (12, 14, 101, 228, 229)
UDP = 17
FRAGMENT_HEADER = 44
AUTHENTICATION = 51
PLAIN_HEADERS = (0, 43, 60, 135, 139, 140)


class Frame(NamedTuple):
    """A captured frame; original: its bytes on the wire."""

    host_ns: int
    link: int
    data: bytes
    original: int


class Datagram(NamedTuple):
    """A UDP datagram with its header."""

    source: str
    data: bytes


class Piece(NamedTuple):
    """A fragment of one; key: source, destination, identification."""

    key: tuple[str, str, int]
    data: bytes
    offset: int
    more: bool


class Found(NamedTuple):
    """A payload as the pipeline sees it."""

    host_ns: int
    stream: str
    payload: bytes


# -- frames ---------------------------------------------------------------------------------------


def content(frame: Frame) -> Datagram | Piece | str:
    """What a frame contains, or why nothing."""
    found = _at_link(frame.data, frame.link)
    if len(frame.data) < frame.original and found not in ("not_ip", "not_udp"):
        return "truncated"
    return found


# What an IP packet may be in: of these frames only the literal bytes in tests say more.
ODD = "odd"
ODD_LINKS = (9, 50, 51)
ODD_TYPES = (0x8847, 0x8848, 0x8864)
TUNNELS = (4, 41, 47)


def _at_link(data: bytes, link: int) -> Datagram | Piece | str:
    if link in TYPED_LINKS:
        size, place = TYPED_LINKS[link]
        if len(data) < size:
            return "truncated"
        ethertype = int.from_bytes(data[place : place + 2], "big")
        rest = data[size:]
        for _ in range(8):
            if ethertype not in TAGS:
                break
            if len(rest) < 4:
                return "truncated"
            ethertype = int.from_bytes(rest[2:4], "big")
            rest = rest[4:]
        if ethertype in ODD_TYPES and rest:
            return ODD
        version = VERSIONS.get(ethertype)
    elif link in FAMILY_LINKS:
        if len(data) < 4:
            return "truncated"
        first, second, third, fourth = data[:4]
        version = None if second or third else FAMILIES.get(first | fourth)
        rest = data[4:]
        if rest and rest[0] >> 4 != version:
            return "not_ip"
    elif link in RAW_LINKS:
        if not data:
            return "truncated"
        version, rest = data[0] >> 4, data
    elif link in ODD_LINKS:
        return ODD if data else "truncated"
    else:
        return "not_ip"
    if version == 4:
        return _ipv4(rest)
    return _ipv6(rest) if version == 6 else "not_ip"


def _ipv4(data: bytes) -> Datagram | Piece | str:
    if len(data) < 20:
        return "truncated"
    first, _, length, ident, place, _, protocol, _, source, target = struct.unpack(
        ">BBHHHBBH4s4s", data[:20]
    )
    header = (first & 15) * 4
    if first >> 4 != 4 or header < 20:
        return "not_ip"
    offset, more = (place & 0x1FFF) * 8, bool(place & 0x2000)
    if protocol in TUNNELS and not offset and not more and len(data) > header:
        return ODD
    if protocol != UDP:
        return "not_udp"
    names = (str(ipaddress.IPv4Address(source)), str(ipaddress.IPv4Address(target)))
    if not offset and not more:
        return _udp(names[0], data[header:])
    if length <= header or length > len(data):
        return "truncated"
    return Piece((*names, ident), data[header:length], offset, more)


def _ipv6(data: bytes) -> Datagram | Piece | str:
    if len(data) < 40:
        return "truncated"
    if data[0] >> 4 != 6:
        return "not_ip"
    length, kind = struct.unpack(">HB", data[4:7])
    names = (str(ipaddress.IPv6Address(data[8:24])), str(ipaddress.IPv6Address(data[24:40])))
    at = 40
    for _ in range(16):
        if kind == UDP:
            return _udp(names[0], data[at:])
        if kind == FRAGMENT_HEADER:
            if len(data) < at + 8:
                return "truncated"
            kind, _, place, ident = struct.unpack(">BBHI", data[at : at + 8])
            at += 8
            offset, more = place & 0xFFF8, bool(place & 1)
            if not offset and not more:
                continue
            if kind != UDP:
                return "not_udp"
            if 40 + length <= at or 40 + length > len(data):
                return "truncated"
            return Piece((*names, ident), data[at : 40 + length], offset, more)
        if kind in TUNNELS and len(data) > at:
            return ODD
        if kind not in (*PLAIN_HEADERS, AUTHENTICATION):
            return "not_udp"
        if len(data) < at + 2:
            return "truncated"
        words = data[at + 1]
        size = (words + 2) * 4 if kind == AUTHENTICATION else (words + 1) * 8
        kind = data[at]
        at += size
    return "not_udp"


def _udp(source: str, data: bytes) -> Datagram | str:
    length = int.from_bytes(data[4:6], "big")
    if len(data) < 8 or length < 8 or length > len(data):
        return "truncated"
    return Datagram(source, data[:length])


# -- fragments ------------------------------------------------------------------------------------


@dataclass
class Set:
    """Fragments of a datagram so far: bytes by offset; total: its length, once known."""

    birth_ns: int
    parts: dict[int, bytes] = field(default_factory=dict)
    frames: int = 0
    total: int | None = None

    def fits(self, piece: Piece) -> bool:
        """Whether a piece neither overlaps the others nor contradicts the end."""
        end = piece.offset + len(piece.data)
        if end > (MAX_DATAGRAM if self.total is None else self.total):
            return False
        spans = [(at, at + len(part)) for at, part in self.parts.items()]
        if any(piece.offset < stop and begin < end for begin, stop in spans):
            return False
        return piece.more or (self.total is None and all(stop <= end for _, stop in spans))


class Dissector:
    """All frames of a capture, one after the other."""

    def __init__(self, max_sets: int = MAX_SETS) -> None:
        self.found: list[Found] = []
        self.skipped: Counter[str] = Counter()
        self.max_sets = max_sets
        self.now_ns = 0
        # Oldest first.
        self.sets: dict[tuple[str, str, int], Set] = {}

    def add(self, frame: Frame) -> None:
        """Count a frame, or deliver its datagram."""
        what = content(frame)
        if isinstance(what, str):
            self.skipped[what] += 1
        elif isinstance(what, Datagram):
            self._deliver(frame.host_ns, what)
        else:
            self._expire(frame.host_ns)
            self._join(frame.host_ns, what)

    def finish(self) -> None:
        """Count what was never completed."""
        for key in list(self.sets):
            self._drop(key)

    def _deliver(self, host_ns: int, datagram: Datagram) -> None:
        port, length = struct.unpack(">HH", datagram.data[2:6])
        payload = datagram.data[8:length]
        self.found.append(Found(host_ns, f"{datagram.source} > port {port}", payload))

    def _expire(self, host_ns: int) -> None:
        if self.now_ns - host_ns > SECOND_NS:
            self.finish()
            self.now_ns = host_ns
        self.now_ns = max(self.now_ns, host_ns)
        for key, held in list(self.sets.items()):
            if self.now_ns - held.birth_ns > SECOND_NS:
                self._drop(key)

    def _join(self, host_ns: int, piece: Piece) -> None:
        held = self.sets.get(piece.key)
        if held is not None and piece.offset in held.parts:
            is_last = piece.offset + len(piece.data) == held.total
            if held.parts[piece.offset] == piece.data and piece.more != is_last:
                held.frames += 1
                return
            if piece.offset == 0:
                self._drop(piece.key)
                held = None
        if held is None:
            if len(self.sets) == self.max_sets:
                self._drop(next(iter(self.sets)))
            held = self.sets[piece.key] = Set(self.now_ns)
        held.frames += 1
        if not held.fits(piece):
            self._drop(piece.key)
            return
        held.parts[piece.offset] = piece.data
        if not piece.more:
            held.total = piece.offset + len(piece.data)
        whole = b"".join(part for _, part in sorted(held.parts.items()))
        if len(whole) != held.total:
            return
        if len(held.parts[0]) < 8 or not 8 <= int.from_bytes(whole[4:6], "big") <= len(whole):
            self._drop(piece.key)
            return
        del self.sets[piece.key]
        self.skipped["fragment"] += held.frames - 1
        self._deliver(host_ns, Datagram(piece.key[0], whole))

    def _drop(self, key: tuple[str, str, int]) -> None:
        self.skipped["fragment_lost"] += self.sets.pop(key).frames


def dissect(
    frames: Iterable[Frame], max_sets: int = MAX_SETS
) -> tuple[list[Found], dict[str, int]]:
    """Payloads of frames in order of completion, and the other frames by reason."""
    dissector = Dissector(max_sets)
    for frame in frames:
        dissector.add(frame)
    dissector.finish()
    return dissector.found, {reason: count for reason, count in dissector.skipped.items() if count}


# -- pcap -----------------------------------------------------------------------------------------


def pcap_frames(content: bytes) -> Iterator[Frame]:
    """Frames of a pcap file, as far as its records are whole and believable."""
    order = "<" if content[:4] in (b"\xd4\xc3\xb2\xa1", b"\x4d\x3c\xb2\xa1") else ">"
    unit_ns = 1 if 0x4D in (content[0], content[3]) else 1000
    link = struct.unpack(order + "I", content[20:24])[0] & 0xFFFF
    at = 24
    while at + 16 <= len(content):
        seconds, fraction, captured, original = struct.unpack(order + "IIII", content[at : at + 16])
        is_nothing = not (seconds or fraction or captured or original)
        if is_nothing or captured > MAX_FRAME or at + 16 + captured > len(content):
            break
        host_ns = seconds * SECOND_NS + fraction * unit_ns
        yield Frame(host_ns, link, content[at + 16 : at + 16 + captured], original)
        at += 16 + captured
    if at < len(content):
        # What is left is one record that is cut off.
        yield Frame(0, link, b"", 0)
