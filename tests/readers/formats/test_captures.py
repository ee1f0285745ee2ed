"""pcap and pcapng files built from values: stamps, link types, headers, what is skipped, damage."""

from __future__ import annotations

import gzip
import struct
from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.errors import RecordingError
from mlbatch.readers.formats.pcapng import Resolution
from tests.builders.captures import (
    OLD_PACKET,
    RAW,
    SIMPLE,
    Interface,
    Other,
    Packet,
    Section,
    pcap_bytes,
    section_bytes,
    udp_frame,
    write_pcap,
    write_pcapng,
)
from tests.builders.reading import Seen, open_capture, read

PAYLOAD = bytes(range(256)) * 4
T0_NS = 1_700_000_000_123_456_789
(FRAME,) = udp_frame(PAYLOAD)


# -- stamps ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize(
    ("ns", "sent_ns", "expected_ns"),
    [
        (True, T0_NS, T0_NS),
        (False, T0_NS, 1_700_000_000_123_456_000),
        # In 2106 the seconds end.
        (True, ((1 << 32) - 1) * 1_000_000_000 + 999_999_999, 4_294_967_295_999_999_999),
    ],
)
def test_stamps_of_pcap_are_exact(
    tmp_path: Path, ns: bool, sent_ns: int, expected_ns: int, big_endian: bool
) -> None:
    path = write_pcap(tmp_path / "a", [(sent_ns, FRAME)], ns=ns, big_endian=big_endian)
    assert read(open_capture(path)) == [Seen(expected_ns, "10.0.0.1 > port 7502", PAYLOAD)]


def _ticks(tsresol: int | None, ticks: int, tsoffset_s: int | None = None) -> list[Section]:
    return [Section([Packet(FRAME, ticks)], [Interface(tsresol=tsresol, tsoffset_s=tsoffset_s)])]


(RAW_FRAME,) = udp_frame(b"raw", link=RAW)
SECTIONS: Mapping[str, tuple[Sequence[Section], list[int]]] = {
    "no resolution": (_ticks(None, 1_700_000_000_123_456), [1_700_000_000_123_456_000]),
    "microseconds": (_ticks(6, 1_700_000_000_123_456), [1_700_000_000_123_456_000]),
    "nanoseconds": (_ticks(9, 1_700_000_000_123_456_789), [1_700_000_000_123_456_789]),
    "milliseconds": (_ticks(3, 1_700_000_000_123), [1_700_000_000_123_000_000]),
    "seconds": (_ticks(0, 1_700_000_000), [1_700_000_000_000_000_000]),
    "picoseconds, rounded down": (_ticks(12, 1_000_000_001_999), [1_000_000_001]),
    # 1 tick is 976562.5 ns.
    "2^-10 s": (_ticks(0x8A, 3), [2_929_687]),
    "2^-32 s, as NTP": (_ticks(0xA0, 3 << 31), [1_500_000_000]),
    "2^-40 s": (_ticks(0xA8, 5 << 38), [1_250_000_000]),
    "offset": (_ticks(9, 5, 1_700_000_000), [1_700_000_000_000_000_005]),
    "kinds of packets": (
        [
            Section(
                [Packet(FRAME, 7), Packet(FRAME, kind=SIMPLE), Packet(FRAME, 9, kind=OLD_PACKET)]
            )
        ],
        [7, 0, 9],
    ),
    "interfaces": (
        [
            Section(
                [
                    Packet(FRAME, 1, 0),
                    Packet(RAW_FRAME, 2, 1),
                    Interface(RAW, tsresol=3),
                    Packet(RAW_FRAME, 3, 2, kind=OLD_PACKET),
                    Packet(FRAME, 4, 0),
                ],
                [Interface(), Interface(RAW, tsresol=6)],
            )
        ],
        [1, 2000, 3_000_000, 4],
    ),
    "sections": (
        [
            Section([Packet(FRAME, 1)], [Interface()]),
            Section([Packet(FRAME, 1)], [Interface(tsresol=6)], big_endian=True),
            Section([], []),
            Section([Packet(FRAME, 1)], [Interface(tsresol=3)]),
        ],
        [1, 1000, 1_000_000],
    ),
    "unknown blocks": (
        [
            Section(
                [
                    Other(5, bytes(20)),
                    Packet(FRAME, 1),
                    Other(10, bytes(99_999)),
                    Packet(FRAME, 2),
                    Other(4),
                ]
            )
        ],
        [1, 2],
    ),
}


