"""Laws of captures: the buffer's size does not matter, every frame is read or counted."""

from __future__ import annotations

import random
from pathlib import Path
from tempfile import TemporaryDirectory

from hypothesis import example, given, settings
from hypothesis import strategies as st

from mlbatch.errors import RecordingError
from mlbatch.readers.capture.recording import CaptureRecording
from tests.builders.captures import (
    Interface,
    Other,
    Packet,
    Section,
    pcap_bytes,
    section_bytes,
    udp_frame,
)
from tests.builders.reading import Seen, assert_balanced, open_capture, read

BUFFERS = st.sampled_from([64, 700, 4096, 20_000, 65_536])


def mixed_frames(pick: random.Random) -> list[tuple[int, bytes]]:
    """Frames of several sensors: plain, tagged, fragmented, IPv6, foreign."""
    records = []
    for i in range(pick.randint(0, 40)):
        payload = pick.randbytes(pick.choice([0, 48, 900, 1206, 6000]))
        frames = pick.choice(
            [
                udp_frame(payload, ident=i),
                udp_frame(payload, "10.0.0.7", ident=i % 5, mtu=1500),
                udp_frame(payload, "10.0.0.8", vlans=[0x8100, 0x88A8]),
                udp_frame(payload, "fe80::1", "fe80::2", ident=i, mtu=1280),
                [pick.randbytes(60)],
            ]
        )
        records += [(i * 1_000_000, frame) for frame in frames]
    return records


def mixed_file(pick: random.Random) -> bytes:
    """A pcap or pcapng file of mixed frames."""
    records = mixed_frames(pick)
    if pick.random() < 0.5:
        return pcap_bytes(records, big_endian=pick.random() < 0.5)
    blocks: list[Packet | Other] = []
    for host_ns, frame in records:
        blocks.append(Packet(frame, host_ns, kind=pick.choice([6, 6, 3, 2])))
        if pick.random() < 0.1:
            blocks.append(Other(pick.choice([4, 5, 10, 99]), pick.randbytes(30)))
    half = len(blocks) // 2
    first = Section(blocks[:half], big_endian=pick.random() < 0.5)
    return section_bytes(first) + section_bytes(Section(blocks[half:], [Interface(tsresol=6)]))


def damaged(content: bytes, pick: random.Random) -> bytes:
    """`content` after its file header with bits flipped, bytes dropped, repeated or cut off."""
    data = bytearray(content)
    for _ in range(pick.randint(1, 6)):
        if len(data) <= 130:
            break
        at, size = pick.randrange(110, len(data)), pick.randint(1, 200)
        deed = pick.choice(["flip", "flip", "drop", "repeat", "cut"])
        if deed == "flip":
            data[at] ^= 1 << pick.randrange(8)
        elif deed == "drop":
            del data[at : at + size]
        elif deed == "repeat":
            data[at:at] = data[at : at + size]
        elif pick.random() < 0.3:
            del data[at:]
    return bytes(data)


def read_or_refusal(recording: CaptureRecording) -> list[Seen] | str:
    """All packets; the error where damage leaves no frame of a known link."""
    try:
        return read(recording)
    except RecordingError as err:
        assert_balanced(recording)
        return str(err)


@settings(max_examples=80, deadline=None)
@given(seed=st.integers(0, 2**32), buffer_bytes=BUFFERS)
def test_any_buffer_gives_the_same_packets_and_counts(seed: int, buffer_bytes: int) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a"
        path.write_bytes(mixed_file(random.Random(seed)))
        whole, small = open_capture(path), open_capture(path, buffer_bytes=buffer_bytes)
        assert read(small) == read(whole)
        assert small.counts == whole.counts
        assert small.streams.streams == whole.streams.streams


@settings(max_examples=200, deadline=None)
@example(seed=128280, buffer_bytes=64)
@given(seed=st.integers(0, 2**32), buffer_bytes=BUFFERS)
def test_damaged_files_balance_whatever_the_buffer(seed: int, buffer_bytes: int) -> None:
    pick = random.Random(seed)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a"
        path.write_bytes(damaged(mixed_file(pick), pick))
        whole, small = open_capture(path), open_capture(path, buffer_bytes=buffer_bytes)
        assert read_or_refusal(small) == read_or_refusal(whole)
        assert small.counts == whole.counts
        assert small.notes == whole.notes
