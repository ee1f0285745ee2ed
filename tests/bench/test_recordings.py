"""Recordings of the benchmark, read by other libraries and by a conversion.

What the packets say is checked with the encoders (tests/simulate, tests/sensors).
"""

from __future__ import annotations

import json
import struct
from itertools import pairwise
from pathlib import Path

import dpkt
import pytest
from mcap.reader import make_reader

from tests.bench.cases import CAPTURE, RECORDINGS, RIG
from tests.bench.recordings import make
from tests.builders.run import command

SECONDS = 1.0
CLOUDS = [name for name, recording in RECORDINGS.items() if recording.is_bag]
IMU_BYTES = 48


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One second of each recording, each in its own folder."""
    place = tmp_path_factory.mktemp("recordings")
    for name, recording in RECORDINGS.items():
        (place / name).mkdir()
        make(recording, SECONDS, place / name)
    return place


def frames(folder: Path, name: str) -> list[tuple[float, bytes]]:
    """Capture time in s and bytes of every record, read by another library."""
    with (folder / name / CAPTURE).open("rb") as file:
        return [(float(stamp), frame) for stamp, frame in dpkt.pcap.Reader(file)]


def payloads(folder: Path, name: str) -> list[tuple[float, bytes, bytes]]:
    """Capture time, sender and payload."""
    packets = [(stamp, dpkt.ethernet.Ethernet(frame).data) for stamp, frame in frames(folder, name)]
    return [(stamp, ip.src, ip.data.data) for stamp, ip in packets]


def test_imu_packets_are_the_only_others(folder: Path) -> None:
    lidars, both = (payloads(folder, name) for name in ("dual-4-no-imu", "dual-4"))
    assert lidars == [one for one in both if len(one[2]) != IMU_BYTES]
    # 100 per second; the rotor of the second lidar is 37.1 ms late.
    assert len(both) - len(lidars) in range(99 + 95, 100 + 97)


def test_fragments_fit_into_frames_and_give_the_same_scans(folder: Path, tmp_path: Path) -> None:
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
    assert max(len(frame) for _, frame in frames(folder, "dual-4-fragments")) <= 1514


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_conversion_accepts_every_packet(folder: Path, tmp_path: Path, name: str) -> None:
    place = folder / name
    recording = RECORDINGS[name]
    size = (place / recording.file).stat().st_size
    assert size == pytest.approx(recording.bytes_per_s * SECONDS, rel=0.05)
    if not recording.is_bag:
        times = [stamp for stamp, _ in frames(folder, name)]
        assert all(later >= earlier for earlier, later in pairwise(times))
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
        sensor.name for sensor in recording.sensors
    ]
    for sensor in report_document["sensors"]:
        assert sensor["packets"]["read"] == sensor["packets"]["accepted"] > 0
        slots = sensor["points"]["slots"]
        assert 0.7 < sensor["points"]["written"] / slots < 0.9
    # Of ten windows the first, the last, and one at a phase are incomplete.
    slots = sum(sensor["points"]["slots"] for sensor in report_document["sensors"])
    assert 0.75 < slots / (recording.slots_per_s * SECONDS) < 0.95


@pytest.mark.parametrize("name", CLOUDS)
def test_clouds_are_revolutions_of_64_rings(folder: Path, name: str) -> None:
    """By hand: 2048 columns in 100 ms are 48,828 ns apart."""
    with (folder / name / RECORDINGS[name].file).open("rb") as file:
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
