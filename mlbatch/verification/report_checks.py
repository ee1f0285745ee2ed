"""Report and metadata of a run: found, read, and checked against each other and the output."""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import TypeAlias, cast

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array
from mlbatch.bounded import parse_json
from mlbatch.errors import UsageError
from mlbatch.outputs.damage import CheckLog, VerifyError
from mlbatch.outputs.metadata import RunMetadata
from mlbatch.outputs.run_files import TABLE, RunFiles
from mlbatch.types import CLOUDS, VARIANTS
from mlbatch.units import parse_rate
from mlbatch.verification.scan_checks import Grid
from mlbatch.verification.table import OutputTotals, Table, read_table

SCHEMA = "mlbatch.report/1"
_NS = 10**9
_NS_PER_MS = 1e6
# Python refuses very long numbers.
_MOST_DIGITS = 19
# More than `--slices` allows.
_MOST_SLICES = 1_000_000
# Largest distance of a sensor from its body.
_MOST_M = 1e9
# Largest span or period.
_MOST_MS = 1e15
# Ledgers of a sensor: section, total, its good outcome, the others by reason.
_LEDGERS = (
    ("packets", "read", "accepted", "rejected"),
    ("imu_samples", "decoded", "written", "dropped"),
    ("columns", "decoded", "written", "dropped"),
)
_OUTCOMES = ("no_return", "range", "box", "repeated", "written")
# Least fill of a scan that is not underfilled.
_UNDERFILLED = 0.5
# Windows without a scan.
_UNWRITTEN = ("empty", "dropped_incomplete")
# Sections that differ between runs on the same recording.
_MACHINE = ("timing", "inputs", "command", "identity", "map")

Json: TypeAlias = "dict[str, Json] | list[Json] | str | int | float | bool | None"
Keys: TypeAlias = "tuple[str | int, ...]"


# -- metadata of the run --------------------------------------------------------------------------


def grid_of(metadata: RunMetadata, where: str) -> Grid | None:
    """The grid of a run; None without a rate, and of sets of sweeps."""
    if metadata.rate is None or metadata.batching is not None:
        return None
    slices = 1 if metadata.slices is None else metadata.slices
    try:
        rate: Fraction = parse_rate(metadata.rate)
    except UsageError as err:
        raise VerifyError(f"{where}: {err}") from err
    if not 1 <= slices <= _MOST_SLICES:
        expected = f"1 to {_MOST_SLICES} slices per window"
        raise VerifyError(f"{where}: expected {expected}, found {slices}; convert again")
    return Grid(rate, slices)


# -- the report as a document ---------------------------------------------------------------------


@dataclass(slots=True)
class Document:
    """A JSON document with values by path; a missing value is a violation, once."""

    log: CheckLog
    where: str
    root: Json
    _failed: set[str] = field(default_factory=set)

    @classmethod
    def parsed(cls, log: CheckLog, path: Path, text: str, where: str = "") -> Document:
        """A document from its text; where: its name if it is in the file at `path`."""
        try:
            return cls(log, where or path.name, cast(Json, parse_json(text)))
        except ValueError as err:
            raise VerifyError(
                f"{path}: expected a report in JSON, found {err}; restore it, or convert again"
            ) from err

    def at(self, *path: str | int) -> Json:
        """The value at a path; None if there is none."""
        value = self.root
        for step in path:
            if isinstance(value, dict) and isinstance(step, str):
                value = value.get(step)
            elif isinstance(value, list) and isinstance(step, int) and step < len(value):
                value = value[step]
            else:
                return None
        return value

    def name(self, *path: str | int) -> str:
        """File and path of a value."""
        return f"{self.where} {'.'.join(map(str, path))}"

    def number(self, *path: str | int) -> int | None:
        """An integer of 0 or more."""
        value = self.at(*path)
        if isinstance(value, int) and not isinstance(value, bool) and value >= 0:
            return value
        self._fail("a whole number of 0 or more", value, path)
        return None

    def text(self, *path: str | int) -> str | None:
        """A text."""
        value = self.at(*path)
        if isinstance(value, str):
            return value
        self._fail("a text", value, path)
        return None

    def counts(self, *path: str | int) -> dict[str, int]:
        """Numbers by reason."""
        value = self.at(*path)
        if not isinstance(value, dict):
            self._fail("counts by reason", value, path)
            return {}
        found = {reason: self.number(*path, reason) for reason in value}
        return {reason: count for reason, count in found.items() if count is not None}

    def length(self, *path: str | int) -> int:
        """Entries of a list."""
        value = self.at(*path)
        if isinstance(value, list):
            return len(value)
        self._fail("a list", value, path)
        return 0

    def metadata(self) -> RunMetadata:
        """Metadata of the run in the report."""
        names = [self.text("sensors", i, "name") for i in range(self.length("sensors"))]
        said = {name: self.text("grid", name) for name in ("rate_hz", "sort")}
        said |= {name: text for name in VARIANTS if isinstance(text := self.at("grid", name), str)}
        said["timescale"] = self.text("timescale")
        return RunMetadata.of(
            self.log,
            self.where,
            {name: text for name, text in said.items() if text is not None},
            tuple(name or "" for name in names),
            slices=self.number("grid", "slices"),
            t_init_ns=self.number("grid", "t_init_ns"),
        )

    def check_number(self, expected: int, *path: str | int) -> None:
        """Check a number of the report against the output."""
        said = self.number(*path)
        if said is not None:
            self.log.equal("report", self.name(*path), expected, said)

    def _fail(self, expected: str, value: Json, path: Keys) -> None:
        name = self.name(*path)
        if name not in self._failed:
            self._failed.add(name)
            self.log.fail("ledger", name, expected, "nothing" if value is None else value)


