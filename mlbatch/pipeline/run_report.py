"""Report of a run: figures of its session, batching and decoding; late warnings; why no scan."""

from __future__ import annotations

import resource
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mlbatch.clocks.compare import SYNCHRONISED, compare
from mlbatch.clocks.host_offset import HostOffset, describe_off
from mlbatch.clocks.timescale import describe_time
from mlbatch.clocks.watch import ClockEstimate
from mlbatch.discovery.discover import not_in_rig
from mlbatch.discovery.match import describe, describe_each
from mlbatch.discovery.sampler import MOST_KINDS
from mlbatch.discovery.types import Note, PacketKind
from mlbatch.errors import NoScanError
from mlbatch.pipeline.passthrough import PASS_REASONS
from mlbatch.pipeline.sensor import Sensor
from mlbatch.pipeline.session import CLOUDS
from mlbatch.reports.ledger import PointCounts, ordered
from mlbatch.reports.report import (
    CUT_OFF,
    ClockReport,
    FaultReport,
    ForwardedMessages,
    InputReport,
    RunReport,
    SensorReport,
    Timing,
    Unassigned,
    Warned,
)
from mlbatch.reports.scan_table import ScanStatistics, Spread
from mlbatch.types import CaptureCounts, CutOff, Recording
from mlbatch.units import NS_PER_MS, NS_PER_S, rate_text

if TYPE_CHECKING:
    from mlbatch.pipeline.conversion import Conversion

_KB_PER_MB = 1024
_NO_SCANS = ScanStatistics(0, 0, 0, 0, 0, {}, {}, {}, 0, 0, Spread(), Spread())


def run_report(run: Conversion) -> RunReport:
    """Collect the content of report.json."""
    table, replay = run.table, run.session.replay
    first_scan = ""
    if table is not None and table.first_start_ns is not None and run.info is not None:
        first_scan = describe_time(table.first_start_ns, run.info.timescale)
    repeated = 0
    # With an end, only datagrams after fault injection are counted.
    if replay is not None and not run.batcher.past_end:
        repeated = sum(one.repeated - one.removed for one in replay.ledgers)
    return RunReport(
        inputs=tuple(
            InputReport(str(r.path), r.size_bytes, r.container) for r in run.session.recordings
        ),
        timescale="unknown" if run.info is None else run.info.timescale,
        rate_hz=rate_text(run.grid.rate),
        t_init_ns=run.batcher.t_init_ns,
        slices=run.job.slices,
        sort=run.job.sort,
        variants=run.job.variants,
        deskew=None if run.deskew is None else run.deskew.ledger,
        poses=run.poses,
        capture=_capture(run),
        sensors=tuple(_sensor(run, sensor) for sensor in run.sensors),
        scans=_NO_SCANS
        if table is None
        else table.statistics(
            # Sets of sweeps are on no grid, where windows may be empty.
            0 if run.job.is_fused else run.batcher.empty,
            run.dropped_incomplete,
        ),
        unassigned=_unassigned(run),
        timing=_timing(run),
        messages=tuple(
            ForwardedMessages(
                topic, counts.read, counts.written, ordered(counts.dropped, PASS_REASONS)
            )
            for topic, counts in sorted(run.messages.counts.items())
        ),
        faults=()
        if replay is None
        else tuple(FaultReport(one.fault, one.packets) for one in replay.counts),
        repeated=repeated,
        first_scan=first_scan,
        warnings=tuple(Warned(n.code, n.sensor, n.message) for n in run.notes),
    )


# Share of a sensor's packets that are lost, above which there is a warning.
LOST = 0.001
# Share of a sensor's packets, or columns, above which there is a warning: a change of mode, a wrong
# calibration; one damaged timestamp in the future makes those that follow it late.
MANY = 0.01
# Main reason of rejections, as in docs/report.md.
_WHY_REJECTED = {
    "bad_size": "their size is not that of the first packets",
    "bad_header": "their model or mode is not that of the first packets",
    "bad_crc": "their checksums are wrong",
    "bad_stamp": "their timestamps are those of no steady clock",
    "duplicate": "their numbers are those of earlier packets with other timestamps",
}
# How long an IMU may be integrated without a warning, s, and the error it names, m/s2.
DRIFT_S = 10
_USUAL_ERROR = 0.05


