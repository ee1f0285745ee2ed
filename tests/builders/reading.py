"""Reading in tests: packets as plain values, and dpkt as an independent reader."""

from __future__ import annotations

import socket
from dataclasses import dataclass
from pathlib import Path

import dpkt

from mlbatch.readers import open_recording
from mlbatch.readers.capture.recording import CaptureRecording
from mlbatch.types import PacketBatch, Recording, StreamTable

RECORDINGS = Path(__file__).resolve().parents[3] / "shared" / "recordings"


@dataclass(frozen=True, slots=True)
class Seen:
    """A payload as the pipeline sees it."""

    host_ns: int
    stream: str
    payload: bytes


def open_capture(
    path: Path,
    *,
    buffer_bytes: int | None = None,
    streams: StreamTable | None = None,
) -> CaptureRecording:
    """An opened capture with the buffer of a test."""
    recording = open_recording(path, streams or StreamTable())
    assert isinstance(recording, CaptureRecording)
    recording.buffer_bytes = buffer_bytes or recording.buffer_bytes
    return recording


def seen_of(batch: PacketBatch, streams: StreamTable) -> list[Seen]:
    """The packets of a batch."""
    columns = (batch.start, batch.size, batch.stream, batch.host_ns)
    return [
        Seen(host_ns, str(streams.streams[stream]), batch.data[start : start + size].tobytes())
        for start, size, stream, host_ns in zip(*(c.tolist() for c in columns), strict=True)
    ]


def read(recording: CaptureRecording) -> list[Seen]:
    """All packets; the ledger must balance afterwards."""
    seen = []
    for batch in recording.packets():
        seen += seen_of(batch, recording.streams)
    assert_balanced(recording)
    return seen


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
