"""report.json and the summary of a run; see docs/report.md."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from typing import Any, NamedTuple, TypeAlias

import mlbatch
from mlbatch.arrays import F64Array
from mlbatch.bounded import parse_json
from mlbatch.errors import RecordingError
from mlbatch.reports.json_records import from_json, to_json
from mlbatch.reports.ledger import (
    CAPTURE_REASONS,
    COLUMN_REASONS,
    IMU_REASONS,
    PACKET_REASONS,
    DecodedCounts,
    SensorLedger,
    check_capture,
    check_datagrams,
    check_messages,
    ordered,
)
from mlbatch.reports.motion import MotionLedger
from mlbatch.reports.poses import PoseFigures
from mlbatch.reports.scan_table import ScanStatistics
from mlbatch.types import VARIANTS, CaptureCounts
from mlbatch.units import NS_PER_S

Json: TypeAlias = bool | int | float | str | Sequence["Json"] | Mapping[str, "Json"] | None
Section: TypeAlias = dict[str, Json]

SCHEMA = "mlbatch.report/1"


# Fields that differ from machine to machine, or are of a file apart from the output.
_OF_MACHINE = ("timing", "command", "identity", "map")
# The warning that a recording ends early.
CUT_OFF = "cut_off"
# Warnings that are no error with `--strict`: two are for information, one states what the user
# asked for by an option of that name.
ACCEPTED_WARNINGS = frozenset({"clouds", "dataset", "identity_extrinsics"})


class InputReport(NamedTuple):
    """One recording."""

    path: str
    bytes: int
    container: str


class Unassigned(NamedTuple):
    """A stream of no sensor."""

    stream: str
    packets: int
    what: str  # description of its packets


class ClockReport(NamedTuple):
    """A sensor's clock against the common one and that of the capture host."""

    source: str
    epoch: str
    offset_to_host_ms: float | None = None
    drift_ppm: float | None = None
    notes: tuple[str, ...] = ()


class SensorReport(NamedTuple):
    """One sensor."""

    name: str
    model: str
    lidar_id: int
    stream: str
    mode: str
    ledger: SensorLedger
    fill: float | None  # mean over the scans, None: unknown
    clock: ClockReport
    extrinsics_source: str
    body_from_sensor: F64Array
    calibration: str  # file name without folder
    calibration_note: str = ""  # for information


class Timing(NamedTuple):
    """Costs of a run."""

    wall_s: float
    cpu_s: float
    read_s: float
    decode_s: float
    merge_s: float
    write_s: float
    recorded_s: float  # length of the recording
    points_per_s: float
    peak_rss_mb: float
    engine: str = "native"  # earlier versions had others

    @property
    def realtime_factor(self) -> float:
        """Recorded time per time of the run."""
        return self.recorded_s / self.wall_s if self.wall_s > 0 else 0.0


class ForwardedMessages(NamedTuple):
    """Recorded messages of a forwarded topic: read = written + sum(dropped)."""

    topic: str
    read: int
    written: int
    dropped: dict[str, int]


class FaultReport(NamedTuple):
    """An injected fault, and the packets it affected."""

    fault: str
    packets: int


class Warned(NamedTuple):
    """A warning."""

    code: str
    sensor: str  # "" if it concerns the run
    message: str


@dataclass(slots=True)
class MapFigures:
    """A map (`--accumulate`): every point of the scans is in it, or in a taken voxel.

    low_m, high_m: its corners; offset_m: of the coordinates in its file; x, y, z.
    """

    file: str  # without folders
    voxel_m: float  # 0: no voxels
    crs: str  # as EPSG:NNNN, or ""
    scans: int = 0
    points: int = 0
    thinned: int = 0  # not the first point in their voxel
    offset_m: tuple[float, ...] = ()
    low_m: tuple[float, ...] = ()
    high_m: tuple[float, ...] = ()

    def describe(self) -> str:
        """A line of the summary."""
        ends = zip(self.low_m, self.high_m, strict=True)
        size = " x ".join(f"{high - low:.1f}" for low, high in ends)
        thinned = f" ({self.thinned} more in the same {self.voxel_m:g} m)" if self.voxel_m else ""
        text = f"map of {self.scans} scans: {self.points} points{thinned}, {size} m {self.crs}"
        return text.rstrip()


