"""Problems of a run in plain words, from its report and its windows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from mlbatch.arrays import BoolArray
from mlbatch.page.windows import Windows
from mlbatch.reports.ledger import SensorLedger
from mlbatch.reports.report import RunReport
from mlbatch.types import CLOUDS

# Outcomes of packets, columns and points.
MEANINGS = {
    "accepted": "accepted",
    "written": "in the output",
    "lost": "never received",
    "no_return": "no return",
    "range": "outside the range limits",
    "box": "in an excluded box",
    "repeated": "repeated return",
    "head": "before the first whole window",
    "tail": "after the last whole window",
    "before_start": "before all sensors had started",
    "outside_time": "outside --start and --end",
    "late": "late",
    "invalid": "marked invalid by the sensor",
    "incomplete": "in a window left out as incomplete",
    "bad_size": "bad size",
    "bad_header": "bad header",
    "bad_crc": "bad checksum",
    "bad_stamp": "bad timestamp",
    "duplicate": "duplicate",
}
# Costs of a run.
COSTS = {
    "wall_s": "total, s",
    "cpu_s": "processor, s",
    "read_s": "reading, s",
    "decode_s": "decoding, s",
    "merge_s": "merging, s",
    "write_s": "writing, s",
    "peak_rss_mb": "memory, MB",
}
# Senders that are no lidars, by port. Source: IANA, Service Name and Transport Protocol Port
# Number Registry.
SERVICES = {
    53: "DNS",
    67: "DHCP",
    68: "DHCP",
    123: "NTP",
    137: "NetBIOS names",
    138: "NetBIOS datagrams",
    319: "PTP events",
    320: "PTP general messages",
    1900: "SSDP",
    3702: "WS-Discovery",
    5353: "mDNS",
    5355: "LLMNR",
}


_NETWORK = (
    "check network, switch and capture buffers (tcpdump -B, net.core.rmem_max), and the speed of "
    "the disk"
)
_POWER = "check the sensor's power, cable and log; --drop-incomplete leaves such scans out"
# Remedy for each warning, by its code (docs/report.md).
REMEDIES = {
    "cut_off": "copy the file again, or record with tcpdump -U; scans end where the file does",
    "recording": "copy the file again; the readable part was used",
    "message": "give metadata with --metadata, transforms in a rig file (--rig)",
    "short": "record two periods or more; or choose a higher --rate",
    "late_stream": "name the sensor in a rig file (--rig)",
    "no_metadata": "give the sensor's metadata or calibration with --metadata FILE",
    "no_decoder": "see mlbatch sensors for the supported models",
    "no_overlap": "give recordings of one drive, or remove the optional sensors from the rig",
    "unassigned": "name both lidars in a rig file (--rig), each with its serial number",
    "not_in_rig": "add the lidar to the rig, or leave it out with --ignore",
    "not_seen_yet": "check address, port or topic of the sensor in the rig",
    "calibration": "check that the calibration belongs to this sensor",
    "rejected": "check model, return mode and calibration: mlbatch inspect RECORDING",
    "clipped": "choose a point layout with a float32 intensity (--point-layout standard)",
    "late": "raise --max-wait; look for damaged timestamps (--decode crc=check)",
    "loss": _NETWORK,
    "no_points": "look for a covered lens; check --min-range, --max-range and --exclude-box",
    "empty_cloud": "check that the sensor measures; leave scans out with --drop-incomplete",
    "timescale": "set all sensors to one time source (PTP or GPS), or use --clock host",
    "extrinsics_contradict": "correct one of the sources, or give the pose in a rig file (--rig)",
    "extrinsics_frame": "give the pose in a rig file (--rig): extrinsics: {frame: NAME}",
    "extrinsics_mixed": "give all poses in a rig file (--rig)",
    "identity_extrinsics": "give the poses in a rig file (--rig); without them clouds do not merge",
    "far_pose": "give translation_m in metres, from an origin on the vehicle",
    "pose_gravity": "correct the pose in the rig file, or the name of its body frame",
    "pose": "measure the poses with mlbatch calibrate, and correct them in the rig file (--rig)",
    "radians": "give rotation_rpy_deg in degrees",
    "same_pose": "correct the pose of one of them in the rig file",
    "constant_tf": "nothing to do if the sensor does not move; else publish on /tf_static",
    "urdf": "give the pose in a rig file (--rig)",
    "other_ros": "write an output of the same ROS version (--format rosbag1, mcap or rosbag2)",
    "imu_clock": "set IMU and lidars to one time source, or give the topic with --pass",
    "no_pose": "give a trajectory of the whole recording (--deskew FILE.tum)",
    "no_velocity": "give a trajectory (--deskew FILE.tum); exclude the machine (--exclude-box)",
    "deskew_drift": "give a trajectory of the drive (--deskew FILE.tum)",
    "clock_epoch": "correct the offset in the rig (clock.offset_s), or use --clock host",
    "clocks": "synchronise the sensors (PTP or GPS), or use --align-clocks or --clock host",
    "clock_jump": "use --on-jump split, or --clock host",
    "host_step": "do not set the clock of the capture host during a recording",
    "max_wait": "give --max-wait in seconds",
    "cloud_time": "state unit or from of points, or the clock, in the rig, as the warning says",
    "clouds": "mlbatch inspect measures whether the times fit the motion",
    "dataset": "check a few seconds of scans; the pages of each fact: mlbatch datasets --json",
}
_INFORMATION = frozenset({"clouds", "constant_tf", "dataset"})
_SERIOUS = frozenset({"clocks", "clock_jump", "cut_off", "recording", "clock_epoch"})

_FINE = "Packets, windows and clocks are fine"
# Shares of packets or columns.
_LITTLE, _MUCH = 0.001, 0.01
# Distance that clocks drift apart during the recording.
_DRIFT_MS, _MUCH_DRIFT_MS = 0.5, 5.0
_MOST_STALLS = 6


class Level(IntEnum):
    """Severity of a finding."""

    GOOD = 0
    NOTE = 1
    WARNING = 2
    PROBLEM = 3


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding; code: of the warning it repeats, else ""."""

    level: Level
    text: str
    remedy: str = ""
    code: str = ""


