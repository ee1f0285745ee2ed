"""What is on the wire in a capture, first of all `fixtures/two_lidars`: frames, datagrams."""

from __future__ import annotations

import functools
import ipaddress
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from tests.builders.captures import ETHERNET, udp_frame
from tests.builders.run import FIXTURE
from tests.builders.two_lidars import START_NS

Records = list[tuple[int, bytes]]

_IPV4 = b"\x08\x00"
_UDP = 17


def read_pcap(path: Path) -> Records:
    """(host_ns, frame) of all records of a little-endian pcap."""
    data = path.read_bytes()
    unit_ns = {b"\xd4\xc3\xb2\xa1": 1000, b"\x4d\x3c\xb2\xa1": 1}[data[:4]]
    at = 24
    records = []
    while at < len(data):
        seconds, fraction, captured, _ = struct.unpack_from("<4I", data, at)
        host_ns = seconds * 10**9 + fraction * unit_ns
        records.append((host_ns, data[at + 16 : at + 16 + captured]))
        at += 16 + captured
    return records


@functools.cache
def frames(length_ns: int) -> tuple[tuple[int, bytes], ...]:
    """The first part of the fixture's recording."""
    every = read_pcap(FIXTURE.recordings[0])
    return tuple(record for record in every if record[0] < START_NS + length_ns)


def source(frame: bytes) -> str:
    """Source IP of an Ethernet frame; "" where it is not IPv4."""
    return str(ipaddress.ip_address(frame[26:30])) if frame[12:14] == _IPV4 else ""


@dataclass(frozen=True, slots=True)
class Datagram:
    """A UDP datagram and the receive time of the frame that completed it."""

    host_ns: int
    source: str
    target: str
    source_port: int
    port: int
    payload: bytes

    def frame(self, link: int = ETHERNET) -> tuple[int, bytes]:
        """The record of one frame with all of it."""
        frames = udp_frame(
            self.payload, self.source, self.target, self.source_port, self.port, link=link
        )
        return self.host_ns, frames[0]


@functools.cache
def datagrams(length_ns: int) -> tuple[Datagram, ...]:
    """Datagrams of `frames`."""
    return tuple(datagrams_of(frames(length_ns)))


def datagrams_of(records: Iterable[tuple[int, bytes]]) -> list[Datagram]:
    """UDP datagrams over IPv4, as they were completed; fragments come in order."""
    parts: dict[bytes, bytes] = {}
    found = []
    for host_ns, frame in records:
        if frame[12:14] != _IPV4 or frame[23] != _UDP:
            continue
        # Identification and both addresses identify the fragments of a datagram.
        key = frame[18:20] + frame[26:34]
        end = 14 + struct.unpack_from(">H", frame, 16)[0]
        parts[key] = parts.get(key, b"") + frame[34:end]
        if struct.unpack_from(">H", frame, 20)[0] & 0x2000:
            continue
        whole = parts.pop(key)
        source_port, port, size = struct.unpack_from(">3H", whole)
        assert size == len(whole)
        sender, target = (str(ipaddress.ip_address(frame[at : at + 4])) for at in (26, 30))
        found.append(Datagram(host_ns, sender, target, source_port, port, whole[8:]))
    return found
