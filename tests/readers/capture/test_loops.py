"""Compiled loops over captures; the records they find: test_recording.py."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.native.capture import CaptureLoops
from tests.builders.captures import pcap_bytes, udp_frame
from tests.builders.reading import open_capture, read


def test_more_frames_than_there_is_room_for(tmp_path: Path) -> None:
    path = tmp_path / "capture.pcap"
    frames = [(1_000_000 + number, b"\x00" * (number % 3)) for number in range(40_000)]
    path.write_bytes(pcap_bytes([*frames, *((1, one) for one in udp_frame(b"last"))]))
    recording = open_capture(path)
    assert [one.payload for one in read(recording)] == [b"last"]
    assert recording.counts.skipped == {"truncated": 40_000}


def _copy(start: int, size: int, place: int) -> None:
    source, out = np.zeros(100, np.uint8), np.zeros(50, np.uint8)
    first, count, at = (np.array([one]) for one in (start, size, place))
    CaptureLoops().copy_runs(source, first, count, out, at)


def _walk(begin: int, end: int) -> None:
    CaptureLoops().walk(np.zeros(100, np.uint8), begin, end, False, 1, 1 << 18)


def _sum_at(begin: int) -> None:
    CaptureLoops().sums(np.zeros(100, np.uint8), np.array([0, begin]), 10)


@pytest.mark.parametrize(
    ("loop", "values"),
    [
        *((_copy, run) for run in ((-1, 4, 0), (98, 4, 0), (0, 4, 48), (0, 4, -1), (0, -1, 0))),
        *((_copy, run) for run in ((0, 2**62, 0), (2**62, 1, 0))),
        *((_walk, span) for span in ((-1, 10), (0, 101), (2**40, 2**41))),
        *((_sum_at, (begin,)) for begin in (-1, 91, 2**40)),
    ],
)
def test_bytes_beyond_the_arrays_are_refused(
    loop: Callable[..., None], values: tuple[int, ...]
) -> None:
    with pytest.raises(IndexError):
        loop(*values)


def _sum(payload: bytes) -> int:
    """Sum of the words of 8 bytes, and of the last 8 bytes if these are no word."""
    if len(payload) < 8:
        return sum(payload)
    words = [payload[at : at + 8] for at in range(0, len(payload) - 7, 8)]
    words += [payload[-8:]] * bool(len(payload) % 8)
    return sum(int.from_bytes(word, "little") for word in words) % 2**64


@pytest.mark.parametrize("size", [1, 7, 8, 9, 15, 16, 23])
def test_every_change_of_a_byte_changes_the_sum(size: int) -> None:
    """Also by the top bit of a byte, which could overflow the sum."""
    packet = np.full(size, 0x7F, np.uint8)
    changed = [
        np.where(np.arange(size) == at, 0x7F ^ flip, packet)
        for at in range(size)
        for flip in range(1, 256)
    ]
    data = np.concatenate([packet, *changed]).astype(np.uint8)
    sums = CaptureLoops().sums(data, np.arange(len(changed) + 1) * size, size)
    assert not (sums[1:] == sums[0]).any()


@given(size=st.integers(1, 70), seed=st.integers(0, 2**32), data=st.data())
def test_sums_are_those_of_words(size: int, seed: int, data: st.DataObject) -> None:
    content = np.random.default_rng(seed).integers(0, 256, 200, np.uint8)
    # The last packet may end with the array.
    begins = data.draw(st.lists(st.integers(0, len(content) - size), max_size=9))
    start = np.array([*begins, len(content) - size])
    packets = [content[begin : begin + size].tobytes() for begin in start]
    found = CaptureLoops().sums(content, start, size)
    assert found.tolist() == [_sum(packet) for packet in packets]
    assert CaptureLoops().sums(content, start[:0], size).tolist() == []