class RunReport(NamedTuple):
    """Content of a report."""

    inputs: tuple[InputReport, ...]
    timescale: str
    rate_hz: str
    t_init_ns: int | None  # None: no window was reached
    slices: int
    sort: str  # as `RunInfo.sort`
    capture: CaptureCounts
    sensors: tuple[SensorReport, ...]
    scans: ScanStatistics
    unassigned: tuple[Unassigned, ...] = ()
    timing: Timing | None = None
    warnings: tuple[Warned, ...] = ()
    messages: tuple[ForwardedMessages, ...] = ()
    faults: tuple[FaultReport, ...] = ()
    repeated: int = 0  # datagrams that injected faults duplicated, less those they removed
    first_scan: str = ""  # start of the first scan, as text
    variants: tuple[tuple[str, str], ...] = ()  # as `RunInfo.variants`
    deskew: MotionLedger | None = None  # with --deskew
    poses: PoseFigures | None = None  # None: of an earlier version
    map: MapFigures | None = None  # with --accumulate
    command: str = ""  # command line; "" for runs by the Python interface
    identity: dict[str, str] | None = None  # of the job, see `identity_of_parts`
    version: str = mlbatch.__version__

    @property
    def recorded_s(self) -> float:
        """Length of the recording; 0: unknown."""
        return 0.0 if self.timing is None else self.timing.recorded_s

    @classmethod
    def from_json(cls, root: object) -> RunReport:
        """The content of report.json, but for `deskew`; of any version.

        What is absent or of another type is empty, 0 or None, so that damaged reports are read.
        """
        report = _section(root)
        grid = _section(report.get("grid"))
        sensors = report.get("sensors")
        found: RunReport = from_json(
            cls,
            {
                **report,
                **grid,
                "sensors": [_fields(one) for one in sensors] if isinstance(sensors, list) else [],
                "variants": [[name, grid[name]] for name in VARIANTS if name in grid],
                "timing": report.get("timing") or None,
                "deskew": None,
            },
            tolerant=True,
        )
        return found


def parse_report(where: object, text: str | bytes) -> dict[str, Any]:
    """The values of a report.json given as text; RecordingError for another document."""
    try:
        root = parse_json(text)
    except ValueError as err:
        raise RecordingError(
            f"{where}: expected a report in JSON, found {err}; restore it, or convert again"
        ) from err
    schema = _section(root).get("schema", "none")
    if schema != SCHEMA:
        raise RecordingError(
            f"{where}: expected a report of schema {SCHEMA}, found {schema!r}; name the report of "
            "`mlbatch convert`"
        )
    return _section(root)


def report_of(where: object, text: str | bytes) -> RunReport:
    """The content of a report.json given as text; RecordingError for another document."""
    return RunReport.from_json(parse_report(where, text))