@pytest.mark.parametrize("swap", [False, True])
@pytest.mark.parametrize("name", SECTIONS)
def test_stamps_of_pcapng_are_exact(tmp_path: Path, name: str, swap: bool) -> None:
    given_sections, expected = SECTIONS[name]
    sections = [
        Section(one.blocks, one.interfaces, one.big_endian != swap) for one in given_sections
    ]
    # A buffer that is smaller than some blocks.
    recording = open_capture(write_pcapng(tmp_path / "a", sections), buffer_bytes=1024)
    assert [one.host_ns for one in read(recording)] == expected
    assert recording.notes == []


@given(
    code=st.one_of(st.integers(0, 19), st.integers(0x80, 0x80 + 63)),
    offset_s=st.integers(-(10**9), 10**9),
    ticks=st.lists(st.integers(0, 2**64 - 1), min_size=1, max_size=4),
)
def test_stamps_equal_exact_fractions(code: int, offset_s: int, ticks: list[int]) -> None:
    per_second = 2 ** (code - 0x80) if code & 0x80 else 10**code
    found = Resolution.of(code, offset_s).ns(np.array(ticks, np.uint64)).tolist()
    for tick, ns in zip(ticks, found, strict=True):
        exact = (Fraction(tick, per_second) + offset_s) * 10**9
        if abs(exact) < 9 * 10**18:
            assert ns == exact.__floor__()
        else:
            assert abs(ns) > 9 * 10**18


# -- frames ---------------------------------------------------------------------------------------


def test_bits_of_the_fcs_are_no_link_type(tmp_path: Path) -> None:
    """Links, tags and headers: `tests/readers/capture/test_frames.py`."""
    path = write_pcap(tmp_path / "a", [(0, FRAME)], linktype=0x5400_0001)
    assert [one.payload for one in read(open_capture(path))] == [PAYLOAD]


def test_largest_datagram_in_one_frame(tmp_path: Path) -> None:
    # 65535 bytes of IP minus 20 of its header and 8 of UDP.
    path = write_pcap(tmp_path / "a", [(0, udp_frame(bytes(65507))[0])])
    assert [len(one.payload) for one in read(open_capture(path, buffer_bytes=4096))] == [65507]


CUT = Packet(FRAME[:40], original=len(FRAME))
CUT_SIMPLE = Packet(FRAME[:30], kind=SIMPLE, original=len(FRAME))
SKIPPED: Mapping[str, tuple[Section, dict[str, int]]] = {
    "snaplen": (Section([CUT]), {"truncated": 1}),
    "snaplen of simple packets": (
        Section([CUT_SIMPLE], [Interface(snaplen=len(FRAME))]),
        {"truncated": 1},
    ),
    "unknown interfaces": (
        Section(
            [Packet(FRAME, interface=1), Packet(FRAME, interface=9)],
            [Interface(), Interface(link=127)],
        ),
        {"not_ip": 2},
    ),
}


@pytest.mark.parametrize("name", SKIPPED)
def test_frames_without_a_datagram_are_counted_by_reason(tmp_path: Path, name: str) -> None:
    section, expected = SKIPPED[name]
    whole = Packet(FRAME, kind=SIMPLE)
    around = Section([whole, *section.blocks, whole], section.interfaces)
    recording = open_capture(write_pcapng(tmp_path / "a", [around]))
    assert [one.payload for one in read(recording)] == [PAYLOAD] * 2
    assert recording.counts.skipped == expected


