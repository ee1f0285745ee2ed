"""Check of poses against the points of the first windows in motion (`motion/agreement.py`).

Windows are registered from the first one in which the poses turn, in the thread that batches, until
enough were compared. So the outcome depends on no worker, and the rest of the run costs nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.errors import RecordingError
from mlbatch.motion.agreement import FEW_WINDOWS, LITTLE_ROTATION, Agreement, Turns, agreement
from mlbatch.motion.estimate import VelocityEstimator
from mlbatch.motion.track import PoseLine
from mlbatch.reports.motion import RotationFigures
from mlbatch.types import Window
from mlbatch.units import NS_PER_S

if TYPE_CHECKING:
    from mlbatch.pipeline.deskew import WindowPoints

# Windows that are compared, and that are registered for it at most.
_WINDOWS = 40
_MOST_TRIED = 200
# Poses turn: mean angular velocity in a window, rad/s.
_MOVING = 0.02
# Poses before the first window and after the last one, for delays.
_AROUND_NS = NS_PER_S


class RotationCheck:
    """Takes windows that have poses; RecordingError where the poses turn otherwise than the points.

    outcome: what is known so far.
    """

    def __init__(self, points: WindowPoints) -> None:
        """points: what reads the points of windows."""
        self.outcome = RotationFigures(not_checked=LITTLE_ROTATION)
        self._points = points
        self._estimator: VelocityEstimator | None = None
        self._tried = 0
        self._is_over = False
        self._middle_ns = 0
        # Windows: middle of the one before, own middle, rotation of the points.
        self._spans_ns: list[tuple[int, int]] = []
        self._seen: list[F64Array] = []
        # Poses so far, for as long as they are needed.
        self._stamp_ns = np.zeros(0, np.int64)
        self._rotation = np.zeros((0, 3, 3))

    def add(self, window: Window, line: PoseLine, name: str, *, is_last: bool) -> None:
        """Add the next window, or slice; name: of the poses; is_last: no pose will follow."""
        if self._is_over:
            return
        self._note(line, window.end_ns)
        if len(self._seen) < _WINDOWS and self._tried < _MOST_TRIED:
            if self._estimator is None and not self._turns(window):
                return
            self._register(window)
        if (len(self._seen) >= _WINDOWS or self._tried >= _MOST_TRIED) and (
            is_last or self._is_known()
        ):
            self._decide(name)

    def finish(self, name: str) -> None:
        """End of input."""
        if not self._is_over and self._estimator is not None:
            self._tried = _MOST_TRIED
            self._decide(name)

    def _note(self, line: PoseLine, end_ns: int) -> None:
        """Keep the poses around the windows that are compared."""
        track = line.track
        newest = int(self._stamp_ns[-1]) if len(self._stamp_ns) else -1
        oldest = self._spans_ns[0][0] if self._spans_ns else end_ns
        rows = slice(
            int(track.stamp_ns.searchsorted(max(newest + 1, oldest - 2 * _AROUND_NS))),
            int(track.stamp_ns.searchsorted(end_ns + 2 * _AROUND_NS, "right")),
        )
        kept = slice(int(self._stamp_ns.searchsorted(oldest - 2 * _AROUND_NS)), None)
        self._stamp_ns = np.concatenate([self._stamp_ns[kept], track.stamp_ns[rows]])
        self._rotation = np.concatenate([self._rotation[kept], track.rotation[rows]])

    def _is_known(self) -> bool:
        """Whether there are poses after the last window."""
        last_ns = self._spans_ns[-1][1] if self._spans_ns else 0
        return int(self._stamp_ns[-1]) >= last_ns + _AROUND_NS

    def _turns(self, window: Window) -> bool:
        """Whether the poses turn in a window."""
        span = self._stamp_ns.searchsorted([window.start_ns, window.end_ns])
        first, last = max(int(span[0]) - 1, 0), min(int(span[1]), len(self._stamp_ns) - 1)
        if first >= last:
            return False
        rotation, stamp_ns = self._rotation[[first, last]], self._stamp_ns[[first, last]]
        turn = Turns.of_poses(stamp_ns, rotation).total[-1]
        limit = _MOVING * float(stamp_ns[1] - stamp_ns[0]) / NS_PER_S
        return float(np.sqrt((turn**2).sum())) > limit

    def _register(self, window: Window) -> None:
        for part in self._points.add(window):
            if self._estimator is None:
                self._estimator = VelocityEstimator()
            middle_ns = (part.start_ns + part.end_ns) // 2
            found = self._estimator.add(part.cloud, middle_ns, part.end_ns - part.start_ns)
            self._tried += 1
            if found.velocity is not None:
                self._spans_ns.append((self._middle_ns, middle_ns))
                seconds = (middle_ns - self._middle_ns) / NS_PER_S
                self._seen.append(found.velocity[3:] * seconds)
            self._middle_ns = middle_ns

    def _decide(self, name: str) -> None:
        """Compare the windows so far; begin again if they hardly turned."""
        found = Agreement(not_checked=FEW_WINDOWS)
        if self._seen:
            begin_ns, end_ns = np.array(self._spans_ns, np.int64).T
            turns = Turns.of_poses(self._stamp_ns, self._rotation)
            found = agreement(turns, begin_ns, end_ns, np.array(self._seen))
        if found.fault:
            raise RecordingError(_refusal(found, name))
        self.outcome = RotationFigures(
            found.windows,
            found.not_checked,
            found.scale,
            found.turned_deg,
            found.delay_ms,
            found.known_ms,
        )
        if self.outcome.not_checked == LITTLE_ROTATION and self._tried < _MOST_TRIED:
            self._estimator = None
            self._spans_ns, self._seen = [], []
            return
        self._is_over = True
        self._stamp_ns, self._rotation = self._stamp_ns[:0], self._rotation[:0]


def _refusal(found: Agreement, name: str) -> str:
    """One line: which of scale, axes and delay is wrong, and the estimate."""
    expected = (
        f"{name}: expected poses that turn as the points of {found.windows} windows do, found"
    )
    late = "late" if found.delay_ms > 0 else "early"
    delay = f"{abs(found.delay_ms):.0f} ms {late}"
    if found.fault == "scale":
        return (
            f"{expected} {found.scale:.3g} times their rotation (scale); check the units, which "
            "are rad/s"
        )
    if found.fault == "axes":
        return (
            f"{expected} axes turned by {found.turned_deg:.0f} degrees; check the axes and the "
            "extrinsics, and whether poses are of the body frame, with quaternions x, y, z, w"
        )
    if found.fault == "delay":
        return f"{expected} them {delay} (delay); set the clock of the poses to that of the lidars"
    if found.fault == "all":
        return (
            f"{expected} {found.scale:.3g} times their rotation, axes turned by "
            f"{found.turned_deg:.0f} degrees, {delay}; give poses of this recording, on the clock "
            "of its lidars"
        )
    return (
        f"{expected} another rotation, which no scale, axes or delay explain; give poses of this "
        "recording, in rad/s, and leave out the machine's own points (--exclude-box)"
    )
