"""Captures from values: UDP frames of every link type, pcap and pcapng files.

Layouts: RFC 791 (IPv4), RFC 8200 (IPv6), RFC 768 (UDP), draft-ietf-opsawg-pcap and -pcapng.
"""

from __future__ import annotations

import ipaddress
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

if TYPE_CHECKING:
    from typing_extensions import Unpack

ETHERNET = 1
NULL = 0
LOOP = 108
RAW = 101
SLL = 113
SLL2 = 276
ENHANCED = 6
SIMPLE = 3
OLD_PACKET = 2
_UDP = 17
_FRAGMENT_HEADER = 44
_ETHERTYPE = {4: 0x0800, 6: 0x86DD}


# Parsed once: that takes longer than to make a frame.
_address = cache(ipaddress.ip_address)


def udp_frame(
    payload: bytes,
    src: str = "10.0.0.1",
    dst: str = "10.0.0.2",
    sport: int = 7502,
    dport: int = 7502,
    *,
    ident: int = 1,
    mtu: int | None = None,
    vlans: Sequence[int] = (),
    link: int = ETHERNET,
) -> list[bytes]:
    """Frames that carry one datagram: several where `mtu` (bytes of an IP packet) is too small.

    `vlans` are ethertypes of stacked tags, outermost first; addresses with colons give IPv6.
    """
    datagram = struct.pack(">4H", sport, dport, len(payload) + 8, 0) + payload
    version = _address(src).version
    build = ipv4_packets if version == 4 else ipv6_packets
    packets = build(datagram, src, dst, ident=ident, mtu=mtu)
    return [link_frame(packet, link=link, vlans=vlans, version=version) for packet in packets]


def pieces(data: bytes, room: int) -> list[tuple[int, bool, bytes]]:
    """Cut `data` into (offset, more follow, bytes) of at most `room` bytes, in units of 8."""
    step = room // 8 * 8
    return [(at, at + step < len(data), data[at : at + step]) for at in range(0, len(data), step)]


def ipv4_packet(
    data: bytes,
    src: str,
    dst: str,
    *,
    ident: int = 1,
    offset: int = 0,
    more: bool = False,
    protocol: int = _UDP,
    total: int | None = None,
    options: bytes = b"",
) -> bytes:
    """One IPv4 packet; `total` overrides the announced length, `options` fill whole words."""
    length = 20 + len(options)
    header = struct.pack(
        ">BBHHHBBH4s4s",
        0x40 | length // 4,
        0,
        length + len(data) if total is None else total,
        ident & 0xFFFF,
        offset // 8 | (0x2000 if more else 0),
        64,
        protocol,
        0,
        _address(src).packed,
        _address(dst).packed,
    )
    header += options
    total_sum = sum(struct.unpack(f">{len(header) // 2}H", header))
    total_sum = (total_sum & 0xFFFF) + (total_sum >> 16)
    checksum = ~((total_sum & 0xFFFF) + (total_sum >> 16)) & 0xFFFF
    return header[:10] + struct.pack(">H", checksum) + header[12:] + data


def ipv4_packets(
    datagram: bytes, src: str, dst: str, *, ident: int = 1, mtu: int | None = None
) -> list[bytes]:
    """IPv4 packets of a UDP datagram, fragmented where `mtu` asks for it."""
    room = len(datagram) + 8 if mtu is None or len(datagram) + 20 <= mtu else mtu - 20
    return [
        ipv4_packet(part, src, dst, ident=ident, offset=at, more=more)
        for at, more, part in pieces(datagram, room)
    ]


def ipv6_packet(body: bytes, src: str, dst: str, *, next_header: int = _UDP) -> bytes:
    """One IPv6 packet; `body` begins with the header that `next_header` names."""
    addresses = _address(src).packed + _address(dst).packed
    return struct.pack(">IHBB", 6 << 28, len(body), next_header, 64) + addresses + body


def ipv6_packets(
    datagram: bytes, src: str, dst: str, *, ident: int = 1, mtu: int | None = None
) -> list[bytes]:
    """IPv6 packets of a UDP datagram, with fragment headers where `mtu` asks for it."""
    if mtu is None or len(datagram) + 40 <= mtu:
        return [ipv6_packet(datagram, src, dst)]
    return [
        ipv6_piece(part, src, dst, ident=ident, offset=at, more=more)
        for at, more, part in pieces(datagram, mtu - 48)
    ]


def ipv6_piece(part: bytes, src: str, dst: str, *, ident: int, offset: int, more: bool) -> bytes:
    """One IPv6 packet with a fragment header."""
    header = struct.pack(">BBHI", _UDP, 0, offset | more, ident)
    return ipv6_packet(header + part, src, dst, next_header=_FRAGMENT_HEADER)


