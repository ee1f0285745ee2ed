"""Captures: laws on any buffer, and real recordings with dpkt as a witness."""

from __future__ import annotations

import random
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mlbatch.errors import RecordingError
from tests.builders.captures import (
    Interface,
    Other,
    Packet,
    Section,
    pcap_bytes,
    section_bytes,
    udp_frame,
)
from tests.builders.reading import RECORDINGS, dpkt_read, open_capture, read
from tests.reference.capture import ODD, dissect, pcap_frames

PCAPNG = b"\x0a\x0d\x0d\x0a"
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


def read_or_refusal(path: Path, buffer_bytes: int | None) -> tuple[object, ...]:
    """Packets, counts, streams and notes; the error where no frame of a known link is left."""
    try:
        recording = open_capture(path, buffer_bytes=buffer_bytes)
        seen = read(recording)
    except RecordingError as err:
        return (str(err),)
    # A second pass starts anew.
    assert read(recording) == seen
    return seen, recording.counts, recording.streams.streams, recording.notes


@settings(max_examples=200, deadline=None)
@example(seed=128280, buffer_bytes=64)
@given(seed=st.integers(0, 2**32), buffer_bytes=BUFFERS)
def test_any_buffer_gives_what_is_in_a_file_whole_or_damaged(seed: int, buffer_bytes: int) -> None:
    """Frames of a pcap are also compared with the literal dissector."""
    pick = random.Random(seed)
    written = mixed_file(pick)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a"
        for content in (written, damaged(written, pick)):
            path.write_bytes(content)
            found = read_or_refusal(path, buffer_bytes)
            assert found == read_or_refusal(path, None)
            if len(found) == 1 or content[:4] == PCAPNG:
                continue
            recording = open_capture(path)
            expected, skipped = dissect(pcap_frames(content))
            if ODD not in skipped:
                seen = [(one.host_ns, one.stream, one.payload) for one in read(recording)]
                assert (seen, recording.counts.skipped) == (expected, skipped)


CAPTURES = [path.relative_to(RECORDINGS).as_posix() for path in RECORDINGS.rglob("*.pcap*")]
# The IP lengths of packets are wrong there, and dpkt believes them.
WRONG_IP_LENGTH = "velodyne/vlp16_wrong-product-byte/"
# Frames without a datagram; MANIFEST.md: TCP 2112 (48), ARP (2); a stray first fragment.
SKIPPED = {
    "other/sick-tcp_pcapng/test.pcapng": {"not_udp": 48, "not_ip": 2},
    "ouster/os2-128_duplicate-ip-id/duplicate_id.pcap": {"fragment_lost": 1, "fragment": 5},
}


@pytest.mark.parametrize("name", CAPTURES)
def test_packets_are_those_that_dpkt_finds(name: str) -> None:
    """How many there are of each lidar: tests/recordings/test_every_recording.py."""
    path = RECORDINGS / name
    recording = open_capture(path)
    seen = read(recording)
    assert recording.counts.skipped == SKIPPED.get(name, recording.counts.skipped)
    if not name.startswith(WRONG_IP_LENGTH):
        assert seen == dpkt_read(path)
    assert read(open_capture(path, buffer_bytes=512)) == seen
