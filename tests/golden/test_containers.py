"""The same packets in every container give the same scans; real bags give all of their packets."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import pytest

from mlbatch.discovery.discover import SensorSelection
from mlbatch.frames.naming import NAMINGS
from mlbatch.pipeline.job import Job
from mlbatch.readers import open_recording
from mlbatch.ros.packet_types import PACKET_TYPES
from mlbatch.types import StreamTable
from tests.builders.run import RECORDINGS, ROOT, in_memory
from tests.builders.sessions_of_bags import edited_copy
from tests.matrix.containers import CONTAINERS as MATRIX
from tests.matrix.lidars import plain, write_metadata

# MANIFEST.md: topic, packets, their bytes.
BAGS = {
    "hesai/pandar40p/1673400149412331409": ("/pandar_packets", 1439, 1262),
    "hesai/pandar64/1673403880599376836": ("/pandar_packets", 2400, 1198),
    "hesai/pandar64_all-points/all_points": ("/pandar_packets", 2400, 1198),
    "hesai/pandarqt64/1673401195788312575": ("/pandar_packets", 1200, 1072),
    "hesai/pandarxt16/1732848127890747768": ("/pandar_packets", 1626, 568),
    "hesai/pandarxt32/1673400677802009732": ("/pandar_packets", 2000, 1080),
    "velodyne/vlp16_ros2_dual/1673400471837873222": ("/velodyne_packets", 603, 1206),
    "velodyne/vlp32c_ros2/1713492677464078412": (
        "/sensing/lidar/front/velodyne_packets",
        379,
        1206,
    ),
}


@pytest.mark.parametrize(("name", "codes"), [("pcap", []), ("rosbag2", ["max_wait", "max_wait"])])
def test_a_message_that_is_longer_than_the_wait_is_warned_of(
    name: str, codes: list[str], tmp_path: Path
) -> None:
    """Messages hold the packets of 20 ms, after which 15 ms are over."""
    session = [plain(vendor) for vendor in ("hesai", "velodyne")]
    write_metadata(tmp_path)
    selection = SensorSelection(metadata=(tmp_path / "unit.csv",), identity_extrinsics=True)
    path = MATRIX[name](tmp_path, session)
    short = Job((path,), selection, Fraction(20), keep_partial=True, max_wait_ns=15_000_000)
    warned = [one for one in in_memory(short).report.warnings if one.code == "max_wait"]
    assert [one.code for one in warned] == codes
    # Single packets are no messages, however short the wait is.
    shortest = in_memory(replace(short, max_wait_ns=10_000)).report.warnings
    assert [one.code for one in shortest if one.code == "max_wait"] == codes
    for one in warned:
        found = re.fullmatch(
            r"--max-wait 0\.015: expected more than a message of \S+, which holds (0\.\d+) s .*"
            r"; give at least (0\.\d+)",
            one.message,
        )
        assert found is not None, one.message
        # Messages are cut by receive time: 20 ms, and a packet.
        assert 0.018 < float(found[1]) <= 0.0214
        assert float(found[2]) >= float(found[1]) + 0.01


def test_the_page_on_recordings_lists_all_types_and_frames() -> None:
    page = (ROOT / "docs" / "recordings.md").read_text(encoding="utf-8")
    cells = [line.split("|") for line in page.splitlines() if line.startswith("|")]
    first = {name.strip(" `") for row in cells for name in row[1].split(",")}
    assert set(PACKET_TYPES) <= first
    by_vendor = {row[1].strip().lower(): row for row in cells}
    for vendor, naming in NAMINGS.items():
        shown = [re.findall(r"`(.+?)`", cell) for cell in by_vendor[vendor][2:5]]
        assert shown == [list(naming.points), list(naming.lidar), list(naming.nick)]


def packets_of(path: Path) -> Counter[tuple[str, int]]:
    """Packets by topic and size; the ledger must balance."""
    table = StreamTable()
    recording = open_recording(path, table)
    found: Counter[tuple[str, int]] = Counter()
    for batch in recording.packets():
        pairs = zip(batch.stream.tolist(), batch.size.tolist(), strict=True)
        found.update((table.streams[stream].topic, size) for stream, size in pairs)
    counts = recording.counts
    assert counts.frames == counts.datagrams == found.total()
    assert recording.notes == []
    return found


def real_bag(name: str) -> Path:
    """A recorded bag; the test is skipped where it is absent."""
    if not (RECORDINGS / name).is_dir():
        pytest.skip(f"recording {name} is not here")
    return RECORDINGS / name


@pytest.mark.parametrize("name", BAGS)
def test_bags_that_do_not_name_their_storage_are_read(name: str, tmp_path: Path) -> None:
    topic, packets, size = BAGS[name]
    copy = edited_copy(real_bag(name), tmp_path / "copy")
    assert packets_of(copy) == {(topic, size): packets}
