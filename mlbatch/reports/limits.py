"""`--fail-on`: limits of a run's report that turn a complete output into exit code 3."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
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
        unit, is_share = _QUANTITIES[self.quantity]
        for owner, (part, whole) in _amounts(self.quantity, report).items():
            share = 100 * part / whole if whole else 0.0
            if (share if self.unit else part) > self.most:
                found = f"{part} of {whole} ({share:.4g} %)" if is_share else str(part)
                sensor = f"{owner}: " if owner else ""
                return f"{self.text}: found {sensor}{found} {unit}"
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
    if name not in _QUANTITIES:
        known = ", ".join((*_QUANTITIES, POSE))
        raise UsageError(f"--fail-on: expected one of {known}, found {name!r}; {_EXAMPLE}")
    words, is_share = _QUANTITIES[name]
    if unit and (unit != "%" or not is_share):
        raise UsageError(
            f"--fail-on: expected a number of {words}, found {text.strip()!r}; "
            f"write {name}>{number}"
        )
    return Limit(text.strip(), name, float(number), unit)


# -- quantities -----------------------------------------------------------------------------------


# Unit for people, and whether an amount is a share of its whole.
_QUANTITIES: Mapping[str, tuple[str, bool]] = {
    "loss": ("packets lost", True),
    "rejected": ("packets rejected", True),
    "underfilled": ("scans underfilled", True),
    "incomplete": ("scans incomplete", True),
    "no_points": ("scans without its points", True),
    "empty_clouds": ("clouds without points", False),
    "empty": ("windows empty", False),
    "dropped_incomplete": ("windows left out", False),
    "cut_off": ("recordings cut off", False),
    "warnings": ("warnings", False),
}


def _amounts(quantity: str, report: RunReport) -> dict[str, Amount]:
    """Amounts of a quantity by sensor, or of the run ("")."""
    scans = report.scans
    packets = {sensor.name: sensor.ledger.packets for sensor in report.sensors}
    codes = [one.code for one in report.warnings]
    if quantity == "loss":
        return {name: (one.lost, one.lost + one.accepted) for name, one in packets.items()}
    if quantity == "rejected":
        return {name: (sum(one.rejected.values()), one.read) for name, one in packets.items()}
    if quantity == "no_points":
        return {name: (count, scans.written) for name, count in scans.no_points.items()}
    if quantity == "cut_off":
        return {"": (codes.count(CUT_OFF), 0)}
    if quantity == "warnings":
        return {"": (sum(code not in ACCEPTED_WARNINGS for code in codes), 0)}
    return {"": (getattr(scans, quantity), scans.written)}
