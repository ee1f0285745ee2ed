"""Whether scans lie on the grid: bounds, index, slice, order and start of the run."""

from __future__ import annotations

from mlbatch.verify.grid import Lines
from mlbatch.verify.scan import HeldScan
from mlbatch.verify.verdict import Judge


class Placing:
    """Places one scan after the other; `first`: number of scan 0's window, once it is known."""

    def __init__(
        self, judge: Judge, lines: Lines | None, t_init_ns: int | None, where: str
    ) -> None:
        self._judge = judge
        self._lines = lines
        self._last: dict[int | None, int] = {}
        self.first: int | None = None
        if lines is not None and t_init_ns is not None:
            q = lines.number(t_init_ns)
            self.first = q // lines.slices
            line = lines.bound(self.first * lines.slices)
            judge.equal("t_init", f"{where} t_init_ns", line, t_init_ns)

    def place(self, scan: HeldScan) -> tuple[int, int] | None:
        """Index and slice of a scan by its start; None where the rate is not known."""
        judge, lines = self._judge, self._lines
        if lines is None:
            return None
        q = self._number(scan, lines)
        judge.passed("grid")
        begin, end = lines.bound(q), lines.bound(q + 1)
        if scan.start_ns != begin:
            judge.blame("grid", f"{scan.where} start_ns", begin, scan.start_ns)
        if scan.end_ns not in (None, end):
            judge.blame("grid", f"{scan.where} end_ns", end, scan.end_ns)
        window, part = divmod(q, lines.slices)
        if self.first is None:
            # The first scan's word; all others have to agree.
            self.first = window - (scan.index or 0)
        index = window - self.first
        judge.passed("index")
        if (scan.index, scan.slice) not in ((None, None), (index, part)):
            got = f"{scan.index}, {scan.slice}"
            judge.blame("index", f"{scan.where} index, slice", f"{index}, {part}", got)
        if index < -1:
            judge.blame("index", scan.where, "a window from the head (-1) on", index)
        self._after(scan, q)
        return index, part

    def _number(self, scan: HeldScan, lines: Lines) -> int:
        """Number of the slice that a scan begins in; its neighbour's line may be meant."""
        q = lines.number(scan.start_ns)
        if scan.index is not None and self.first is not None and scan.slice is not None:
            # Of two lines that the start lies between, the nearer one, if the index names it.
            said = (self.first + scan.index) * lines.slices + scan.slice
            begin, end = lines.bound(q), lines.bound(q + 1)
            return said if said == q + 1 and 2 * scan.start_ns > begin + end else q
        return q

    def _after(self, scan: HeldScan, q: int) -> None:
        last = self._last.get(scan.sensor)
        if last is not None and q <= last:
            line = 0 if self._lines is None else self._lines.bound(last)
            wanted = f"a start after {line}, that of the scan before"
            self._judge.blame("index", f"{scan.where} start_ns", wanted, scan.start_ns)
        self._last[scan.sensor] = max(q, last) if last is not None else q
