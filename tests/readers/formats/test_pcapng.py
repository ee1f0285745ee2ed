"""pcapng files: sections, interfaces, block kinds, time resolutions."""

from __future__ import annotations

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
    section_bytes,
    udp_frame,
    write_pcapng,
)
from tests.builders.reading import open_capture, read

(FRAME,) = udp_frame(b"payload")


def stamps(path: Path, sections: list[Section]) -> list[int]:
    """Host times of the packets of a capture."""
    return [one.host_ns for one in read(open_capture(write_pcapng(path, sections)))]


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize(
    ("tsresol", "ticks", "expected_ns"),
    [
        (None, 1_700_000_000_123_456, 1_700_000_000_123_456_000),
        (6, 1_700_000_000_123_456, 1_700_000_000_123_456_000),
        (9, 1_700_000_000_123_456_789, 1_700_000_000_123_456_789),
        (3, 1_700_000_000_123, 1_700_000_000_123_000_000),
        (0, 1_700_000_000, 1_700_000_000_000_000_000),
        # Picoseconds: rounded down.
        (12, 1_000_000_001_999, 1_000_000_001),
        # 2^-10 s: 1 tick is 976562.5 ns.
        (0x8A, 3, 2_929_687),
        # 2^-32 s, as NTP: one and a half seconds.
        (0xA0, 3 << 31, 1_500_000_000),
        # 2^-40 s.
        (0xA8, 5 << 38, 1_250_000_000),
    ],
)
def test_resolutions(
    tmp_path: Path, tsresol: int | None, ticks: int, expected_ns: int, big_endian: bool
) -> None:
    section = Section([Packet(FRAME, ticks)], [Interface(tsresol=tsresol)], big_endian)
    assert stamps(tmp_path / "a", [section]) == [expected_ns]


def test_time_offset_is_added(tmp_path: Path) -> None:
    section = Section([Packet(FRAME, 5)], [Interface(tsoffset_s=1_700_000_000)])
    assert stamps(tmp_path / "a", [section]) == [1_700_000_000_000_000_005]


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


def test_all_kinds_of_packet_blocks(tmp_path: Path) -> None:
    blocks = [Packet(FRAME, 7), Packet(FRAME, kind=SIMPLE), Packet(FRAME, 9, kind=OLD_PACKET)]
    for big_endian in (False, True):
        section = Section(blocks, big_endian=big_endian)
        assert stamps(tmp_path / "a", [section]) == [7, 0, 9]


def test_interfaces_have_their_own_link_type_and_resolution(tmp_path: Path) -> None:
    interfaces = [Interface(), Interface(RAW, tsresol=6)]
    (raw,) = udp_frame(b"raw", link=RAW)
    late = Interface(RAW, tsresol=3)
    blocks: list[Packet | Interface] = [
        Packet(FRAME, 1, 0),
        Packet(raw, 2, 1),
        late,
        Packet(raw, 3, 2, kind=OLD_PACKET),
        Packet(FRAME, 4, 0),
    ]
    for big_endian in (False, True):
        section = Section(blocks, interfaces, big_endian)
        assert stamps(tmp_path / "a", [section]) == [1, 2000, 3_000_000, 4]


def test_sections_have_their_own_byte_order_and_interfaces(tmp_path: Path) -> None:
    sections = [
        Section([Packet(FRAME, 1)], [Interface()]),
        Section([Packet(FRAME, 1)], [Interface(tsresol=6)], big_endian=True),
        Section([], []),
        Section([Packet(FRAME, 1)], [Interface(tsresol=3)]),
    ]
    assert stamps(tmp_path / "a", sections) == [1, 1000, 1_000_000]


def test_unknown_blocks_are_skipped_even_when_longer_than_the_buffer(tmp_path: Path) -> None:
    long, short = Other(10, bytes(99_999)), Other(5, bytes(20))
    section = Section([short, Packet(FRAME, 1), long, Packet(FRAME, 2), Other(4)])
    path = write_pcapng(tmp_path / "a", [section])
    recording = open_capture(path, buffer_bytes=1024)
    assert [one.host_ns for one in read(recording)] == [1, 2]
    assert recording.notes == []


def test_snaplen_of_simple_packets(tmp_path: Path) -> None:
    whole = Packet(FRAME, kind=SIMPLE)
    cut = Packet(FRAME[:30], kind=SIMPLE, original=len(FRAME))
    section = Section([whole, cut, whole], [Interface(snaplen=len(FRAME))])
    recording = open_capture(write_pcapng(tmp_path / "a", [section]))
    assert len(read(recording)) == 2
    assert recording.counts.skipped == {"truncated": 1}


def test_cut_by_snaplen_is_truncated(tmp_path: Path) -> None:
    section = Section([Packet(FRAME[:40], original=len(FRAME))])
    recording = open_capture(write_pcapng(tmp_path / "a", [section]))
    assert read(recording) == []
    assert recording.counts.skipped == {"truncated": 1}


def test_packets_of_unknown_interfaces_are_not_ip(tmp_path: Path) -> None:
    interfaces = [Interface(), Interface(link=127)]
    section = Section(
        [Packet(FRAME), Packet(FRAME, interface=1), Packet(FRAME, interface=9)], interfaces
    )
    recording = open_capture(write_pcapng(tmp_path / "a", [section]))
    assert len(read(recording)) == 1
    assert recording.counts.skipped == {"not_ip": 2}


def test_a_file_of_unknown_link_types_only_is_an_error(tmp_path: Path) -> None:
    path = write_pcapng(tmp_path / "a", [Section([Packet(FRAME)], [Interface(link=105)])])
    with pytest.raises(RecordingError, match=r"found 105 \(IEEE 802\.11\)"):
        list(open_capture(path).packets())


@pytest.mark.parametrize("length", [0, 8, 13, 2**32 - 4])
def test_impossible_block_lengths_end_the_readable_part(tmp_path: Path, length: int) -> None:
    good = section_bytes(Section([Packet(FRAME, 1)]))
    bad = (6).to_bytes(4, "little") + length.to_bytes(4, "little") + bytes(100)
    (tmp_path / "a").write_bytes(good + bad)
    recording = open_capture(tmp_path / "a")
    assert [one.host_ns for one in read(recording)] == [1]
    assert recording.counts.skipped == {"truncated": 1}
    assert recording.notes[0].startswith(f"byte {len(good)}: ")


def test_last_packet_block_that_is_cut_off(tmp_path: Path) -> None:
    whole = section_bytes(Section([Packet(FRAME, 1), Packet(FRAME, 2)]))
    for cut in (1, 4, 40, 60):
        (tmp_path / "a").write_bytes(whole[:-cut])
        recording = open_capture(tmp_path / "a")
        assert [one.host_ns for one in read(recording)] == [1]
        assert recording.counts.skipped == {"truncated": 1}
        assert len(recording.notes) == 1