def findings(report: RunReport, windows: Windows | None) -> list[Finding]:
    """All findings, the most serious first."""
    stalls = [] if windows is None else _stalls(report, windows)
    # Their loss is that of their stalls.
    stalled = {one.sensor for one in stalls if one.has_all_loss}
    found = [
        *_scans(report, windows, stalls),
        *(finding for one in stalls for finding in one.findings()),
        *_packets(report, stalled),
        *_columns(report),
        *_clocks(report),
        *_poses(report),
        *_faults(report),
        *_warnings(report, stalled),
    ]
    return sorted(found, key=lambda one: -one.level)


def verdict(found: list[Finding], report: RunReport) -> tuple[Level, str, str]:
    """The overall level, a heading, and the number of other findings in words."""
    level = max((one.level for one in found), default=Level.GOOD)
    if level < Level.WARNING:
        # Where lidars are, no packet says: the heading names what was compared.
        covered = "poses not checked" if report.poses is None else report.poses.describe()
        fine = _FINE
        if any(sensor.model in CLOUDS for sensor in report.sensors):
            fine = "Windows are fine; clocks and times of decoded clouds not measured"
        return Level.GOOD, f"{fine}; {covered}", ""
    problems = sum(one.level == Level.PROBLEM for one in found)
    warnings = sum(one.level == Level.WARNING for one in found)
    parts = [number(problems, "problem")] * (problems > 0)
    parts += [number(warnings, "warning")] * (warnings > 0)
    return level, found[0].text, f"{' and '.join(parts)} below." if len(found) > 1 else ""


def percent(part: float, whole: float) -> str:
    """A share in %, with as many digits as it needs."""
    share = 100.0 * part / whole if whole else 0.0
    if share and share < 0.01:
        return "less than 0.01 %"
    return f"{share:.2f} %" if share < 1 else f"{share:.1f} %"


def number(count: int, one: str, many: str = "") -> str:
    """A count with its noun."""
    return f"{count:,} {one if count == 1 else many or one + 's'}"


