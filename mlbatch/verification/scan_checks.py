"""Checks of single scans: grid, columns, points, geometry."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from fractions import Fraction
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import BoolArray, F32Array, F64Array, I64Array, U8Array
from mlbatch.outputs.damage import CheckLog
from mlbatch.outputs.stored_scan import COLUMN_NS, Points, StoredScan

Plane: TypeAlias = npt.NDArray[np.generic]
_NS = 10**9
# docs/sources/outputs.md section 3.
_LAST_RETURN_TYPE = 7

# Ranges count from the place where a beam leaves, a few cm from the origin of the sensor frame;
# those of an HDL-64E lack the correction of their laser, 0.9 to 1.6 m.
# Largest usual difference of a sensor, and largest difference of a point from the usual one.
FARTHEST_M = 2.0
APART_M = 1.0
# Of coordinates rounded to float32.
SHARE = 1e-5
# Nearer points have no direction: it is rounding.
NEAR_M = 0.1


# -- grid -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Grid:
    """The bounds of windows and slices, in plain Python; shares no code with `batching`.

    `bound(k) = ceil(k * 1e9 / rate)` of the exact rational rate; slice j of window k is number
    q = k * slices + j of a grid `slices` times as fine.
    """

    rate: Fraction
    slices: int

    def bound(self, q: int) -> int:
        """First nanosecond of slice q."""
        whole, rest = divmod(q * _NS * self.rate.denominator, self.rate.numerator * self.slices)
        return whole + (rest > 0)

    def number(self, stamp_ns: int) -> int:
        """Return the number q of the slice that contains a stamp."""
        q = stamp_ns * self.rate.numerator * self.slices // (_NS * self.rate.denominator)
        return q + 1 if self.bound(q + 1) <= stamp_ns else q


class GridChecks:
    """Checks bounds, index, slice and order of scans, one after the other."""

    def __init__(self, log: CheckLog, grid: Grid | None, t_init_ns: int | None, where: str) -> None:
        # Number of the window of scan 0, once known.
        self.first: int | None = None
        self._log = log
        self._grid = grid
        self._last: dict[int | None, int] = {}
        if grid is not None and t_init_ns is not None:
            q = grid.number(t_init_ns)
            self.first = q // grid.slices
            bound = grid.bound(self.first * grid.slices)
            log.equal("t_init", f"{where} t_init_ns", bound, t_init_ns)

    def check(self, scan: StoredScan) -> tuple[int, int] | None:
        """Check a scan; its index and slice by its start, None without a rate."""
        log = self._log
        grid = self._grid
        if grid is None:
            return None
        q = self._number(scan, grid)
        log.ok("grid")
        begin = grid.bound(q)
        end = grid.bound(q + 1)
        if scan.start_ns != begin:
            log.fail("grid", f"{scan.where} start_ns", begin, scan.start_ns)
        if scan.end_ns not in (None, end):
            log.fail("grid", f"{scan.where} end_ns", end, scan.end_ns)
        window, part = divmod(q, grid.slices)
        if self.first is None:
            # By the index of the first scan; all others have to agree.
            self.first = window - (scan.index or 0)
        index = window - self.first
        log.ok("index")
        if (scan.index, scan.slice) not in ((None, None), (index, part)):
            found = f"{scan.index}, {scan.slice}"
            log.fail("index", f"{scan.where} index, slice", f"{index}, {part}", found)
        if index < -1:
            log.fail("index", scan.where, "the window of the head (-1) or a later one", index)
        self._check_order(scan, grid, q)
        return index, part

    def _number(self, scan: StoredScan, grid: Grid) -> int:
        """The slice of the start of a scan, or the next one if its bound is nearer."""
        q = grid.number(scan.start_ns)
        if scan.index is None or scan.slice is None or self.first is None:
            return q
        # A start just before a bound belongs to it if index and slice agree.
        said = (self.first + scan.index) * grid.slices + scan.slice
        is_nearer = 2 * scan.start_ns > grid.bound(q) + grid.bound(q + 1)
        return said if said == q + 1 and is_nearer else q

    def _check_order(self, scan: StoredScan, grid: Grid, q: int) -> None:
        last = self._last.get(scan.sensor)
        if last is not None and q <= last:
            expected = f"a start after {grid.bound(last)}, that of the scan before"
            self._log.fail("index", f"{scan.where} start_ns", expected, scan.start_ns)
        self._last[scan.sensor] = q if last is None else max(q, last)


# -- columns --------------------------------------------------------------------------------------


def check_columns(log: CheckLog, scan: StoredScan, end_ns: int, sensors: int) -> bool:
    """Check columns against their window; False if a sensor of a column does not exist."""
    stamps = scan.column_stamp_ns
    owner = scan.column_lidar_id
    if stamps is None or owner is None:
        return True
    column = f"{scan.where} column"
    outside = (stamps < scan.start_ns) | (stamps >= end_ns)
    window = f"[{scan.start_ns}, {end_ns})"
    log.none("columns", column, outside, window, lambda at: int(stamps[at]))
    if len(stamps) == 0:
        log.fail("columns", scan.where, "a column or more: empty windows have no scan", 0)
    log.none(
        "order",
        f"{column} after",
        stamps[1:] < stamps[:-1],
        "a stamp at or after the one before",
        lambda at: f"{int(stamps[at])}, then {int(stamps[at + 1])}",
    )
    log.none(
        "order",
        f"{column} after",
        (stamps[1:] == stamps[:-1]) & (owner[1:] < owner[:-1]),
        "columns of equal stamp in the order of sensors",
        lambda at: f"sensor {owner[at]}, then {owner[at + 1]}",
    )
    if scan.sensor is not None:
        expected = f"sensor {scan.sensor}"
        bad = owner != scan.sensor
    else:
        expected = f"a sensor below {sensors}"
        bad = owner >= sensors
    return log.none("sensors", column, bad, expected, lambda at: owner[at])


@dataclass(slots=True)
class DuplicateColumns:
    """Finds columns of one sensor with equal stamps and equal points.

    Some sensors give several columns one stamp (a column for each return, or clouds without times),
    and these may be equal: as many equal columns are allowed.
    """

    log: CheckLog
    # Columns of one stamp that each sensor gives to at least a quarter of its stamps.
    usual: dict[int, int] = field(default_factory=dict)

    def check(self, scan: StoredScan) -> None:
        """Check the columns of a scan."""
        stamps = scan.column_stamp_ns
        owner = scan.column_lidar_id
        if stamps is None or owner is None:
            return
        self.log.ok("duplicates", len(stamps))
        # Columns of one stamp and sensor are neighbours if `order` is ok.
        same = (stamps[1:] == stamps[:-1]) & (owner[1:] == owner[:-1])
        if not same.any():
            self.usual.update(dict.fromkeys(np.unique(owner).tolist(), 1))
            return
        self._update_usual(stamps, owner)
        candidates = np.zeros(len(stamps), bool)
        candidates[1:] |= same
        candidates[:-1] |= same
        counts: Counter[tuple[int, int, bytes]] = Counter()
        by_column = _by_column(scan)
        for column in np.flatnonzero(candidates).tolist():
            content = _content(scan, column, by_column)
            if not content:
                continue
            sensor = int(owner[column])
            stamp_ns = int(stamps[column])
            key = (sensor, stamp_ns, content)
            counts[key] += 1
            if counts[key] == self.usual[sensor] + 1:
                self.log.fail(
                    "duplicates",
                    f"{scan.where} column {column}",
                    f"one column of sensor {sensor} at {stamp_ns} with these points",
                    "another one",
                )

    def _update_usual(self, stamps: I64Array, owner: U8Array) -> None:
        for sensor in np.unique(owner).tolist():
            _, counts = np.unique(stamps[owner == sensor], return_counts=True)
            often = int(np.sort(counts)[len(counts) * 3 // 4])
            self.usual[sensor] = min(often, self.usual.get(sensor, often))


def _by_column(scan: StoredScan) -> I64Array | None:
    """Points in the order of their columns; None if that is how they are stored."""
    if scan.column is None or not scan.by_time:
        return None
    order: I64Array = scan.column.argsort(kind="stable")
    return order


def _content(scan: StoredScan, column: int, by_column: I64Array | None) -> bytes:
    """The points of a column as bytes, empty without points; by_column: of all points."""
    rows: slice | int | I64Array
    if scan.column is None:
        rows = column
        if not bool(np.isfinite(scan.xyz[column]).any()):
            return b""
    else:
        bounds = [column, column + 1]
        begin, end = np.searchsorted(scan.column, bounds, sorter=by_column).tolist()
        rows = slice(begin, end) if by_column is None else by_column[begin:end]
        if begin == end:
            return b""
    parts: list[F32Array | F64Array] = [scan.xyz[rows]]
    parts += [part[rows] for part in (scan.intensity, scan.range_m) if part is not None]
    rings = b"" if scan.ring is None else scan.ring[rows].tobytes()
    return b"".join(part.tobytes() for part in parts) + rings


# -- points ---------------------------------------------------------------------------------------


def valid_points(log: CheckLog, scan: StoredScan) -> Points:
    """The points of a scan, checked to be finite; those of an organized one without empty slots."""
    fields = ("time_ns", "ring", "return_type", "lidar_id")
    planes = {name: getattr(scan, name) for name in fields}
    if not scan.organized:
        bad: BoolArray = np.logical_not(np.all(np.isfinite(scan.xyz), axis=1))
        log.none("finite", scan.point, bad, "finite coordinates", lambda at: scan.xyz[at])
        return Points(len(scan.xyz), None, None, scan.xyz, **planes)
    valid: BoolArray = np.logical_not(np.all(np.isnan(scan.xyz), axis=2))
    _check_slots(log, scan, valid)
    row: I64Array = np.repeat(np.arange(len(valid)), np.count_nonzero(valid, axis=1))
    picked = {name: None if plane is None else plane[valid] for name, plane in planes.items()}
    return Points(len(row), valid, row, scan.xyz[valid], **picked)


def _check_slots(log: CheckLog, scan: StoredScan, valid: BoolArray) -> None:
    """Empty slots contain NaN or 0, all others finite coordinates."""
    finite = np.isfinite(scan.xyz).all(axis=2)
    flat = scan.xyz.reshape(-1, 3)
    bad = (valid & ~finite).reshape(-1)
    expected = "three finite coordinates, or three NaN"
    log.none("finite", scan.point, bad, expected, lambda at: flat[at])
    for name in ("intensity", "range_m"):
        plane = getattr(scan, name)
        # A layout with ranges in whole mm has 0 where others have NaN.
        if plane is not None and plane.dtype == np.float32:
            bad = (np.isnan(plane) == valid).reshape(-1)
            expected = f"{name} where there are coordinates, else NaN"
            log.none("finite", scan.point, bad, expected, plane.reshape(-1).__getitem__)
    for name in ("time_ns", "ring", "return_type"):
        plane = getattr(scan, name)
        if plane is not None:
            # Times in float64 seconds of the clock are not exact.
            zero = scan.time_step_ns if name == "time_ns" else 0
            bad = ((plane > zero) & ~valid).reshape(-1)
            expected = f"{name} 0 in an empty slot"
            log.none("finite", scan.point, bad, expected, plane.reshape(-1).__getitem__)


def check_times(log: CheckLog, scan: StoredScan, points: Points, span_ns: int) -> None:
    """Points are in the window; those of the last column up to the duration of a column later."""
    time_ns = points.time_ns
    step_ns = scan.time_step_ns
    if time_ns is None or not len(time_ns):
        return
    latest_ns = span_ns + COLUMN_NS
    log.none(
        "times",
        scan.point,
        (time_ns < -step_ns) | (time_ns >= latest_ns),
        f"0 to {latest_ns} ns after {scan.start_ns}",
        lambda at: int(time_ns[at]),
    )
    if scan.column_stamp_ns is not None:
        _check_offsets(log, scan, points, time_ns)
    elif points.row is not None:
        _check_rows(log, scan, points.row, time_ns)
    elif not scan.organized and (scan.by_time or not scan.own_times):
        _check_steps_back(log, scan, scan.point, time_ns)


def _check_steps_back(log: CheckLog, scan: StoredScan, where: str, time_ns: I64Array) -> None:
    """Times step back by less than the duration of a column, or not at all if sorted by time."""
    newest: I64Array = np.maximum.accumulate(time_ns)
    back = newest - time_ns
    most_ns = 1 if scan.by_time else COLUMN_NS
    log.none(
        "order",
        where,
        back >= most_ns + scan.time_step_ns,
        f"a time less than {most_ns} ns before earlier ones",
        lambda at: f"{int(back[at])} ns before",
    )


def _check_offsets(log: CheckLog, scan: StoredScan, points: Points, time_ns: I64Array) -> None:
    """The time of a point after the stamp of its column."""
    column = points.row if scan.column is None else scan.column
    if column is None or scan.column_stamp_ns is None or not fits_columns(scan):
        return
    offset_ns = time_ns - (scan.column_stamp_ns - _time_origins(scan))[column]
    log.none(
        "times",
        scan.point,
        (offset_ns < 0) | (offset_ns >= COLUMN_NS),
        f"0 to {COLUMN_NS} ns after its column",
        lambda at: f"{int(offset_ns[at])} ns after column {int(column[at])}",
    )
    if scan.column is not None:
        _check_point_order(log, scan, scan.column.astype(np.int64), time_ns)


def _time_origins(scan: StoredScan) -> int | I64Array:
    """Where times of points count from: the start, or (n,) the first column of each sensor."""
    stamps = scan.column_stamp_ns
    owner = scan.column_lidar_id
    if not scan.own_times or stamps is None or owner is None:
        return scan.start_ns
    first: I64Array = np.full(256, np.iinfo(np.int64).max)
    np.minimum.at(first, owner, stamps)
    return first[owner]


def _check_point_order(
    log: CheckLog, scan: StoredScan, column: I64Array, time_ns: I64Array
) -> None:
    """By column, then time, then ring; if sorted by time: by time, then column, then ring."""
    step = np.diff(column)
    later = np.diff(time_ns)
    first, second = (later, step) if scan.by_time else (step, later)
    back: BoolArray = (first < 0) | ((first == 0) & (second < 0))
    if scan.ring is not None:
        back |= (step == 0) & (later == 0) & (scan.ring[1:] < scan.ring[:-1])
    order = "time, then column" if scan.by_time else "column, then time"
    log.none(
        "order",
        f"{scan.point} after",
        back,
        f"points by {order}, then ring",
        lambda at: f"columns {column[at : at + 2].tolist()}, ns {time_ns[at : at + 2].tolist()}",
    )


def fits_columns(scan: StoredScan) -> bool:
    """Whether the columns of all points exist."""
    stamps = scan.column_stamp_ns
    column = scan.column
    if stamps is None:
        return False
    return column is None or not len(column) or int(column.max()) < len(stamps)


def _check_rows(log: CheckLog, scan: StoredScan, row: I64Array, time_ns: I64Array) -> None:
    """Points of one column are close together in time."""
    count = len(scan.xyz)
    first = np.full(count, np.iinfo(np.int64).max)
    last = np.full(count, -1)
    np.minimum.at(first, row, time_ns)
    np.maximum.at(last, row, time_ns)
    spread: I64Array = np.where(last < 0, 0, last - first)
    log.none(
        "times",
        f"{scan.where} column",
        spread >= COLUMN_NS + scan.time_step_ns,
        f"points within {COLUMN_NS} ns",
        lambda at: f"{int(spread[at])} ns",
    )
    if not scan.own_times:
        _check_steps_back(log, scan, f"{scan.where} column with points", first[last >= 0])


def check_labels(log: CheckLog, scan: StoredScan, points: Points, sensors: int) -> bool:
    """Check sensor and return type of each point; False if a sensor does not exist."""
    types = points.return_type
    owner = points.lidar_id
    if types is not None:
        bad = types > _LAST_RETURN_TYPE
        expected = f"a return type up to {_LAST_RETURN_TYPE}"
        log.none("returns", scan.point, bad, expected, lambda at: types[at])
    if owner is None:
        return True
    if scan.sensor is None:
        expected = f"a sensor below {sensors}"
        bad = owner >= sensors
    else:
        expected = f"sensor {scan.sensor}"
        bad = owner != scan.sensor
    if not log.none("sensors", scan.point, bad, expected, lambda at: owner[at]):
        return False
    _check_owner(log, scan)
    return True


def _check_owner(log: CheckLog, scan: StoredScan) -> None:
    """The sensor of a point is that of its column."""
    owner = scan.lidar_id
    columns = scan.column_lidar_id
    if owner is None:
        return
    bad: BoolArray
    if scan.organized:
        expected = owner[:, :1] if columns is None else columns[:, None]
        bad = (owner != expected).reshape(-1)
    elif columns is not None and scan.column is not None and fits_columns(scan):
        bad = owner != columns[scan.column]
    else:
        return
    flat = owner.reshape(-1)
    log.none("sensors", scan.point, bad, "the sensor of its column", flat.__getitem__)


# -- geometry -------------------------------------------------------------------------------------


@dataclass(slots=True)
class GeometryChecks:
    """Checks coordinates against ranges, distances and angles."""

    log: CheckLog
    # Body from sensor, (s, 4, 4); None without a report.
    poses: F64Array | None
    # Usual difference of each sensor, from its first scan.
    usual_m: dict[int, float] = field(default_factory=dict)

    def check(self, scan: StoredScan, points: Points) -> None:
        """Check one scan."""
        no_range = scan.range_m is None and scan.distance_m is None
        if self.poses is None or not points.count or no_range:
            return
        owner = points.lidar_id
        if owner is None and scan.sensor is None and len(self.poses) > 1:
            return
        pose = self.poses[scan.sensor or 0] if owner is None else self.poses[owner]
        apart_m: F64Array = points.xyz - pose[..., :3, 3]
        away_m: F64Array = np.sqrt((apart_m * apart_m).sum(axis=1))
        if scan.range_m is not None:
            self._check_ranges(scan, points, away_m, _of_points(points, scan.range_m))
        # The largest coordinate was rounded before the position of the sensor was subtracted.
        rounding_m: F64Array = SHARE * (1 + np.abs(points.xyz).max(axis=1))
        if scan.distance_m is not None:
            said_m = _of_points(points, scan.distance_m)
            bad = ~(np.abs(away_m - said_m) <= rounding_m)
            self._log(scan, bad, "distance from its sensor", away_m, said_m, "m")
        if scan.angles_rad is not None:
            own_m: F64Array = np.einsum("...ji,...j->...i", pose[..., :3, :3], apart_m)
            self._check_angles(scan, points, own_m, rounding_m)

    def _check_ranges(
        self, scan: StoredScan, points: Points, away_m: F64Array, said_m: F64Array
    ) -> None:
        difference_m: F64Array = away_m - said_m
        owner = points.lidar_id
        sensors = [scan.sensor or 0] if owner is None else np.unique(owner).tolist()
        usual_m = np.zeros(0 if self.poses is None else len(self.poses))
        for sensor in sensors:
            if sensor not in self.usual_m:
                own_m = difference_m if owner is None else difference_m[owner == sensor]
                middle_m = float(np.median(np.nan_to_num(own_m)))
                self.usual_m[sensor] = middle_m if abs(middle_m) <= FARTHEST_M else 0.0
            usual_m[sensor] = self.usual_m[sensor]
        from_usual_m = difference_m - (usual_m[sensors[0]] if owner is None else usual_m[owner])
        bad = ~(np.abs(from_usual_m) <= APART_M) | (said_m <= 0)
        self._log(scan, bad, "distance from its sensor", away_m, said_m, "m")

    def _check_angles(
        self, scan: StoredScan, points: Points, own_m: F64Array, rounding_m: F64Array
    ) -> None:
        """Azimuth and elevation in the sensor frame; own_m: (p, 3)."""
        if scan.angles_rad is None:
            return
        flat_m = np.hypot(own_m[:, 0], own_m[:, 1])
        azimuth = np.arctan2(own_m[:, 1], own_m[:, 0])
        elevation = np.arctan2(own_m[:, 2], flat_m)
        near: BoolArray = flat_m < NEAR_M
        names = ("azimuth", "elevation")
        angles = (azimuth, elevation)
        for name, plane, angle in zip(names, scan.angles_rad, angles, strict=True):
            said = _of_points(points, plane)
            apart = np.abs(np.remainder(said - angle + np.pi, 2 * np.pi) - np.pi)
            bad = ~(apart * flat_m <= rounding_m * 2) & ~near
            self._log(scan, bad, name, angle, said, "rad")

    def _log(
        self,
        scan: StoredScan,
        bad: BoolArray,
        name: str,
        expected: F64Array,
        said: F64Array,
        unit: str,
    ) -> None:
        first = int(bad.argmax()) if bad.any() else 0
        text = f"{name} {expected[first]:.6g} {unit} of its coordinates"
        self.log.none("geometry", scan.point, bad, text, lambda at: f"{said[at]:.6g} {unit}")


def _of_points(points: Points, plane: Plane) -> F64Array:
    picked: F64Array = (plane if points.valid is None else plane[points.valid]).astype(np.float64)
    return picked