def link_frame(
    packet: bytes, *, link: int = ETHERNET, vlans: Sequence[int] = (), version: int = 4
) -> bytes:
    """`packet` with the header of its link type and VLAN tags before it."""
    if link == NULL:
        return struct.pack("<I", 2 if version == 4 else 30) + packet
    if link == LOOP:
        return struct.pack(">I", 2 if version == 4 else 30) + packet
    chain = [*vlans, _ETHERTYPE[version]]
    tags = b"".join(struct.pack(">HH", 7, inner) for inner in chain[1:])
    first = struct.pack(">H", chain[0])
    if link == ETHERNET:
        return bytes(range(12)) + first + tags + packet
    if link == SLL:
        return struct.pack(">HHH8s", 0, 1, 6, bytes(8)) + first + tags + packet
    if link == SLL2:
        return first + struct.pack(">HIHBB8s", 0, 3, 1, 0, 6, bytes(8)) + tags + packet
    return packet


class PcapForm(TypedDict, total=False):
    """How a capture is written."""

    ns: bool
    big_endian: bool
    linktype: int
    snaplen: int


def pcap_parts(
    records: Iterable[tuple[int, bytes]],
    *,
    ns: bool = True,
    big_endian: bool = False,
    linktype: int = ETHERNET,
    snaplen: int = 262144,
) -> Iterator[bytes]:
    """A pcap file of (host_ns, frame) records in parts; frames longer than `snaplen` are cut."""
    order = ">" if big_endian else "<"
    magic = 0xA1B23C4D if ns else 0xA1B2C3D4
    yield struct.pack(order + "IHHiIII", magic, 2, 4, 0, 0, snaplen, linktype)
    header = struct.Struct(order + "IIII")
    for host_ns, frame in records:
        seconds, rest_ns = divmod(host_ns, 1_000_000_000)
        fraction = rest_ns if ns else rest_ns // 1000
        yield header.pack(seconds, fraction, min(len(frame), snaplen), len(frame))
        yield frame[:snaplen]


def pcap_bytes(records: Iterable[tuple[int, bytes]], **form: Unpack[PcapForm]) -> bytes:
    """The whole file."""
    return b"".join(pcap_parts(records, **form))


def write_pcap(path: Path, records: Iterable[tuple[int, bytes]], **form: Unpack[PcapForm]) -> Path:
    """Write the file and return its path."""
    with path.open("wb") as file:
        file.writelines(pcap_parts(records, **form))
    return path


@dataclass(frozen=True, slots=True)
class Interface:
    """A pcapng interface; `tsresol` is the option's raw byte, None leaves the option out."""

    link: int = ETHERNET
    tsresol: int | None = 9
    tsoffset_s: int | None = None
    snaplen: int = 0


@dataclass(frozen=True, slots=True)
class Packet:
    """A packet block; `ticks` counts in the interface's resolution, `original` its full length."""

    frame: bytes
    ticks: int = 0
    interface: int = 0
    kind: int = ENHANCED
    original: int | None = None


@dataclass(frozen=True, slots=True)
class Other:
    """Any other block."""

    kind: int
    body: bytes = b""


@dataclass(frozen=True, slots=True)
class Section:
    """A pcapng section; interface blocks may also be among the others."""

    blocks: Sequence[Packet | Other | Interface] = ()
    interfaces: Sequence[Interface] = field(default_factory=lambda: [Interface()])
    big_endian: bool = False


def write_pcapng(path: Path, sections: Sequence[Section]) -> Path:
    """Write sections with their blocks to `path` and return it."""
    path.write_bytes(b"".join(map(section_bytes, sections)))
    return path


def section_bytes(section: Section) -> bytes:
    """A section header block and all its blocks."""
    order = ">" if section.big_endian else "<"
    head = _block(order, 0x0A0D0D0A, struct.pack(order + "IHHq", 0x1A2B3C4D, 1, 0, -1))
    blocks = [*section.interfaces, *section.blocks]
    return head + b"".join(_body(order, block) for block in blocks)


def _body(order: str, block: Packet | Other | Interface) -> bytes:
    if isinstance(block, Other):
        return _block(order, block.kind, block.body)
    if isinstance(block, Interface):
        return _block(order, 1, _interface(order, block))
    original = len(block.frame) if block.original is None else block.original
    if block.kind == SIMPLE:
        return _block(order, SIMPLE, struct.pack(order + "I", original) + block.frame)
    interface = "HH" if block.kind == OLD_PACKET else "I"
    number = (block.interface, 0) if block.kind == OLD_PACKET else (block.interface,)
    times = (block.ticks >> 32, block.ticks & 0xFFFFFFFF)
    head = struct.pack(order + interface + "IIII", *number, *times, len(block.frame), original)
    return _block(order, block.kind, head + block.frame)


def _interface(order: str, interface: Interface) -> bytes:
    body = struct.pack(order + "HHI", interface.link, 0, interface.snaplen)
    if interface.tsresol is not None:
        body += struct.pack(order + "HHBxxx", 9, 1, interface.tsresol)
    if interface.tsoffset_s is not None:
        body += struct.pack(order + "HHq", 14, 8, interface.tsoffset_s)
    return body + struct.pack(order + "HH", 0, 0)


def _block(order: str, kind: int, body: bytes) -> bytes:
    padded = body + bytes(-len(body) % 4)
    length = struct.pack(order + "I", len(padded) + 12)
    return struct.pack(order + "I", kind) + length + padded + length
