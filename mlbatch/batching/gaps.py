"""Times without a column of a sensor that touch the bounds of windows."""

from __future__ import annotations

from mlbatch.types import WindowFigures


class EdgeGaps:
    """The last column of each sensor, from window to window.

    The gap of a window counts from the last column before the window, however long ago, and to the
    end of the window at most: what follows is not known when the window is published, and must not
    depend on when it is. A gap over several windows so grows from one to the next.
    """

    def __init__(self, sensors: int) -> None:
        self._last_ns: list[int | None] = [None] * sensors

    def measure(self, start_ns: int, end_ns: int, figures: WindowFigures) -> tuple[int, ...]:
        """Widest gap at either bound of a window, ns, by sensor; windows in order of time.

        Without an earlier column a gap counts from the start.
        """
        gaps_ns = []
        for number, last_ns in enumerate(self._last_ns):
            before_ns = start_ns if last_ns is None else last_ns
            own = figures[number]
            if own.columns:
                self._last_ns[number] = own.last_ns
                gaps_ns.append(max(own.first_ns - before_ns, end_ns - own.last_ns))
            else:
                gaps_ns.append(end_ns - before_ns)
        return tuple(gaps_ns)
