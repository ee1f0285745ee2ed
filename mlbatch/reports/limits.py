"""`--fail-on`: limits of a run's report that turn a complete output into exit code 3."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import NamedTuple, TypeAlias

from mlbatch.errors import UsageError
from mlbatch.reports.poses import MISFIT
from mlbatch.reports.report import ACCEPTED_WARNINGS, CUT_OFF, RunReport

# A part and the whole that it is a share of; 0: it is a share of nothing.
Amount: TypeAlias = tuple[int, int]

_LIMIT = r"\s*([a-z_]+)\s*>\s*(\d+(?:\.\d*)?|\.\d+)\s*(%|[a-z]*)\s*"
# Of residuals of poses: in mm, or degrees.
POSE = "pose"
_UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "deg": 1.0}
_EXAMPLE = "write loss>0.1%,underfilled>0"


class Limit(NamedTuple):
    """A limit of one quantity: a number, a share in percent, or a shift or turn with its unit."""

    text: str
    quantity: str
    most: float
    unit: str

    def exceeded(self, report: RunReport) -> str:
        """Text that says how the limit is exceeded; "" if it is not."""
        if self.quantity == POSE:
            return self._exceeded_by_pose(report)
        quantity = _QUANTITIES[self.quantity]
        for owner, (part, whole) in quantity.amounts(report):
            share = 100 * part / whole if whole else 0.0
            if (share if self.unit else part) > self.most:
                found = f"{part} of {whole} ({share:.4g} %)" if quantity.is_share else str(part)
                sensor = f"{owner}: " if owner else ""
                return f"{self.text}: found {sensor}{found} {quantity.unit}"
        return ""

    def _exceeded_by_pose(self, report: RunReport) -> str:
        """By two standard deviations, or by surfaces that do not fit at all."""
        for pair in () if report.poses is None else report.poses.pairs:
            found, sigma = pair.shift_mm, pair.shift_deviation_mm
            if self.unit == "deg":
                found, sigma = pair.turn_deg, pair.turn_deviation_deg
            is_beyond = found is not None and (
                found - 2 * (sigma or 0.0) > self.most * _UNITS[self.unit]
            )
            if is_beyond or pair.outcome == MISFIT:
                return f"{self.text}: found {pair.describe()}"
        return ""


def parse_limits(texts: Sequence[str]) -> tuple[Limit, ...]:
    """Values of `--fail-on`, each one limit or several, separated by commas."""
    return tuple(_parsed(part) for text in texts for part in text.split(","))


def exceeded(limits: Sequence[Limit], report: RunReport) -> list[str]:
    """One line for each limit that is exceeded."""
    return [line for limit in limits if (line := limit.exceeded(report))]


def not_covered(limits: Sequence[Limit], report: RunReport) -> list[str]:
    """One line for each pair of lidars that a limit of poses says nothing, or not all, about."""
    return [
        f"{limit.text}: {gap}"
        for limit in limits
        if limit.quantity == POSE
        for gap in (["not checked"] if report.poses is None else report.poses.gaps())
    ]


def _parsed(text: str) -> Limit:
    found = re.fullmatch(_LIMIT, text, re.ASCII)
    if found is None:
        raise UsageError(
            f"--fail-on: expected NAME>NUMBER or NAME>NUMBER%, found {text!r}; {_EXAMPLE}"
        )
    name, number, unit = found.groups()
    if name == POSE:
        if unit not in _UNITS:
            raise UsageError(
                f"--fail-on: expected {POSE}>NUMBER with mm, cm, m or deg, found "
                f"{text.strip()!r}; write {POSE}>5cm"
            )
        return Limit(text.strip(), name, float(number), unit)
    quantity = _QUANTITIES.get(name)
    if quantity is None:
        known = ", ".join((*_QUANTITIES, POSE))
        raise UsageError(f"--fail-on: expected one of {known}, found {name!r}; {_EXAMPLE}")
    if unit and (unit != "%" or not quantity.is_share):
        raise UsageError(
            f"--fail-on: expected a number of {quantity.unit}, found {text.strip()!r}; "
            f"write {name}>{number}"
        )
    return Limit(text.strip(), name, float(number), unit)


# -- quantities -----------------------------------------------------------------------------------


def _loss(report: RunReport) -> Iterator[tuple[str, Amount]]:
    for sensor in report.sensors:
        packets = sensor.ledger.packets
        yield sensor.name, (packets.lost, packets.lost + packets.accepted)


def _rejected(report: RunReport) -> Iterator[tuple[str, Amount]]:
    for sensor in report.sensors:
        packets = sensor.ledger.packets
        yield sensor.name, (sum(packets.rejected.values()), packets.read)


def _scans(report: RunReport, key: str) -> Iterator[tuple[str, Amount]]:
    yield "", (getattr(report.scans, key), report.scans.written)


def _without_points(report: RunReport) -> Iterator[tuple[str, Amount]]:
    for name, count in report.scans.no_points.items():
        yield name, (count, report.scans.written)


def _cut_off(report: RunReport) -> Iterator[tuple[str, Amount]]:
    yield "", (sum(one.code == CUT_OFF for one in report.warnings), 0)


def _warnings(report: RunReport) -> Iterator[tuple[str, Amount]]:
    yield "", (sum(one.code not in ACCEPTED_WARNINGS for one in report.warnings), 0)


class _Quantity(NamedTuple):
    """A quantity of a report.

    unit: for people; amounts: name of the sensor ("": the run) and amount; is_share: whether the
    amount is a part of its whole.
    """

    unit: str
    amounts: Callable[[RunReport], Iterator[tuple[str, Amount]]]
    is_share: bool = True


_QUANTITIES: Mapping[str, _Quantity] = {
    "loss": _Quantity("packets lost", _loss),
    "rejected": _Quantity("packets rejected", _rejected),
    "underfilled": _Quantity("scans underfilled", partial(_scans, key="underfilled")),
    "incomplete": _Quantity("scans incomplete", partial(_scans, key="incomplete")),
    "no_points": _Quantity("scans without its points", _without_points),
    "empty_clouds": _Quantity("clouds without points", partial(_scans, key="empty_clouds"), False),
    "empty": _Quantity("windows empty", partial(_scans, key="empty"), False),
    "dropped_incomplete": _Quantity(
        "windows left out", partial(_scans, key="dropped_incomplete"), False
    ),
    "cut_off": _Quantity("recordings cut off", _cut_off, False),
    "warnings": _Quantity("warnings", _warnings, False),
}
