"""pcap files, link types and frames, built from values."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import pytest

from mlbatch.errors import RecordingError
from tests.builders import captures
from tests.builders.captures import (
    ETHERNET,
    LOOP,
    NULL,
    RAW,
    SLL,
    SLL2,
    ipv4_packet,
    ipv6_packet,
    link_frame,
    pcap_bytes,
    udp_frame,
    write_pcap,
)
from tests.builders.reading import Seen, open_capture, read

PAYLOAD = bytes(range(256)) * 4
T0_NS = 1_700_000_000_123_456_789


def udp(payload: bytes, *, length: int | None = None, port: int = 7502) -> bytes:
    """A UDP header and its payload; `length` overrides the announced one."""
    size = len(payload) + 8 if length is None else length
    return struct.pack(">4H", 9, port, size, 0) + payload


def skipped(path: Path, frames: list[bytes], linktype: int = ETHERNET) -> dict[str, int]:
    """What is skipped of a capture of these frames, none of which is a datagram."""
    recording = open_capture(write_pcap(path, [(0, f) for f in frames], linktype=linktype))
    assert read(recording) == []
    return recording.counts.skipped


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize("ns", [False, True])
def test_stamps_are_exact_in_both_resolutions_and_byte_orders(
    tmp_path: Path, ns: bool, big_endian: bool
) -> None:
    (frame,) = udp_frame(PAYLOAD)
    path = write_pcap(tmp_path / "a", [(T0_NS, frame)], ns=ns, big_endian=big_endian)
    expected_ns = T0_NS if ns else 1_700_000_000_123_456_000
    assert read(open_capture(path)) == [Seen(expected_ns, "10.0.0.1 > port 7502", PAYLOAD)]


def test_stamps_up_to_2106_are_exact(tmp_path: Path) -> None:
    last_ns = ((1 << 32) - 1) * 1_000_000_000 + 999_999_999
    path = write_pcap(tmp_path / "a", [(last_ns, udp_frame(b"x")[0])])
    assert [one.host_ns for one in read(open_capture(path))] == [last_ns]


@pytest.mark.parametrize("link", [ETHERNET, NULL, LOOP, RAW, 12, 14, SLL, SLL2, 228])
@pytest.mark.parametrize("mtu", [None, 576])
def test_every_link_type_gives_the_payload(tmp_path: Path, link: int, mtu: int | None) -> None:
    frames = [(T0_NS, frame) for frame in udp_frame(PAYLOAD, mtu=mtu, link=link)]
    seen = read(open_capture(write_pcap(tmp_path / "a", frames, linktype=link)))
    assert seen == [Seen(T0_NS, "10.0.0.1 > port 7502", PAYLOAD)]


@pytest.mark.parametrize("link", [ETHERNET, NULL, LOOP, RAW, SLL, SLL2, 229])
@pytest.mark.parametrize("mtu", [None, 576])
def test_every_link_type_gives_ipv6_payloads(tmp_path: Path, link: int, mtu: int | None) -> None:
    frames = udp_frame(PAYLOAD, "fe80::1", "fe80::2", mtu=mtu, link=link)
    path = write_pcap(tmp_path / "a", [(T0_NS, f) for f in frames], linktype=link)
    assert read(open_capture(path)) == [Seen(T0_NS, "fe80::1 > port 7502", PAYLOAD)]


@pytest.mark.parametrize("family", [2, 2 << 24])
def test_null_family_of_either_byte_order(tmp_path: Path, family: int) -> None:
    frame = struct.pack("<I", family) + ipv4_packet(udp(PAYLOAD), "10.0.0.1", "10.0.0.2")
    path = write_pcap(tmp_path / "a", [(0, frame)], linktype=NULL)
    assert [one.payload for one in read(open_capture(path))] == [PAYLOAD]


@pytest.mark.parametrize("vlans", [[0x8100], [0x88A8, 0x8100], [0x9100, 0x8100, 0x8100]])
@pytest.mark.parametrize("link", [ETHERNET, SLL, SLL2])
def test_stacked_vlan_tags(tmp_path: Path, link: int, vlans: list[int]) -> None:
    frames = udp_frame(PAYLOAD, vlans=vlans, link=link) + udp_frame(b"plain", link=link)
    path = write_pcap(tmp_path / "a", [(0, f) for f in frames], linktype=link)
    assert [one.payload for one in read(open_capture(path))] == [PAYLOAD, b"plain"]


def test_largest_datagram_in_one_frame(tmp_path: Path) -> None:
    # 65535 bytes of IP minus 20 of its header and 8 of UDP.
    payload = bytes(65507)
    path = write_pcap(tmp_path / "a", [(0, udp_frame(payload)[0])])
    assert [len(one.payload) for one in read(open_capture(path, buffer_bytes=4096))] == [65507]


def test_ipv4_options_and_ipv6_extension_headers(tmp_path: Path) -> None:
    options = ipv4_packet(udp(b"four"), "10.0.0.1", "10.0.0.2", options=bytes(40))
    # Hop-by-hop (0) of 8 bytes, then destination options (60) of 16, then UDP.
    chain = bytes([60, 0, *bytes(6)]) + bytes([17, 1, *bytes(14)]) + udp(b"six")
    six = ipv6_packet(chain, "fe80::1", "fe80::2", next_header=0)
    frames = [link_frame(options), link_frame(six, version=6)]
    path = write_pcap(tmp_path / "a", [(0, f) for f in frames])
    assert [one.payload for one in read(open_capture(path))] == [b"four", b"six"]


def test_ipv6_fragment_that_is_the_whole_datagram(tmp_path: Path) -> None:
    body = struct.pack(">BBHI", 17, 0, 0, 5) + udp(b"atom")
    frame = link_frame(ipv6_packet(body, "fe80::1", "fe80::2", next_header=44), version=6)
    assert [
        one.payload for one in read(open_capture(write_pcap(tmp_path / "a", [(0, frame)])))
    ] == [b"atom"]


def test_the_udp_length_counts(tmp_path: Path) -> None:
    padded = udp_frame(b"short")[0] + bytes(30)
    wrong = link_frame(ipv4_packet(udp(PAYLOAD), "10.0.0.1", "10.0.0.2", total=1234))
    path = write_pcap(tmp_path / "a", [(0, padded), (0, wrong)])
    assert [one.payload for one in read(open_capture(path))] == [b"short", PAYLOAD]


def test_foreign_frames_are_counted_by_reason(tmp_path: Path) -> None:
    arp = bytes(12) + b"\x08\x06" + bytes(28)
    tcp = link_frame(ipv4_packet(bytes(20), "10.0.0.1", "10.0.0.2", protocol=6))
    icmp6 = link_frame(ipv6_packet(bytes(8), "fe80::1", "fe80::2", next_header=58), version=6)
    spanning_tree = bytes(12) + b"\x00\x26" + bytes(38)
    found = skipped(tmp_path / "a", [arp, tcp, icmp6, spanning_tree, tcp])
    assert found == {"not_ip": 2, "not_udp": 3}


@pytest.mark.parametrize("version", [4, 6])
def test_every_cut_of_a_frame_is_truncated(tmp_path: Path, version: int) -> None:
    pair = ("10.0.0.1", "10.0.0.2") if version == 4 else ("fe80::1", "fe80::2")
    (frame,) = udp_frame(b"12345678", *pair, vlans=[0x8100])
    for snaplen in range(1, len(frame)):
        path = write_pcap(tmp_path / "a", [(0, frame)], snaplen=snaplen)
        recording = open_capture(path)
        assert read(recording) == []
        assert recording.counts.skipped == {"truncated": 1}, snaplen


@pytest.mark.parametrize("length", [0, 7, 100])
def test_impossible_udp_lengths_are_truncated(tmp_path: Path, length: int) -> None:
    frame = link_frame(ipv4_packet(udp(b"12345", length=length), "10.0.0.1", "10.0.0.2"))
    assert skipped(tmp_path / "a", [frame]) == {"truncated": 1}


def test_streams_are_numbered_by_their_first_packets(tmp_path: Path) -> None:
    sources = ["10.0.0.9", "10.0.0.1", "10.0.0.9", "10.0.0.5"]
    frames = [(i, udp_frame(b"x", src)[0]) for i, src in enumerate(sources)]
    recording = open_capture(write_pcap(tmp_path / "a", frames))
    (batch,) = recording.packets()
    assert batch.stream.tolist() == [0, 1, 0, 2]
    found = [stream.source_ip for stream in recording.streams.streams]
    assert found == ["10.0.0.9", "10.0.0.1", "10.0.0.5"]


def test_last_record_that_is_cut_off_is_one_truncated_frame(tmp_path: Path) -> None:
    whole = pcap_bytes([(0, udp_frame(b"first")[0]), (1, udp_frame(b"second")[0])])
    last = 16 + len(udp_frame(b"second")[0])
    for cut in range(1, last):
        (tmp_path / "a").write_bytes(whole[:-cut])
        recording = open_capture(tmp_path / "a")
        assert [one.payload for one in read(recording)] == [b"first"]
        assert recording.counts.skipped == {"truncated": 1}
        assert recording.notes[0].startswith(f"byte {len(whole) - last}: ")


@pytest.mark.parametrize("claimed", [262_145, 10_000_000, 0xFFFFFFFF])
def test_a_lying_record_ends_the_readable_part(tmp_path: Path, claimed: int) -> None:
    first = pcap_bytes([(0, udp_frame(b"first")[0])])
    wrong_record = struct.pack("<IIII", 0, 0, claimed, claimed)
    (tmp_path / "a").write_bytes(first + wrong_record + bytes(600_000))
    recording = open_capture(tmp_path / "a")
    assert [one.payload for one in read(recording)] == [b"first"]
    assert recording.counts.skipped == {"truncated": 1}
    assert recording.notes == [
        f"byte {len(first)}: expected a frame of at most 262144 bytes, found {claimed}; "
        "the rest of the file was not read"
    ]


def test_each_pass_starts_anew(tmp_path: Path) -> None:
    frames = [(T0_NS + i * 100, udp_frame(bytes([i]))[0]) for i in range(10)]
    recording = open_capture(write_pcap(tmp_path / "a", frames))
    for _ in range(2):
        assert [one.payload[0] for one in read(recording)] == list(range(10))
        assert recording.counts.frames == 10
    assert recording.position_bytes == recording.size_bytes


def test_a_pass_that_is_given_up_leaves_balanced_counts(tmp_path: Path) -> None:
    frames = [f for i in range(50) for f in udp_frame(PAYLOAD, ident=i, mtu=576)]
    path = write_pcap(tmp_path / "a", [(0, f) for f in frames])
    recording = open_capture(path, buffer_bytes=1000)
    packets = recording.packets()
    next(packets)
    del packets
    counts = recording.counts
    assert 0 < counts.frames < len(frames)
    assert counts.frames == counts.datagrams + sum(counts.skipped.values())


def test_unknown_link_type_is_named(tmp_path: Path) -> None:
    path = write_pcap(tmp_path / "a", [], linktype=127)
    with pytest.raises(RecordingError, match=r"found 127 \(IEEE 802\.11 radiotap\)"):
        open_capture(path)


def test_fcs_bits_in_the_link_type_field_are_ignored(tmp_path: Path) -> None:
    path = write_pcap(tmp_path / "a", [(0, udp_frame(b"x")[0])], linktype=0x5400_0001)
    assert len(read(open_capture(path))) == 1


def test_modified_pcap_is_refused_with_a_way_on(tmp_path: Path) -> None:
    path = tmp_path / "old.pcap"
    path.write_bytes(struct.pack("<I", 0xA1B2CD34) + bytes(20))
    with pytest.raises(RecordingError, match=r"a1b2cd34.*editcap"):
        open_capture(path)


def test_builders_agree_with_the_header_lengths() -> None:
    # 14 Ethernet + 20 IPv4 + 8 UDP + 5; SLL 16 and SLL2 20 in Ethernet's place.
    sizes = [len(captures.udp_frame(b"12345", link=link)[0]) for link in (ETHERNET, SLL, SLL2)]
    assert sizes == [47, 49, 53]


@pytest.mark.parametrize("zeros", [16, 40, 5_000_000])
def test_zeros_after_the_last_record_end_a_capture(tmp_path: Path, zeros: int) -> None:
    """A full disk or a power cut leaves them: 16 would be a record at 1970 without a byte."""
    (frame,) = udp_frame(PAYLOAD)
    whole = pcap_bytes([(T0_NS, frame)] * 3)
    (tmp_path / "a").write_bytes(whole + bytes(zeros))
    recording = open_capture(tmp_path / "a")
    assert len(read(recording)) == 3
    assert recording.notes == [
        f"byte {len(whole)}: expected a record, found zeros; the rest of the file was not read"
    ]
    assert recording.counts.skipped == {"truncated": 1}


@pytest.mark.parametrize("suffix", ["", ".gz"])
def test_a_capture_of_zeros_is_refused_at_its_first_record(tmp_path: Path, suffix: str) -> None:
    """Not read to its end, which may be 5 GB away in a small file."""
    data = pcap_bytes([]) + bytes(1 << 20)
    path = tmp_path / f"a.pcap{suffix}"
    path.write_bytes(gzip.compress(data) if suffix else data)
    with pytest.raises(RecordingError, match=r"expected a record, found zeros at byte 24; nothing"):
        open_capture(path)


def test_a_frame_without_bytes_at_a_time_is_one(tmp_path: Path) -> None:
    data = pcap_bytes([(T0_NS, b"")]) + pcap_bytes([(T0_NS, udp_frame(PAYLOAD)[0])])[24:]
    (tmp_path / "b").write_bytes(data)
    assert len(read(open_capture(tmp_path / "b"))) == 1
