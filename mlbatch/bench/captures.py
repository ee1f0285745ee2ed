"""Captures of many sensors: their packets as UDP in IPv4 over Ethernet, in order of arrival.

Source: RFC 791 (IPv4), RFC 768 (UDP), draft-ietf-opsawg-pcap. UDP checksums are 0: none.
"""

from __future__ import annotations

import ipaddress
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Final

import numpy as np

from mlbatch.arrays import I64Array, U8Array
from mlbatch.bench.lidars import EPOCH_NS, Lidar
from mlbatch.types import Stream
from mlbatch.units import NS_PER_MS, NS_PER_S, NS_PER_US

ETHERNET_MTU, JUMBO_MTU = 1500, 65535
_FILE_HEAD: Final = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)
_RECORD: Final = np.dtype([("s", "<u4"), ("us", "<u4"), ("kept", "<u4"), ("length", "<u4")])
_ETHERNET: Final = np.frombuffer(bytes(12) + b"\x08\x00", np.uint8)
_IP: Final = struct.Struct(">BBHHHBBH4s4s")
_IP_ID_AT, _IP_CHECK_AT = 4, 10
_UDP: Final = struct.Struct(">HHHH")
_RECEIVER: Final = ipaddress.IPv4Address("192.168.7.2").packed
_MORE_FRAGMENTS: Final = 0x2000
# A full frame takes this long on 1 Gbit/s Ethernet; fragments of a packet arrive so far apart.
_FRAGMENT_STEP_NS: Final = 12 * NS_PER_US
_PIECE_NS: Final = 500 * NS_PER_MS
Row = tuple[int, U8Array]


@dataclass(frozen=True, slots=True)
class Source:
    """A lidar on the network, and how far (ns) its rotor runs behind."""

    lidar: Lidar
    stream: Stream
    phase_ns: int


def write_capture(path: Path, sources: Sequence[Source], seconds: float, mtu: int) -> None:
    """Write so many seconds of all sources, a piece of time after the other."""
    end_ns = EPOCH_NS + round(seconds * NS_PER_S)
    waiting: list[Row] = []
    sent = [0] * len(sources)
    with path.open("wb") as file:
        file.write(_FILE_HEAD)
        for edge_ns in (*range(EPOCH_NS + _PIECE_NS, end_ns, _PIECE_NS), end_ns):
            for number, source in enumerate(sources):
                lidar = source.lidar
                count = (edge_ns - EPOCH_NS - source.phase_ns) // lidar.packet_ns
                numbers = np.arange(sent[number], max(sent[number], count))
                sent[number] += len(numbers)
                waiting += rows(source, numbers, mtu)
            waiting.sort(key=itemgetter(0))
            # What arrives later may still be overtaken by packets of the next piece.
            whole = sum(arrival_ns < edge_ns for arrival_ns, _ in waiting)
            file.writelines(row.data for _, row in waiting[:whole])
            del waiting[:whole]
        file.writelines(row.data for _, row in waiting)


def rows(source: Source, numbers: I64Array, mtu: int) -> Iterator[Row]:
    """Arrival and bytes of all records that carry these packets."""
    if not len(numbers):
        return
    arrival_ns, payloads = source.lidar.packets(numbers, source.phase_ns)
    port, size = source.stream.port, payloads.shape[1] + _UDP.size
    udp = np.frombuffer(_UDP.pack(port, port, size, 0), np.uint8)
    datagrams = np.concatenate([np.broadcast_to(udp, (len(numbers), _UDP.size)), payloads], 1)
    step = (mtu - _IP.size) // 8 * 8
    for place, offset in enumerate(range(0, size, step)):
        part = datagrams[:, offset : offset + step]
        flags = offset // 8 | (_MORE_FRAGMENTS if offset + step < size else 0)
        ip = _ip_headers(source.stream.source_ip, numbers & 0xFFFF, flags, part.shape[1])
        at_ns = arrival_ns + place * _FRAGMENT_STEP_NS
        yield from zip(at_ns.tolist(), _records(at_ns, ip, part), strict=True)


def _records(at_ns: I64Array, ip: U8Array, part: U8Array) -> U8Array:
    """(n, bytes) pcap records."""
    head = np.zeros(len(part), _RECORD)
    head["s"], rest_ns = np.divmod(at_ns, NS_PER_S)
    head["us"] = rest_ns // NS_PER_US
    head["kept"] = head["length"] = len(_ETHERNET) + _IP.size + part.shape[1]
    ethernet = np.broadcast_to(_ETHERNET, (len(part), len(_ETHERNET)))
    return np.concatenate([head.view(np.uint8).reshape(len(part), -1), ethernet, ip, part], 1)


def _ip_headers(source_ip: str, ids: I64Array, flags: int, size: int) -> U8Array:
    """(n, 20) headers with their checksums."""
    sender = ipaddress.IPv4Address(source_ip).packed
    head = _IP.pack(0x45, 0, _IP.size + size, 0, flags, 64, 17, 0, sender, _RECEIVER)
    total = sum(struct.unpack(">10H", head)) + ids
    folded = (total & 0xFFFF) + (total >> 16)
    check = ~((folded & 0xFFFF) + (folded >> 16)) & 0xFFFF
    headers = np.tile(np.frombuffer(head, np.uint8), (len(ids), 1))
    for at, words in ((_IP_ID_AT, ids), (_IP_CHECK_AT, check)):
        headers[:, at], headers[:, at + 1] = words >> 8, words & 0xFF
    return headers
