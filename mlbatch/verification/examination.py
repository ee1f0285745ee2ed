"""The checks of an output: each scan, then the sums of all scans."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

from mlbatch.outputs.damage import CheckLog
from mlbatch.outputs.metadata import RunMetadata
from mlbatch.outputs.stored_scan import StoredScan
from mlbatch.verification.report_checks import (
    ReportFiles,
    check_ledgers,
    check_period,
    check_report,
    grid_of,
    poses_of,
)
from mlbatch.verification.scan_checks import (
    DuplicateColumns,
    GeometryChecks,
    GridChecks,
    check_columns,
    check_labels,
    check_times,
    fits_columns,
    valid_points,
)
from mlbatch.verification.table import OutputTotals, Table, check_table

# Called with the number of scans checked, and of all scans (0: unknown).
Progress = Callable[[int, int], object]
# Values of one byte, for outputs without the number of sensors.
_MOST_SENSORS = 256
# Stamps end at 2^31 s; times of points are added to them in 64 bits.
_MOST_NS = 2**62
# In the report: windows or sets that --deskew left out.
_LEFT_OUT = ("deskew", "windows_without_poses")


class MessageWindow(NamedTuple):
    """Window of a message; place: index of the scan; None: not known by the message alone."""

    start_ns: int
    end_ns: int | None = None
    place: int | None = None


class Examination:
    """Takes the scans of an output one after the other; arrays are only used during the call."""

    def __init__(
        self,
        log: CheckLog,
        where: str,
        metadata: RunMetadata,
        files: ReportFiles,
        progress: Progress | None = None,
    ) -> None:
        """progress: called after each scan."""
        self._progress = progress
        self._all = 0 if files.table is None else len(files.table.index)
        self.log = log
        self.metadata = metadata
        self._files = files
        # Why checks are impossible for scans of these options.
        self.limits = metadata.limits
        self._grid = grid_of(metadata, where)
        self._grid_checks = GridChecks(log, self._grid, metadata.t_init_ns, where)
        self._by_time = metadata.sort == "points"
        self._is_fused = metadata.batching is not None
        self._is_moved = metadata.deskew is not None
        self._stamp = metadata.stamp or "start"
        self._own_times = metadata.batching_times == "own"
        if metadata.sort not in (None, "columns", "points"):
            log.fail("metadata", f"{where} sort", "columns or points", metadata.sort)
        self._sensors = _MOST_SENSORS if metadata.sensors is None else len(metadata.sensors)
        table = files.table
        if table is not None and metadata.sensors is not None:
            log.equal("metadata", f"{table.where} sensors", metadata.sensors, table.sensors)
            if table.sensors != metadata.sensors:
                table = None
                files.table = None
        self.totals = OutputTotals(log, self._sensors, table)
        self._duplicates = DuplicateColumns(log)
        poses = None if files.report is None else poses_of(files.report)
        # Moved points are not at their ranges from the sensor.
        fits = poses is not None and len(poses) == self._sensors and not self._is_moved
        self._geometry = GeometryChecks(log, poses if fits else None)

    def scan(self, scan: StoredScan) -> None:
        """Check one scan."""
        self._check(scan)
        if self._progress is not None:
            self._progress(self.totals.scans, self._all)

    def _check(self, scan: StoredScan) -> None:
        log = self.log
        scan.by_time = self._by_time
        scan.own_times = self._own_times
        for name, at_ns in (("start_ns", scan.start_ns), ("end_ns", scan.end_ns)):
            if at_ns is not None and abs(at_ns) >= _MOST_NS:
                log.fail("grid", f"{scan.where} {name}", "a time", at_ns)
                return
        place = self._grid_checks.check(scan)
        if place is None and scan.index is not None:
            # Without a rate, by its name.
            place = scan.index, scan.slice or 0
        end_ns = self._end_ns(scan)
        fits = check_columns(log, scan, end_ns, self._sensors)
        points = valid_points(log, scan)
        fits &= check_labels(log, scan, points, self._sensors)
        if scan.column is not None and not fits_columns(scan):
            count = 0 if scan.column_stamp_ns is None else len(scan.column_stamp_ns)
            where = f"{scan.where} column"
            log.fail("order", where, f"numbers below {count}", int(scan.column.max()))
            fits = False
        if fits:
            self._geometry.check(scan, points)
            self._duplicates.check(scan)
        else:
            # Checks by sensor or column would only repeat the violation.
            scan.lidar_id = None
            scan.column = None
            scan.column_lidar_id = None
            scan.column_stamp_ns = None
            points = replace(points, lidar_id=None)
        check_times(log, scan, points, end_ns - scan.start_ns)
        self.totals.add(scan, points, place)

    def window_of_message(self, stamp_ns: int, number: int, where: str) -> MessageWindow:
        """Window of the message of a scan by its stamp; number: of the message in its topic."""
        table = self._files.table
        if self._is_fused:
            if table is None or number >= len(table):
                # A scan without a line of the table is a violation there.
                return MessageWindow(stamp_ns, place=number)
            index = int(table.index[number])
            window = MessageWindow(int(table.start_ns[number]), int(table.end_ns[number]), index)
        elif self._stamp == "start" or self._grid is None:
            return MessageWindow(stamp_ns)
        else:
            # The end of a window is the start of the next one.
            q = self._grid.number(stamp_ns - (self._stamp == "end"))
            window = MessageWindow(self._grid.bound(q), self._grid.bound(q + 1))
        end_ns = window.start_ns if window.end_ns is None else window.end_ns
        middle_ns = window.start_ns + (end_ns - window.start_ns) // 2
        instants = {"start": window.start_ns, "middle": middle_ns, "end": end_ns}
        expected = instants[self._stamp]
        self.log.equal("stamps", f"{where} header stamp ({self._stamp})", expected, stamp_ns)
        return window

    def _end_ns(self, scan: StoredScan) -> int:
        if scan.end_ns is not None:
            return scan.end_ns
        if self._grid is not None:
            return self._grid.bound(self._grid.number(scan.start_ns) + 1)
        # Unknown without a rate.
        return scan.start_ns + 2**32

    def finish(self, *, split: bool) -> None:
        """Check the sums against table and report."""
        if not split:
            self._check_rings()
        table = self._files.table
        report = self._files.report
        if table is not None:
            check_table(self.log, table, self._grid, self._grid_checks.first)
            if self._is_fused:
                self._check_numbers(table)
            self.totals.check_table(apart=self._is_fused)
        if report is not None:
            check_ledgers(report)
            if not self._is_fused:
                check_period(report)
            check_report(report, self.totals, table, self._grid)

    def _check_numbers(self, table: Table) -> None:
        """Sets are numbered; where they begin is known from their columns alone."""
        where = f"{table.where} index"
        found = table.index.tolist()
        if not self._is_moved:
            self.log.equal("index", where, list(range(len(found))), found)
            return
        # Sets that --deskew left out have numbers, too; `check_table` finds those that step back.
        report = self._files.report
        left_out = 0 if report is None else report.number(*_LEFT_OUT) or 0
        if found and found[0] < 0:
            self.log.fail("index", where, "0 or more", found[0])
        elif found and report is not None and found[-1] >= len(found) + left_out:
            expected = f"numbers below {len(found) + left_out}"
            self.log.fail("index", where, expected, found[-1])
        else:
            self.log.ok("index", len(found))

    def _check_rings(self) -> None:
        """Rings of a sensor follow those of all earlier sensors."""
        rings = self.totals.rings
        found = [sensor for sensor in range(self._sensors) if sensor in rings.low_at]
        self.log.ok("rings", len(found))
        for before, after in pairwise(found):
            highest = int(rings.high[before])
            if rings.low[after] <= highest:
                self.log.fail(
                    "rings",
                    f"{rings.low_at[after]} ({rings.high_at[before]})",
                    f"a ring above {highest}, the highest of sensor {before}",
                    int(rings.low[after]),
                )
