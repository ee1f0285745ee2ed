"""What the columns of a scan are, sensor by sensor: how many, their gaps, how much of a turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import I64Array
from mlbatch.decode.scan_buffer import WindowColumns
from mlbatch.lidar.geometry import SECTORS, sectors


@dataclass(frozen=True, slots=True)
class ColumnStats:
    """The columns of a sensor in a scan, but for its points; shares are those of Scan."""

    columns: int
    max_gap_ns: int
    coverage: float
    overlap: float


NO_COLUMNS = ColumnStats(0, 0, 0.0, 0.0)


class ColumnStatistics:
    """Tells the outlines of scans, by passes of numpy."""

    def __init__(self, positions: Sequence[int | None]) -> None:
        """positions: rotor positions of a turn of each sensor; None: rotor words."""
        self._positions = positions

    def measure(self, due: WindowColumns) -> list[ColumnStats]:
        """Of each sensor."""
        if len(self._positions) == 1:
            return [_outline(due.stamp_ns, due.encoder, self._positions[0])]
        # Sorted once, and as bytes: masks of each sensor cost more.
        order = due.sensor.astype(np.uint8).argsort(kind="stable")
        stamp_ns, encoder = due.stamp_ns[order], due.encoder[order]
        ends = np.bincount(due.sensor, minlength=len(self._positions)).cumsum().tolist()
        return [
            _outline(stamp_ns[begin:end], encoder[begin:end], positions)
            for begin, end, positions in zip([0, *ends], ends, self._positions, strict=False)
        ]


def _outline(stamp_ns: I64Array, encoder: I64Array, positions: int | None) -> ColumnStats:
    """Of the columns of one sensor, (n,) each; positions: see `sectors`."""
    if not len(stamp_ns):
        return NO_COLUMNS
    gap_ns = int((stamp_ns[1:] - stamp_ns[:-1]).max(initial=0))
    # How often the rotor entered each sector.
    sector = sectors(encoder, positions)
    entered = sector[1:][sector[1:] != sector[:-1]]
    passes = np.bincount(entered, minlength=SECTORS)
    passes[sector[0]] += 1
    once, again = np.count_nonzero(passes), np.count_nonzero(passes > 1)
    return ColumnStats(len(stamp_ns), gap_ns, once / SECTORS, again / SECTORS)
