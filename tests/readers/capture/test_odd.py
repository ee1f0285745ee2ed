"""IP packets in other ones and behind rare headers: what is in them, or one reason for each frame.

Layouts: RFC 1661 and 1662 (PPP), 2516 (PPPoE), 3032 (MPLS), 2784 and 2890 (GRE), 2003 (IPv4 in
IPv4), 4213 (IPv6 in IPv4), 2473 (packets in IPv6).
"""

from __future__ import annotations

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mlbatch.readers.capture.odd import MAX_DEPTH, MAX_HEADER_BYTES, find_ip
from tests.builders.captures import ipv4_packet, ipv4_packets, ipv6_packet, link_frame, udp_frame
from tests.readers.capture.test_frames import found, whole
from tests.reference.capture import Frame

PAYLOAD = bytes(range(64))
UDP = struct.pack(">HHHH", 5000, 7502, 8 + len(PAYLOAD), 0) + PAYLOAD
FOUR = ipv4_packet(UDP, "10.0.0.1", "10.0.0.2")
SIX = ipv6_packet(UDP, "fe80::1", "fe80::2")
# Sent to another protocol, to be counted, not read.
TCP = ipv4_packet(bytes(20), "10.0.0.1", "10.0.0.2", protocol=6)
ETHERNET = bytes(12)
GRE, IPV4_IN_IP, IPV6_IN_IP = 47, 4, 41


def outer(content: bytes, protocol: int) -> bytes:
    """An Ethernet frame with a packet of this protocol."""
    return link_frame(ipv4_packet(content, "172.16.0.1", "172.16.0.2", protocol=protocol))


def outer_six(content: bytes, protocol: int) -> bytes:
    """The same by IPv6, behind options."""
    chain = bytes([protocol, 0, *bytes(6)]) + content
    return link_frame(ipv6_packet(chain, "2001::1", "2001::2", next_header=60), version=6)


def pppoe(protocol: int, packet: bytes) -> bytes:
    """A session packet: version and type, code, session, length, then PPP."""
    return struct.pack(">BBHHH", 0x11, 0, 5, len(packet) + 2, protocol) + packet


# Frames of (link type, bytes) with FOUR.
FRAMES = {
    "PPP": (9, b"\xff\x03\x00\x21" + FOUR),
    "PPP, protocol of one byte": (9, b"\xff\x03\x21" + FOUR),
    "PPP, without framing": (9, b"\x00\x21" + FOUR),
    "PPP, serial": (50, b"\xff\x03\x00\x21" + FOUR),
    "PPPoE": (51, pppoe(0x21, FOUR)),
    "PPPoE, Ethernet": (1, ETHERNET + b"\x88\x64" + pppoe(0x21, FOUR)),
    "PPPoE, VLAN": (1, ETHERNET + b"\x81\x00\x00\x07\x88\x64" + pppoe(0x21, FOUR)),
    "PPPoE, cooked": (113, bytes(14) + b"\x88\x64" + pppoe(0x21, FOUR)),
    "MPLS": (1, ETHERNET + b"\x88\x47" + b"\x00\x01\x01\x40" + FOUR),
    "MPLS, two labels": (
        1,
        ETHERNET + b"\x88\x48" + b"\x00\x01\x00\x40" + b"\x00\x02\x01\x40" + FOUR,
    ),
    "GRE": (1, outer(b"\x00\x00\x08\x00" + FOUR, GRE)),
    "GRE, key and number": (1, outer(b"\x30\x00\x08\x00" + bytes(8) + FOUR, GRE)),
    "GRE, Ethernet": (1, outer(b"\x00\x00\x65\x58" + ETHERNET + b"\x08\x00" + FOUR, GRE)),
    "GRE by IPv6": (1, outer_six(b"\x00\x00\x08\x00" + FOUR, GRE)),
    "IPv4 in IPv4": (1, outer(FOUR, IPV4_IN_IP)),
    "IPv4 in IPv6": (1, outer_six(FOUR, IPV4_IN_IP)),
    "GRE in IPv4 in IPv4": (
        101,
        ipv4_packet(outer(b"\x00\x00\x08\x00" + FOUR, GRE)[14:], "1.1.1.1", "1.1.1.2", protocol=4),
    ),
}
SIX_FRAMES = {
    "PPP": (9, b"\xff\x03\x00\x57" + SIX),
    "PPPoE": (1, ETHERNET + b"\x88\x64" + pppoe(0x57, SIX)),
    "MPLS": (1, ETHERNET + b"\x88\x47" + b"\x00\x01\x01\x40" + SIX),
    "GRE": (1, outer(b"\x00\x00\x86\xdd" + SIX, GRE)),
    "IPv6 in IPv4": (1, outer(SIX, IPV6_IN_IP)),
    "IPv6 in IPv6": (1, outer_six(SIX, IPV6_IN_IP)),
}


@pytest.mark.parametrize(("frames", "source"), [(FRAMES, "10.0.0.1"), (SIX_FRAMES, "fe80::1")])
def test_packets_in_odd_frames_are_read(frames: dict[str, tuple[int, bytes]], source: str) -> None:
    for name, (link, frame) in frames.items():
        assert found([whole(frame, link)]) == [[(5, f"{source} > port 7502", PAYLOAD)], {}], name