def _scans(report: RunReport, windows: Windows | None, stalls: list[_Stalls]) -> Iterator[Finding]:
    scans = report.scans
    written = scans.written
    if not written:
        yield Finding(
            Level.PROBLEM,
            "No scan was written.",
            "see the error of mlbatch convert; mlbatch inspect shows what the recording contains",
        )
    if empty := scans.empty:
        yield Finding(
            Level.WARNING,
            f"{number(empty, 'window')} without a column of any sensor: no scan was written.",
            "look for a pause of the capture; the indices of scans keep the gap",
        )
    incomplete = scans.incomplete
    if windows is not None and windows.has_head:
        yield Finding(Level.NOTE, "Head and tail are incomplete, as requested by --keep-partial.")
        partial = 1 + int(not windows.complete[-1])
        incomplete -= partial
        if written <= partial:
            yield Finding(
                Level.WARNING,
                "No window is whole: head and tail, which are partial, are all that was written.",
                "record longer, or use shorter windows (--rate)",
            )
    if windows is not None and stalls:
        near: BoolArray = np.logical_or.reduce([one.near for one in stalls])
        incomplete -= int(np.count_nonzero(near & ~_is_partial(windows) & ~windows.complete))
    if incomplete > 0:
        yield Finding(
            Level.WARNING,
            f"{number(incomplete, 'scan')} of {written:,} "
            f"{'is' if incomplete == 1 else 'are'} incomplete: a sensor does not cover the window.",
            "skip scans with complete = false, or leave them out with --drop-incomplete",
        )
    if dropped := scans.dropped_incomplete:
        yield Finding(
            Level.NOTE, f"{number(dropped, 'scan')} left out, as requested by --drop-incomplete."
        )


@dataclass(frozen=True, slots=True)
class _Stalls:
    """Intervals of rows in which a sensor sent nothing; near: rows of these and of neighbours.

    lost: packets of the sensor; has_all_loss: they are of the stalls.
    """

    sensor: str
    windows: Windows
    intervals: list[tuple[int, int]]
    near: BoolArray
    lost: int
    has_all_loss: bool

    def findings(self) -> Iterator[Finding]:
        """A finding for each of the first intervals, and one for the others."""
        windows = self.windows
        times = "this time" if len(self.intervals) == 1 else "its stalls"
        loss = f" All {number(self.lost, 'lost packet')} of {self.sensor} are of {times}."
        for first, end in self.intervals[:_MOST_STALLS]:
            begin_s = windows.seconds(first)
            end_s = windows.seconds(end - 1) + _length_s(windows, end - 1)
            what = f"{self.sensor} sent nothing"
            if first == 0 and end == len(windows):
                text = f"{what}: no column in any scan."
            elif first == 0:
                text = f"{what} until +{end_s:.1f} s ({number(end - first, 'scan')})."
            elif end == len(windows):
                text = f"{what} from +{begin_s:.1f} s to the end ({number(end - first, 'scan')})."
            else:
                text = (
                    f"{what} from +{begin_s:.1f} s to +{end_s:.1f} s: a stall of "
                    f"{number(end - first, 'scan')}."
                )
            if self.has_all_loss and (first, end) == self.intervals[0]:
                text += loss
            yield Finding(Level.PROBLEM, text, _POWER)
        if len(self.intervals) > _MOST_STALLS:
            more = len(self.intervals) - _MOST_STALLS
            yield Finding(Level.PROBLEM, f"{number(more, 'more stall')} of {self.sensor}.", _POWER)


def _stalls(report: RunReport, windows: Windows) -> list[_Stalls]:
    """The stalls of each sensor that has some."""
    found = []
    for i, name in enumerate(windows.sensors):
        silent: BoolArray = windows.columns[:, i] == 0
        if windows.has_head and len(silent) > 1:
            # Head and tail are partial: alone, they are no stall.
            silent[0] &= silent[1]
            silent[-1] &= silent[-2] | windows.complete[-1]
        intervals = _intervals(silent)
        if not intervals:
            continue
        near = silent.copy()
        near[1:] |= silent[:-1]
        near[:-1] |= silent[1:]
        ledger = next((one.ledger for one in report.sensors if one.name == name), SensorLedger())
        lost, accepted = ledger.packets.lost, max(1, ledger.packets.accepted)
        # Columns that are missing near the stalls, and nowhere else, account for all packets.
        per_packet = ledger.columns.decoded / accepted
        missing = int((windows.expected - windows.columns)[near, i].sum())
        is_all = missing + int(near.sum()) + per_packet >= lost * per_packet
        elsewhere = windows.fill[~near & ~_is_partial(windows), i] < 1
        has_all_loss = lost > 0 and is_all and not elsewhere.any()
        found.append(_Stalls(name, windows, intervals, near, lost, has_all_loss))
    return found


def _is_partial(windows: Windows) -> BoolArray:
    """Head and tail."""
    partial: BoolArray = np.zeros(len(windows), np.bool_)
    partial[0], partial[-1] = windows.has_head, windows.has_head and not windows.complete[-1]
    return partial


def _length_s(windows: Windows, row: int) -> float:
    return int(windows.end_ns[row] - windows.start_ns[row]) / 1e9