# Of a reading of times that is plausible.
_UNMEASURED = "whether they fit the motion was not measured, mlbatch inspect does"


def _cloud_notes(run: Conversion) -> Iterator[Note]:
    """How the times of decoded clouds were read."""
    if not any(recording.topics for recording in run.session.recordings):
        return
    # Captures have no topics, hence no clouds: do not load their reader.
    from mlbatch.readers.bag.clouds import CloudRecording

    for recording in run.session.recordings:
        if isinstance(recording, CloudRecording):
            for text in recording.verdicts:
                yield Note(CLOUDS, "", f"{recording.path.name}: {text}; {_UNMEASURED}")


def clock_notes(run: Conversion) -> Iterator[Note]:
    """Steps of sensor clocks and of the capture host's, clocks that differ."""
    estimates = _estimates(run)
    comparison = compare(estimates) if estimates else None
    if comparison is None:
        return
    for name, finding in comparison.estimates:
        for jump in finding.jumps:
            code = "host_step" if jump.kind == "host" else "clock_jump"
            yield Note(code, name, f"{name}: {jump.describe()}")
    for pair in comparison.pairs:
        if pair.verdict != SYNCHRONISED:
            yield Note("clocks", "", pair.describe())


def _estimates(run: Conversion) -> list[tuple[str, ClockEstimate]]:
    """Name and clock of each sensor that gave timestamps of its own."""
    found = ((sensor.name, sensor.clock.watch.estimate()) for sensor in run.sensors)
    return [(name, estimate) for name, estimate in found if estimate is not None]


def host_offsets(run: Conversion) -> list[HostOffset]:
    """Clocks of the sensors, as batched, against the capture host's; none by receive times."""
    findings = dict(_estimates(run))
    offsets = []
    for sensor, first in zip(run.sensors, run.batcher.firsts, strict=True):
        if sensor.clock.by_host or first is None:
            continue
        lidar = sensor.lidar
        found = findings.get(sensor.name)
        if found is None:
            offsets.append(
                HostOffset.of_message(
                    sensor.name, *first, lidar.clock_period_ns, lidar.timestamp_mode
                )
            )
        else:
            offsets.append(HostOffset.measured(sensor.name, found))
    return offsets


def _epoch_notes(run: Conversion) -> Iterator[Note]:
    """Clocks that agree with each other, but not with the capture host's."""
    offsets = host_offsets(run)
    off = [one.sensor for one in offsets if one.is_off]
    if not off:
        return
    first = next(sensor for sensor in run.sensors if sensor.name == off[0])
    given_ns = 0 if first.rig is None else first.rig.offset_ns
    timed = all(sensor.clock.has_receive_times for sensor in run.sensors)
    text = describe_off(offsets, given_ns, timed=timed)
    yield Note("clock_epoch", off[0] if len(run.sensors) == 1 else "", text)


def _pose_notes(run: Conversion) -> Iterator[Note]:
    """Lidars whose surfaces are proven to be apart, unless they have no pose of their own."""
    placed = {sensor.name for sensor in run.sensors if sensor.detected.pose.is_known}
    for pair in run.poses.pairs:
        if pair.is_wrong and placed.issuperset(pair.lidars):
            text = (
                f"{pair.describe()}; correct the poses in the rig file (--rig), or measure them "
                "(mlbatch calibrate)"
            )
            yield Note("pose", "", text)


def final_notes(run: Conversion) -> list[Note]:
    """Warnings known at the end of a run only: damaged recordings, lidars that start late."""
    notes = [note for recording in run.session.recordings for note in _damage(recording)]
    notes += _cloud_notes(run)
    notes += _epoch_notes(run)
    notes += _pose_notes(run)
    for sensor in run.sensors:
        packets = sensor.ledger.packets
        # A packet captured twice is no loss, but another packet of the same number is.
        counts = packets.rejected | {"duplicate": run.batcher.renumbered[sensor.index]}
        rejected = sum(counts.values())
        if rejected > MANY * packets.read:
            by_count = sorted((one for one in counts.items() if one[1]), key=lambda one: -one[1])
            reasons = ", ".join(f"{count} {reason}" for reason, count in by_count)
            why = _WHY_REJECTED[by_count[0][0]]
            text = (
                f"{sensor.name}: {rejected} of {packets.read} packets rejected ({reasons}): {why}"
            )
            notes.append(Note("rejected", sensor.name, text))
        decoded = sensor.ledger.columns.decoded
        late = sensor.ledger.columns.dropped.get("late", 0)
        if late > MANY * decoded:
            text = (
                f"{sensor.name}: {late} of {decoded} columns were late, after a timestamp in the "
                "future (damaged?) or a stall; see --decode crc=check, --max-wait"
            )
            notes.append(Note("late", sensor.name, text))
    notes += _motion_notes(run)
    notes += _loss_notes(run)
    return notes


