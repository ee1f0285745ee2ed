"""scans.csv: checked on its own, and checked against the sums of the scans.

Columns that later versions add are ignored.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array
from mlbatch.outputs.damage import CheckLog
from mlbatch.outputs.stored_scan import COLUMN_NS, Points, StoredScan
from mlbatch.outputs.table import COLUMNS, Cells, TableError
from mlbatch.verification.scan_checks import Grid

_COUNTS = ("points", "columns")
_GAP = "max_gap_ns_"
_FILL = "fill_"
_CHECKSUM = "checksum"
# Checksums are modulo this.
_CHECKSUMS = 1 << 32
# Of a float32, relative.
_FILL_ERROR = 1e-6
# Below and above all times.
_EARLY_NS = -(2**62)
_LATE_NS = 2**62
_MAX_U8 = 255


class Table:
    """Rows of scans.csv, (n,) int64 each; (n, s) by sensor. where: name of the file."""

    def __init__(self, log: CheckLog, where: str, cells: Cells) -> None:
        """TableError unless all columns are there."""
        self.where = where
        self.sensors = cells.sensors
        by_sensor = [prefix + name for prefix in (COLUMNS, _GAP) for name in self.sensors]
        missing = [name for name in (*_COUNTS, *by_sensor, "complete") if name not in cells.columns]
        if missing or not self.sensors:
            raise TableError("", f"columns {', '.join(missing) or 'of sensors'}", "none")
        if not len(cells):
            raise TableError("", "a line for each scan", "none")
        self.index = cells.integers("index")
        self.slice = cells.integers("slice")
        self.start_ns = cells.integers("start_ns")
        self.end_ns = cells.integers("end_ns")
        self.first_ns = cells.integers("first_stamp_ns")
        self.last_ns = cells.integers("last_stamp_ns")
        self.points = cells.integers("points")
        self.columns = cells.integers("columns")
        self.columns_of: I64Array = cells.by_sensor(COLUMNS, cells.integers)
        # Longest time without a column.
        self.gap_ns: I64Array = cells.by_sensor(_GAP, cells.integers)
        # Columns present / columns expected, NaN: unknown.
        self.fill = _fills(log, where, cells)
        # Of all bytes of the scans, -1: unknown; None in older tables.
        has_checksums = _CHECKSUM in cells.columns
        self.checksum = cells.integers(_CHECKSUM) if has_checksums else None
        self.complete = cells.flags("complete")
        keys = zip(self.index.tolist(), self.slice.tolist(), strict=True)
        self._rows = {key: number for number, key in enumerate(keys)}

    def __len__(self) -> int:
        return len(self.index)

    def row(self, index: int, part: int) -> int | None:
        """Row of a window or slice."""
        return self._rows.get((index, part))

    def name(self, row: int) -> str:
        """File and line of a row; line 1 is the header."""
        return f"{self.where} line {row + 2}"


def read_table(log: CheckLog, where: str, text: str) -> Table | None:
    """Read scans.csv; None if it is not usable, which is a violation."""
    try:
        return Table(log, where, Cells.of(text))
    except TableError as err:
        log.fail("table", err.at(where), err.expected, err.found)
        return None


def _fills(log: CheckLog, where: str, cells: Cells) -> F64Array | None:
    """Fills by sensor; None in older tables, or if a cell is no share, which is a violation."""
    if not all(_FILL + name in cells.columns for name in cells.sensors):
        return None
    try:
        return cells.by_sensor(_FILL, cells.reals)
    except TableError as err:
        log.fail("table", f"{where} fill", "numbers from 0 to 1", err.__cause__)
        return None


def check_table(log: CheckLog, table: Table, grid: Grid | None, first: int | None) -> None:
    """Check the table on its own; `first`: number of the window of scan 0."""
    rows = _RowChecks(log, table)
    rows.check_columns()
    key = table.index * (1 if grid is None else grid.slices) + table.slice
    back = key[1:] <= key[:-1]
    rows.none("table", "index and slice", back, "later ones than before", key[1:], skipped=1)
    if grid is None:
        return
    if first is None:
        first = grid.number(int(table.start_ns[0])) // grid.slices - int(table.index[0])
    # Python integers: the values of a damaged table may be anywhere.
    numbers = [number + first * grid.slices for number in key.tolist()]
    for name, column, after in (("start_ns", table.start_ns, 0), ("end_ns", table.end_ns, 1)):
        bounds = np.array([grid.bound(q + after) for q in numbers])
        bad = column != bounds
        at = int(bad.argmax()) if bad.any() else 0
        rows.none("grid", name, bad, str(bounds[at]), column)
    bad = (table.slice < 0) | (table.slice >= grid.slices)
    rows.none("index", "slice", bad, f"a slice below {grid.slices}", table.slice)
    rows.none("index", "index", table.index < -1, "-1 or more", table.index)


@dataclass(frozen=True, slots=True)
class _RowChecks:
    """Checks of rows; a violation names the line of the first bad one."""

    log: CheckLog
    table: Table

    def none(
        self,
        check: str,
        name: str,
        bad: BoolArray,
        expected: str,
        values: I64Array | F64Array | BoolArray,
        skipped: int = 0,
    ) -> None:
        """Check that no row is bad; `skipped`: rows before the first one in `bad`."""
        self.log.ok(check, len(bad))
        if not bad.any():
            return
        at = int(bad.argmax())
        count = int(np.count_nonzero(bad))
        more = f" ({count} lines)" if count > 1 else ""
        where = f"{self.table.name(at + skipped)} {name}"
        self.log.fail(check, where, expected, f"{values[at]}{more}")

    def equal(self, name: str, said: I64Array, found: I64Array) -> None:
        """Check a column of the table against the scans."""
        bad = said != found
        at = int(bad.argmax()) if bad.any() else 0
        self.none("table", name, bad, f"{found[at]} of the scan", said)

    def check_columns(self) -> None:
        """Check stamps, counts and gaps."""
        table = self.table
        bad = (table.first_ns < table.start_ns) | (table.first_ns > table.last_ns)
        expected = "a stamp from start_ns to last_stamp_ns"
        self.none("columns", "first_stamp_ns", bad, expected, table.first_ns)
        bad = table.last_ns >= table.end_ns
        self.none("columns", "last_stamp_ns", bad, "a stamp before end_ns", table.last_ns)
        total: I64Array = table.columns_of.sum(axis=1)
        bad = (table.columns != total) | (table.columns <= 0) | (table.columns_of < 0).any(axis=1)
        expected = "the sum of the sensors, above 0"
        self.none("table", "columns", bad, expected, table.columns)
        self.none("table", "points", table.points < 0, "0 or more", table.points)
        # A sensor without a column has none from start to end.
        length_ns = np.where(table.columns_of == 0, (table.end_ns - table.start_ns)[:, None], 0)
        narrow: BoolArray = np.any(table.gap_ns < length_ns, axis=1)
        expected = "0 or more; the window's length without a column"
        self.none("table", "max_gap_ns", narrow, expected, table.gap_ns.min(axis=1))
        self.check_fill()

    def check_fill(self) -> None:
        """Check fills against columns: of a whole number of expected ones."""
        fill = self.table.fill
        if fill is None:
            return
        count = self.table.columns_of
        outside = (fill < 0) | (fill > 1)
        zero = (fill == 0) != (count == 0)
        # Without a column the fill may be unknown as well.
        zero &= ~np.isnan(fill)
        inside = (fill > 0) & (fill < 1)
        expected = np.divide(count, fill, out=np.zeros_like(fill), where=inside)
        broken = inside & (np.abs(expected - np.rint(expected)) > _FILL_ERROR * expected)
        bad: BoolArray = np.any(outside | zero | broken, axis=1)
        at = np.argmax(outside | zero | broken, axis=1)
        shown = np.take_along_axis(fill, at[:, None], axis=1)[:, 0]
        self.none("table", "fill", bad, "columns / a whole number, from 0 to 1", shown)


# -- sums of the scans ----------------------------------------------------------------------------


@dataclass(slots=True)
class Rings:
    """Lowest and highest ring of each sensor, (s,) int64, and the first point on it."""

    low: I64Array
    high: I64Array
    low_at: dict[int, str] = field(default_factory=dict)
    high_at: dict[int, str] = field(default_factory=dict)

    def add(self, sensor: int, scan: StoredScan, points: Points) -> None:
        """Add the points of one sensor of a scan."""
        ring = points.ring
        owner = points.lidar_id
        if ring is None:
            return
        own = ring if owner is None else ring[owner == sensor]
        if not len(own):
            return
        low = int(own.min())
        high = int(own.max())
        if low < self.low[sensor]:
            self.low[sensor] = low
            self.low_at[sensor] = _first_point(scan, points, sensor, low)
        if high > self.high[sensor]:
            self.high[sensor] = high
            self.high_at[sensor] = _first_point(scan, points, sensor, high)


def _first_point(scan: StoredScan, points: Points, sensor: int, ring: int) -> str:
    """The first point of a sensor on a ring."""
    found = points.ring == ring
    if points.lidar_id is not None:
        found &= points.lidar_id == sensor
    at = int(np.argmax(found))
    if points.valid is not None:
        at = int(np.flatnonzero(points.valid)[at])
    return f"{scan.point} {at} of sensor {sensor}"


class _RowTotals:
    """Values found for each row of the table, (n,) each; (n, s) by sensor."""

    def __init__(self, count: int, sensors: int) -> None:
        self.scans = np.zeros(count, np.int64)
        self.points = np.zeros(count, np.int64)
        self.columns = np.zeros(count, np.int64)
        self.columns_of = np.zeros((count, sensors), np.int64)
        # Widest step between columns, first and last column of a sensor.
        self.gap_ns = np.zeros((count, sensors), np.int64)
        self.first_of_ns = np.full((count, sensors), _LATE_NS)
        self.last_of_ns = np.full((count, sensors), _EARLY_NS)
        # Fills, where a scan has them.
        self.fill = np.full((count, sensors), np.nan)
        self.has_fill = np.zeros((count, sensors), bool)
        # Stamps of columns.
        self.first_ns = np.full(count, _LATE_NS)
        self.last_ns = np.full(count, _EARLY_NS)
        # Times of points.
        self.oldest_ns = np.full(count, _LATE_NS)
        self.newest_ns = np.full(count, _EARLY_NS)
        self.incomplete = np.zeros(count, bool)
        self.checksum = np.zeros(count, np.int64)

    def add(self, row: int, scan: StoredScan, points: Points, columns_of: I64Array | None) -> None:
        """Add a scan to its row."""
        self.scans[row] += 1
        self.points[row] += points.count
        self.columns[row] += len(scan.xyz) if scan.organized else 0
        self.incomplete[row] |= scan.complete is False
        self.checksum[row] = (self.checksum[row] + (scan.checksum or 0)) % _CHECKSUMS
        if points.time_ns is not None and points.count:
            oldest_ns = scan.start_ns + int(points.time_ns.min())
            newest_ns = scan.start_ns + int(points.time_ns.max())
            self.oldest_ns[row] = min(self.oldest_ns[row], oldest_ns)
            self.newest_ns[row] = max(self.newest_ns[row], newest_ns)
        if columns_of is not None:
            self.columns_of[row] += columns_of
        self._add_fill(row, scan)
        stamps = scan.column_stamp_ns
        owner = scan.column_lidar_id
        if stamps is None or owner is None or not len(stamps):
            return
        self.first_ns[row] = min(self.first_ns[row], int(stamps.min()))
        self.last_ns[row] = max(self.last_ns[row], int(stamps.max()))
        for sensor in range(self.gap_ns.shape[1]):
            own = stamps[owner == sensor]
            if not len(own):
                continue
            gap_ns = int(np.diff(own).max(initial=0))
            self.gap_ns[row, sensor] = max(self.gap_ns[row, sensor], gap_ns)
            self.first_of_ns[row, sensor] = int(own.min())
            self.last_of_ns[row, sensor] = int(own.max())

    def _add_fill(self, row: int, scan: StoredScan) -> None:
        if scan.fill is None:
            return
        is_all = len(scan.fill) == self.fill.shape[1]
        sensors = slice(None) if is_all else slice(scan.sensor, (scan.sensor or 0) + 1)
        if is_all or (len(scan.fill) == 1 and scan.sensor is not None):
            self.fill[row, sensors] = scan.fill
            self.has_fill[row, sensors] = True


class OutputTotals:
    """Sums of the scans of an output, in all and by row of scans.csv."""

    def __init__(self, log: CheckLog, sensors: int, table: Table | None) -> None:
        self.scans = 0
        self.points = 0
        self.columns = 0
        # By sensor, (s,).
        self.points_of = np.zeros(sensors, np.int64)
        # Points whose 8-bit intensity is 0 or 255.
        self.at_limit = 0
        self.columns_of = np.zeros(sensors, np.int64)
        self.rings = Rings(np.full(sensors, _LATE_NS), np.full(sensors, -1))
        # True while every scan so far shows them.
        self.knows_points = True
        self.knows_columns = True
        self.knows_owners = True
        self.knows_complete = True
        self.knows_times = True
        # Largest error of times of points.
        self.time_step_ns = 0
        self._log = log
        self._sensors = sensors
        self._table = table
        self._rows = None if table is None else _RowTotals(len(table), sensors)

    def add(self, scan: StoredScan, points: Points, place: tuple[int, int] | None) -> None:
        """Add a scan; place: its index and slice."""
        self.scans += 1
        self.points += points.count
        self.knows_points &= self._add_points(scan, points)
        if scan.byte_intensity is not None:
            valid = ... if points.valid is None else points.valid
            values = scan.byte_intensity[valid]
            self.at_limit += int(np.count_nonzero((values == 0) | (values == _MAX_U8)))
        self.knows_complete &= scan.complete is not None
        self.knows_times &= points.time_ns is not None
        self.time_step_ns = max(self.time_step_ns, scan.time_step_ns)
        columns_of = self._add_columns(scan)
        if self._rows is None or self._table is None or place is None:
            return
        row = self._table.row(*place)
        if row is None:
            expected = f"a line for index {place[0]}, slice {place[1]}"
            self._log.fail("table", f"{self._table.where} ({scan.where})", expected, "none")
        else:
            self._rows.add(row, scan, points, columns_of)

    def _add_points(self, scan: StoredScan, points: Points) -> bool:
        """Count points by sensor; False if a scan does not show sensors."""
        owner = points.lidar_id
        only = self._only_sensor(scan)
        if only is not None:
            self.points_of[only] += points.count
            self.rings.add(only, scan, points)
            return True
        if owner is None:
            return False
        counts = np.bincount(owner, minlength=self._sensors)[: self._sensors]
        self.points_of += counts
        for sensor in np.flatnonzero(counts).tolist():
            self.rings.add(sensor, scan, points)
        return True

    def _only_sensor(self, scan: StoredScan) -> int | None:
        """The sensor of all points of a scan, if known."""
        return 0 if self._sensors == 1 else scan.sensor

    def _add_columns(self, scan: StoredScan) -> I64Array | None:
        """Count columns; those of the scan by sensor, None if not shown."""
        if scan.column_lidar_id is not None:
            found = np.bincount(scan.column_lidar_id, minlength=self._sensors)
            counts: I64Array = found[: self._sensors]
            self.columns += len(scan.column_lidar_id)
            self.columns_of += counts
            return counts
        self.knows_owners = False
        if not scan.organized:
            self.knows_columns = False
            return None
        self.columns += len(scan.xyz)
        only = self._only_sensor(scan)
        if only is None:
            return None
        own = np.zeros(self._sensors, np.int64)
        own[only] = len(scan.xyz)
        return own

    def check_table(self, *, apart: bool = False) -> None:
        """Check scans.csv against the sums; apart: no scan continues the one before."""
        table = self._table
        rows = self._rows
        if table is None or rows is None or not self.scans:
            return
        checks = _RowChecks(self._log, table)
        checks.none("table", "scan", rows.scans == 0, "a scan of this line", rows.scans)
        checks.equal("points", table.points, rows.points)
        if self.knows_owners:
            checks.equal("first_stamp_ns", table.first_ns, rows.first_ns)
            checks.equal("last_stamp_ns", table.last_ns, rows.last_ns)
            for sensor, name in enumerate(table.sensors):
                columns = table.columns_of[:, sensor]
                checks.equal(f"{COLUMNS}{name}", columns, rows.columns_of[:, sensor])
                self._check_gaps(checks, rows, sensor, apart)
        elif self.knows_columns:
            checks.equal("columns", table.columns, rows.columns)
        self._check_bytes(checks, rows)
        if self.knows_complete:
            bad = table.complete == rows.incomplete
            checks.none("table", "complete", bad, "the value in the scan", table.complete)
        if table.fill is not None:
            differs = np.abs(rows.fill - table.fill) > _FILL_ERROR
            differs |= np.isnan(rows.fill) != np.isnan(table.fill)
            for sensor, name in enumerate(table.sensors):
                bad = (differs & rows.has_fill)[:, sensor]
                at = int(bad.argmax()) if bad.any() else 0
                expected = f"{rows.fill[at, sensor]:.6g} of the scan"
                checks.none("table", f"{_FILL}{name}", bad, expected, table.fill[:, sensor])
        if self.knows_times:
            self._check_times(checks, rows)

    def _check_bytes(self, checks: _RowChecks, rows: _RowTotals) -> None:
        """Compare the bytes of the scans with those that were written."""
        said = checks.table.checksum
        if said is None or (said < 0).all():
            return
        bad = (said != rows.checksum) & (said >= 0) & (rows.scans > 0)
        at = int(bad.argmax())
        expected = f"{rows.checksum[at]} of the bytes of the scan"
        checks.none("checksum", "checksum", bad, expected, said)

    def _check_gaps(self, checks: _RowChecks, rows: _RowTotals, sensor: int, apart: bool) -> None:
        """Widest gaps of a sensor: from its last column before a window to the window's end.

        Between lines that do not follow each other there may be columns that were not written.
        """
        table = checks.table
        count = len(table)
        has_columns = rows.columns_of[:, sensor] > 0
        line = np.arange(count)
        # The last line before with columns of the sensor.
        newest = np.maximum.accumulate(np.where(has_columns, line, -1))
        before = np.concatenate([[-1], newest[:-1]])
        begins = np.ones(count - 1, bool) if apart else table.start_ns[1:] != table.end_ns[:-1]
        part = np.concatenate([[0], np.cumsum(begins)])
        is_known = (before >= 0) & (part[before] == part)
        before_ns = np.where(is_known, rows.last_of_ns[before, sensor], table.start_ns)
        first_ns = np.where(has_columns, rows.first_of_ns[:, sensor], table.end_ns)
        last_ns = np.where(has_columns, rows.last_of_ns[:, sensor], before_ns)
        inside_ns = rows.gap_ns[:, sensor]
        least_ns = np.maximum(np.maximum(first_ns - before_ns, table.end_ns - last_ns), inside_ns)
        said_ns = table.gap_ns[:, sensor]
        bad = (said_ns < least_ns) | (is_known & (said_ns > least_ns))
        at = int(bad.argmax()) if bad.any() else 0
        name = f"{_GAP}{table.sensors[sensor]}"
        checks.none("table", name, bad, f"{least_ns[at]} by the scans", said_ns)

    def _check_times(self, checks: _RowChecks, rows: _RowTotals) -> None:
        """Points begin and end with the stamps of their columns."""
        table = checks.table
        some = rows.newest_ns > _EARLY_NS
        early = some & (rows.oldest_ns + self.time_step_ns < table.first_ns)
        expected = "the oldest point at it or later"
        checks.none("table", "first_stamp_ns", early, expected, rows.oldest_ns)
        late = some & (rows.newest_ns - self.time_step_ns >= table.last_ns + COLUMN_NS)
        expected = f"the newest point less than {COLUMN_NS} ns after it"
        checks.none("table", "last_stamp_ns", late, expected, rows.newest_ns)
