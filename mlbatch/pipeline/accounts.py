"""What a finished run has to say: the inputs of its report, and why there may be no scan."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from mlbatch import sensors
from mlbatch.discovery.match import describe
from mlbatch.discovery.types import Note, PacketKind
from mlbatch.pipeline.passthrough import PASS_REASONS
from mlbatch.pipeline.sensor import Sensor
from mlbatch.pipeline.session import CLOUDS
from mlbatch.report.ledger import PointCounts, ordered
from mlbatch.report.report import (
    ClockReport,
    FaultReport,
    InputReport,
    Passed,
    ReportInputs,
    SensorReport,
    Timing,
    Unassigned,
    Warned,
)
from mlbatch.report.scan_table import ScanStatistics, Spread
from mlbatch.types import CaptureCounts
from mlbatch.units import NS_PER_MS, NS_PER_S, rate_text

if TYPE_CHECKING:
    from mlbatch.pipeline.conversion import Conversion

__all__ = ["PointCounts", "report_inputs", "why_nothing"]

_KB_PER_MB = 1024
_NO_SCANS = ScanStatistics(0, 0, 0, 0, 0, Spread(), Spread())


def report_inputs(run: Conversion) -> ReportInputs:
    """All that report.json is made of."""
    table = run.table
    return ReportInputs(
        inputs=tuple(
            InputReport(str(r.path), r.size_bytes, r.container) for r in run.session.recordings
        ),
        timescale="unknown" if run.info is None else run.info.timescale,
        rate_hz=rate_text(run.grid.rate),
        t_init_ns=run.batcher.t_init_ns,
        slices=run.job.slices,
        capture=_capture(run),
        sensors=tuple(_sensor(run, sensor) for sensor in run.sensors),
        scans=_NO_SCANS
        if table is None
        else table.statistics(run.batcher.empty, run.dropped_incomplete),
        unassigned=_unassigned(run),
        timing=_timing(run),
        messages=tuple(
            Passed(topic, counts.read, counts.written, ordered(counts.dropped, PASS_REASONS))
            for topic, counts in sorted(run.passthrough.messages.counts.items())
        ),
        faults=()
        if run.session.replay is None
        else tuple(FaultReport(one.fault, one.packets) for one in run.session.replay.counts),
        repeated=_repeated(run),
        warnings=tuple(Warned(n.code, n.sensor, n.message) for n in run.notes),
    )


# Share of a sensor's packets, or columns, that is worth a warning: a change of mode, a wrong
# calibration; one damaged stamp that lies ahead makes those that follow it late.
MANY = 0.01


def _cloud_notes(run: Conversion) -> Iterator[Note]:
    """What the times of clouds were taken for."""
    if not any(recording.topics for recording in run.session.recordings):
        return
    # Captures have no topics, and so no clouds: they need not wait for what reads these.
    from mlbatch.clouds import CloudRecording

    for recording in run.session.recordings:
        if isinstance(recording, CloudRecording):
            for text in recording.verdicts:
                yield Note(CLOUDS, "", f"{recording.path.name}: {text}")


def late_notes(run: Conversion) -> list[Note]:
    """Warnings that only the end of a run knows: damaged recordings, lidars that came late."""
    notes = [
        Note("recording", "", f"{recording.path.name}: {text}")
        for recording in run.session.recordings
        for text in recording.notes
    ]
    notes += _cloud_notes(run)
    for sensor in run.sensors:
        packets = sensor.ledger.packets
        # What was captured twice is no loss.
        reasons_of = {r: n for r, n in packets.rejected.items() if r != "duplicate"}
        rejected = sum(reasons_of.values())
        if rejected > MANY * packets.read:
            reasons = ", ".join(f"{n} {reason}" for reason, n in reasons_of.items())
            text = f"{sensor.name}: {rejected} of {packets.read} packets rejected ({reasons})"
            notes.append(Note("rejected", sensor.name, text))
        decoded, late = sensor.ledger.columns.decoded, sensor.ledger.columns.dropped.get("late", 0)
        if late > MANY * decoded:
            text = (
                f"{sensor.name}: {late} of {decoded} columns came too late for their scans, after "
                "a stamp that lay ahead (damaged?) or a stall; see --decode crc=check, --max-wait"
            )
            notes.append(Note("late", sensor.name, text))
    table, seen = run.session.setup.sampler.table, run.session.setup.sampler.kinds
    for kind in sorted(run.session.ingest.samples):
        what = _what(run, kind)
        # A rig says which sensors are wanted, so that others need no warning.
        if run.session.setup.rig is None and kind not in seen and "lidar" in what:
            notes.append(
                Note(
                    "late_stream",
                    "",
                    f"{table.streams[kind[0]]}: {what}; it began after the first 10 s, where "
                    "sensors are looked for, so that its packets are counted as unassigned; "
                    "name the sensor in a rig file (--rig)",
                )
            )
    return notes


def message_notes(run: Conversion) -> list[Note]:
    """Warnings about messages that could not be forwarded."""
    notes = []
    for topic, counts in run.passthrough.messages.counts.items():
        if run.passthrough.messages.has_place and (other := counts.dropped.get("no_place")):
            text = f"{topic}: {other} message(s) dropped: the output cannot hold its ROS version"
            notes.append(Note("other_ros", "", text))
        if other := counts.dropped.get("other_clock"):
            text = (
                f"{topic}: {other} message(s) dropped: their clock differs from that of the scans"
            )
            notes.append(Note("imu_clock", "", text))
    return notes


def why_nothing(run: Conversion) -> str:
    """Why no scan came out, with the stamps of each sensor and what to do."""
    where = ", ".join(str(path) for path in run.job.recordings)
    spans = []
    for sensor, span in zip(run.sensors, run.batcher.spans_ns, strict=True):
        if span is None:
            spans.append(f"{sensor.name} gave no valid column")
        else:
            spans.append(
                f"{sensor.name} from {span[0] / NS_PER_S:.6f} to {span[1] / NS_PER_S:.6f} s"
            )
    heads = sum(
        count
        for dropped in run.batcher.dropped
        for reason, count in dropped.items()
        if reason in ("head", "tail")
    )
    if all(span is None for span in run.batcher.spans_ns):
        return f"{where}: no scan: wanted valid columns, got none ({'; '.join(spans)})"
    period_ms = float(NS_PER_S / run.grid.rate / NS_PER_MS)
    advice = (
        "write the partial ones with --keep-partial"
        if heads
        else "choose another --start/--end, or a recording where all sensors run together"
    )
    return (
        f"{where}: no scan: wanted a whole window of {period_ms:g} ms seen by all sensors, got "
        f"{'; '.join(spans)}; {advice}"
    )


def _capture(run: Conversion) -> CaptureCounts:
    total = CaptureCounts()
    for recording in run.session.recordings:
        total.frames += recording.counts.frames
        total.datagrams += recording.counts.datagrams
        for reason, count in recording.counts.skipped.items():
            total.skip(reason, count)
    if run.batcher.past_end:
        # What several recordings read ahead of each other was never looked at.
        ahead = total.datagrams - run.session.delivered
        total.frames -= ahead
        total.datagrams -= ahead
    return total


def _repeated(run: Conversion) -> int:
    """Datagrams that faults repeated less those they removed."""
    if run.session.replay is None or run.batcher.past_end:
        # Up to an end only those are counted that the faults gave.
        return 0
    return sum(one.repeated - one.removed for one in run.session.replay.ledgers)


def _sensor(run: Conversion, sensor: Sensor) -> SensorReport:
    table = run.session.setup.sampler.table
    kinds = sensor.detected.kinds
    streams = sorted({str(table.streams[stream]) for stream, _ in kinds})
    return SensorReport(
        name=sensor.name,
        model=sensor.lidar.model,
        lidar_id=sensor.index,
        stream="; ".join(streams),
        mode=sensor.lidar.mode,
        ledger=sensor.ledger,
        clock=_clock(run, sensor),
        extrinsics_source=sensor.detected.pose.describe(),
        body_from_sensor=sensor.body_from_sensor,
        calibration=Path(sensor.lidar.calibration).name,
    )


def _clock(run: Conversion, sensor: Sensor) -> ClockReport:
    first = run.batcher.firsts[sensor.index]
    source = sensor.clock.source
    mode = sensor.lidar.timestamp_mode
    notes: tuple[str, ...] = (f"timestamp mode {mode}",) if mode else ()
    if first is None:
        return ClockReport(source, "unknown", notes=notes)
    epoch = sensor.clock.timescale(*first)
    offset_ns = first[0] - first[1]
    finding = dict(run.session.clocks.findings()).get(sensor.name)
    if finding is None:
        return ClockReport(source, epoch, offset_ns / NS_PER_MS, notes=notes)
    if sensor.clock.map is not None:
        notes += (sensor.clock.map.in_words(),)
    return ClockReport(
        source,
        epoch,
        offset_to_host_ms=offset_ns / NS_PER_MS,
        drift_ppm=None if finding.drift_ppm is None else round(finding.drift_ppm, 3),
        notes=(*notes, finding.in_words()),
    )


def _unassigned(run: Conversion) -> tuple[Unassigned, ...]:
    setup, rows = run.session.setup, []
    streams = setup.sampler.table.streams
    # Not by the streams' numbers, which follow the order in which files are read.
    by_name = sorted(
        run.session.ingest.unassigned.items(), key=lambda item: (str(streams[item[0][0]]), item)
    )
    for kind, count in by_name:
        stream = streams[kind[0]]
        what = _what(run, kind)
        if kind not in setup.sampler.kinds:
            what = f"not seen in the first 10 s: {what}"
        if kind in setup.ignored:
            what = f"ignored: {what}"
        elif kind in setup.not_in_rig:
            what = f"not_in_rig: {what}"
        rows.append(Unassigned(str(stream), count, f"{what} ({kind[1]} bytes)"))
    return tuple(rows)


def _what(run: Conversion, kind: PacketKind) -> str:
    """What unassigned packets look like: one of them, else those seen at first."""
    sample = run.session.ingest.samples.get(kind)
    if sample is not None and (text := sensors.describe(kind[1], sample)):
        return text
    if kind in run.session.setup.sampler.kinds:
        return describe(run.session.setup.sampler, kind) or "unknown"
    return "unknown"


def _timing(run: Conversion) -> Timing:
    wall_s, cpu_s = run.stages.elapsed_s
    stages = run.stages
    points = sum(sensor.ledger.points.written for sensor in run.sensors)
    return Timing(
        wall_s=wall_s,
        cpu_s=cpu_s,
        read_s=stages.read_s,
        decode_s=stages.decode_s,
        merge_s=stages.merge_s - stages.read_s,
        write_s=stages.write_s,
        recorded_s=run.session.recorded_s,
        points_per_s=points / wall_s if wall_s > 0 else 0.0,
        peak_rss_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / _KB_PER_MB,
        engine=run.session.engine,
    )
