"""Reading in tests: packets as plain values, and dpkt as an independent reader."""

from __future__ import annotations

import socket
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import dpkt
import pytest

from mlbatch.errors import RecordingError
from mlbatch.readers import open_recording
from mlbatch.readers.bag.recording import BagRecording
from mlbatch.readers.capture.recording import CaptureRecording
from mlbatch.readers.formats import mcap, rosbag1, rosbag2
from mlbatch.types import Message, PacketBatch, Recording, StreamTable

RECORDINGS = Path(__file__).resolve().parents[3] / "shared" / "recordings"


@dataclass(frozen=True, slots=True)
class Seen:
    """A payload as the pipeline sees it."""

    host_ns: int
    stream: str
    payload: bytes


def open_capture(
    path: Path, *, buffer_bytes: int | None = None, streams: StreamTable | None = None
) -> CaptureRecording:
    """An opened capture with the buffer of a test."""
    recording = open_recording(path, streams or StreamTable())
    assert isinstance(recording, CaptureRecording)
    recording.buffer_bytes = buffer_bytes or recording.buffer_bytes
    return recording


def open_bag(
    path: Path, *, keep: Iterable[str] = (), buffer_bytes: int | None = None
) -> BagRecording:
    """A bag, opened by its content; with the buffer of a test, if it is one file."""
    table = StreamTable()
    recording = open_recording(path, table)
    if buffer_bytes and recording.container == rosbag1.CONTAINER:
        recording = rosbag1.open_packets(path, table, buffer_bytes)
    elif buffer_bytes:
        module = mcap if recording.container == mcap.CONTAINER else rosbag2
        recording = module.open_folder(path, [path], table, buffer_bytes=buffer_bytes)
    assert isinstance(recording, BagRecording)
    recording.keep = frozenset(keep)
    return recording


def refusal(path: Path) -> str:
    """The one line that says why `path` cannot be opened."""
    with pytest.raises(RecordingError) as caught:
        open_recording(path, StreamTable())
    line = str(caught.value)
    assert line.startswith(str(path))
    assert "\n" not in line
    return line


def packets_in(batch: PacketBatch) -> Iterator[tuple[int, int, bytes]]:
    """Number of the stream, receive time and payload of each packet of a batch."""
    columns = (batch.start, batch.size, batch.stream, batch.host_ns)
    for start, size, stream, host_ns in zip(*(c.tolist() for c in columns), strict=True):
        yield stream, host_ns, batch.data[start : start + size].tobytes()


def seen_of(batch: PacketBatch, streams: StreamTable) -> list[Seen]:
    """The packets of a batch."""
    return [
        Seen(host_ns, str(streams.streams[stream]), payload)
        for stream, host_ns, payload in packets_in(batch)
    ]


def read(recording: CaptureRecording | BagRecording) -> list[Seen]:
    """All packets; the ledger must balance afterwards."""
    return read_kept(recording)[0]


def read_kept(recording: CaptureRecording | BagRecording) -> tuple[list[Seen], list[Message]]:
    """All packets and the messages that are kept; the ledger must balance afterwards."""
    seen: list[Seen] = []
    messages: list[Message] = []
    for batch in recording.packets():
        seen += seen_of(batch, recording.streams)
        messages += batch.messages
    assert_balanced(recording)
    assert recording.position_bytes <= recording.size_bytes
    assert all("\n" not in note for note in recording.notes)
    return seen, messages


def assert_balanced(recording: Recording) -> None:
    """The law of the capture ledger, and only known reasons."""
    counts = recording.counts
    assert counts.frames == counts.datagrams + sum(counts.skipped.values())
    assert min(counts.skipped.values(), default=1) > 0
    assert set(counts.skipped) <= {"not_ip", "not_udp", "truncated", "fragment", "fragment_lost"}


def dpkt_read(path: Path) -> list[Seen]:
    """What dpkt finds in an Ethernet pcap: whole IPv4 datagrams, and fragments joined in order."""
    seen: list[Seen] = []
    waiting: dict[tuple[bytes, bytes, int], list[dpkt.ip.IP]] = {}
    with path.open("rb") as file:
        for time_s, frame in dpkt.pcap.UniversalReader(file):
            packet = dpkt.ethernet.Ethernet(frame).data
            if not isinstance(packet, dpkt.ip.IP) or packet.p != dpkt.ip.IP_PROTO_UDP:
                continue
            if packet.mf or packet.offset:
                key = packet.src, packet.dst, packet.id
                held = waiting.setdefault(key, []) if packet.offset else []
                waiting[key] = [*held, packet]
                if packet.mf:
                    continue
                data = b"".join(bytes(part.data) for part in waiting.pop(key))
            else:
                data = bytes(packet.data)
            udp = dpkt.udp.UDP(data)
            stream = f"{socket.inet_ntoa(packet.src)} > port {udp.dport}"
            # dpkt gives float seconds; the captures read with it count whole microseconds.
            host_ns = round(float(time_s) * 1_000_000) * 1000
            seen.append(Seen(host_ns, stream, data[8 : udp.ulen]))
    return seen