# -- files of report and table --------------------------------------------------------------------


@dataclass(slots=True)
class ReportFiles:
    """The report and the table of a run; None if there is none."""

    report: Document | None
    table: Table | None

    @classmethod
    def read(cls, log: CheckLog, files: RunFiles) -> ReportFiles:
        """Files in the output folder, or next to the output file."""
        text = files.report_text()
        report = None if text is None else Document.parsed(log, files.report, text)
        text = files.table_text()
        return cls(report, None if text is None else read_table(log, files.table.name, text))

    @classmethod
    def inside(
        cls, log: CheckLog, path: Path, metadata: dict[str, str] | None, attachment: bytes | None
    ) -> ReportFiles:
        """Metadata record and attachment of an MCAP file."""
        where = path.name
        report = None
        if metadata is None:
            log.fail("metadata", where, "a metadata record mlbatch.report", "none")
        else:
            text = metadata.get("json", "")
            report = Document.parsed(log, path, text, f"{where} mlbatch.report")
        if attachment is None:
            log.fail("table", where, f"an attachment {TABLE}", "none")
            return cls(report, None)
        text = attachment.decode("utf-8", "replace")
        return cls(report, read_table(log, f"{where} {TABLE}", text))

    def check_copies(self, log: CheckLog, attachment: bytes | None, files: RunFiles) -> None:
        """Check the files next to an MCAP file against those inside."""
        text = files.report_text()
        if text is not None and self.report is not None:
            _check_same(log, self.report, Document.parsed(log, files.report, text))
        table = files.table_text()
        if table is not None and attachment is not None:
            log.ok("table")
            if table.encode() != attachment:
                log.fail("table", files.table.name, "the bytes of the attachment", "others")

    def metadata(self, log: CheckLog, own: RunMetadata) -> RunMetadata:
        """Metadata `own` of the output, joined with those of report and table."""
        found = own
        if self.report is not None:
            found = found.joined(log, self.report.where, self.report.metadata())
        if self.table is not None:
            of_table = RunMetadata(sensors=self.table.sensors)
            found = found.joined(log, self.table.where, of_table)
        return found


def _check_same(log: CheckLog, one: Document, other: Document) -> None:
    """Check two copies of a report; one may lack the sections of the machine."""
    if not isinstance(one.root, dict) or not isinstance(other.root, dict):
        log.equal("report", other.where, "an object", type(other.root).__name__)
        return
    for key in sorted({*one.root, *other.root} - set(_MACHINE)):
        path = _difference(one.root.get(key), other.root.get(key), key)
        log.ok("report")
        if path is not None:
            log.fail("report", f"{other.where} {path}", f"as in {one.where}", "another value")


