"""What the scans of an output add up to, row by row of scans.csv."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mlbatch.arrays import BoolArray, I64Array
from mlbatch.verify.scan import COLUMN_NS, HeldScan, Points
from mlbatch.verify.table import Table
from mlbatch.verify.verdict import Judge

_NEVER, _FOREVER = -(2**62), 2**62


@dataclass(slots=True)
class Rings:
    """Lowest and highest ring of every sensor, and where they were met; (s,) int64."""

    low: I64Array
    high: I64Array
    low_at: dict[int, str] = field(default_factory=dict)
    high_at: dict[int, str] = field(default_factory=dict)

    def add(self, sensor: int, scan: HeldScan, points: Points) -> None:
        """Rings of a scan's points of one sensor."""
        ring, owner = points.ring, points.lidar_id
        if ring is None:
            return
        own = ring if owner is None else ring[owner == sensor]
        if not len(own):
            return
        low, high = int(own.min()), int(own.max())
        if low < self.low[sensor]:
            self.low[sensor], self.low_at[sensor] = low, _place(scan, points, sensor, low)
        if high > self.high[sensor]:
            self.high[sensor], self.high_at[sensor] = high, _place(scan, points, sensor, high)


def _place(scan: HeldScan, points: Points, sensor: int, ring: int) -> str:
    """The first point of a sensor on a ring."""
    found = points.ring == ring
    if points.lidar_id is not None:
        found &= points.lidar_id == sensor
    at = int(np.argmax(found))
    if points.valid is not None:
        at = int(np.flatnonzero(points.valid)[at])
    return f"{scan.point} {at} of sensor {sensor}"


@dataclass(slots=True)
class Rows:
    """What was met of every row of the table, (n,) each; columns_of, gap_ns: (n, s)."""

    scans: I64Array
    points: I64Array
    columns: I64Array
    columns_of: I64Array
    gap_ns: I64Array
    first_ns: I64Array
    last_ns: I64Array
    oldest_ns: I64Array
    newest_ns: I64Array
    incomplete: BoolArray

    @classmethod
    def of(cls, count: int, sensors: int) -> Rows:
        """Before the first scan."""
        zeros, wide = np.zeros(count, np.int64), np.zeros((count, sensors), np.int64)
        early, late = np.full(count, _FOREVER), np.full(count, _NEVER)
        return cls(
            zeros,
            zeros.copy(),
            zeros.copy(),
            wide,
            wide.copy(),
            early,
            late,
            early.copy(),
            late.copy(),
            np.zeros(count, bool),
        )


