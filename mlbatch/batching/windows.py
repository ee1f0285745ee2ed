"""Windows of a run: numbering from t_init, `--start` and `--end`, which are written, which empty.

A window is a tumbling event-time window of stream processing: half open, on an absolute grid. The
start of the first one, t_init, follows from eq. (1): with t0max the largest first stamp t0 of the
sensors, t_init is the first bound after t0max.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from mlbatch.batching.grid import Grid
from mlbatch.units import NS_PER_S

# Words of `--batching`: windows are on the grid; the others are policies of `fusion.py`.
WINDOW = "window"
# Words of `--batching-times`: times of points count from the start of the set, or of their sweep.
COMMON = "common"
OWN = "own"


@dataclass(frozen=True, slots=True)
class Limit:
    """Value of `--start` or `--end`: a time, or (from_t_init) a time after t_init; int ns."""

    ns: int
    from_t_init: bool = False

    def at(self, t_init: int) -> int:
        """The limit as a time on the common clock."""
        return self.ns + t_init if self.from_t_init else self.ns


@dataclass(slots=True)
class Coverage:
    """The time that the scans of an earlier run cover, as far as they were read.

    begin_ns: start of the first scan, 0 before it; end_ns: of the last; gaps: (begin, end) of
    incomplete and absent ones, neighbours joined.
    """

    begin_ns: int = 0
    end_ns: int = 0
    gaps: list[tuple[int, int]] = field(default_factory=list)

    def begin(self) -> None:
        """Forget all scans."""
        self.begin_ns = 0
        self.gaps.clear()

    def add(self, start_ns: int, end_ns: int, *, is_complete: bool) -> None:
        """Add the next scan."""
        if not self.begin_ns:
            self.begin_ns = self.end_ns = start_ns
        gap_ns = (self.end_ns, start_ns if is_complete else end_ns)
        if gap_ns[0] < gap_ns[1]:
            touches = bool(self.gaps) and self.gaps[-1][1] == gap_ns[0]
            begin_ns = self.gaps.pop()[0] if touches else gap_ns[0]
            self.gaps.append((begin_ns, gap_ns[1]))
        self.end_ns = end_ns

    def is_complete(self, start_ns: int, end_ns: int) -> bool:
        """Whether a window is in complete scans."""
        return not any(begin < end_ns and end > start_ns for begin, end in self.gaps)


class Policy(NamedTuple):
    """Options of batching."""

    max_wait_ns: int | None = NS_PER_S  # idle-source timeout; None: none, as in the paper
    keep_partial: bool = False  # also write the window before t_init and the one of the last stamp
    start: Limit | None = None  # windows start at or after it
    end: Limit | None = None  # windows start before it
    covered: Coverage | None = None  # by the scans that are batched again
    partial_if_short: bool = False  # also write them where no window is whole, in less than two


class Schedule:
    """Selects the windows that a run writes. Arguments named `window` are slice numbers q."""

    def __init__(self, grid: Grid, policy: Policy) -> None:
        self.t_init_ns: int | None = None
        self._grid = grid
        self._policy = policy
        # k0 of eq. (1).
        self._first = 0
        # Windows with columns from k0 on, within the limits.
        self._filled = 0
        self._last: int | None = None

    def begin(self, t0max_ns: int) -> None:
        """Evaluate eq. (1)."""
        self._first = self._grid.first_window(t0max_ns)
        self.t_init_ns = self._grid.bound(self._first * self._grid.slices)

    def index_of(self, window: int) -> int:
        """Output index of the whole window that a slice belongs to; -1 is the head."""
        return window // self._grid.slices - self._first

    def enter(self, window: int, last_of_all: int | None) -> str:
        """Record a window that has columns; return the reason to drop them, or an empty text.

        last_of_all: newest stamp of all sensors at the end of input, None before the end.
        """
        index = self.index_of(window)
        inside = self._is_inside(index)
        if index >= 0:
            self._last = window
            self._filled += inside
        if index < -1:
            return "before_start"
        if not inside:
            return "outside_time"
        if self._policy.keep_partial:
            return ""
        if index == -1:
            return "head"
        return "tail" if self.is_partial(window, last_of_all) else ""

    def is_partial(self, window: int, last_of_all: int | None) -> bool:
        """True for the head and the tail; last_of_all: as in `enter`."""
        is_tail = last_of_all is not None and self._grid.index_of(last_of_all) == window
        return is_tail or self.index_of(window) == -1

    def is_past_end(self, watermark_ns: int) -> bool:
        """True once all windows that begin before `--end` are closed."""
        if self.t_init_ns is None or self._policy.end is None:
            return False
        # A window that begins before the limit may end after it.
        end = max(self._policy.end.at(self.t_init_ns), 0)
        return watermark_ns >= self._grid.bound(self._at_or_after(end) * self._grid.slices)

    @property
    def limits_ns(self) -> tuple[int | None, int | None]:
        """`--start` and `--end` on the common clock; None: not given, or not known yet."""
        return self._limit_ns(self._policy.start), self._limit_ns(self._policy.end)

    def _limit_ns(self, limit: Limit | None) -> int | None:
        if limit is None or (limit.from_t_init and self.t_init_ns is None):
            return None
        return limit.at(self.t_init_ns or 0)

    @property
    def empty(self) -> int:
        """Windows without a column from k0 to the last one with columns, by subtraction."""
        if self._last is None or self.t_init_ns is None:
            return 0
        slices = self._grid.slices
        first = self._first
        stop = self._last + 1
        if self._policy.start is not None:
            first = max(first, self._at_or_after(self._policy.start.at(self.t_init_ns)))
        if self._policy.end is not None:
            stop = min(stop, self._at_or_after(self._policy.end.at(self.t_init_ns)) * slices)
        return max(0, stop - first * slices - self._filled)

    def _is_inside(self, index: int) -> bool:
        """True if window `index` begins in [--start, --end)."""
        if self.t_init_ns is None:
            return False
        start = self._policy.start
        end = self._policy.end
        if start is None and end is None:
            return True
        begin = self._grid.bound((index + self._first) * self._grid.slices)
        return (start is None or begin >= start.at(self.t_init_ns)) and (
            end is None or begin < end.at(self.t_init_ns)
        )

    def _at_or_after(self, time_ns: int) -> int:
        """Number of the first whole window that begins at or after `time_ns`."""
        slices = self._grid.slices
        window = self._grid.index_of(max(time_ns, 0)) // slices
        return window if self._grid.bound(window * slices) >= time_ns else window + 1
