"""The content of a frame does not depend on its neighbours; usual frames have a fast path."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from mlbatch.readers.byte_records import SLACK
from mlbatch.readers.capture.frames import Addresses, Frames, dissect

_PAYLOAD = bytes(range(100, 110))
# Ethernet (no tag), IPv4 of five words, UDP from port 5000 to 7502, ten bytes; RFC 791 and 768.
_UDP = struct.pack(">HHHH", 5000, 7502, 8 + len(_PAYLOAD), 0) + _PAYLOAD
_IP = struct.pack(">BBHHHBBHII", 0x45, 0, 20 + len(_UDP), 7, 0, 64, 17, 0, 0x0A000001, 0x0A000002)
_USUAL = bytes(12) + b"\x08\x00" + _IP + _UDP
_ARP = bytes(12) + b"\x08\x06" + bytes(28)
_ETHERNET = 1


def content(frames: list[bytes], cut: int = 0, link: int = _ETHERNET) -> list[object]:
    """Content of the first of some frames; cut: bytes that the capture left out of it."""
    sizes = np.array([len(frame) for frame in frames])
    data = np.frombuffer(b"".join(frames) + bytes(SLACK), np.uint8)
    captured = sizes.copy()
    captured[0] -= cut
    start = np.cumsum(sizes) - sizes
    links = np.full(len(frames), _ETHERNET)
    links[0] = link
    found = dissect(data, Frames(start, captured, sizes, links, np.zeros_like(start)), Addresses())
    datagrams, fragments = found.datagrams, found.fragments
    whole = [
        (int(s), int(n), int(a), int(p))
        for f, s, n, a, p in zip(
            datagrams.frame,
            datagrams.start,
            datagrams.size,
            datagrams.source,
            datagrams.port,
            strict=True,
        )
        if f == 0
    ]
    parts = [
        (int(s), int(n), int(o))
        for f, s, n, o in zip(
            fragments.frame, fragments.start, fragments.size, fragments.offset, strict=True
        )
        if f == 0
    ]
    skipped = dict(found.skipped)
    if len(frames) > 1:
        skipped["not_ip"] -= 1
    return [whole, parts, {reason: count for reason, count in skipped.items() if count}]


def test_a_usual_frame_holds_its_payload() -> None:
    assert content([_USUAL]) == [[(42, 10, 0x0A000001, 7502)], [], {}]


@pytest.mark.parametrize("at", range(42))
def test_a_changed_header_means_the_same_alone_and_among_others(at: int) -> None:
    for value in range(256):
        changed = bytearray(_USUAL)
        changed[at] = value
        assert content([bytes(changed)]) == content([bytes(changed), _ARP]), value


@pytest.mark.parametrize("cut", range(len(_USUAL) + 1))
def test_a_cut_frame_means_the_same_alone_and_among_others(cut: int) -> None:
    assert content([_USUAL], cut) == content([_USUAL, _ARP], cut)


@pytest.mark.parametrize("link", [0, 12, 101, 113, 276, 127])
def test_other_links_mean_the_same_alone_and_among_others(link: int) -> None:
    assert content([_USUAL], link=link) == content([_USUAL, _ARP], link=link)


def test_a_cut_frame_is_no_datagram_though_its_payload_is_there() -> None:
    padded = _USUAL + bytes(6)
    assert content([padded], cut=6) == [[], [], {"truncated": 1}]
