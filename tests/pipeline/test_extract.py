"""`mlbatch extract`: what it writes converts to the same scans as that piece of the original."""

from __future__ import annotations

import ipaddress
import re
import struct
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import dpkt
import numpy as np
import pytest
from mcap.reader import make_reader

from mlbatch.batching.windows import Limit
from mlbatch.discovery.discover import SensorSelection
from mlbatch.errors import MlbatchError, UsageError
from mlbatch.pipeline.extract import Extracted, Extraction, extract
from mlbatch.pipeline.job import Job, TimeSegment
from mlbatch.readers import open_recording
from mlbatch.types import StreamTable
from mlbatch.units import NS_PER_S
from tests.builders.bags import Body, Recorded
from tests.builders.captures import pcap_bytes, udp_frame
from tests.builders.livox import LivoxSpec, point_packets
from tests.builders.mcaps import write_mcap
from tests.builders.messages import Unit, messages
from tests.builders.rosbag1 import write_rosbag1
from tests.builders.run import (
    FIXTURE,
    FOUR_MAKERS,
    ROOT,
    TWO_LIDARS,
    buffers_of,
    in_memory,
    print_of,
    prints,
)
from tests.builders.sessions_of_bags import packets_only
from tests.builders.traffic import datagrams_of, read_pcap
from tests.matrix.containers import CONTAINERS, packets_of, rig_text
from tests.matrix.lidars import VENDORS, plain, write_metadata

TARGETS = (".pcap", ".mcap", ".db3", ".bag")
FOUR = Job(
    (FOUR_MAKERS / "four_makers.pcap",),
    SensorSelection(rig=FOUR_MAKERS / "rig.yaml"),
    keep_partial=True,
)
FRAMES = read_pcap(FIXTURE.recordings[0])
SCAN = "hesai_lidar/PandarScan"
CORRECTION = b"\x47\x74\x05\x00"
LIDAR_PORTS = (7502, 7503)
# A piece of the fixture, which begins 08:00:00.020.
BEGIN_NS = 1_777_881_600_200_000_000
END_NS = BEGIN_NS + 400_000_000


def _matrix(container: str) -> Callable[[Path], Job]:
    def write(folder: Path) -> Job:
        session = [plain(vendor) for vendor in VENDORS]
        write_metadata(folder)
        rig = folder / "rig.yaml"
        rig.write_text(rig_text(session, container), encoding="utf-8")
        path = CONTAINERS[container](folder, session)
        return Job((path,), SensorSelection(rig=rig), keep_partial=True)

    return write


def _with_vlan(folder: Path) -> Job:
    path = folder / "vlan.pcap"
    frames = [
        (one.host_ns, frame)
        for number, one in enumerate(datagrams_of(FRAMES))
        for frame in udp_frame(
            one.payload, one.source, dport=one.port, ident=number, mtu=1500, vlans=[0x8100]
        )
    ]
    path.write_bytes(pcap_bytes(frames))
    return replace(FIXTURE, recordings=(path,))


def _in_files(folder: Path) -> Job:
    """As tcpdump -C writes it: borders are within datagrams."""
    paths = []
    for number, at in enumerate(range(0, len(FRAMES), 500)):
        path = folder / f"trace.pcap{number}"
        path.write_bytes(pcap_bytes(FRAMES[at : at + 500]))
        paths.append(path)
    return replace(FIXTURE, recordings=tuple(paths))


SOURCES: Mapping[str, Callable[[Path], Job]] = {
    "fragments, one port": lambda _: FIXTURE,
    "VLAN": _with_vlan,
    "several files": _in_files,
    "four vendors, pcap": lambda _: FOUR,
    "four vendors, mcap": _matrix("mcap"),
    "four vendors, rosbag1": _matrix("rosbag1"),
    "four vendors, rosbag2": _matrix("rosbag2"),
}


def extracted(job: Job, target: Path, **options: object) -> tuple[Extracted, Job]:
    """What was extracted of a job's recordings, and the job that converts it."""
    request = Extraction(job.recordings, target, job.selection)
    found = extract(replace(request, **options))  # type: ignore[arg-type]
    assert found.read == found.written + sum(found.left_out.values())
    assert found.written == sum(one.written for one in found.lidars)
    rig = target.with_name(f"{target.stem}.rig.yaml")
    return found, replace(job, recordings=(target,), selection=SensorSelection(rig=rig))


