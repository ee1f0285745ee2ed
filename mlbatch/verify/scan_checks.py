"""Points of a scan: times, places, numbers of sensors, rings and returns."""

from __future__ import annotations

import numpy as np

from mlbatch.types import BoolArray, I64Array
from mlbatch.verify.scan import COLUMN_NS, HeldScan, Points
from mlbatch.verify.verdict import Judge

# facts/outputs.md, section 3.
LAST_RETURN_TYPE = 7


def valid_points(judge: Judge, scan: HeldScan) -> Points:
    """The points of a scan; those of an organized one are picked out of their slots."""
    if not scan.organized:
        bad: BoolArray = np.logical_not(np.all(np.isfinite(scan.xyz), axis=1))
        judge.none("finite", scan.point, bad, "finite coordinates", lambda at: scan.xyz[at])
        return Points(
            len(scan.xyz),
            None,
            None,
            scan.xyz,
            scan.time_ns,
            scan.ring,
            scan.return_type,
            scan.lidar_id,
        )
    valid: BoolArray = np.logical_not(np.all(np.isnan(scan.xyz), axis=2))
    _check_empty(judge, scan, valid)
    return Points(
        int(np.count_nonzero(valid)),
        valid,
        np.repeat(np.arange(len(valid)), np.count_nonzero(valid, axis=1)),
        scan.xyz[valid],
        None if scan.time_ns is None else scan.time_ns[valid],
        None if scan.ring is None else scan.ring[valid],
        None if scan.return_type is None else scan.return_type[valid],
        None if scan.lidar_id is None else scan.lidar_id[valid],
    )


def _check_empty(judge: Judge, scan: HeldScan, valid: BoolArray) -> None:
    """Empty slots hold NaN or 0, all others finite coordinates."""
    finite = np.isfinite(scan.xyz).all(axis=2)
    flat = scan.xyz.reshape(-1, 3)
    judge.none(
        "finite",
        scan.point,
        (valid & ~finite).reshape(-1),
        "three finite coordinates, or three NaN",
        lambda at: flat[at],
    )
    for name in ("intensity", "range_m"):
        plane = getattr(scan, name)
        # A layout whose ranges are whole mm has 0 where others have NaN.
        if plane is not None and plane.dtype == np.float32:
            bad = (np.isnan(plane) == valid).reshape(-1)
            wanted = f"{name} where there are coordinates, else NaN"
            judge.none("finite", scan.point, bad, wanted, plane.reshape(-1).__getitem__)
    for name in ("time_ns", "ring", "return_type"):
        plane = getattr(scan, name)
        if plane is not None:
            # A time of the clock is a float64, and not exact.
            zero = scan.time_step_ns if name == "time_ns" else 0
            bad = ((plane > zero) & ~valid).reshape(-1)
            judge.none(
                "finite",
                scan.point,
                bad,
                f"{name} 0 in an empty slot",
                plane.reshape(-1).__getitem__,
            )


def check_times(judge: Judge, scan: HeldScan, points: Points, span_ns: int) -> None:
    """Points lie in the window; the last column's may end a column's duration later."""
    time_ns, step_ns = points.time_ns, scan.time_step_ns
    if time_ns is None or not len(time_ns):
        return
    latest = span_ns + COLUMN_NS
    judge.none(
        "times",
        scan.point,
        (time_ns < -step_ns) | (time_ns >= latest),
        f"0 to {latest} ns after {scan.start_ns}",
        lambda at: int(time_ns[at]),
    )
    if scan.column_stamp_ns is not None:
        _check_offsets(judge, scan, points, time_ns)
    elif points.row is not None:
        _check_rows(judge, scan, points.row, time_ns)
    elif not scan.organized:
        newest: I64Array = np.maximum.accumulate(time_ns)
        back = newest - time_ns
        judge.none(
            "order",
            scan.point,
            back >= COLUMN_NS + step_ns,
            f"a time less than {COLUMN_NS} ns older than those before",
            lambda at: f"{int(back[at])} ns older",
        )


