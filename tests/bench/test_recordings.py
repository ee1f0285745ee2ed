"""Recordings of the benchmark, read by dpkt, by hand-computed offsets, and by a conversion."""

from __future__ import annotations

import datetime
import json
import math
import socket
import struct
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import dpkt
import pytest
from mcap.reader import make_reader

from tests.bench import recordings
from tests.bench.cases import CAPTURE, RECORDINGS, RIG
from tests.bench.recordings import make
from tests.builders.run import command

SECONDS = 1.0
CAPTURES = [name for name, recording in RECORDINGS.items() if not recording.is_bag]
CLOUDS = [name for name, recording in RECORDINGS.items() if recording.is_bag]
EPOCH_S = 1_700_000_000
# 640 packets per second, 64 per revolution; the second sensor's rotor is 37.1 ms late: 23.7 packets
# less.
OUSTER_PACKETS = {"192.168.7.11": 640, "192.168.7.12": 616}
# 100 per second, the second sensor's 37.1 ms late.
IMU_PACKETS = {"192.168.7.11": 100, "192.168.7.12": 96}
IMU_BYTES = 48
A_IP, B_IP = OUSTER_PACKETS


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One second of each recording, each in its own folder."""
    place = tmp_path_factory.mktemp("recordings")
    for name, recording in RECORDINGS.items():
        (place / name).mkdir()
        make(recording, SECONDS, place / name)
    return place


def records(path: Path) -> Iterator[tuple[float, bytes]]:
    """Capture time in s and bytes of every record, read by another library."""
    with (path / CAPTURE).open("rb") as file:
        yield from dpkt.pcap.Reader(file)


def datagrams(path: Path) -> Iterator[tuple[float, str, bytes]]:
    """Capture time in s, sender and payload."""
    for stamp, frame in records(path):
        ip = dpkt.ethernet.Ethernet(frame).data
        yield float(stamp), socket.inet_ntoa(ip.src), ip.data.data


@pytest.mark.parametrize(("name", "size"), [("dual-4", 8448), ("dual-12", 24832)])
def test_two_ousters(folder: Path, name: str, size: int) -> None:
    """docs/sources/ouster.md: header 32, 16 columns of 12 bytes and 128 pixels, footer 32."""
    sent = Counter((source, len(data)) for _, source, data in datagrams(folder / name))
    lidars = {(source, size): count for source, count in OUSTER_PACKETS.items()}
    imus = {(source, IMU_BYTES): count for source, count in IMU_PACKETS.items()}
    assert sent == lidars | imus


def test_ouster_imu_samples_are_10_ms_apart(folder: Path) -> None:
    """docs/sources/ouster.md section 8: three times in ns, m/s2 / 9.80665, deg/s."""
    sent = [one for one in datagrams(folder / "dual-4") if len(one[2]) == IMU_BYTES]
    of_b = [
        (host_s, struct.unpack("<3q6f", data)) for host_s, source, data in sent if source == B_IP
    ]
    for number, (host_s, (*stamps_ns, x, y, z, _, _, _)) in enumerate(of_b, 1):
        stamp_ns = EPOCH_S * 10**9 + 37_100_000 + number * 10_000_000
        assert stamps_ns == [stamp_ns] * 3
        assert (x, y, z) == (0, 0, 1)
        assert 0 < host_s - stamp_ns / 1e9 < 0.001


def test_a_recording_without_imu_has_the_same_lidar_packets(folder: Path) -> None:
    plain, both = (datagrams(folder / name) for name in ("dual-4-no-imu", "dual-4"))
    assert list(plain) == [one for one in both if len(one[2]) != IMU_BYTES]


def test_ouster_columns_are_consecutive(folder: Path) -> None:
    stamps_ns: list[int] = []
    for number, (host_s, _, data) in enumerate(
        one for one in datagrams(folder / "dual-4") if one[1] == B_IP and len(one[2]) != IMU_BYTES
    ):
        kind, frame_id = struct.unpack_from("<HH", data)
        assert (kind, frame_id) == (1, number // 64)
        assert int.from_bytes(data[7:12], "little") == 122201000999
        for column in range(16):
            stamp_ns, mid, status = struct.unpack_from("<QHH", data, 32 + column * 524)
            assert (mid, status) == (number % 64 * 16 + column, 1)
            stamps_ns.append(stamp_ns)
        # Less than 2 ms in a packet, and 0.3 ms of transport.
        assert 0 < host_s - stamps_ns[-1] / 1e9 < 0.002
    assert stamps_ns[0] == EPOCH_S * 10**9 + 37_100_000
    assert {b - a for a, b in pairwise(stamps_ns)} == {97656, 97657}


def test_both_profiles_have_the_same_ranges(folder: Path) -> None:
    low = next(datagrams(folder / "dual-4"))[2]
    full = next(datagrams(folder / "dual-12"))[2]
    near = 0
    for channel in range(128):
        eighth_mm, reflectivity = struct.unpack_from("<HB", low, 44 + channel * 4)
        range_mm, same, _, signal = struct.unpack_from("<IBBH", full, 44 + channel * 12)
        assert (range_mm // 8, reflectivity) == (eighth_mm, same)
        assert (range_mm == 0) == (reflectivity == 0)
        assert range_mm < 2**19
        near += 500 < range_mm < 40_000
        assert signal < 2**16
    assert near > 64


def test_fragments_join_to_the_plain_packets(folder: Path) -> None:
    joined: dict[tuple[bytes, int], bytearray] = {}
    counts: Counter[tuple[bytes, int]] = Counter()
    for _, frame in records(folder / "dual-4-fragments"):
        assert len(frame) <= 1514
        assert dpkt.dpkt.in_cksum(frame[14:34]) == 0
        source = frame[26:30]
        ip_id = int.from_bytes(frame[18:20], "big")
        offset = (int.from_bytes(frame[20:22], "big") & 0x1FFF) * 8
        data = joined.setdefault((source, ip_id), bytearray(8456))
        data[offset : offset + len(frame) - 34] = frame[34:]
        counts[source, ip_id] += 1
    # One frame for each packet of an IMU.
    assert Counter(counts.values())[1] == sum(IMU_PACKETS.values())
    counts = Counter({key: count for key, count in counts.items() if count > 1})
    # 8456 bytes in fragments of 1480.
    assert set(counts.values()) == {6}
    for _, frame in records(folder / "dual-4"):
        source = frame[26:30]
        ip_id = int.from_bytes(frame[18:20], "big")
        assert joined.pop((source, ip_id))[: len(frame) - 34] == frame[34:]
    assert not joined


@pytest.mark.parametrize("name", CAPTURES)
def test_records_are_in_order_and_of_about_the_given_size(folder: Path, name: str) -> None:
    times = [stamp for stamp, _ in records(folder / name)]
    assert all(later >= earlier for earlier, later in pairwise(times))
    size = (folder / name / CAPTURE).stat().st_size
    assert size == pytest.approx(RECORDINGS[name].bytes_per_s * SECONDS, rel=0.05)


def test_velodyne_azimuths_follow_the_clock(folder: Path) -> None:
    """docs/sources/velodyne.md: 12 blocks of 100 bytes, then us past the hour and two bytes."""
    packets = [one for one in datagrams(folder / "three-vlp16") if one[1] == "192.168.7.21"]
    assert len(packets) == 753
    for number, (_, _, data) in enumerate(packets):
        begin_ns = number * 1_327_104
        past_us, mode, product = struct.unpack_from("<IBB", data, 1200)
        assert (mode, product) == (0x37, 0x22)
        assert past_us == EPOCH_S % 3600 * 10**6 + begin_ns // 1000
        for block in range(12):
            flag, cdeg = struct.unpack_from("<HH", data, block * 100)
            assert flag == 0xEEFF
            assert cdeg == int((begin_ns + block * 110_592) * 36_000 / 1e8) % 36_000


def test_hesai_packets_contain_the_date(folder: Path) -> None:
    """docs/sources/hesai.md section 3: the tail of a Pandar64 begins at byte 1172."""
    _, _, data = next(datagrams(folder / "pandar64"))
    assert len(data) == 1198
    assert data[:8] == bytes.fromhex("eeff400600040000")
    year, month, day, hour, minute, second = data[1188:1194]
    date = datetime.datetime(
        1900 + year, month, day, hour, minute, second, tzinfo=datetime.timezone.utc
    )
    assert date.timestamp() == EPOCH_S


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_conversion_accepts_every_packet(folder: Path, tmp_path: Path, name: str) -> None:
    place = folder / name
    recording = RECORDINGS[name]
    report = tmp_path / "report.json"
    done = command(
        "convert", place / recording.file, "--rig", place / RIG, "--dry-run", "--report", report
    )
    report_document = json.loads(report.read_text(encoding="utf-8"))
    # How the times of clouds are read, and how many points have no place.
    expected = ["clouds", "clouds"] if recording.is_bag else []
    assert [one["code"] for one in report_document["warnings"]] == expected
    assert (done.code, done.err == "") == (0, not recording.is_bag)
    assert not report_document["unassigned"]
    assert [sensor["name"] for sensor in report_document["sensors"]] == [
        sensor.name for sensor in RECORDINGS[name].sensors
    ]
    for sensor in report_document["sensors"]:
        assert sensor["packets"]["read"] == sensor["packets"]["accepted"] > 0
        slots = sensor["points"]["slots"]
        assert 0.7 < sensor["points"]["written"] / slots < 0.9
    # Of ten windows the first, the last, and one at a phase are incomplete.
    slots = sum(sensor["points"]["slots"] for sensor in report_document["sensors"])
    assert 0.75 < slots / (RECORDINGS[name].slots_per_s * SECONDS) < 0.95


@pytest.mark.parametrize("name", CLOUDS)
def test_clouds_are_revolutions_of_64_rings(folder: Path, name: str) -> None:
    """Read by another library; by hand: 2048 columns in 100 ms are 48,828 ns apart."""
    path = folder / name / RECORDINGS[name].file
    assert path.stat().st_size == pytest.approx(RECORDINGS[name].bytes_per_s * SECONDS, rel=0.01)
    with path.open("rb") as file:
        messages = [one for _, _, one in make_reader(file).iter_messages()]
    assert len(messages) == 20
    # The points, and the flag behind them.
    points = messages[-1].data[-1 - 131_072 * 32 : -1]
    step = 2048 if "ring" in name else 1
    rows = [struct.unpack_from("<4fIH", points, 32 * number) for number in range(0, 131_072, step)]
    assert [row[5] for row in rows[:64]] == list(range(64))
    assert {row[4] for row in rows[:64]} == {0}
    if step == 1:
        assert [row[4] for row in rows[::64]][:4] == [0, 48_828, 97_656, 146_484]
    near = [math.dist(row[:3], (0, 0, 0)) for row in rows]
    assert max(near) < 40
    assert 0.05 < sum(one == 0 for one in near) / len(near) < 0.5


def test_fragments_give_the_same_scans(folder: Path, tmp_path: Path) -> None:
    found = []
    for name in ("dual-4", "dual-4-fragments"):
        output = tmp_path / name
        done = command(
            "convert", folder / name / CAPTURE, "--rig", folder / name / RIG, "-o", output
        )
        assert done.code == 0
        found.append([path.read_bytes() for path in sorted(output.glob("*.npz"))])
    assert found[0] == found[1]
    assert found[0]


def test_the_chunk_length_does_not_matter(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recordings, "CHUNK_NS", 70_000_000)
    make(RECORDINGS["mixed"], SECONDS, tmp_path)
    assert (tmp_path / CAPTURE).read_bytes() == (folder / "mixed" / CAPTURE).read_bytes()
