"""Windows of the common clock: which are wanted, how they are numbered, which stayed empty."""

from __future__ import annotations

from dataclasses import dataclass

from mlbatch.arrays import I64Array
from mlbatch.batching.grid import Grid
from mlbatch.units import NS_PER_S


@dataclass(frozen=True, slots=True)
class Limit:
    """An end of `--start`/`--end`: a time, or (from_t_init) a time after t_init; int ns."""

    ns: int
    from_t_init: bool = False

    def at(self, t_init: int) -> int:
        """The limit as a time on the common clock."""
        return self.ns + t_init if self.from_t_init else self.ns


@dataclass(frozen=True, slots=True)
class Policy:
    """Options of the batching; max_wait_ns None waits for ever (the paper to the letter)."""

    max_wait_ns: int | None = NS_PER_S
    keep_partial: bool = False
    start: Limit | None = None
    end: Limit | None = None


@dataclass(slots=True)
class Window:
    """Columns of one window (or slice) of all sensors, by (stamp, sensor, arrival).

    stamp_ns, sensor, place, encoder: (n,) int64; `index` is -1 for the head.
    """

    index: int
    slice: int
    start_ns: int
    end_ns: int
    complete: bool
    ready_host_ns: int
    stamp_ns: I64Array
    sensor: I64Array
    place: I64Array
    encoder: I64Array


class Schedule:
    """The windows of a run, once eq. (1) is known; all windows are given as slices of the grid."""

    def __init__(self, grid: Grid, policy: Policy) -> None:
        self.t_init_ns: int | None = None
        self._grid = grid
        self._policy = policy
        self._first = 0
        self._seen = 0
        self._last: int | None = None

    def begin(self, t0max_ns: int) -> None:
        """Evaluate eq. (1)."""
        self._first = self._grid.first_window(t0max_ns)
        self.t_init_ns = self._grid.bound(self._first * self._grid.slices)

    def index_of(self, window: int) -> int:
        """Index in the output of the whole window that a slice belongs to; -1 is the head."""
        return window // self._grid.slices - self._first

    def enter(self, window: int, last_of_all: int | None) -> str:
        """Note that a window holds columns; gives why they are dropped, or an empty text.

        last_of_all: the newest stamp of all sensors at the end of input, None before.
        """
        index = self.index_of(window)
        inside = self._is_inside(index)
        if index >= 0:
            self._last = window
            self._seen += inside
        if index < -1:
            return "before_start"
        if not inside:
            return "outside_time"
        if self._policy.keep_partial:
            return ""
        if index == -1:
            return "head"
        is_tail = last_of_all is not None and self._grid.index_of(last_of_all) == window
        return "tail" if is_tail else ""

    def is_past_end(self, watermark_ns: int) -> bool:
        """Whether all windows that begin before `--end` are closed."""
        if self.t_init_ns is None or self._policy.end is None:
            return False
        # A window that begins before the end may reach past it by less than a period.
        end = max(self._policy.end.at(self.t_init_ns), 0)
        return watermark_ns >= self._grid.bound(self._at_or_after(end) * self._grid.slices)

    @property
    def limits_ns(self) -> tuple[int | None, int | None]:
        """`--start` and `--end` on the common clock; None: none, or not known yet."""
        return self._limit_ns(self._policy.start), self._limit_ns(self._policy.end)

    def _limit_ns(self, limit: Limit | None) -> int | None:
        if limit is None or (limit.from_t_init and self.t_init_ns is None):
            return None
        return limit.at(self.t_init_ns or 0)

    @property
    def empty(self) -> int:
        """Windows without a column from the first to the last that holds one, by subtraction."""
        if self._last is None or self.t_init_ns is None:
            return 0
        slices, policy = self._grid.slices, self._policy
        low, stop = self._first, self._last + 1
        if policy.start is not None:
            low = max(low, self._at_or_after(policy.start.at(self.t_init_ns)))
        if policy.end is not None:
            stop = min(stop, self._at_or_after(policy.end.at(self.t_init_ns)) * slices)
        return max(0, stop - low * slices - self._seen)

    def _is_inside(self, index: int) -> bool:
        """Whether the start of window `index` lies in [--start, --end)."""
        if self.t_init_ns is None:
            return False
        start = self._grid.bound((index + self._first) * self._grid.slices)
        low, high = self._policy.start, self._policy.end
        return (low is None or start >= low.at(self.t_init_ns)) and (
            high is None or start < high.at(self.t_init_ns)
        )

    def _at_or_after(self, time_ns: int) -> int:
        """First whole window whose start is at or after `time_ns`."""
        slices = self._grid.slices
        window = self._grid.index_of(max(time_ns, 0)) // slices
        return window if self._grid.bound(window * slices) >= time_ns else window + 1