def _damage(recording: Recording) -> Iterator[Note]:
    """Warnings about damage, one for each place, and one about an end that is missing."""
    name = recording.path.name
    ends = [text for text in recording.notes if isinstance(text, CutOff)]
    for text in recording.notes:
        if text not in ends:
            yield Note("recording", "", f"{name}: {text}")
    if ends:
        yield Note(CUT_OFF, "", f"{name}: {'; '.join(ends)}")


def _motion_notes(run: Conversion) -> Iterator[Note]:
    """Windows without poses, and velocities that an IMU was integrated to for long."""
    if run.deskew is None:
        return
    motion = run.deskew.ledger
    if motion.windows_without_poses:
        ended = f" ({motion.ended})" if motion.ended else ""
        yield Note(
            "no_pose",
            "",
            f"{motion.source} has no poses of {motion.windows_without_poses} windows with "
            f"{motion.no_pose} of {motion.columns} columns{ended}, which were left out; give a "
            "trajectory of the whole recording",
        )
    velocity = motion.velocity
    # Nothing is known before the first two windows, and nothing is missed at rest.
    expected = ("first", "no_gain")
    if velocity is not None and not set(velocity.windows) <= set(expected):
        yield Note(
            "no_velocity",
            "",
            f"{velocity.unmoved} of {motion.columns} columns were not moved "
            f"(windows: {velocity.describe()}); look at scene and motion, or give a trajectory "
            "(--deskew FILE.tum)",
        )
    seconds = 0.0 if run.deskew.source is None else run.deskew.source.integrated_s
    if seconds > DRIFT_S:
        yield Note(
            "deskew_drift",
            "",
            f"{motion.source} was integrated for {seconds:.0f} s after the standstill: an "
            f"error of its accelerometer of {_USUAL_ERROR} m/s2 is then a velocity of "
            f"{_USUAL_ERROR * seconds:.2g} m/s; give a trajectory (--deskew FILE.tum)",
        )


def _loss_notes(run: Conversion) -> Iterator[Note]:
    """Sensors that lost packets, or sent less than half of their columns in a scan."""
    scans = None if run.table is None else run.table.statistics(0)
    for sensor in run.sensors:
        packets = sensor.ledger.packets
        if not packets.read:
            # Its absence is another warning.
            continue
        texts = []
        sent = packets.accepted + packets.lost
        if packets.lost > LOST * sent:
            share = 100 * packets.lost / sent
            texts.append(f"{packets.lost} of {sent} packets lost ({share:.3g} %)")
        lacking = 0 if scans is None else scans.underfilled_by_sensor.get(sensor.name, 0)
        if scans is not None and lacking:
            without = scans.without.get(sensor.name, 0)
            # Of a sensor whose rate is unknown, what is usual is only known after the run.
            what, remedy = ("columns", "; --drop-incomplete leaves them out")
            if not sensor.lidar.columns_per_s:
                what, remedy = ("usual columns", "")
            texts.append(
                f"{lacking} of {scans.written} scans have less than half of its {what}, {without} "
                f"have none{remedy}"
            )
        if texts:
            yield Note("loss", sensor.name, f"{sensor.name}: {'; '.join(texts)}")