def _intervals(mask: BoolArray) -> list[tuple[int, int]]:
    """First and end rows of each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(first), int(end)) for first, end in edges.reshape(-1, 2)]


def _packets(report: RunReport, stalled: set[str]) -> Iterator[Finding]:
    warned = stalled | {one.sensor for one in report.warnings if one.code == "loss"}
    for sensor in report.sensors:
        name = sensor.name
        packets = sensor.ledger.packets
        lost = packets.lost
        sent = packets.read + lost
        # Else the warning, or the stall, states it.
        if lost and name not in warned:
            level = _level(lost, sent)
            text = f"{name} lost {number(lost, 'packet')} of {sent:,}, {percent(lost, sent)}."
            yield Finding(level, text, _NETWORK)
        rejected = {
            reason: count for reason, count in packets.rejected.items() if reason != "duplicate"
        }
        total = sum(rejected.values())
        if total:
            reasons = ", ".join(
                f"{MEANINGS.get(reason, reason)} {count:,}" for reason, count in rejected.items()
            )
            text = f"{number(total, 'packet')} of {name} rejected ({reasons})."
            yield Finding(_level(total, sent), text, REMEDIES["rejected"])


def _level(part: int, whole: int) -> Level:
    if part >= _MUCH * whole:
        return Level.PROBLEM
    return Level.WARNING if part >= _LITTLE * whole else Level.NOTE


def _columns(report: RunReport) -> Iterator[Finding]:
    for sensor in report.sensors:
        late = sensor.ledger.columns.dropped.get("late", 0)
        decoded = sensor.ledger.columns.decoded
        if late and late < _MUCH * decoded:
            text = f"{number(late, 'column')} of {sensor.name} came late and were dropped."
            yield Finding(Level.NOTE, text, REMEDIES["late"])


def _clocks(report: RunReport) -> Iterator[Finding]:
    recorded_s = report.recorded_s
    drifts = {
        sensor.name: sensor.clock.drift_ppm
        for sensor in report.sensors
        if sensor.clock.drift_ppm is not None
    }
    if len(drifts) < 2:
        return
    slow = min(drifts, key=drifts.__getitem__)
    fast = max(drifts, key=drifts.__getitem__)
    ppm = drifts[fast] - drifts[slow]
    apart_ms = ppm * recorded_s / 1000.0
    if apart_ms < _DRIFT_MS:
        return
    level = Level.PROBLEM if apart_ms >= _MUCH_DRIFT_MS else Level.WARNING
    text = (
        f"The clocks of {fast} and {slow} drift apart by {ppm:.1f} ppm: {apart_ms:.2f} ms in "
        f"{recorded_s:.0f} s."
    )
    yield Finding(level, text, REMEDIES["clocks"])


def _poses(report: RunReport) -> Iterator[Finding]:
    """Findings of the pose check; wrong poses with a warning `pose` are left to that."""
    pairs = () if report.poses is None else report.poses.pairs
    has_warning = any(one.code == "pose" for one in report.warnings)
    for pair in pairs:
        if not (pair.is_wrong and has_warning):
            level = Level.WARNING if pair.is_wrong else Level.NOTE
            remedy = REMEDIES["pose"] if pair.is_wrong else ""
            yield Finding(level, f"Poses: {pair.describe()}.", remedy)


def _faults(report: RunReport) -> Iterator[Finding]:
    if report.faults:
        texts = ", ".join(f"{one.fault} ({number(one.packets, 'packet')})" for one in report.faults)
        yield Finding(Level.NOTE, f"Faults were injected by --fault: {texts}.")


def _warnings(report: RunReport, stalled: set[str]) -> Iterator[Finding]:
    losses = {
        sensor.name: _level(packets.lost, packets.lost + packets.read)
        for sensor in report.sensors
        if (packets := sensor.ledger.packets).lost
    }
    for one in report.warnings:
        code = one.code
        if code == "loss" and one.sensor in stalled:
            continue
        level = Level.WARNING
        # Other notes on a calibration say what was assumed, and contradict nothing.
        is_note = code == "calibration" and "expected" not in one.message
        if code in _INFORMATION or is_note:
            level = Level.NOTE
        elif code in _SERIOUS:
            level = Level.PROBLEM
        elif code == "loss":
            level = max(level, losses.get(one.sensor, level))
        remedy = REMEDIES.get(code, "see docs/report.md")
        yield Finding(level, one.message, remedy, code)
