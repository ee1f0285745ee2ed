"""Statistics of the columns of a scan: their number, gaps, coverage and overlap, by sensor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import I64Array
from mlbatch.decode.scan_buffer import WindowColumns
from mlbatch.lidar.geometry import SECTORS, sectors


@dataclass(frozen=True, slots=True)
class ColumnStats:
    """Columns of one sensor in a scan; all fields but the number as in `Scan`."""

    columns: int
    max_gap_ns: int
    coverage: float
    overlap: float


NO_COLUMNS = ColumnStats(0, 0, 0.0, 0.0)


class ColumnStatistics:
    """Column statistics of every sensor, by numpy."""

    def __init__(self, positions: Sequence[int | None]) -> None:
        """positions: rotor positions of a revolution by sensor; None: columns have rotor words."""
        self._positions = positions

    def measure(self, columns: WindowColumns) -> list[ColumnStats]:
        """Statistics by sensor."""
        if len(self._positions) == 1:
            return [_stats(columns.stamp_ns, columns.encoder, self._positions[0])]
        # One sort of bytes costs less than a mask for each sensor.
        order = columns.sensor.astype(np.uint8).argsort(kind="stable")
        stamp_ns = columns.stamp_ns[order]
        encoder = columns.encoder[order]
        counts = np.bincount(columns.sensor, minlength=len(self._positions))
        ends = counts.cumsum().tolist()
        begins = [0, *ends[:-1]]
        return [
            _stats(stamp_ns[begin:end], encoder[begin:end], positions)
            for begin, end, positions in zip(begins, ends, self._positions, strict=True)
        ]


def _stats(stamp_ns: I64Array, encoder: I64Array, positions: int | None) -> ColumnStats:
    """Statistics of the columns (n,) of one sensor; positions: see `sectors`."""
    if not len(stamp_ns):
        return NO_COLUMNS
    gap_ns = int((stamp_ns[1:] - stamp_ns[:-1]).max(initial=0))
    sector = sectors(encoder, positions)
    # A sector counts once each time that the rotor enters it.
    entered = sector[1:][sector[1:] != sector[:-1]]
    passes = np.bincount(entered, minlength=SECTORS)
    passes[sector[0]] += 1
    passed = int(np.count_nonzero(passes))
    passed_again = int(np.count_nonzero(passes > 1))
    return ColumnStats(len(stamp_ns), gap_ns, passed / SECTORS, passed_again / SECTORS)
