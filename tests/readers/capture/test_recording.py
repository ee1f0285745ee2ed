"""Captures: laws on any buffer, and real recordings with dpkt as a witness."""

from __future__ import annotations

import random
from collections import Counter
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


# (port, payload size): packets; MANIFEST.md, columns "transport" and "packets".
MANIFEST = {
    "ouster/os0-128_v2.3.0_rng15/OS-0-128-U1_v2.3.0_1024x10.pcap": {
        (7502, 8448): 64,
        (7503, 48): 10,
    },
    "ouster/os0-32_v2.2.0_rng19-dual/OS-0-32-U1_v2.2.0_1024x10.pcap": {
        (7502, 8448): 64,
        (7503, 48): 10,
    },
    "ouster/os0-32_v2.2.0_single-packet/OS-0-32-U1_v2.2.0_1024x10-single-packet.pcap": {
        (7502, 8448): 1
    },
    "ouster/os1-128_v2.3.0_rng15_3frames/OS-1-128_v2.3.0_1024x10_lb_n3.pcap": {
        (7502, 8448): 192,
        (7503, 48): 30,
    },
    "ouster/os1-32-g_v2.1.1_legacy/OS-1-32-G_v2.1.1_1024x10.pcap": {(7502, 6464): 64},
    "ouster/os1-64_fw2.0_legacy_reduced-config/OS-1-64_1024x10_fw20.pcap": {
        (7502, 12608): 64,
        (7503, 48): 11,
    },
    "ouster/os1-64_fw1_legacy_broadcast/ouster_example.pcap": {(7502, 12608): 100},
    "ouster/os0-128_512x10_crc/crc_test.pcap": {(7502, 8448): 34, (7503, 48): 10},
    "ouster/os2-128_duplicate-ip-id/duplicate_id.pcap": {(34636, 8448): 1},
    "ouster/os0-128_windowed/windowed_frame1.pcap": {(53750, 8448): 17, (7503, 48): 10},
    "ouster/two-sensors_same-ports_legacy/same_ports_legacy.pcap": {
        (7502, 24896): 1,
        (7502, 12608): 1,
    },
    "ouster/two-sensors_same-ports_nonlegacy/same_ports_nonlegacy.pcap": {
        (7502, 16640): 2,
        (7502, 48): 2,
    },
    "ouster/os0-128_imu-zone-no-lidar/imu_zm_no_lidar.pcap": {(7513, 452): 8, (7514, 680): 1},
    "ouster/empty-pcap/empty_pcap.pcap": {},
    "velodyne/vlp16_gps/sample_velodyne_vlp16_gps.pcap": {(2368, 1206): 293, (8308, 512): 57},
    "velodyne/vlp16_wrong-product-byte/velodyne_vlp16.pcap": {(2368, 1206): 84, (8308, 512): 16},
    "velodyne/hdl32e_named-vlp32/velodyne_vlp32.pcap": {(2368, 1206): 91, (8308, 512): 9},
    "other/lslidar-1212-byte-lookalike/VLI-16-one-packet.pcap": {(2368, 1212): 1},
    "other/sick-tcp_pcapng/test.pcapng": {},
}
# The IP length of 16 packets is wrong there, and dpkt believes it.
WRONG_IP_LENGTH = "velodyne/vlp16_wrong-product-byte/velodyne_vlp16.pcap"


def capture(name: str) -> Path:
    """A recording; the test is skipped where it is absent."""
    path = RECORDINGS / name
    if not path.exists():
        pytest.skip(f"recording {name} is not here")
    return path


# Frames without a datagram; MANIFEST.md: TCP 2112 (48), ARP (2); a stray first fragment.
SKIPPED = {
    "other/sick-tcp_pcapng/test.pcapng": {"not_udp": 48, "not_ip": 2},
    "ouster/os2-128_duplicate-ip-id/duplicate_id.pcap": {"fragment_lost": 1, "fragment": 5},
}


@pytest.mark.parametrize("name", MANIFEST)
def test_packets_are_those_of_the_manifest_and_of_dpkt(name: str) -> None:
    path = RECORDINGS / name
    if not path.exists():
        pytest.skip(f"recording {name} is not here")
    recording = open_capture(path)
    seen = read(recording)
    found = Counter((int(one.stream.split()[-1]), len(one.payload)) for one in seen)
    assert found == MANIFEST[name]
    assert recording.counts.skipped == SKIPPED.get(name, recording.counts.skipped)
    if name != WRONG_IP_LENGTH:
        assert seen == dpkt_read(path)
    assert read(open_capture(path, buffer_bytes=512)) == seen