def _section(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _fields(sensor: object) -> dict[str, Any]:
    """The fields of a `SensorReport` in the JSON of a sensor."""
    section = _section(sensor)
    extrinsics = _section(section.get("extrinsics"))
    return {
        **section,
        "ledger": section,
        "extrinsics_source": extrinsics.get("source"),
        "body_from_sensor": extrinsics.get("body_from_sensor"),
    }


def build_report(run: RunReport) -> Section:
    """The report as JSON values, in the order of docs/report.md."""
    return {
        "schema": SCHEMA,
        "version": run.version,
        **({"command": run.command} if run.command else {}),
        **({"identity": run.identity} if run.identity else {}),
        "inputs": [item._asdict() for item in run.inputs],
        "timescale": run.timescale,
        "grid": {
            "rate_hz": run.rate_hz,
            # Text, since a period may be a fraction: 200000000/3 at 15 Hz.
            "period_ns": str(NS_PER_S / Fraction(run.rate_hz)),
            "t_init_ns": run.t_init_ns,
            "slices": run.slices,
            "sort": run.sort,
            **dict(run.variants),
        },
        "capture": {
            "frames": run.capture.frames,
            "datagrams": run.capture.datagrams,
            "skipped": ordered(run.capture.skipped, CAPTURE_REASONS),
        },
        "unassigned": [item._asdict() for item in run.unassigned],
        "sensors": [_sensor(sensor) for sensor in run.sensors],
        "messages": [item._asdict() for item in run.messages],
        **({"faults": [item._asdict() for item in run.faults]} if run.faults else {}),
        **({"deskew": dict(run.deskew.as_json())} if run.deskew is not None else {}),
        **({} if run.poses is None else {"poses": _section(to_json(run.poses))}),
        **({} if run.map is None else {"map": _section(to_json(run.map))}),
        "scans": _scans(run.scans),
        "timing": {} if run.timing is None else _timing(run.timing),
        "warnings": [item._asdict() for item in run.warnings],
    }


def without_machine(report: Section, inputs: Sequence[InputReport]) -> Section:
    """The report without timings, paths, command and identity."""
    kept = {key: value for key, value in report.items() if key not in _OF_MACHINE}
    kept["inputs"] = [{"bytes": item.bytes, "container": item.container} for item in inputs]
    return kept


def report_text(run: RunReport, machine: bool = True, in_a_line: bool = False) -> str:
    """report.json as text; `machine`: with timings and paths."""
    report = build_report(run)
    if not machine:
        report = without_machine(report, run.inputs)
    indent = None if in_a_line else 1
    text = json.dumps(report, indent=indent, ensure_ascii=False, allow_nan=False)
    # File names may contain bytes that are not UTF-8: write them as JSON escapes, which give the
    # name back.
    return text.encode("utf-8", "backslashreplace").decode() + "\n"


def fill_totals(run: RunReport) -> dict[str, str]:
    """Totals of fill as texts: sensors in JSON, underfilled scans as a number."""
    scans = run.scans
    fill = {sensor.name: sensor.fill for sensor in run.sensors}
    by_sensor: dict[str, Json] = {"fill": fill, "without": scans.without}
    texts = {key: json.dumps(value, ensure_ascii=False) for key, value in by_sensor.items()}
    return {"underfilled": str(scans.underfilled), **texts}


def imbalances(run: RunReport) -> list[str]:
    """One line for each counter of a run that does not balance."""
    lines = [f"capture: {line}" for line in check_capture(run.capture)]
    ledgers = [sensor.ledger for sensor in run.sensors]
    unassigned = sum(stream.packets for stream in run.unassigned)
    lines += check_datagrams(run.capture.datagrams + run.repeated, ledgers, unassigned)
    for sensor in run.sensors:
        lines += [f"{sensor.name}: {line}" for line in sensor.ledger.check()]
    for one in run.messages:
        lines += check_messages(one.topic, one.read, one.written, one.dropped)
    return lines


def summary_rows(run: RunReport) -> list[tuple[str, ...]]:
    """Counts of each sensor, head first."""
    head = ("sensor", "model", "packets", "lost", "rejected", "columns", "dropped", "points")
    return [head, *(_summary_row(sensor) for sensor in run.sensors)]


def summary_lines(run: RunReport) -> list[str]:
    """Result of a run as a text table, of `summary_rows`, and two lines."""
    rows = summary_rows(run)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        "  ".join(
            cell.ljust(width) if i < 2 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    ]
    scans = run.scans
    left_out = scans.dropped_incomplete
    dropped = f", {left_out} left out by --drop-incomplete" if left_out else ""
    variants = dict(run.variants)
    if "batching" in variants:
        lines.append(
            f"{scans.written} sets of sweeps ({scans.incomplete} incomplete), frame-level fusion "
            f"{variants['batching']}, {variants['batching_times']} times, {scans.points} points, "
            f"clock {run.timescale}"
        )
    else:
        lines.append(
            f"{scans.written} scans at {run.rate_hz} Hz ({scans.incomplete} incomplete, "
            f"{scans.empty} empty windows{dropped}), {scans.points} points, clock {run.timescale}"
        )
    if run.deskew is not None:
        lines.append(run.deskew.describe())
    if run.map is not None:
        lines.append(run.map.describe())
    if run.first_scan:
        lines.append(f"first scan at {run.first_scan}")
    for name, count in scans.underfilled_by_sensor.items():
        none = scans.without.get(name, 0)
        tail = f": {none} have none" if none else ""
        lines.append(f"{count} scans lack columns of {name}{tail}")
    lines += [
        f"extrinsics of {sensor.name} are from its metadata, {sensor.calibration}"
        for sensor in run.sensors
        if sensor.extrinsics_source == "metadata"
    ]
    if run.timing is not None:
        timing = run.timing
        lines.append(
            f"{timing.recorded_s:.1f} s recorded in {timing.wall_s:.1f} s: "
            f"{timing.realtime_factor:.1f} x real time, "
            f"{timing.points_per_s / 1e6:.1f} million points/s, {timing.peak_rss_mb:.0f} MB"
        )
    return lines + [f"warning {item.code}: {item.message}" for item in run.warnings]


def _scans(scans: ScanStatistics) -> Section:
    spreads = {"span_ms": scans.span_ms._asdict(), "period_ms": scans.period_ms._asdict()}
    return {**scans._asdict(), **spreads}


def _timing(timing: Timing) -> Section:
    costs: Section = timing._asdict()
    # The rates come last, after realtime_factor.
    tail = {key: costs.pop(key) for key in ("points_per_s", "peak_rss_mb", "engine")}
    return {**costs, "realtime_factor": timing.realtime_factor, **tail}


def _sensor(sensor: SensorReport) -> Section:
    ledger = sensor.ledger
    rejected = ordered(ledger.packets.rejected, PACKET_REASONS)
    return {
        "name": sensor.name,
        "model": sensor.model,
        "lidar_id": sensor.lidar_id,
        "stream": sensor.stream,
        "mode": sensor.mode,
        "packets": asdict(ledger.packets) | {"rejected": rejected},
        "imu_packets": ledger.imu_packets,
        "imu_samples": _decoded(ledger.imu_samples, IMU_REASONS),
        "columns": _decoded(ledger.columns, COLUMN_REASONS),
        "fill": sensor.fill,
        "points": asdict(ledger.points),
        "clock": sensor.clock._asdict(),
        "extrinsics": {
            "source": sensor.extrinsics_source,
            "body_from_sensor": sensor.body_from_sensor.tolist(),
        },
        "calibration": sensor.calibration,
        **({"calibration_note": sensor.calibration_note} if sensor.calibration_note else {}),
    }


def _decoded(counts: DecodedCounts, reasons: tuple[str, ...]) -> Section:
    """Columns or IMU samples; without `reused` where nothing is."""
    section = asdict(counts) | {"dropped": ordered(counts.dropped, reasons)}
    return {key: value for key, value in section.items() if value or key != "reused"}


def _summary_row(sensor: SensorReport) -> tuple[str, ...]:
    packets = sensor.ledger.packets
    columns = sensor.ledger.columns
    counts = (
        packets.read,
        packets.lost,
        sum(packets.rejected.values()),
        columns.written,
        sum(columns.dropped.values()),
        sensor.ledger.points.written,
    )
    return (sensor.name, sensor.model, *map(str, counts))
