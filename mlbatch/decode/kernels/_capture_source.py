"""A kernel that reads captures: records to frames, frames to datagrams and fragments, and copies.

Layouts: draft-ietf-opsawg-pcap, section 5; RFC 791 (IPv4); RFC 768 (UDP). What is judged here is
what `readers/_frames.py` says of the same frames; all that is seldom is left to it.
"""

from __future__ import annotations

from collections.abc import Callable

from mlbatch.decode.kernels import capture as at
from mlbatch.decode.kernels._primitives import Pointer, i8_at, moved, piece, u1_at

_RECORD_BYTES, _ETHERNET_BYTES, _IP_BYTES, _UDP_BYTES = 16, 14, 20, 8
_IPV4_TYPE, _UDP = 0x0800, 17
_MORE, _OFFSET = 0x2000, 0x1FFF
_NS_PER_S = 1_000_000_000


def build() -> Callable[[Pointer], int]:
    """Takes the frame of `capture.py`; what it gives is said there for each task."""
    walk, dissect, copy = _walk(), _dissect(), _copy()

    def kernel(frame: Pointer) -> int:
        if frame[at.TASK] == at.WALK:
            return walk(frame)
        if frame[at.TASK] == at.DISSECT:
            return dissect(frame)
        return copy(frame)

    return kernel


@piece
def _low(byte: Pointer, place: int) -> int:
    """Four bytes, the low one first."""
    value = 0
    for number in range(4):
        value |= byte[place + number] << (8 * number)
    return value


@piece
def _high(byte: Pointer, place: int, count: int) -> int:
    """Two or four bytes, the high one first."""
    value = 0
    for number in range(count):
        value = value << 8 | byte[place + number]
    return value


def _walk() -> Callable[[Pointer], int]:
    """From record to record of a pcap file: where frames lie, until something is not usual."""

    low, high = _low, _high

    @piece
    def word(byte: Pointer, place: int, is_swapped: int) -> int:
        return high(byte, place, 4) if is_swapped != 0 else low(byte, place)

    @piece
    def walk(frame: Pointer) -> int:
        byte, swapped = u1_at(frame[at.BYTES]), frame[at.IS_SWAPPED]
        starts, sizes = i8_at(frame[at.START]), i8_at(frame[at.CAPTURED])
        originals, hosts = i8_at(frame[at.ORIGINAL]), i8_at(frame[at.HOST_NS])
        place, end, count = frame[at.BEGIN], frame[at.END], 0
        why = at.NO_ROOM
        while count < frame[at.ROOM]:
            if place + _RECORD_BYTES > end:
                why = at.CUT
                break
            size = word(byte, place + 8, swapped)
            if size > frame[at.MOST_BYTES]:
                why = at.TOO_LONG
                break
            if place + _RECORD_BYTES + size > end:
                why = at.CUT
                break
            starts[count], sizes[count] = place + _RECORD_BYTES, size
            originals[count] = word(byte, place + 12, swapped)
            fraction = word(byte, place + 4, swapped) * frame[at.UNIT_NS]
            hosts[count] = word(byte, place, swapped) * _NS_PER_S + fraction
            place += _RECORD_BYTES + size
            count += 1
        frame[at.NEXT], frame[at.WHY] = place, why
        return count

    return walk


def _dissect() -> Callable[[Pointer], int]:
    """Frames of Ethernet, IPv4 and UDP to datagrams and fragments; all others are left over."""

    high, add_datagram, add_fragment = _high, _add_datagram, _add_fragment

    @piece
    def dissect(frame: Pointer) -> int:
        byte, size = u1_at(frame[at.BYTES]), frame[at.SIZE_BYTES]
        starts, sizes = i8_at(frame[at.START]), i8_at(frame[at.CAPTURED])
        originals, others = i8_at(frame[at.ORIGINAL]), i8_at(frame[at.OTHERS])
        datagrams, fragments, rest = 0, 0, 0
        for number in range(frame[at.FRAMES]):
            start, captured, kind = starts[number], sizes[number], 0
            is_there = start >= 0 and captured >= 0 and start <= size and captured <= size - start
            stop = start + captured
            least = _ETHERNET_BYTES + _IP_BYTES + _UDP_BYTES
            if is_there and least <= captured and originals[number] <= captured:
                packet = start + _ETHERNET_BYTES
                body = packet + (byte[packet] & 15) * 4
                is_udp = high(byte, start + 12, 2) == _IPV4_TYPE and byte[packet] >> 4 == 4
                is_udp = is_udp and byte[packet + 9] == _UDP
                if is_udp and packet + _IP_BYTES <= body and body + _UDP_BYTES <= stop:
                    place = high(byte, packet + 6, 2) & (_MORE | _OFFSET)
                    if place == 0:
                        kind = add_datagram(frame, number, packet, body, stop, datagrams)
                        datagrams += kind
                    else:
                        kind = add_fragment(frame, number, packet, body, stop, fragments)
                        fragments += kind
            if kind == 0:
                others[rest] = number
                rest += 1
        frame[at.FRAGMENTS_FOUND], frame[at.OTHERS_FOUND] = fragments, rest
        return datagrams

    return dissect


@piece
def _add_datagram(frame: Pointer, number: int, packet: int, body: int, stop: int, row: int) -> int:
    """Note a whole datagram as number `row`; 0 if its length is wrong."""
    byte, room = u1_at(frame[at.BYTES]), frame[at.FRAMES]
    size = _high(byte, body + 4, 2)
    if size < _UDP_BYTES or body + size > stop:
        return 0
    out = moved(i8_at(frame[at.DATAGRAMS]), row)
    out[0], out[room] = number, body + _UDP_BYTES
    out[2 * room] = size - _UDP_BYTES
    out[3 * room] = _high(byte, packet + 12, 4)
    out[4 * room] = _high(byte, body + 2, 2)
    return 1


@piece
def _add_fragment(frame: Pointer, number: int, packet: int, body: int, stop: int, row: int) -> int:
    """Note a fragment as number `row`; 0 if its length is wrong."""
    byte, room = u1_at(frame[at.BYTES]), frame[at.FRAMES]
    end, place = packet + _high(byte, packet + 2, 2), _high(byte, packet + 6, 2)
    if end <= body or end > stop:
        return 0
    out = moved(i8_at(frame[at.FRAGMENTS]), row)
    out[0], out[room] = number, _high(byte, packet + 12, 4)
    out[2 * room], out[3 * room] = _high(byte, packet + 16, 4), _high(byte, packet + 4, 2)
    out[4 * room], out[5 * room] = (place & _OFFSET) * 8, 1 if place & _MORE != 0 else 0
    out[6 * room], out[7 * room] = body, end - body
    return 1


def _copy() -> Callable[[Pointer], int]:
    """Fragments to their places; nothing is looked at."""

    @piece
    def copy(frame: Pointer) -> int:
        source_at, target_at = i8_at(frame[at.SOURCE_AT]), i8_at(frame[at.TARGET_AT])
        sizes = i8_at(frame[at.RUN_BYTES])
        for number in range(frame[at.RUNS]):
            source = u1_at(frame[at.SOURCE] + source_at[number])
            target = u1_at(frame[at.TARGET] + target_at[number])
            for place in range(sizes[number]):
                target[place] = source[place]
        return 0

    return copy
