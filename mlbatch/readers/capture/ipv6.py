"""IPv6 packets, one at a time: the chain of headers down to UDP.

Layouts: RFC 8200 (headers, fragments), RFC 4302 (authentication header), RFC 768 (UDP). Not read by
`dpkt.ip6`: it cuts the payload at the IP length, which some sensors announce wrongly; sees a
fragment only directly behind the fixed header; does not skip the headers 135, 139 and 140; and
copies the payload for every header of a chain of any length.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

_HEADER = struct.Struct(">IHBB16s16s")
_FRAGMENT = struct.Struct(">BBHI")
_UDP = struct.Struct(">HHHH")
_UDP_PROTOCOL = 17
_FRAGMENT_HEADER = 44
_AUTHENTICATION = 51
# Headers of two bytes: number of the next header, length in units of 8 bytes after the first 8.
_PLAIN_HEADERS = frozenset((0, 43, 60, 135, 139, 140))
# No sensor sends more headers; the bound keeps a crafted packet cheap.
_MOST_HEADERS = 16


class Packet(NamedTuple):
    """A UDP payload or a fragment: `size` bytes from `start`; source and destination: 16 bytes.

    port: destination port of a whole datagram; ident: number of the set of a fragment, or None.
    """

    source: bytes
    destination: bytes
    start: int
    size: int
    port: int = 0
    ident: int | None = None
    offset: int = 0
    more: bool = False


def dissect(data: memoryview, at: int, stop: int) -> Packet | str:
    """The UDP content of the packet at `at`, captured up to `stop`, or why there is none."""
    if at + _HEADER.size > stop:
        return "truncated"
    first, length, kind, _, source, destination = _HEADER.unpack_from(data, at)
    if first >> 28 != 6:
        return "not_ip"
    end = at + _HEADER.size + length
    at += _HEADER.size
    for _ in range(_MOST_HEADERS):
        if kind == _UDP_PROTOCOL:
            return _datagram(data, at, stop, source, destination)
        if kind == _FRAGMENT_HEADER:
            if at + _FRAGMENT.size > stop:
                return "truncated"
            kind, _, place, ident = _FRAGMENT.unpack_from(data, at)
            at += _FRAGMENT.size
            # A fragment that is the whole datagram (RFC 6946) is read like one.
            if place & ~6:
                return _fragment(source, destination, kind, place, ident, at, min(end, stop), end)
        elif kind in _PLAIN_HEADERS or kind == _AUTHENTICATION:
            if at + 2 > stop:
                return "truncated"
            next_kind = data[at]
            length_words = data[at + 1]
            at += (length_words + 2) * 4 if kind == _AUTHENTICATION else (length_words + 1) * 8
            kind = next_kind
        else:
            break
    return "not_udp"


def _datagram(
    data: memoryview, at: int, stop: int, source: bytes, destination: bytes
) -> Packet | str:
    if at + _UDP.size > stop:
        return "truncated"
    _, port, length, _ = _UDP.unpack_from(data, at)
    if length < _UDP.size or at + length > stop:
        return "truncated"
    return Packet(source, destination, at + _UDP.size, length - _UDP.size, port)


def _fragment(
    source: bytes,
    destination: bytes,
    kind: int,
    place: int,
    ident: int,
    at: int,
    stop: int,
    end: int,
) -> Packet | str:
    if kind != _UDP_PROTOCOL:
        return "not_udp"
    if end > stop or end <= at:
        return "truncated"
    return Packet(
        source, destination, at, end - at, ident=ident, offset=place & ~7, more=bool(place & 1)
    )
