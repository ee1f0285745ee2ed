"""Compiled loops find what numpy finds, in whole captures and in damaged ones."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.decode.packet_ring import packet_sums
from mlbatch.errors import RecordingError
from mlbatch.native.capture import CaptureLoops
from mlbatch.readers.byte_records import copy_runs
from tests.builders.captures import pcap_bytes, udp_frame
from tests.builders.engines import needs_native
from tests.builders.reading import Seen, open_capture, read
from tests.readers.capture.test_recording import damaged, mixed_file

pytestmark = needs_native

BUFFERS = (64, 700, 4096, 65_536)


def outcome(
    path: Path, engine: str, buffer_bytes: int
) -> tuple[list[Seen], object, object, object]:
    """Result of reading a capture: packets, counts, notes and an error."""
    recording = open_capture(path, engine=engine, buffer_bytes=buffer_bytes)
    try:
        seen, error = read(recording), ""
    except RecordingError as err:
        seen, error = [], str(err)
    return seen, recording.counts, recording.notes, error


@pytest.mark.parametrize("seed", range(120))
def test_captures_whole_and_damaged(tmp_path: Path, seed: int) -> None:
    pick = random.Random(seed)
    path = tmp_path / "capture"
    content = mixed_file(pick)
    for written in (content, damaged(content, pick), damaged(content, pick)):
        path.write_bytes(written)
        try:
            open_capture(path)
        except RecordingError:
            continue
        buffer_bytes = pick.choice(BUFFERS)
        assert outcome(path, "native", buffer_bytes) == outcome(path, "numpy", buffer_bytes)


def test_headers_with_any_byte_changed(tmp_path: Path) -> None:
    pick, path = random.Random(1), tmp_path / "capture.pcap"
    plain = udp_frame(bytes(48), ident=3)
    parts = udp_frame(bytes(4000), ident=4, mtu=1500)
    for frame in (plain[0], parts[0], parts[-1]):
        changed: list[tuple[int, bytes]] = []
        for place in range(42):
            for value in (0, 1, 0x20, 0x45, 0x46, 0x4F, 0x7F, 0x80, 0xFF, pick.randrange(256)):
                one = bytearray(frame)
                one[place] = value
                changed.append((len(changed), bytes(one)))
        path.write_bytes(pcap_bytes(changed))
        assert outcome(path, "native", 65_536) == outcome(path, "numpy", 65_536)


def test_more_frames_than_there_is_room_for(tmp_path: Path) -> None:
    path = tmp_path / "capture.pcap"
    frames = [(1_000_000 + number, b"\x00" * (number % 3)) for number in range(40_000)]
    path.write_bytes(pcap_bytes([*frames, *((1, one) for one in udp_frame(b"last"))]))
    found = outcome(path, "native", 4 << 20)
    assert found == outcome(path, "numpy", 4 << 20)
    assert [one.payload for one in found[0]] == [b"last"]


def test_frames_that_claim_to_lie_elsewhere_are_left_to_others() -> None:
    loops, data = CaptureLoops(), np.zeros(100, np.uint8)
    start = np.array([-1, 101, 90, 2**62, 0, 0])
    captured = np.array([42, 42, 42, 2**62, -5, 2**62])
    found = loops.dissect(data, start, captured, captured)
    assert found.others.tolist() == list(range(6))
    assert not found.datagrams.size
    assert not found.fragments.size


def test_runs_are_copied() -> None:
    pick = np.random.default_rng(1)
    source = pick.integers(0, 256, 5000, np.uint8)
    size = pick.integers(0, 90, 40)
    start = pick.integers(0, 4900, 40)
    place = np.cumsum(size) - size
    one, other = np.zeros(5000, np.uint8), np.zeros(5000, np.uint8)
    copy_runs(source, start, size, one, place)
    CaptureLoops().copy_runs(source, start, size, other, place)
    assert one.tobytes() == other.tobytes()


@pytest.mark.parametrize(
    ("start", "size", "place"),
    [(-1, 4, 0), (98, 4, 0), (0, 4, 48), (0, 4, -1), (0, -1, 0), (0, 2**62, 0), (2**62, 1, 0)],
)
def test_runs_beyond_their_arrays_are_refused(start: int, size: int, place: int) -> None:
    source, out = np.zeros(100, np.uint8), np.zeros(50, np.uint8)
    run = (np.array([one]) for one in (start, size, place))
    first, count, at = run
    with pytest.raises(IndexError):
        CaptureLoops().copy_runs(source, first, count, out, at)


@pytest.mark.parametrize(("begin", "end"), [(-1, 10), (0, 101), (2**40, 2**41)])
def test_bytes_beyond_the_buffer_are_not_walked(begin: int, end: int) -> None:
    with pytest.raises(IndexError):
        CaptureLoops().walk(np.zeros(100, np.uint8), begin, end, False, 1, 1 << 18)


@given(size=st.integers(1, 70), seed=st.integers(0, 2**32), data=st.data())
def test_sums_of_packets_are_those_of_numpy(size: int, seed: int, data: st.DataObject) -> None:
    content = np.random.default_rng(seed).integers(0, 256, 200, np.uint8)
    # The last packet may end with the array.
    begins = data.draw(st.lists(st.integers(0, len(content) - size), max_size=9))
    start = np.array([*begins, len(content) - size])
    packets = np.stack([content[begin : begin + size] for begin in start])
    found = CaptureLoops().sums(content, start, size)
    assert found.tolist() == packet_sums(packets).tolist()
    assert CaptureLoops().sums(content, start[:0], size).tolist() == []


@pytest.mark.parametrize("begin", [-1, 91, 2**40])
def test_sums_beyond_the_array_are_refused(begin: int) -> None:
    with pytest.raises(IndexError):
        CaptureLoops().sums(np.zeros(100, np.uint8), np.array([0, begin]), 10)