def _difference(one: Json, other: Json, path: str) -> str | None:
    """The first path where two values differ."""
    pairs: list[tuple[str | int, Json, Json]]
    if isinstance(one, dict) and isinstance(other, dict):
        pairs = [(key, one.get(key), other.get(key)) for key in (*one, *other)]
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        pairs = [(i, one[i], other[i]) for i in range(len(one))]
    else:
        return None if one == other else path
    found = (_difference(left, right, f"{path}.{key}") for key, left, right in pairs)
    return next((place for place in found if place is not None), None)


# -- the report on its own ------------------------------------------------------------------------


def check_ledgers(report: Document) -> None:
    """Everything that was read is written or counted."""
    log = report.log
    log.equal("ledger", report.name("schema"), SCHEMA, report.at("schema"))
    skipped = report.counts("capture", "skipped")
    _check_sum(report, ("capture", "frames"), ("capture", "datagrams"), skipped)
    for i in range(report.length("sensors")):
        number = report.number("sensors", i, "lidar_id")
        log.equal("ledger", report.name("sensors", i, "lidar_id"), i, number)
        for section, total, good, others in _LEDGERS:
            path: Keys = ("sensors", i, section)
            more = report.number(*path, "reused") if report.at(*path, "reused") else 0
            _check_sum(report, (*path, total), (*path, good), report.counts(*path, others), more)
        path = ("sensors", i, "points")
        outcomes = {name: report.number(*path, name) for name in _OUTCOMES[1:]}
        if None not in outcomes.values():
            known = {name: count or 0 for name, count in outcomes.items()}
            _check_sum(report, (*path, "slots"), (*path, _OUTCOMES[0]), known)
        _check_clipped(report, path)
    if report.at("deskew") is not None:
        _check_motion(report)
    if report.at("map") is not None:
        thinned = {"thinned": report.number("map", "thinned") or 0}
        _check_sum(report, ("scans", "points"), ("map", "points"), thinned)
    for i in range(report.length("messages")):
        path = ("messages", i)
        _check_sum(report, (*path, "read"), (*path, "written"), report.counts(*path, "dropped"))


def _check_motion(report: Document) -> None:
    """Every column of --deskew is moved and written, written as it is, or has no pose."""
    no_pose = report.number("deskew", "no_pose") or 0
    others = {"no_pose": no_pose}
    if report.at("deskew", "unmoved") is not None:
        others["unmoved"] = report.number("deskew", "unmoved") or 0
    _check_sum(report, ("deskew", "columns"), ("deskew", "moved"), others)
    sensors = range(report.length("sensors"))
    dropped = [report.counts("sensors", i, "columns", "dropped") for i in sensors]
    counted = sum(counts.get("no_pose", 0) for counts in dropped)
    report.log.equal("ledger", report.name("deskew", "no_pose"), counted, no_pose)


def _check_clipped(report: Document, points: Keys) -> None:
    """Clipped points of a sensor are among its written ones."""
    clipped = _clipped(report, points)
    written = report.number(*points, "written")
    report.log.ok("ledger")
    if written is not None and clipped > written:
        name = report.name(*points, "clipped")
        report.log.fail("ledger", name, f"at most {written} written points", clipped)


def _clipped(report: Document, points: Keys) -> int:
    """Clipped points of a sensor; 0 where the report is of a version that did not count them."""
    path = (*points, "clipped")
    return 0 if report.at(*path) is None else report.number(*path) or 0


def _check_sum(
    report: Document, total: Keys, good: Keys, others: dict[str, int], more: int | None = 0
) -> None:
    """Check that a total is its good outcome and the others together; more: counted again."""
    said = report.number(*total)
    first = report.number(*good)
    if said is None or first is None:
        return
    parts = [first, *others.values()]
    if more:
        parts.append(-more)
    report.log.ok("ledger")
    if said != sum(parts):
        text = " + ".join(map(str, parts))
        report.log.fail("ledger", report.name(*total), f"{text} = {sum(parts)}", said)


