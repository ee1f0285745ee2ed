"""A conversion from Python: clocks of the rig, progress, writers that fail, memory, timing."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

import mlbatch
from mlbatch.discovery.discover import SensorSelection
from mlbatch.errors import ExportError, RecordingError
from mlbatch.pipeline.conversion import Conversion
from mlbatch.pipeline.job import Job, wait_ns
from mlbatch.pipeline.passthrough import ImuQueue
from mlbatch.pipeline.run import convert
from mlbatch.types import EXTRAS, IMU, RunInfo, Scan
from tests.builders.run import FIXTURE, Memory, in_memory
from tests.builders.sessions import (
    CAPTURE,
    EPOCH_NS,
    NS_PER_MS,
    NS_PER_S,
    RIG,
    Unit,
    twin,
    write_session,
)


def _job(capture: Path, **selection: bool) -> Job:
    return Job((capture,), SensorSelection(identity_extrinsics=selection.get("identity", False)))


def _rig(folder: Path, *clocks: str) -> Path:
    """A rig of lidars 111 and 222 with these clocks."""
    rig = folder / "rig.yaml"
    lines = [
        f'- {{name: s{serial}, stream: {{serial: "{serial}"}}, metadata: {serial}.json, '
        f"extrinsics: {{translation_m: [{serial}, 0, 0]}}, clock: {clock}}}\n"
        for serial, clock in zip((111, 222), clocks, strict=True)
    ]
    rig.write_text("sensors:\n" + "".join(lines))
    return rig


# -- clocks ---------------------------------------------------------------------------------------


def test_one_lidar_of_a_rig_may_run_on_the_host_clock(tmp_path: Path) -> None:
    one = Unit()
    uptime = replace(
        twin(one, 222), begin_ns=77 * NS_PER_S, host_ns=one.begin_ns - 77 * NS_PER_S + NS_PER_MS
    )
    capture = write_session(tmp_path, one, uptime)
    rig = _rig(tmp_path, "{source: sensor}", "{source: host}")
    result = in_memory(Job((capture,), SensorSelection(rig=rig)))
    assert result.report.timescale == "utc"
    assert [sensor.clock.source for sensor in result.report.sensors] == ["sensor", "host"]
    # The last column of a packet gets its receive time: 1 ms and a column's 0.195 ms later.
    grid_ns = np.arange(1536) * 195_312.5 + 1_195_312.5 + one.begin_ns % NS_PER_S
    for scan in result.scans:
        start_ns = scan.start_ns % NS_PER_S
        inside = (grid_ns >= start_ns) & (grid_ns < start_ns + 100 * NS_PER_MS)
        stamps = scan.column_stamp_ns[scan.column_lidar_id == 1] % NS_PER_S
        np.testing.assert_allclose(stamps, grid_ns[inside], atol=1.5, rtol=0)


def test_mixed_timescales_are_told(tmp_path: Path) -> None:
    """Clocks half a second apart are merged, but 2.1 s from the capture host is not UTC."""
    one = replace(Unit(), host_ns=1_900 * NS_PER_MS)
    two = replace(twin(one, 222), host_ns=2_300 * NS_PER_MS)
    run, report = convert(_job(write_session(tmp_path, one, two), identity=True), None)
    assert report.timescale == "unknown"
    assert [(note.code, note.message) for note in run.notes[1:2]] == [
        ("timescale", "sensors differ in timescale: utc, unknown")
    ]
    codes = [note.code for note in run.notes]
    assert codes == ["identity_extrinsics", "timescale", "clock_epoch", "clocks"]


# -- progress and report ---------------------------------------------------------------------------


def test_progress_rises_to_the_size_of_the_recordings(tmp_path: Path) -> None:
    captures = tuple(
        write_session(tmp_path / name, replace(Unit(), begin_ns=EPOCH_NS + at * NS_PER_S))
        for name, at in (("1", 1), ("2", 2))
    )
    reported: list[tuple[int, int, int]] = []
    result, _ = convert(
        Job(captures, keep_partial=True), None, lambda *progress: reported.append(progress)
    )
    size = sum(capture.stat().st_size for capture in captures)
    assert reported == sorted(reported)
    assert reported[0] == (0, size, 0)
    assert reported[-1][:2] == (size, size)
    assert result.table is not None
    # Windows close behind what is read.
    assert 0 < reported[-1][2] <= result.table.rows


def test_the_pass_that_aligns_clocks_is_reported_as_well(tmp_path: Path) -> None:
    capture = write_session(tmp_path, Unit(turns=10))
    reported: list[tuple[int, int, int]] = []
    convert(
        Job((capture,), align_clocks_to="host"), None, lambda *progress: reported.append(progress)
    )
    size = capture.stat().st_size
    second = reported.index((0, size, 0))
    assert reported[second - 1] == (size, size, 0)
    assert reported[-1][:2] == (size, size)


def test_a_dry_run_cuts_no_imu_samples_at_windows() -> None:
    """At 100 Hz the 0.85 s of the fixture are tens of windows; its lidars send IMU packets."""
    job = replace(FIXTURE, rate=Fraction(100), extras=EXTRAS | {IMU})
    cut = ImuQueue.drain_until
    with patch.object(ImuQueue, "drain_until", autospec=True, side_effect=cut) as called:
        _, dry = convert(job, None)
    assert dry.scans.written > 20
    # Twice per second of scans, until nothing is left, and at the end.
    assert called.call_count <= 4
    ledgers = [sensor.ledger for sensor in in_memory(job).report.sensors]
    assert [sensor.ledger for sensor in dry.sensors] == ledgers
    assert all(ledger.imu_samples.written for ledger in ledgers)


def test_memory_does_not_grow_with_the_recording(tmp_path: Path) -> None:
    sizes = []
    for turns in (150, 600):
        folder = tmp_path / str(turns)
        one = Unit(turns=turns)
        run, _ = convert(_job(write_session(folder, one, twin(one, 222)), identity=True), None)
        sizes.append([sensor.source.ring.nbytes for sensor in run.sensors])
    assert sizes[0] == sizes[1]


# -- when it fails --------------------------------------------------------------------------------


class _FullDisk(Memory):
    """Fails at the second scan."""

    def keep(self, scan: Scan, sensor: int | None) -> None:
        if self.scans:
            raise ExportError("no space left")
        super().keep(scan, sensor)


def test_a_writer_is_abandoned_when_the_run_fails() -> None:
    opened: list[Memory] = []

    def start(info: RunInfo) -> Memory:
        opened.append(_FullDisk(info))
        return opened[0]

    with pytest.raises(ExportError):
        convert(FIXTURE, start)
    assert [(one.abandoned, one.summary, len(one.scans)) for one in opened] == [(True, None, 1)]


def test_a_writer_is_opened_with_the_first_scan_only(tmp_path: Path) -> None:
    """A run without a scan leaves nothing to abandon."""

    def start(info: RunInfo) -> Memory:
        raise AssertionError

    capture = write_session(tmp_path, Unit(turns=1))
    with pytest.raises(RecordingError, match="no scan"):
        convert(replace(_job(capture), drop_incomplete=100.0), start)


# -- scans in Python ------------------------------------------------------------------------------


def test_scans_in_python_may_be_kept() -> None:
    found = list(mlbatch.scans(str(CAPTURE), rig=str(RIG)))
    assert not np.shares_memory(found[0].xyz, found[1].xyz)
    assert len({scan.xyz[:100].tobytes() for scan in found}) > 1


def test_the_shortest_wait_is_a_nanosecond() -> None:
    assert wait_ns("max_wait", 1e-12) == 1
    assert wait_ns("max_wait", 2e-9) == 2


def test_scans_in_python_wait_for_ever_from_some_time_on() -> None:
    one, other = (list(mlbatch.scans(CAPTURE, rig=RIG, max_wait=s)) for s in (1e300, math.inf))
    assert [scan.point_count for scan in one] == [scan.point_count for scan in other]


def test_a_conversion_may_be_left_half_way() -> None:
    run = Conversion(replace(FIXTURE, keep_partial=False))
    scan, only = next(run.scans())
    assert (scan.index, only) == (0, None)