@pytest.mark.parametrize("name", FRAMES)
def test_the_rules_for_packets_are_the_same_there(name: str) -> None:
    """Wrong IP length, options, other protocols, cut frames."""
    link, frame = FRAMES[name]
    for length in (0, 60, 1234):
        wrong = ipv4_packet(UDP, "10.0.0.1", "10.0.0.2", total=length)
        seen, skipped = found([whole(frame.replace(FOUR, wrong), link)])
        assert (len(seen), skipped) == (1, {}), length  # type: ignore[arg-type]
    assert found([whole(frame.replace(FOUR, TCP), link)]) == [[], {"not_udp": 1}]
    assert found([Frame(5, link, frame, len(frame) + 1)]) == [[], {"truncated": 1}]
    assert found([whole(frame[:-1], link)]) == [[], {"truncated": 1}]


def test_what_dpkt_reads_wrongly_is_read_rightly() -> None:
    """Headers of IPv6 that it does not skip, and a fragment behind another header."""
    mobility = bytes([17, 0, *bytes(6)]) + UDP
    part = bytes([44, 0, *bytes(6)]) + struct.pack(">BBHI", 17, 0, 0, 5) + UDP
    for chain, first in ((mobility, 135), (part, 60)):
        inner = ipv6_packet(chain, "fe80::1", "fe80::2", next_header=first)
        for frame in (outer(inner, IPV6_IN_IP), outer(b"\x00\x00\x86\xdd" + inner, GRE)):
            assert found([whole(frame)])[1] == {}


def test_fragments_in_tunnels_are_joined_in_order_with_others() -> None:
    parts = ipv4_packets(UDP[:4] + b"\x01\xf8" + bytes(498), "10.0.0.1", "10.0.0.2", mtu=220)
    tunnelled = [whole(outer(b"\x00\x00\x08\x00" + part, GRE)) for part in parts]
    plain = [whole(udp_frame(bytes([i]))[0]) for i in range(4)]
    frames = [plain[0], tunnelled[2], plain[1], tunnelled[0], plain[2], tunnelled[1], plain[3]]
    for portions in (1, 2, 7):
        seen, skipped = found(frames, portions)
        payloads = [payload for _, _, payload in seen]  # type: ignore[attr-defined]
        assert payloads == [b"\x00", b"\x01", b"\x02", bytes(496), b"\x03"]
        assert skipped == {"fragment": 2}


@pytest.mark.parametrize("depth", range(MAX_DEPTH - 1, MAX_DEPTH + 2))
@pytest.mark.parametrize("portions", [1, 3])
def test_packets_in_packets_are_opened_so_far(depth: int, portions: int) -> None:
    packet = FOUR
    for number in range(depth):
        packet = ipv4_packet(packet, "10.9.0.1", f"10.9.0.{number}", protocol=IPV4_IN_IP)
    seen, skipped = found([whole(link_frame(packet))] * 3, portions)
    is_read = depth <= MAX_DEPTH
    assert len(seen) == 3 * is_read  # type: ignore[arg-type]
    assert skipped == ({} if is_read else {"not_udp": 3})


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (outer(bytes(60), GRE), "not_udp"),
        (outer(bytes(60), IPV4_IN_IP), "not_udp"),
        (outer(SIX, IPV4_IN_IP), "not_udp"),
        (outer(FOUR, IPV6_IN_IP), "not_udp"),
        (outer(b"\x00\x00\x88\xcc" + bytes(30), GRE), "not_udp"),
        (ETHERNET + b"\x88\x64" + bytes(40), "not_ip"),
        (ETHERNET + b"\x88\x64" + pppoe(0xC021, bytes(30)), "not_ip"),
        (ETHERNET + b"\x88\x47" + bytes(40), "not_ip"),
        (ETHERNET + b"\x88\x47", "not_ip"),
    ],
)
def test_frames_without_a_packet_have_one_reason(frame: bytes, reason: str) -> None:
    plain = whole(udp_frame(b"x")[0])
    assert found([plain, whole(frame), plain])[1] == {reason: 1}


@settings(max_examples=300, deadline=None)
@given(
    data=st.binary(max_size=MAX_HEADER_BYTES),
    kind=st.sampled_from([4, 41, 47, 0x8847, 0x8848, 0x8864, -9, -50, -51]),
)
def test_any_bytes_have_a_place_or_none(data: bytes, kind: int) -> None:
    place = find_ip(data, kind)
    assert place is None or 0 <= place < len(data)


@settings(max_examples=300, deadline=None)
@given(data=st.data())
def test_any_damage_is_counted(data: st.DataObject) -> None:
    """`found` checks that each frame is delivered or counted once."""
    frames = []
    for link, frame in (*FRAMES.values(), *SIX_FRAMES.values()):
        damaged = bytearray(frame)
        damaged[data.draw(st.integers(0, len(frame) - 1))] = data.draw(st.integers(0, 255))
        frames.append(whole(bytes(damaged[: data.draw(st.integers(0, len(frame)))]), link))
    assert found(frames, 1) == found(frames, 5)
