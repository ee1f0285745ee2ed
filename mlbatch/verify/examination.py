"""The proof itself: every scan, then what all of them add up to."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from mlbatch.verify.agreement import check_report
from mlbatch.verify.claims import Claims
from mlbatch.verify.column_checks import Twins, check_columns
from mlbatch.verify.geometry_checks import Geometry
from mlbatch.verify.placing import Placing
from mlbatch.verify.report import check_grid, check_ledger, poses_of
from mlbatch.verify.report_checks import Papers
from mlbatch.verify.scan import HeldScan
from mlbatch.verify.scan_checks import (
    check_labels,
    check_times,
    fits_columns,
    valid_points,
)
from mlbatch.verify.table import check_table
from mlbatch.verify.tally import Tally
from mlbatch.verify.verdict import Judge

# Sensors that one byte can name, where an output does not tell how many there are.
_MOST_SENSORS = 256
# Stamps end at 2^31 s; times of points are added to them in 64 bits.
_MOST_NS = 2**62


class Examination:
    """Takes the scans of an output one after the other; arrays are only used during the call."""

    def __init__(self, judge: Judge, where: str, claims: Claims, papers: Papers) -> None:
        self.judge = judge
        self._papers = papers
        self._lines = claims.lines(where)
        self._placing = Placing(judge, self._lines, claims.t_init_ns, where)
        self._sensors = _MOST_SENSORS if claims.sensors is None else len(claims.sensors)
        table = papers.table
        if table is not None and claims.sensors is not None:
            judge.equal("metadata", f"{table.where} sensors", claims.sensors, table.sensors)
            if table.sensors != claims.sensors:
                table = papers.table = None
        self.tally = Tally(judge, self._sensors, table)
        self._twins = Twins(judge)
        poses = None if papers.report is None else poses_of(papers.report)
        fits = poses is not None and len(poses) == self._sensors
        self._geometry = Geometry(judge, poses if fits else None)

    def scan(self, scan: HeldScan) -> None:
        """Hold one scan against the rules."""
        judge = self.judge
        for name, at_ns in (("start_ns", scan.start_ns), ("end_ns", scan.end_ns)):
            if at_ns is not None and abs(at_ns) >= _MOST_NS:
                judge.blame("grid", f"{scan.where} {name}", "a time", at_ns)
                return
        place = self._placing.place(scan)
        end_ns = self._end(scan)
        named = check_columns(judge, scan, end_ns, self._sensors)
        points = valid_points(judge, scan)
        named &= check_labels(judge, scan, points, self._sensors)
        if scan.column is not None and not fits_columns(scan):
            count = 0 if scan.column_stamp_ns is None else len(scan.column_stamp_ns)
            judge.blame(
                "order", f"{scan.where} column", f"numbers below {count}", int(scan.column.max())
            )
            named = False
        if not named:
            # Whatever is told by sensor or column would only repeat the fault.
            scan.lidar_id = scan.column_lidar_id = scan.column_stamp_ns = scan.column = None
            points = replace(points, lidar_id=None)
        else:
            self._geometry.check(scan, points)
            self._twins.check(scan)
        check_times(judge, scan, points, end_ns - scan.start_ns)
        self.tally.add(scan, points, place)

    def _end(self, scan: HeldScan) -> int:
        if scan.end_ns is not None:
            return scan.end_ns
        if self._lines is not None:
            return self._lines.bound(self._lines.number(scan.start_ns) + 1)
        # Without a rate nothing tells where a scan ends.
        return scan.start_ns + 2**32

    def finish(self, *, split: bool) -> None:
        """Hold the sums against table and report."""
        if not split:
            self._check_rings()
        table, report = self._papers.table, self._papers.report
        if table is not None:
            check_table(self.judge, table, self._lines, self._placing.first)
            self.tally.check_table()
        if report is not None:
            check_ledger(report)
            check_grid(report)
            check_report(report, self.tally, table, self._lines)

    def _check_rings(self) -> None:
        """Rings of a sensor follow those of all earlier ones."""
        rings = self.tally.rings
        met = [sensor for sensor in range(self._sensors) if sensor in rings.low_at]
        self.judge.passed("rings", len(met))
        for before, after in pairwise(met):
            if rings.low[after] > rings.high[before]:
                continue
            highest = int(np.asarray(rings.high)[before])
            self.judge.blame(
                "rings",
                f"{rings.low_at[after]} ({rings.high_at[before]})",
                f"a ring above {highest}, the highest of sensor {before}",
                int(rings.low[after]),
            )