def test_streams_are_numbered_by_their_first_packets(tmp_path: Path) -> None:
    sources = ["10.0.0.9", "10.0.0.1", "10.0.0.9", "10.0.0.5"]
    frames = [(i, udp_frame(b"x", src)[0]) for i, src in enumerate(sources)]
    recording = open_capture(write_pcap(tmp_path / "a", frames))
    (batch,) = recording.packets()
    assert batch.stream.tolist() == [0, 1, 0, 2]
    found = [stream.source_ip for stream in recording.streams.streams]
    assert found == ["10.0.0.9", "10.0.0.1", "10.0.0.5"]


def test_a_frame_without_bytes_at_a_time_is_one(tmp_path: Path) -> None:
    path = write_pcap(tmp_path / "b", [(T0_NS, b""), (T0_NS, FRAME)])
    assert len(read(open_capture(path))) == 1


# -- damage ---------------------------------------------------------------------------------------

PCAP = pcap_bytes([(0, FRAME)])
PCAPNG = section_bytes(Section([Packet(FRAME)]))
RECORD = pcap_bytes([(1, FRAME)])[24:]
BLOCK = section_bytes(Section([Packet(FRAME)], []))[28:]
ZEROS = "expected a record, found zeros; the rest of the file was not read"
# What follows a whole capture, and how the only note begins after its byte.
DAMAGED: Mapping[str, tuple[bytes, Sequence[bytes], str]] = {
    "pcap, cut": (PCAP, [RECORD[:size] for size in range(1, len(RECORD))], ""),
    "pcapng, cut": (PCAPNG, [BLOCK[:-cut] for cut in (1, 4, 40, 60)], ""),
    **{
        f"pcap, {claimed} bytes": (
            PCAP,
            [struct.pack("<IIII", 0, 0, claimed, claimed) + bytes(600_000)],
            f"expected a frame of at most 262144 bytes, found {claimed}; the rest of the file was "
            "not read",
        )
        for claimed in (262_145, 10_000_000, 0xFFFFFFFF)
    },
    "pcapng, lengths": (
        PCAPNG,
        [struct.pack("<II", 6, length) + bytes(100) for length in (0, 8, 13, 2**32 - 4)],
        "",
    ),
    # A full disk or a power cut leaves them: 16 would be a record at 1970 without a byte.
    "pcap, zeros": (PCAP, [bytes(16), bytes(40), bytes(5_000_000)], ZEROS),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damage_ends_the_readable_part(tmp_path: Path, name: str) -> None:
    whole, tails, note = DAMAGED[name]
    for tail in tails:
        (tmp_path / "a").write_bytes(whole + tail)
        recording = open_capture(tmp_path / "a")
        assert [one.payload for one in read(recording)] == [PAYLOAD]
        assert recording.counts.skipped == {"truncated": 1}
        [said] = recording.notes
        assert said.startswith(f"byte {len(whole)}: {note}")
        assert not note or said.endswith(note)


NOTHING = pcap_bytes([]) + bytes(1 << 20)
REFUSED = {
    "link type": (pcap_bytes([], linktype=127), r"found 127 \(IEEE 802\.11 radiotap\)"),
    "link types only": (
        section_bytes(Section([Packet(FRAME)], [Interface(link=105)])),
        r"found 105 \(IEEE 802\.11\)",
    ),
    "modified pcap": (struct.pack("<I", 0xA1B2CD34) + bytes(20), "a1b2cd34.*editcap"),
    "short": (PCAP[:10], "found 10"),
    # Not read to its end, which may be 5 GB away in a small file.
    "zeros": (NOTHING, "expected a record, found zeros at byte 24; nothing"),
    "zeros, gzip": (gzip.compress(NOTHING), "expected a record, found zeros at byte 24; nothing"),
    "cut gzip": (gzip.compress(PCAP)[:10], "compressed data"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_captures_without_a_packet_are_refused_in_one_line(tmp_path: Path, name: str) -> None:
    content, said = REFUSED[name]
    path = tmp_path / "a.pcap"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=said) as caught:
        list(open_capture(path).packets())
    assert "\n" not in str(caught.value)