class Tally:
    """Sums of a run; knows_* turn False where one scan does not tell.

    points_of, columns_of: (s,) by sensor.
    """

    def __init__(self, judge: Judge, sensors: int, table: Table | None) -> None:
        self.scans = self.points = self.columns = 0
        self.points_of = np.zeros(sensors, np.int64)
        self.columns_of = np.zeros(sensors, np.int64)
        self.knows_points = self.knows_columns = self.knows_owners = self.knows_complete = True
        self.time_step_ns = 0
        self.knows_times = True
        self.rings = Rings(np.full(sensors, _FOREVER), np.full(sensors, -1))
        self._judge = judge
        self._sensors = sensors
        self._table = table
        self._rows = None if table is None else Rows.of(len(table), sensors)

    def add(self, scan: HeldScan, points: Points, place: tuple[int, int] | None) -> None:
        """Add a scan; place: its index and slice."""
        self.scans += 1
        self.points += points.count
        self.knows_points &= self._add_points(scan, points)
        columns_of = self._columns_of(scan)
        self.knows_complete &= scan.complete is not None
        self.knows_times &= points.time_ns is not None
        self.time_step_ns = max(self.time_step_ns, scan.time_step_ns)
        if self._rows is not None and self._table is not None and place is not None:
            row = self._table.row(*place)
            if row is None:
                wanted = f"a line for index {place[0]}, slice {place[1]}"
                self._judge.blame("table", f"{self._table.where} ({scan.where})", wanted, "none")
            else:
                self._add_row(self._rows, row, scan, points, columns_of)

    def _add_points(self, scan: HeldScan, points: Points) -> bool:
        """Count points by sensor; whether they tell theirs."""
        owner, alone = points.lidar_id, self._alone(scan)
        if alone is not None:
            self.points_of[alone] += points.count
            self.rings.add(alone, scan, points)
            return True
        if owner is None:
            return False
        counts = np.bincount(owner, minlength=self._sensors)[: self._sensors]
        self.points_of += counts
        for sensor in np.flatnonzero(counts).tolist():
            self.rings.add(sensor, scan, points)
        return True

    def _alone(self, scan: HeldScan) -> int | None:
        """The one sensor that gave all of a scan, where that is known."""
        return 0 if self._sensors == 1 else scan.sensor

    def _columns_of(self, scan: HeldScan) -> I64Array | None:
        if scan.column_lidar_id is None:
            self.knows_owners = False
            if not scan.organized:
                self.knows_columns = False
                return None
            self.columns += len(scan.xyz)
            alone = self._alone(scan)
            if alone is None:
                return None
            own = np.zeros(self._sensors, np.int64)
            own[alone] = len(scan.xyz)
            return own
        found = np.bincount(scan.column_lidar_id, minlength=self._sensors)
        counts: I64Array = found[: self._sensors]
        self.columns += len(scan.column_lidar_id)
        self.columns_of += counts
        return counts

    def _add_row(
        self, rows: Rows, row: int, scan: HeldScan, points: Points, columns_of: I64Array | None
    ) -> None:
        rows.scans[row] += 1
        rows.points[row] += points.count
        rows.columns[row] += len(scan.xyz) if scan.organized else 0
        rows.incomplete[row] |= scan.complete is False
        if points.time_ns is not None and points.count:
            oldest, newest = int(points.time_ns.min()), int(points.time_ns.max())
            rows.oldest_ns[row] = min(rows.oldest_ns[row], scan.start_ns + oldest)
            rows.newest_ns[row] = max(rows.newest_ns[row], scan.start_ns + newest)
        if columns_of is not None:
            rows.columns_of[row] += columns_of
        stamps, owner = scan.column_stamp_ns, scan.column_lidar_id
        if stamps is None or owner is None or not len(stamps):
            return
        rows.first_ns[row] = min(rows.first_ns[row], int(stamps.min()))
        rows.last_ns[row] = max(rows.last_ns[row], int(stamps.max()))
        for sensor in range(self._sensors):
            own = stamps[owner == sensor]
            if len(own) > 1:
                gap_ns = int(np.diff(own).max())
                rows.gap_ns[row, sensor] = max(rows.gap_ns[row, sensor], gap_ns)

    # -- the end ------------------------------------------------------------------------------

    def check_table(self) -> None:
        """Hold what was met against scans.csv."""
        table, rows = self._table, self._rows
        if table is None or rows is None or not self.scans:
            return
        self._row("scan", rows.scans == 0, "a scan of this line", rows.scans)
        self._equal("points", table.points, rows.points)
        if self.knows_owners:
            self._equal("first_stamp_ns", table.first_ns, rows.first_ns)
            self._equal("last_stamp_ns", table.last_ns, rows.last_ns)
            for sensor, name in enumerate(table.sensors):
                own, met = table.columns_of[:, sensor], rows.columns_of[:, sensor]
                self._equal(f"columns_{name}", own, met)
                own, met = table.gap_ns[:, sensor], rows.gap_ns[:, sensor]
                self._equal(f"max_gap_ns_{name}", own, met)
        elif self.knows_columns:
            self._equal("columns", table.columns, rows.columns)
        if self.knows_complete:
            differs = table.complete == rows.incomplete
            self._row("complete", differs, "what the scan says", table.complete)
        if self.knows_times:
            self._check_times(table, rows)

    def _check_times(self, table: Table, rows: Rows) -> None:
        """Points begin and end with the stamps of their columns."""
        some, step_ns = rows.newest_ns > _NEVER, self.time_step_ns
        early = some & (rows.oldest_ns + step_ns < table.first_ns)
        self._row("first_stamp_ns", early, "the oldest point at it or later", rows.oldest_ns)
        late = some & (rows.newest_ns - step_ns >= table.last_ns + COLUMN_NS)
        wanted = f"the newest point less than {COLUMN_NS} ns after it"
        self._row("last_stamp_ns", late, wanted, rows.newest_ns)

    def _equal(self, name: str, said: I64Array, met: I64Array) -> None:
        differs = said != met
        at = int(differs.argmax()) if differs.any() else 0
        self._row(name, differs, f"{met[at]} of the scan", said)

    def _row(self, name: str, bad: BoolArray, wanted: str, values: I64Array | BoolArray) -> None:
        self._judge.passed("table", len(bad))
        if bad.any() and self._table is not None:
            at, count = int(bad.argmax()), int(np.count_nonzero(bad))
            more = f" ({count} lines)" if count > 1 else ""
            where = f"{self._table.name(at)} {name}"
            self._judge.blame("table", where, wanted, f"{values[at]}{more}")