def unassigned_notes(run: Conversion) -> Iterator[Note]:
    """Warnings about lidar packets of no sensor, unless the user left them out.

    Those of `setup.noted` have a warning since the start.
    """
    setup = run.session.setup
    streams = setup.sampler.table.streams
    for kind, ignored in sorted(run.session.ingest.unassigned):
        stream = streams[kind.stream]
        what = _what(run, kind, ignored)
        owners = [sensor.name for sensor in run.sensors if kind in sensor.detected.kinds]
        is_late = kind not in setup.sampler.kinds
        if ignored or kind in setup.noted or "lidar" not in what:
            continue
        if owners and not is_late:
            # Several lidars at one address, or damaged serial numbers.
            packets = run.session.ingest.unassigned[kind, ignored].packets
            yield Note(
                "unassigned",
                "",
                f"{stream}: expected packets of {', '.join(owners)}, found {what} as well; "
                f"{packets} packets are counted as unassigned; give the --metadata of that lidar, "
                "or leave it out with --ignore SERIAL",
            )
        elif setup.rig is not None:
            yield not_in_rig(stream, what)
        else:
            start = "it started after" if is_late else "it was not recognised in"
            yield Note(
                "late_stream",
                "",
                f"{stream}: {what}; {start} the first 10 s, in which sensors are detected; its "
                "packets are counted as unassigned; name the sensor in a rig file (--rig)",
            )


def message_notes(run: Conversion) -> Iterator[Note]:
    """Warnings about messages that could not be forwarded."""
    for topic, counts in run.messages.counts.items():
        if run.messages.has_place and (other := counts.dropped.get("no_place")):
            text = f"{topic}: {other} message(s) dropped: the output cannot store its ROS version"
            yield Note("other_ros", "", text)
        if other := counts.dropped.get("other_clock"):
            text = (
                f"{topic}: {other} message(s) dropped: their clock differs from that of the scans"
            )
            yield Note("imu_clock", "", text)


def why_no_scan(run: Conversion) -> str:
    """Error text of a run without a scan: time span of each sensor, and a remedy."""
    where = ", ".join(str(path) for path in run.job.recordings)
    spans = []
    for sensor, span in zip(run.sensors, run.batcher.spans_ns, strict=True):
        if span is None:
            spans.append(f"{sensor.name} has no valid column")
        else:
            spans.append(
                f"{sensor.name} from {span[0] / NS_PER_S:.6f} to {span[1] / NS_PER_S:.6f} s"
            )
    headers = sum(
        count
        for dropped in run.batcher.dropped
        for reason, count in dropped.items()
        if reason in ("head", "tail")
    )
    if all(span is None for span in run.batcher.spans_ns):
        return f"{where}: no scan: expected valid columns, found none ({'; '.join(spans)})"
    known = [span for span in run.batcher.spans_ns if span is not None]
    first_ns = min(span[0] for span in known)
    last_ns = max(span[1] for span in known)
    start_ns, _ = run.batcher.limits_ns
    if start_ns is not None and start_ns > last_ns:
        from mlbatch.pipeline.time_limits import text_of_range, text_of_time

        return (
            f"{where}: no scan: expected --start in the recording, "
            f"{text_of_range(first_ns, last_ns)}, found {text_of_time(start_ns)}; choose another"
        )
    if run.deskew is not None and run.deskew.ledger.no_pose:
        motion = run.deskew.ledger
        return (
            f"{where}: no scan: expected poses at the times of the scans for --deskew, found "
            f"{motion.poses} poses of {motion.source}, none of a whole window, and "
            f"{'; '.join(spans)}; give a trajectory of this recording, on the clock of its lidars"
        )
    if run.job.is_fused:
        return (
            f"{where}: no scan: expected a whole sweep of each sensor for --batching "
            f"{run.job.batching}, found {'; '.join(spans)}; choose a longer recording"
        )
    period_ms = float(NS_PER_S / run.grid.rate / NS_PER_MS)
    advice = (
        "write the partial ones with --keep-partial"
        if headers
        else "choose another --start/--end, or a recording where all sensors run together"
    )
    return (
        f"{where}: no scan: expected a whole window of {period_ms:g} ms with all sensors, found "
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
        # Recordings are read ahead of each other; what was not used does not count.
        ahead = total.datagrams - run.session.delivered
        total.frames -= ahead
        total.datagrams -= ahead
    return total


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
        fill=None if run.table is None else run.table.fill[sensor.index],
        clock=_clock(run, sensor),
        extrinsics_source=sensor.detected.pose.describe(),
        body_from_sensor=sensor.body_from_sensor,
        calibration=Path(sensor.lidar.calibration).name,
        calibration_note=sensor.lidar.unproven,
    )