def check_period(report: Document) -> None:
    """The period is one over the rate."""
    rate = report.text("grid", "rate_hz")
    period = report.text("grid", "period_ns")
    if rate is None or period is None:
        return
    try:
        expected = str(Fraction(_NS) / parse_rate(rate))
    except UsageError:
        return  # An error where the rate is used.
    report.log.equal("grid", report.name("grid", "period_ns"), expected, period)


def poses_of(report: Document) -> F64Array | None:
    """Body from sensor, (s, 4, 4); None if one is not rigid, which is a violation."""
    poses = []
    for i in range(report.length("sensors")):
        path: Keys = ("sensors", i, "extrinsics", "body_from_sensor")
        try:
            pose: F64Array = np.array(report.at(*path), np.float64)
        except (TypeError, ValueError, OverflowError):
            pose = np.zeros(0)
        if not _is_rigid(pose):
            report.log.fail("report", report.name(*path), "a rigid transform (4, 4)", pose)
            return None
        poses.append(pose)
    report.log.ok("report", len(poses))
    return np.stack(poses) if poses else None


def _is_rigid(pose: F64Array) -> bool:
    # Squares of larger numbers would overflow; NaN is not less.
    if pose.shape != (4, 4) or not (np.abs(pose) < _MOST_M).all():
        return False
    rotation = pose[:3, :3]
    return bool(
        np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
        and np.linalg.det(rotation) > 0
        and (pose[3] == (0, 0, 0, 1)).all()
    )


# -- the report against the output ----------------------------------------------------------------


def check_report(
    report: Document, totals: OutputTotals, table: Table | None, grid: Grid | None
) -> None:
    """Check counts and figures of the report against scans and table."""
    log = report.log
    report.check_number(totals.points, "scans", "points")
    sensors = report.length("sensors")
    count = min(sensors, len(totals.points_of))
    if totals.knows_points:
        for i in range(count):
            report.check_number(int(totals.points_of[i]), "sensors", i, "points", "written")
    if totals.knows_owners:
        for i in range(count):
            report.check_number(int(totals.columns_of[i]), "sensors", i, "columns", "written")
    written = [report.number("sensors", i, "columns", "written") for i in range(sensors)]
    if totals.knows_columns and None not in written:
        total = sum(number or 0 for number in written)
        name = report.name("sensors", "columns", "written")
        log.equal("report", f"{name}, all", totals.columns, total)
    for i in range(count):
        _check_slots(report, totals, i)
    # A clipped intensity is a limit of its field.
    clipped = sum(_clipped(report, ("sensors", i, "points")) for i in range(sensors))
    log.ok("report")
    if clipped > totals.at_limit:
        name = report.name("sensors", "points", "clipped")
        log.fail("report", f"{name}, all", f"at most {totals.at_limit}", clipped)
    if table is not None:
        _check_table(report, table)
        if grid is not None:
            _check_windows(report, table, grid)


def _check_slots(report: Document, totals: OutputTotals, i: int) -> None:
    """Every column of a sensor has as many slots, and at most as many rings."""
    log = report.log
    slots = report.number("sensors", i, "points", "slots")
    columns = report.number("sensors", i, "columns", "written")
    if not slots or not columns:
        return
    name = report.name("sensors", i, "points", "slots")
    if slots % columns:
        log.fail("report", name, f"a multiple of {columns} columns", slots)
        return
    log.ok("report")
    rings = totals.rings
    low = int(rings.low[i])
    high = int(rings.high[i])
    # A column of one point may be of any ring of its sensor, and columns of an output that was
    # converted again are points of one time.
    is_again = report.text("sensors", i, "extrinsics", "source") == "output"
    if is_again or slots <= columns or not rings.high_at.get(i):
        return
    if high - low >= slots // columns:
        expected = f"a ring less than {slots // columns} slots above {low}, the sensor's lowest"
        log.fail("rings", rings.high_at[i], expected, high)


def _check_table(report: Document, table: Table) -> None:
    report.check_number(len(table), "scans", "written")
    report.check_number(int(table.points.sum()), "scans", "points")
    report.check_number(int(np.count_nonzero(~table.complete)), "scans", "incomplete")
    _check_fill(report, table)
    for i in range(min(report.length("sensors"), len(table.sensors))):
        written = int(table.columns_of[:, i].sum())
        report.check_number(written, "sensors", i, "columns", "written")
    span_ms: F64Array = (table.last_ns - table.first_ns) / _NS_PER_MS
    _check_quantiles(report, "span_ms", span_ms)


