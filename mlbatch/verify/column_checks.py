"""Columns of a scan: inside their window, in order, none twice."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from mlbatch.arrays import F32Array, F64Array, I64Array, U8Array
from mlbatch.verify.scan import HeldScan
from mlbatch.verify.verdict import Judge


def check_columns(judge: Judge, scan: HeldScan, end_ns: int, sensors: int) -> bool:
    """Hold the columns against their window; False where their arrays do not fit each other."""
    stamps, owner = scan.column_stamp_ns, scan.column_lidar_id
    if stamps is None or owner is None:
        return True
    column = f"{scan.where} column"
    outside = (stamps < scan.start_ns) | (stamps >= end_ns)
    judge.none(
        "columns", column, outside, f"[{scan.start_ns}, {end_ns})", lambda at: int(stamps[at])
    )
    if len(stamps) == 0:
        judge.blame("columns", scan.where, "a column or more, since empty windows are left out", 0)
    back = stamps[1:] < stamps[:-1]
    judge.none(
        "order",
        f"{column} after",
        back,
        "a stamp at or after the one before",
        lambda at: f"{int(stamps[at])}, then {int(stamps[at + 1])}",
    )
    swapped = (stamps[1:] == stamps[:-1]) & (owner[1:] < owner[:-1])
    judge.none(
        "order",
        f"{column} after",
        swapped,
        "columns of equal stamp in the order of sensors",
        lambda at: f"sensor {owner[at]}, then {owner[at + 1]}",
    )
    if scan.sensor is not None:
        wanted, strange = str(scan.sensor), owner != scan.sensor
    else:
        wanted, strange = f"a number below {sensors}", owner >= sensors
    judge.none("sensors", column, strange, f"sensor {wanted}", lambda at: owner[at])
    return not bool(strange.any())


@dataclass(slots=True)
class Twins:
    """Finds columns that are there twice: of one sensor, one stamp and equal points.

    Some sensors give several columns one stamp (each return a column of its own, or points of a
    cloud without times), and these may well be equal. `usual`: how many each sensor gives to a
    quarter of its stamps; as many may be equal.
    """

    judge: Judge
    usual: dict[int, int] = field(default_factory=dict)

    def check(self, scan: HeldScan) -> None:
        """Look for twins among the columns of a scan."""
        stamps, owner = scan.column_stamp_ns, scan.column_lidar_id
        if stamps is None or owner is None:
            return
        self.judge.passed("duplicates", len(stamps))
        # Columns of one stamp and sensor are neighbours where `order` holds.
        same = (stamps[1:] == stamps[:-1]) & (owner[1:] == owner[:-1])
        if not same.any():
            self.usual.update(dict.fromkeys(np.unique(owner).tolist(), 1))
            return
        self._note_usual(stamps, owner)
        alike = np.zeros(len(stamps), bool)
        alike[1:] |= same
        alike[:-1] |= same
        met: Counter[tuple[int, int, bytes]] = Counter()
        for column in np.flatnonzero(alike).tolist():
            content = _content(scan, column)
            if not content:
                continue
            sensor, stamp_ns = int(owner[column]), int(stamps[column])
            met[sensor, stamp_ns, content] += 1
            if met[sensor, stamp_ns, content] == self.usual[sensor] + 1:
                self.judge.blame(
                    "duplicates",
                    f"{scan.where} column {column}",
                    f"one column of sensor {sensor} at {stamp_ns} with these points",
                    "another one",
                )

    def _note_usual(self, stamps: I64Array, owner: U8Array) -> None:
        for sensor in np.unique(owner).tolist():
            _, counts = np.unique(stamps[owner == sensor], return_counts=True)
            often = int(np.sort(counts)[len(counts) * 3 // 4])
            self.usual[sensor] = min(often, self.usual.get(sensor, often))


def _content(scan: HeldScan, column: int) -> bytes:
    """The points of a column as bytes; none where it has none."""
    if scan.column is None:
        rows: slice | int = column
        if not bool(np.isfinite(scan.xyz[column]).any()):
            return b""
    else:
        begin, end = np.searchsorted(scan.column, [column, column + 1]).tolist()
        if begin == end:
            return b""
        rows = slice(begin, end)
    parts: list[F32Array | F64Array] = [scan.xyz[rows]]
    parts += [part[rows] for part in (scan.intensity, scan.range_m) if part is not None]
    rings = b"" if scan.ring is None else scan.ring[rows].tobytes()
    return b"".join(part.tobytes() for part in parts) + rings