def _clock(run: Conversion, sensor: Sensor) -> ClockReport:
    first = run.batcher.firsts[sensor.index]
    source = sensor.clock.source
    mode = sensor.lidar.timestamp_mode
    notes: tuple[str, ...] = (f"timestamp mode {mode}",) if mode else ()
    if first is None:
        return ClockReport(source, "unknown", notes=notes)
    epoch = sensor.clock.timescale(*first)
    # A clock by receive times is in none of these: it is the capture host's.
    offsets_ns = {one.sensor: one.offset_ns for one in host_offsets(run)}
    offset_ms = offsets_ns.get(sensor.name, 0) / NS_PER_MS
    finding = dict(_estimates(run)).get(sensor.name)
    if finding is None:
        return ClockReport(source, epoch, offset_ms, notes=notes)
    if sensor.clock.map is not None:
        notes += (sensor.clock.map.describe(),)
    return ClockReport(
        source,
        epoch,
        offset_to_host_ms=offset_ms,
        drift_ppm=None if finding.drift_ppm is None else round(finding.drift_ppm, 3),
        notes=(*notes, finding.describe()),
    )


def _unassigned(run: Conversion) -> tuple[Unassigned, ...]:
    setup = run.session.setup
    rows = []
    streams = setup.sampler.table.streams
    # Not by stream number, which depends on the order of reading.
    by_name = sorted(run.session.ingest.unassigned, key=lambda key: (str(streams[key[0][0]]), key))
    for kind, ignored in by_name:
        what = _what(run, kind, ignored)
        if kind not in setup.sampler.kinds:
            what = f"not seen in the first 10 s: {what}"
        if ignored:
            what = f"ignored: {what}"
        elif kind in setup.not_in_rig:
            what = f"not_in_rig: {what}"
        count = run.session.ingest.unassigned[kind, ignored].packets
        rows.append(Unassigned(str(streams[kind.stream]), count, f"{what} ({kind.size} bytes)"))
    kind_filter = run.session.ingest.kind_filter
    if kind_filter.packets:
        what = (
            f"unknown: at least {kind_filter.kinds} streams or sizes after the first {MOST_KINDS}"
        )
        rows.append(Unassigned("other streams", kind_filter.packets, what))
    return tuple(rows)


def _what(run: Conversion, kind: PacketKind, ignored: bool) -> str:
    """Description of unassigned packets: by some of them, else by those sampled by discovery."""
    packets = run.session.ingest.unassigned[kind, ignored]
    if packets.what is None:
        sampler = run.session.setup.sampler
        text = describe_each(kind.size, packets.sample)
        if text is None and kind in sampler.kinds:
            text = describe(sampler, kind)
        packets.what = text or "unknown"
    return packets.what


# -- points, of a run or of merged shards ----------------------------------------------------------


def refuse_all_removed(where: str, points: Sequence[PointCounts]) -> None:
    """Raise NoScanError if limits and boxes left no point of any sensor."""
    by_range = sum(counts.range for counts in points)
    by_box = sum(counts.box for counts in points)
    if not by_range + by_box or any(counts.written for counts in points):
        return
    removed = [f"{by_range} by --min-range and --max-range (min_range_m, max_range_m of the rig)"]
    removed = removed * bool(by_range)
    if by_box:
        removed.append(f"{by_box} by --exclude-box (exclude_boxes_m of the rig)")
    raise NoScanError(
        f"{where}: no scan with points: expected points within the limits, found that all "
        f"{by_range + by_box} were removed: {', '.join(removed)}; widen the range, or make the "
        "boxes smaller: both are in metres"
    )


def point_notes(points: Sequence[tuple[str, PointCounts]], scans: ScanStatistics) -> Iterator[Note]:
    """Clipped intensities; scans with columns but no points: of a sensor, and of all.

    points: name and counts of each sensor.
    """
    for name, counts in points:
        if counts.clipped:
            text = (
                f"{name}: {counts.clipped} of {counts.written} points "
                f"({counts.clipped / counts.written:.2%}) have an intensity outside 0 to 255, "
                "which the point layout clips; choose one with a float32 intensity"
            )
            yield Note("clipped", name, text)
    for name, count in scans.no_points.items():
        text = (
            f"{name}: {count} of {scans.written} scans have its columns but none of its points: no "
            "returns, or all excluded; check its window, --min-range and --exclude-box"
        )
        yield Note("no_points", name, text)
    if scans.empty_clouds:
        text = f"{scans.empty_clouds} clouds without a point were written"
        yield Note("empty_cloud", "", text)


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
    )