def _check_fill(report: Document, table: Table) -> None:
    """Check underfilled scans, and those without columns of a sensor; head and tail do not count.

    The tail is at most the last line.
    """
    if table.fill is None:
        return
    whole = table.index >= 0
    # The last one may not count, nor for what is usual.
    ends = whole.copy()
    ends[-1:] = False
    models = [report.text("sensors", i, "model") for i in range(len(table.sensors))]
    clouds = np.array([model in CLOUDS for model in models], np.bool_)
    most, least = (_lacking(table, table.fill, clouds, rows) for rows in (whole, ends))
    any_most, any_least = (np.logical_or.reduce(lacking, axis=1) for lacking in (most, least))
    _check_count(report, any_most, any_least, "underfilled")
    none = table.columns_of == 0
    for name, more, fewer in (
        ("without", none & whole[:, None], none & ends[:, None]),
        ("underfilled_by_sensor", most, least),
    ):
        said = report.counts("scans", name)
        for i, sensor in enumerate(table.sensors):
            if sensor in said or fewer[:, i].any():
                _check_count(report, more[:, i], fewer[:, i], name, sensor)


def _lacking(table: Table, fill: F64Array, clouds: BoolArray, rows: BoolArray) -> BoolArray:
    """Which of some scans (r,) lack columns of a sensor (r, s): by fill, or the usual number.

    clouds: sensors (s,) whose fill is unknown where they have columns.
    """
    lacking = fill < _UNDERFILLED
    unsure = np.isnan(fill) & (table.columns_of > 0) & rows[:, None] & clouds
    for i in np.flatnonzero(unsure.any(axis=0)).tolist():
        columns = table.columns_of[:, i]
        lacking[:, i] |= unsure[:, i] & (columns < _UNDERFILLED * np.median(columns[unsure[:, i]]))
    found: BoolArray = lacking & rows[:, None]
    return found


def _check_count(report: Document, most: BoolArray, least: BoolArray, *path: str) -> None:
    """Check a number of scans: at least and at most so many."""
    said = report.number("scans", *path)
    lowest, highest = sorted(int(np.count_nonzero(rows)) for rows in (most, least))
    report.log.ok("report")
    if said is not None and not lowest <= said <= highest:
        report.log.fail("report", report.name("scans", *path), highest, said)


def _check_windows(report: Document, table: Table, grid: Grid) -> None:
    """Check periods between scans, and the number of windows without a scan."""
    number: I64Array = table.index * grid.slices + table.slice
    steps = np.diff(number)
    if not (steps > 0).all():
        return
    period_ms: F64Array = np.diff(table.start_ns) / steps / _NS_PER_MS
    _check_quantiles(report, "period_ms", period_ms)
    inside = number[number >= 0]
    gaps = int(inside[-1] - inside[0]) + 1 - len(inside) if len(inside) else 0
    unwritten = sum(report.number("scans", name) or 0 for name in _UNWRITTEN)
    if report.at("deskew") is not None:
        unwritten += report.number("deskew", "windows_without_poses") or 0
    report.log.ok("report")
    if gaps > unwritten:
        name = report.name("scans", " + ".join(_UNWRITTEN))
        expected = f"{gaps} or more, the windows missing from {table.where}"
        report.log.fail("report", name, expected, unwritten)


def _check_quantiles(report: Document, name: str, values_ms: F64Array) -> None:
    """Check median, 99 % and largest, which are values of the table."""
    if not len(values_ms):
        return
    ranks = np.sort(values_ms)
    for key, share in {"p50": 0.5, "p99": 0.99, "max": 1.0}.items():
        expected = float(ranks[max(0, int(np.ceil(len(ranks) * share)) - 1)])
        said = report.at("scans", name, key)
        report.log.ok("report")
        # Larger integers do not fit a float.
        is_number = isinstance(said, (int, float)) and abs(said) < _MOST_MS
        if not is_number or abs(cast(float, said) - expected) > 1e-9 * abs(expected):
            report.log.fail("report", report.name("scans", name, key), expected, said)