def _check_offsets(judge: Judge, scan: HeldScan, points: Points, time_ns: I64Array) -> None:
    """Every point's time after the stamp of its own column."""
    column = points.row if scan.column is None else scan.column
    if column is None or scan.column_stamp_ns is None or not fits_columns(scan):
        return
    offset_ns = time_ns - (scan.column_stamp_ns - scan.start_ns)[column]
    judge.none(
        "times",
        scan.point,
        (offset_ns < 0) | (offset_ns >= COLUMN_NS),
        f"0 to {COLUMN_NS} ns after its column",
        lambda at: f"{int(offset_ns[at])} ns after column {int(column[at])}",
    )
    if scan.column is not None:
        _check_point_order(judge, scan, scan.column.astype(np.int64), time_ns)


def _check_point_order(judge: Judge, scan: HeldScan, column: I64Array, time_ns: I64Array) -> None:
    """By column, then time, then ring."""
    step, later = np.diff(column), np.diff(time_ns)
    back: BoolArray = (step < 0) | ((step == 0) & (later < 0))
    if scan.ring is not None:
        back |= (step == 0) & (later == 0) & (scan.ring[1:] < scan.ring[:-1])
    judge.none(
        "order",
        f"{scan.point} after",
        back,
        "points by column, then time, then ring",
        lambda at: f"columns {column[at : at + 2].tolist()}, ns {time_ns[at : at + 2].tolist()}",
    )


def fits_columns(scan: HeldScan) -> bool:
    """Whether the columns that points name are there."""
    stamps, column = scan.column_stamp_ns, scan.column
    if stamps is None:
        return False
    return column is None or not len(column) or int(column.max()) < len(stamps)


def _check_rows(judge: Judge, scan: HeldScan, row: I64Array, time_ns: I64Array) -> None:
    """Points of one column lie close together in time."""
    count = len(scan.xyz)
    first, last = np.full(count, np.iinfo(np.int64).max), np.full(count, -1)
    np.minimum.at(first, row, time_ns)
    np.maximum.at(last, row, time_ns)
    spread: I64Array = np.where(last < 0, 0, last - first)
    judge.none(
        "times",
        f"{scan.where} column",
        spread >= COLUMN_NS + scan.time_step_ns,
        f"points within {COLUMN_NS} ns",
        lambda at: f"{int(spread[at])} ns",
    )
    some = last >= 0
    newest: I64Array = np.maximum.accumulate(first[some])
    back = newest - first[some]
    judge.none(
        "order",
        f"{scan.where} column with points",
        back >= COLUMN_NS + scan.time_step_ns,
        f"a time less than {COLUMN_NS} ns older than those before",
        lambda at: f"{int(back[at])} ns older",
    )


def check_labels(judge: Judge, scan: HeldScan, points: Points, sensors: int) -> bool:
    """Sensor and return type of every point; False where a sensor is none."""
    types, owner = points.return_type, points.lidar_id
    if types is not None:
        strange = types > LAST_RETURN_TYPE
        wanted = f"a return type up to {LAST_RETURN_TYPE}"
        judge.none("returns", scan.point, strange, wanted, lambda at: types[at])
    if owner is None:
        return True
    if scan.sensor is None:
        strange, wanted = owner >= sensors, f"a sensor below {sensors}"
    else:
        strange, wanted = owner != scan.sensor, f"sensor {scan.sensor}"
    if not judge.none("sensors", scan.point, strange, wanted, lambda at: owner[at]):
        return False
    _check_owner(judge, scan)
    return True


def _check_owner(judge: Judge, scan: HeldScan) -> None:
    """The sensor of a point is that of its column."""
    owner, columns = scan.lidar_id, scan.column_lidar_id
    if owner is None:
        return
    if scan.organized:
        wanted = owner[:, :1] if columns is None else columns[:, None]
        strange: BoolArray = (owner != wanted).reshape(-1)
    elif columns is not None and scan.column is not None and fits_columns(scan):
        strange = owner != columns[scan.column]
    else:
        return
    flat = owner.reshape(-1)
    judge.none("sensors", scan.point, strange, "the sensor of its column", flat.__getitem__)
