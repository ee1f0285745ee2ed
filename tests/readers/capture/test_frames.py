"""Frames of every kind: the same payloads, reasons and order as by the literal dissector."""

from __future__ import annotations

import random
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mlbatch.readers.capture import frames as _frames
from mlbatch.readers.capture.dissector import MAX_DATAGRAM_BYTES, Dissector
from mlbatch.readers.capture.frames import Frames
from mlbatch.types import CaptureCounts, StreamTable
from tests.builders.captures import ipv4_packet, ipv6_packet, link_frame, udp_frame
from tests.reference import capture as reference
from tests.reference.capture import ODD, Frame, content, dissect

_PAYLOAD = bytes(range(100, 110))
_ETHERNET = 1
LINKS = (*reference.TYPED_LINKS, *reference.FAMILY_LINKS, *reference.RAW_LINKS)


def found(frames: list[Frame], portions: int = 1) -> list[object]:
    """Payloads and skipped frames, in so many calls; the frames end with their array."""
    counts, streams = CaptureCounts(), StreamTable()
    dissector = Dissector(counts, streams)
    seen = []
    for number in range(portions):
        some = frames[number * len(frames) // portions : (number + 1) * len(frames) // portions]
        captured = np.array([len(one.data) for one in some], np.int64)
        front = len(some) * MAX_DATAGRAM_BYTES
        data = np.zeros(front + int(captured.sum()), np.uint8)
        data[front:] = np.frombuffer(b"".join(one.data for one in some), np.uint8)
        original, link, host_ns = (
            np.array([getattr(one, name) for one in some], np.int64)
            for name in ("original", "link", "host_ns")
        )
        start = front + captured.cumsum() - captured
        datagrams, _ = dissector.push(data, Frames(start, captured, original, link, host_ns))
        rows = zip(*(column.tolist() for column in datagrams), strict=True)
        seen += [
            (at_ns, str(streams.streams[stream]), data[at : at + size].tobytes())
            for at, size, stream, at_ns in rows
        ]
    dissector.finish()
    assert counts.frames == len(frames) == counts.datagrams + sum(counts.skipped.values())
    return [seen, counts.skipped]


def check(frames: list[Frame], portions: int = 1) -> None:
    """The literal dissector finds the same, but in odd frames, which it does not open."""
    frames = [frame for frame in frames if content(frame) != ODD]
    seen, skipped = dissect(frames)
    assert found(frames, portions) == [[tuple(one) for one in seen], skipped]


def whole(data: bytes, link: int = _ETHERNET) -> Frame:
    """A frame that is captured as it was sent."""
    return Frame(5, link, data, len(data))


def test_link_types_are_those_of_the_reference() -> None:
    assert {*LINKS, *reference.ODD_LINKS} == _frames.LINKS


def kinds() -> list[bytes]:
    """Ethernet frames with every header that is read."""
    udp = struct.pack(">HHHH", 5000, 7502, 8 + len(_PAYLOAD), 0) + _PAYLOAD
    chain = bytes([60, 0, *bytes(6)]) + bytes([51, 1, *bytes(14)]) + bytes([44, 1, *bytes(10)])
    chain += struct.pack(">BBHI", 17, 0, 0, 9) + udp
    return [
        udp_frame(_PAYLOAD)[0],
        udp_frame(_PAYLOAD, vlans=[0x88A8, 0x8100])[0],
        udp_frame(bytes(80), mtu=60)[0],
        link_frame(ipv4_packet(udp, "10.0.0.1", "10.0.0.2", options=bytes(8))),
        udp_frame(_PAYLOAD, "fe80::1", "fe80::2")[0],
        udp_frame(bytes(80), "fe80::1", "fe80::2", mtu=100)[0],
        link_frame(ipv6_packet(chain, "fe80::1", "fe80::2", next_header=0), version=6),
    ]


@pytest.mark.parametrize("kind", range(7))
def test_frames_with_any_byte_changed_and_cut_anywhere(kind: int) -> None:
    frame = kinds()[kind]
    changed = []
    for at in range(len(frame)):
        for value in range(256) if at < 64 else (0, 255):
            one = bytearray(frame)
            one[at] = value
            changed.append(whole(bytes(one)))
    cut = [Frame(5, _ETHERNET, frame[:size], len(frame)) for size in range(len(frame))]
    short = [whole(frame[:size]) for size in range(len(frame))]
    for frames in (changed, cut, short):
        for at in range(0, len(frames), 400):
            check(frames[at : at + 400])


@pytest.mark.parametrize("link", [*LINKS, 127, -1])
def test_frames_of_another_link_type_cut_anywhere(link: int) -> None:
    pick = random.Random(link)
    for frame in (*kinds(), *(link_frame(one[14:], link=link) for one in kinds())):
        sizes = range(len(frame) + 1)
        check([whole(frame[:size], link) for size in sizes])
        check([Frame(5, link, frame[:size], len(frame)) for size in sizes])
        changed = []
        for _ in range(200):
            one = bytearray(frame)
            one[pick.randrange(min(len(one), 30))] = pick.choice(
                [0, 2, 10, 24, 30, 0x45, 0x60, 255]
            )
            changed.append(whole(bytes(one), link))
        check(changed)


def _chained(headers: int) -> bytes:
    """A frame with so many headers of IPv6."""
    udp = struct.pack(">HHHH", 5000, 7502, 8 + len(_PAYLOAD), 0) + _PAYLOAD
    chain = bytes([0, 0, *bytes(6)]) * (headers - 1) + bytes([17, 0, *bytes(6)]) + udp
    return link_frame(ipv6_packet(chain, "fe80::1", "fe80::2", next_header=0), version=6)


@pytest.mark.parametrize(
    ("frame", "is_read"),
    [
        *((udp_frame(_PAYLOAD, vlans=[0x8100] * tags)[0], tags <= 8) for tags in range(7, 11)),
        *((_chained(headers), headers <= 15) for headers in range(14, 18)),
    ],
)
def test_eight_tags_and_fifteen_headers_of_ipv6_are_skipped(frame: bytes, is_read: bool) -> None:
    check([whole(frame)])
    assert len(found([whole(frame)])[0]) == is_read  # type: ignore[arg-type]


def test_addresses_of_both_versions_are_different_streams() -> None:
    frames = [
        whole(udp_frame(b"x", source, "::9" if ":" in source else "10.0.0.9")[0])
        for source in ("1.2.3.4", "::102:304", "::ffff:1.2.3.4", "1.2.3.4")
    ]
    check(frames)
    (seen, _) = found(frames)
    assert len({stream for _, stream, _ in seen}) == 3  # type: ignore[attr-defined]


@st.composite
def traffic(draw: st.DrawFn) -> list[Frame]:
    """Frames of any link type, tags, version and size, in fragments that arrive in any order."""
    pick = random.Random(draw(st.integers(0, 2**32)))
    waiting: list[Frame] = []
    for _ in range(draw(st.integers(0, 15))):
        link = pick.choice([_ETHERNET, _ETHERNET, *LINKS])
        six = pick.random() < 0.4
        pair = (f"fe80::{pick.randint(1, 2)}", "fe80::9") if six else ("10.0.0.1", "10.0.0.9")
        parts = udp_frame(
            pick.randbytes(pick.choice([0, 9, 100, 700])),
            *pair,
            ident=pick.randint(1, 3),
            dport=pick.randint(1, 3),
            mtu=pick.choice([None, 96, 200]),
            vlans=pick.choice([[], [0x8100], [0x88A8, 0x8100]]),
            link=link,
        )
        for part in parts:
            cut = pick.random() < 0.03
            waiting.append(
                Frame(0, link, part[: pick.randrange(len(part) + 1)] if cut else part, len(part))
            )
    deeds = draw(st.lists(st.sampled_from(["drop", "repeat", "move"]), max_size=8))
    for deed in deeds:
        if not waiting:
            break
        taken = waiting[pick.randrange(len(waiting))]
        if deed != "repeat":
            waiting.remove(taken)
        if deed != "drop":
            waiting.insert(pick.randint(0, len(waiting)), taken)
    steps_ns = [1000, 1000, -2000, 400_000_000, pick.choice([-2 * 10**9, 1000])]
    host_ns = 10**18
    frames = []
    for frame in waiting:
        host_ns += pick.choice(steps_ns)
        frames.append(frame._replace(host_ns=host_ns))
    return frames


@settings(max_examples=400, deadline=None)
@given(frames=traffic(), portions=st.integers(1, 6))
def test_any_traffic_gives_what_the_literal_dissector_finds(
    frames: list[Frame], portions: int
) -> None:
    check(frames, portions)


@settings(max_examples=200, deadline=None)
@given(pieces=st.lists(st.binary(max_size=80), max_size=20), link=st.sampled_from(LINKS))
def test_any_bytes_are_counted(pieces: list[bytes], link: int) -> None:
    check([whole(piece, link) for piece in pieces])


@pytest.mark.parametrize(
    ("start", "captured"),
    [(-1, 42), (101, 42), (90, 42), (2**62, 2**62), (0, -5), (0, 2**62), (2**62, 1)],
)
def test_frames_beyond_their_array_are_refused(start: int, captured: int) -> None:
    one = np.array([captured])
    frames = Frames(np.array([start]), one, one, np.array([_ETHERNET]), np.zeros(1, np.int64))
    with pytest.raises(IndexError):
        Dissector(CaptureCounts(), StreamTable()).push(np.zeros(100, np.uint8), frames)


def test_times_at_the_ends_of_the_clock() -> None:
    """The stamps that a damaged pcapng file may have."""
    (first, last) = udp_frame(bytes(100), mtu=80)
    for times in ((-(2**63) + 2 * 10**9, 2**63 - 10**9), (2**63 - 1, -(2**63) + 2 * 10**9)):
        check([Frame(at_ns, 1, one, len(one)) for at_ns in times for one in (first, last)])
