"""report.json as it stands in an output (CONTRACT.md, section 4): its ledgers, and its claims."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.errors import UsageError
from mlbatch.units import parse_rate
from mlbatch.verify.claims import Claims
from mlbatch.verify.document import Document, Json
from mlbatch.verify.verdict import Judge

SCHEMA = "mlbatch.report/1"
_NS = 10**9
# A run's balance sheets for each sensor: the total, its one good fate, the others by reason.
_SHEETS = (
    ("packets", "read", "accepted", "rejected"),
    ("imu_samples", "decoded", "written", "dropped"),
    ("columns", "decoded", "written", "dropped"),
)
_FATES = ("no_return", "range", "box", "repeated", "written")
# What differs from machine to machine, and where it stands.
_MACHINE = ("timing", "inputs")


def claims_of(report: Document) -> Claims:
    """What the report says of the run."""
    names = [report.text("sensors", i, "name") for i in range(report.length("sensors"))]
    return Claims(
        report.text("grid", "rate_hz"),
        report.number("grid", "slices"),
        report.number("grid", "t_init_ns"),
        tuple(name or "" for name in names),
        report.text("timescale"),
    )


def check_ledger(report: Document) -> None:
    """Everything that was read is written or counted."""
    judge = report.judge
    judge.equal("ledger", report.name("schema"), SCHEMA, report.at("schema"))
    skipped = report.counts("capture", "skipped")
    fates = (report.number("capture", "datagrams"), *skipped.values())
    _balance(report, ("capture", "frames"), fates)
    for i in range(report.length("sensors")):
        judge.equal("ledger", report.name("sensors", i, "lidar_id"), i, _id(report, i))
        for sheet, total, good, others in _SHEETS:
            path = ("sensors", i, sheet)
            reasons = report.counts(*path, others)
            _balance(report, (*path, total), (report.number(*path, good), *reasons.values()))
        path = ("sensors", i, "points")
        _balance(report, (*path, "slots"), tuple(report.number(*path, fate) for fate in _FATES))
    for i in range(report.length("messages")):
        reasons = report.counts("messages", i, "dropped")
        written = report.number("messages", i, "written")
        _balance(report, ("messages", i, "read"), (written, *reasons.values()))


def _id(report: Document, i: int) -> int | None:
    return report.number("sensors", i, "lidar_id")


def _balance(report: Document, path: tuple[str | int, ...], fates: tuple[int | None, ...]) -> None:
    total = report.number(*path)
    if total is None or None in fates:
        return
    parts = [fate for fate in fates if fate is not None]
    report.judge.passed("ledger")
    if total != sum(parts):
        text = " + ".join(map(str, parts))
        report.judge.blame("ledger", report.name(*path), f"{text} = {sum(parts)}", total)


def check_grid(report: Document) -> None:
    """The period is one over the rate."""
    rate, period = report.text("grid", "rate_hz"), report.text("grid", "period_ns")
    if rate is None or period is None:
        return
    try:
        wanted = str(Fraction(_NS) / parse_rate(rate))
    except UsageError:
        return  # Blamed where the rate is used.
    report.judge.equal("grid", report.name("grid", "period_ns"), wanted, period)


# No sensor sits farther from its body.
_MOST_M = 1e9


def poses_of(report: Document) -> F64Array | None:
    """Body from sensor, (s, 4, 4); None where one is no rigid transform, which is blamed."""
    poses = []
    for i in range(report.length("sensors")):
        path = ("sensors", i, "extrinsics", "body_from_sensor")
        try:
            pose: F64Array = np.array(report.at(*path), np.float64)
        except (TypeError, ValueError):
            pose = np.zeros(0)
        # Squares of much larger numbers would overflow; NaN is not less.
        rigid = pose.shape == (4, 4) and bool((np.abs(pose) < _MOST_M).all())
        if rigid:
            turn = pose[:3, :3]
            rigid = bool(
                np.allclose(turn @ turn.T, np.eye(3), atol=1e-3)
                and np.linalg.det(turn) > 0
                and (pose[3] == (0, 0, 0, 1)).all()
            )
        if not rigid:
            report.judge.blame("report", report.name(*path), "a rigid transform (4, 4)", pose)
            return None
        poses.append(pose)
    report.judge.passed("report", len(poses))
    return np.stack(poses) if poses else None


def check_same(judge: Judge, one: Document, other: Document) -> None:
    """Two copies of a report, one of them perhaps without what differs between machines."""
    left, right = _shared(one.root), _shared(other.root)
    if not isinstance(left, dict) or not isinstance(right, dict):
        judge.equal("report", other.where, "an object", type(right).__name__)
        return
    for key in sorted(set(left) | set(right)):
        path = _difference(left.get(key), right.get(key), key)
        judge.passed("report")
        if path is not None:
            judge.blame("report", f"{other.where} {path}", f"as in {one.where}", "something else")


def _shared(root: Json) -> Json:
    return {k: v for k, v in root.items() if k not in _MACHINE} if isinstance(root, dict) else root


def _difference(one: Json, other: Json, path: str) -> str | None:
    """The first place where two values differ."""
    if isinstance(one, dict) and isinstance(other, dict):
        for key in (*one, *other):
            found = _difference(one.get(key), other.get(key), f"{path}.{key}")
            if found is not None:
                return found
        return None
    if isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        pairs = enumerate(zip(one, other, strict=True))
        places = (_difference(a, b, f"{path}.{i}") for i, (a, b) in pairs)
        return next((place for place in places if place is not None), None)
    return None if one == other else path
