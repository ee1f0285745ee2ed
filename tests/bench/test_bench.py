"""What the recordings hold that are replayed from a real capture, in each container."""

from __future__ import annotations

import socket
import struct
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import dpkt
import pytest

from tests.bench import containers
from tests.bench.capture import CAPTURE, PCAP_NAME
from tests.bench.recordings import make_recording

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not (CAPTURE / PCAP_NAME).exists(), reason=f"the shared recordings lack {PCAP_NAME}"
    ),
]

# The capture has 192 lidar and 30 IMU packets (the manifest of the recordings).
CYCLES = 4
SECONDS = CYCLES * 0.3
LIDAR_PACKETS = 192 * CYCLES
IMU_PACKETS = 30 * CYCLES
SOURCES = ("192.168.7.11", "192.168.7.12")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the short recording, plain and in fragments."""
    place = tmp_path_factory.mktemp("bench")
    for fragments in (False, True):
        make_recording(place, SECONDS, fragments)
    return place


def records(path: Path) -> Iterator[tuple[float, bytes]]:
    """Capture time in s and bytes of every record, read by another library."""
    with path.open("rb") as file:
        yield from dpkt.pcap.Reader(file)


def test_plain_recording_holds_each_packet_of_both_sensors(folder: Path) -> None:
    sizes: Counter[tuple[str, int]] = Counter()
    for _, frame in records(folder / "two_os1-128_1.2s.pcap"):
        ip = dpkt.ethernet.Ethernet(frame).data
        sizes[socket.inet_ntoa(ip.src), len(ip.data.data)] += 1
    expected = Counter({(source, 8448): LIDAR_PACKETS for source in SOURCES})
    expected.update({(source, 48): IMU_PACKETS for source in SOURCES})
    assert sizes == expected


def test_fragments_are_six_a_packet_and_join_to_the_plain_packets(folder: Path) -> None:
    joined: dict[tuple[bytes, int], bytearray] = {}
    counts: Counter[tuple[bytes, int]] = Counter()
    for _, frame in records(folder / "two_os1-128_1.2s_fragments.pcap"):
        assert len(frame) <= 1514
        assert dpkt.dpkt.in_cksum(frame[14:34]) == 0
        source, ip_id = frame[26:30], int.from_bytes(frame[18:20], "big")
        offset = (int.from_bytes(frame[20:22], "big") & 0x1FFF) * 8
        data = joined.setdefault((source, ip_id), bytearray(8456))
        data[offset : offset + len(frame) - 34] = frame[34:]
        counts[source, ip_id] += 1
    assert Counter(counts.values()) == Counter({6: 2 * LIDAR_PACKETS, 1: 2 * IMU_PACKETS})
    for _, frame in records(folder / "two_os1-128_1.2s.pcap"):
        source, ip_id = frame[26:30], int.from_bytes(frame[18:20], "big")
        assert joined[source, ip_id][: len(frame) - 34] == frame[34:]


@pytest.mark.parametrize("suffix", ["", "_fragments"])
def test_capture_times_never_step_back(folder: Path, suffix: str) -> None:
    times = [time for time, _ in records(folder / f"two_os1-128_1.2s{suffix}.pcap")]
    assert all(later >= earlier for earlier, later in pairwise(times))


def test_columns_follow_each_other_and_the_capture_clock(folder: Path) -> None:
    stamps_ns: dict[str, list[int]] = {source: [] for source in SOURCES}
    frame_ids: dict[str, list[int]] = {source: [] for source in SOURCES}
    serials: dict[str, set[int]] = {source: set() for source in SOURCES}
    for host_s, frame in records(folder / "two_os1-128_1.2s.pcap"):
        packet, source = frame[42:], socket.inet_ntoa(frame[26:30])
        if len(packet) != 8448:
            continue
        first_ns = struct.unpack_from("<Q", packet, 32)[0]
        last_ns = struct.unpack_from("<Q", packet, 32 + 15 * 524)[0]
        stamps_ns[source] += [first_ns, last_ns]
        frame_ids[source].append(int.from_bytes(packet[2:4], "little"))
        serials[source].add(int.from_bytes(packet[7:12], "little"))
        # The common-clock rule of the contract: stamps and arrival within 1 s; here a few ms.
        assert abs(float(host_s) - last_ns / 1e9) < 0.02
    assert [serials[source] for source in SOURCES] == [{122201000998}, {122201000999}]
    for source in SOURCES:
        assert all(0 < b - a < 2_000_000 for a, b in pairwise(stamps_ns[source]))
        assert frame_ids[source] == [1795 + number // 64 for number in range(LIDAR_PACKETS)]
    assert stamps_ns[SOURCES[1]][0] - stamps_ns[SOURCES[0]][0] == 37_100_000


def test_containers_hold_the_same_packets(folder: Path) -> None:
    pcap = folder / "two_os1-128_1.2s.pcap"
    found = []
    for suffix in (".pcap", *containers.WRITERS):
        path = pcap.with_suffix(suffix)
        if not path.exists():
            containers.write(pcap, path)
        told = containers.read(path)
        found.append((told["packets"], told["bytes"]))
    lidars, imus = 2 * LIDAR_PACKETS, 2 * IMU_PACKETS
    assert found == [(lidars + imus, lidars * 8448 + imus * 48)] * len(found)