def datagrams(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Receive times and payloads by stream."""
    table = StreamTable()
    found: dict[str, list[tuple[int, bytes]]] = {}
    for batch in open_recording(path, table).packets():
        for row in range(len(batch)):
            begin = int(batch.start[row])
            payload = batch.data[begin : begin + int(batch.size[row])].tobytes()
            stream = str(table.streams[int(batch.stream[row])])
            found.setdefault(stream, []).append((int(batch.host_ns[row]), payload))
    return found


@pytest.mark.parametrize(
    ("name", "suffix"),
    # Every source and every target once, and one source with all targets.
    [
        *(("four vendors, pcap", suffix) for suffix in TARGETS[:3]),
        *zip(SOURCES, (*TARGETS, *TARGETS[:3]), strict=True),
    ],
)
def test_the_extract_converts_to_the_same_scans(name: str, suffix: str, tmp_path: Path) -> None:
    job = SOURCES[name](tmp_path)
    (tmp_path / "out").mkdir()
    _, other = extracted(job, tmp_path / "out" / f"drive{suffix}")
    expected = in_memory(job)
    assert len(expected.scans) > 4
    assert prints(in_memory(other)) == prints(expected)


@pytest.mark.parametrize("suffix", TARGETS)
def test_a_piece_converts_as_that_piece_of_the_original(suffix: str, tmp_path: Path) -> None:
    limits = {"start": Limit(BEGIN_NS), "end": Limit(END_NS)}
    found, other = extracted(FIXTURE, tmp_path / f"piece{suffix}", **limits)
    piece = replace(FIXTURE, segment=TimeSegment(BEGIN_NS, END_NS))
    assert prints(in_memory(other)) == prints(in_memory(piece))
    assert BEGIN_NS <= found.first_ns <= found.last_ns < END_NS
    inside = [one for one in datagrams_of(FRAMES) if BEGIN_NS <= one.host_ns < END_NS]
    assert found.written == sum(one.port in LIDAR_PORTS for one in inside)


def test_windows_of_a_piece_are_those_of_the_whole(tmp_path: Path) -> None:
    """Its only DIFOP packets, without which one lidar cannot be read, come before the piece."""
    whole = {scan.start_ns: scan for scan in in_memory(FOUR).scans}
    _, other = extracted(FOUR, tmp_path / "piece.pcap", start=Limit(1_777_881_600_040_000_000))
    scans = [scan for scan in in_memory(other).scans if scan.complete and not scan.is_partial]
    assert scans
    for scan in scans:
        same = replace(whole[scan.start_ns], index=scan.index, info=scan.info)
        assert print_of(same) == print_of(scan)


@pytest.mark.parametrize("suffix", TARGETS)
def test_one_of_two_lidars_on_a_port(suffix: str, tmp_path: Path) -> None:
    """SOURCE.md: 271 lidar packets and 85 of the IMU each, 2 of no lidar."""
    left = replace(FIXTURE, selection=replace(FIXTURE.selection, only=("left",)))
    found, other = extracted(left, tmp_path / f"left{suffix}")
    assert (found.read, found.written, found.left_out) == (714, 356, {"not_chosen": 358})
    assert found.frames == {"fragment": 1355, "not_ip": 3, "not_udp": 2}
    assert prints(in_memory(other)) == prints(in_memory(left))


def test_lidars_that_share_a_topic_are_separated(tmp_path: Path) -> None:
    """By their serial numbers, and so they get addresses of their own."""
    one_topic = [
        replace(recorded, topic=re.sub("left|right", "both", recorded.topic))
        for recorded in packets_only("cdr")
    ]
    job = replace(FIXTURE, recordings=(write_mcap(tmp_path / "both.mcap", one_topic),))
    found, _ = extracted(job, tmp_path / "apart.pcap")
    assert [one.place for one in found.lidars] == [
        "192.168.1.201 > port 7502",
        "192.168.1.202 > port 7502",
    ]
    sent = sorted(datagrams(tmp_path / "apart.pcap")["192.168.1.201 > port 7502"])
    assert sent == sorted(
        (one.host_ns, one.payload)
        for one in datagrams_of(FRAMES)
        if (one.source, one.port) == ("10.5.5.87", 7502)
    )


def test_messages_of_a_bag_go_along(tmp_path: Path) -> None:
    """Latched ones at the start of the piece; others if they are asked for."""
    moving = ROOT / "fixtures" / "moving" / "moving.mcap"
    job = Job((moving,), SensorSelection(identity_extrinsics=True), keep_partial=True)
    begin_ns = 1_777_881_601_000_000_000
    for passed, more in (((), set()), (("/imu/*",), {"/imu/data"})):
        target = tmp_path / f"piece{len(passed)}.mcap"
        limits = {"start": Limit(begin_ns), "duration_ns": NS_PER_S // 2}
        extracted(job, target, passed=passed, **limits)
        with target.open("rb") as file:
            found = [(one[1].topic, one[2].log_time) for one in make_reader(file).iter_messages()]
        latched = {"/tf_static", "/left/metadata", "/right/metadata"}
        packets = {
            f"/{name}/{kind}_packets" for name in ("left", "right") for kind in ("lidar", "imu")
        }
        assert {topic for topic, _ in found} == {*latched, *packets, "/tf", *more}
        times = {at for topic, at in found if topic in latched}
        assert times == {begin_ns}
        assert all(begin_ns <= at < begin_ns + NS_PER_S // 2 for _, at in found)
    other = replace(job, recordings=(target,))
    piece = replace(job, segment=TimeSegment(begin_ns, begin_ns + NS_PER_S // 2))
    assert prints(in_memory(other)) == prints(in_memory(piece))


@pytest.mark.parametrize("address", ["10.0.0.7", "fd00::7"])
def test_frames_have_right_checksums(address: str, tmp_path: Path) -> None:
    source = tmp_path / "source.pcap"
    sent = [one for one in datagrams_of(FRAMES) if one.port == 7502][:40]
    frames = [
        (
            one.host_ns,
            udp_frame(one.payload, address, "fd00::1" if ":" in address else "10.0.0.1")[0],
        )
        for one in sent
    ]
    source.write_bytes(pcap_bytes(frames))
    extract(Extraction((source,), tmp_path / "out.pcap"))
    payloads = []
    with (tmp_path / "out.pcap").open("rb") as file:
        for _, frame in dpkt.pcap.Reader(file):
            packet = dpkt.ethernet.Ethernet(frame).data
            assert ipaddress.ip_address(packet.src) == ipaddress.ip_address(address)
            payloads.append(bytes(packet.data.data))
            if packet.v == 4:
                assert dpkt.in_cksum(packet.pack_hdr()) == 0
                continue
            # RFC 8200 section 8.1: addresses, length, next header.
            datagram = bytes(packet)[40:]
            pseudo = packet.src + packet.dst + struct.pack(">II", len(datagram), 17)
            assert dpkt.in_cksum(pseudo + datagram) == 0
    assert payloads == [one.payload for one in sent]


def test_times_of_messages_are_no_times_of_packets(tmp_path: Path) -> None:
    """A driver that leaves stamps empty: the extract says so as well."""
    scans = messages(
        Unit("hesai", "/pandar_packets", packets_of(plain("hesai"))), "ros1", 20_000_000
    )
    kind = "pandar_msgs/PandarScan"
    assert {one.type for one in scans} == {kind}
    write_metadata(tmp_path)
    source = write_rosbag1(tmp_path / "drive.bag", scans)
    selection = SensorSelection(metadata=(tmp_path / "unit.csv",), identity_extrinsics=True)
    found = extract(Extraction((source,), tmp_path / "out.pcap", selection))
    assert any("do not convert with --clock host" in note for note in found.notes)
    for suffix in (".bag", ".mcap"):
        target = tmp_path / f"out{suffix}"
        extract(Extraction((source,), target, selection))
        by_host = Job((target,), replace(selection, host_clock=True))
        with pytest.raises(UsageError, match="expected the receive time of each packet"):
            in_memory(by_host)


MISTAKES: Mapping[str, tuple[dict[str, object], str]] = {
    "suffix": ({"output": "out.txt"}, "expected a name that ends with .pcap"),
    "folder": ({"output": "none/out.pcap"}, "expected an output in an existing folder"),
    "itself": ({"output": "two_lidars.pcap"}, "expected another file than the recordings"),
    "pass": ({"passed": ("/imu",)}, "--pass: expected a bag"),
    "no topic": ({"output": "out.mcap", "passed": ("/imu",)}, "expected a topic of the recording"),
    "1970": ({"start": Limit(10 * NS_PER_S)}, r"write --start \+10 for 10 s after"),
    "after": ({"start": Limit(NS_PER_S, from_t_init=True)}, "in the time limits, found none"),
    "overwrite": ({"output": "there.pcap"}, "expected a new output, found an existing one"),
    "name": ({"selection": SensorSelection(only=("rear",))}, "expected the name or serial number"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_leave_nothing_behind(name: str, tmp_path: Path) -> None:
    changes, expected = MISTAKES[name]
    for source in TWO_LIDARS.iterdir():
        (tmp_path / source.name).write_bytes(source.read_bytes())
    (tmp_path / "there.pcap").touch()
    before = sorted(path.name for path in tmp_path.iterdir())
    options: dict[str, object] = {"output": "out.pcap", **changes}
    output = tmp_path / str(options.pop("output"))
    request = Extraction((tmp_path / "two_lidars.pcap",), output)
    with pytest.raises(MlbatchError, match=expected):
        extract(replace(request, **options))  # type: ignore[arg-type]
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_what_has_no_message_is_refused_or_counted(tmp_path: Path) -> None:
    """Livox: its drivers publish points only. Velodyne: no driver publishes position packets."""
    source = tmp_path / "livox.pcap"
    places = np.full((96 * 50, 1, 3), 2000)
    packets = point_packets(LivoxSpec(), places, np.full(places.shape[:2], 90))
    frames = [(at, udp_frame(payload, "10.0.0.9", dport=56301)[0]) for at, payload in packets]
    source.write_bytes(pcap_bytes(frames))
    with pytest.raises(UsageError, match=r"which have no place in it; write a \.pcap"):
        extract(Extraction((source,), tmp_path / "out.mcap"))
    assert extract(Extraction((source,), tmp_path / "out.pcap")).written == len(packets)
    roof = replace(FOUR, selection=replace(FOUR.selection, only=("roof",)))
    found, _ = extracted(roof, tmp_path / "roof.db3")
    # SOURCE.md: 446 lidar packets; of 512 bytes, 10 a second.
    assert (found.written, found.left_out["no_place"]) == (446, 3)
    assert any("no place for 3 packets of 512 bytes" in note for note in found.notes)


def test_reading_ends_after_the_end(tmp_path: Path) -> None:
    source = tmp_path / "long.pcap"
    later = [(host_ns + 60 * NS_PER_S, frame) for host_ns, frame in FRAMES]
    source.write_bytes(pcap_bytes([*FRAMES, *later]))
    # Otherwise the whole capture is kept when it is opened, in one batch.
    with buffers_of(1 << 16):
        found = extract(Extraction((source,), tmp_path / "out.pcap", duration_ns=NS_PER_S))
    assert found.is_short
    assert found.written == 712
    assert found.read < 800
    assert found.read == found.written + sum(found.left_out.values())


@pytest.mark.parametrize("suffix", TARGETS)
def test_a_calibration_among_the_packets_becomes_a_file(suffix: str, tmp_path: Path) -> None:
    """docs/sources/hesai.md section 10: the first message has the angles as a packet."""
    write_metadata(tmp_path)
    text = (tmp_path / "unit.csv").read_bytes()
    packets = packets_of(plain("hesai"))
    angles = CORRECTION + len(text).to_bytes(4, "little") + text
    scans = []
    for at in range(0, len(packets), 40):
        group = packets[at : at + 40]
        body = Body("ros1").header(group[-1][0], "").put("I", len(group) + (at == 0))
        if at == 0:
            body.time(group[0][0]).blob(angles).put("I", len(text))
        for host_ns, payload in group:
            body.time(host_ns).blob(payload).put("I", len(payload))
        scans.append(Recorded("/a/pandar_packets", SCAN, group[-1][0], body.done()))
    folder = tmp_path / "out"
    folder.mkdir()
    (tmp_path / "in").mkdir()
    source = write_rosbag1(tmp_path / "in" / "drive.bag", scans)
    selection = SensorSelection(identity_extrinsics=True)
    found = extract(Extraction((source,), folder / f"drive{suffix}", selection))
    assert found.written == len(packets)
    (path,) = folder.glob("drive.*.csv")
    assert path.read_bytes() == text
    job = Job((source,), selection, keep_partial=True)
    other = replace(job, recordings=(folder / f"drive{suffix}",))
    expected = [print_of(scan) for scan in in_memory(job).scans]
    assert [print_of(scan) for scan in in_memory(other).scans] == expected
