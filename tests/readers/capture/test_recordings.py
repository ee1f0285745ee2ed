"""Real captures: packet counts of the recordings' MANIFEST, contents as dpkt reads them."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from tests.builders.reading import RECORDINGS, dpkt_read, open_capture, read

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


@pytest.mark.parametrize("name", MANIFEST)
def test_packet_counts_are_those_of_the_manifest(name: str) -> None:
    seen = read(open_capture(capture(name)))
    found = Counter((int(one.stream.split()[-1]), len(one.payload)) for one in seen)
    assert found == MANIFEST[name]


@pytest.mark.parametrize("name", [n for n in MANIFEST if n != WRONG_IP_LENGTH])
def test_contents_are_those_that_dpkt_reads(name: str) -> None:
    path = capture(name)
    seen, expected = read(open_capture(path)), dpkt_read(path)
    assert seen == expected


def test_two_sensors_on_one_port_are_two_streams() -> None:
    name = "ouster/two-sensors_same-ports_legacy/same_ports_legacy.pcap"
    seen = read(open_capture(capture(name)))
    assert {(one.stream, len(one.payload)) for one in seen} == {
        ("169.254.92.158 > port 7502", 24896),
        ("169.254.238.111 > port 7502", 12608),
    }


def test_stray_first_fragment_is_lost_and_the_later_set_is_whole() -> None:
    recording = open_capture(capture("ouster/os2-128_duplicate-ip-id/duplicate_id.pcap"))
    assert len(read(recording)) == 1
    # MANIFEST: 7 frames, of which 6 are the datagram.
    assert recording.counts.frames == 7
    assert recording.counts.skipped == {"fragment_lost": 1, "fragment": 5}


def test_tcp_and_arp_are_counted() -> None:
    recording = open_capture(capture("other/sick-tcp_pcapng/test.pcapng"))
    assert read(recording) == []
    # MANIFEST: TCP 2112 (48), ARP (2).
    assert recording.counts.skipped == {"not_udp": 48, "not_ip": 2}


def test_position_packets_keep_512_bytes_though_their_ip_length_is_wrong() -> None:
    seen = read(open_capture(capture(WRONG_IP_LENGTH)))
    position = [one.payload for one in seen if one.stream.endswith("port 8308")]
    assert {len(payload) for payload in position} == {512}
    assert len(position) == 16


@pytest.mark.parametrize("buffer_bytes", [512, 4096, 40_000])
@pytest.mark.parametrize("name", [n for n in MANIFEST if n.startswith("ouster/")])
def test_buffer_size_does_not_matter(name: str, buffer_bytes: int) -> None:
    path = capture(name)
    whole = open_capture(path)
    expected = read(whole)
    small = open_capture(path, buffer_bytes=buffer_bytes)
    assert read(small) == expected
    assert small.counts == whole.counts
