"""What a proof of an output says: its checks, what broke them, and what its format leaves open."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from mlbatch.arrays import BoolArray
from mlbatch.errors import MlbatchError

# Every check with what it proves, in the order in which a verdict shows them.
CHECKS = {
    "container": "files are whole: lengths, indexes, checksums; nothing under .partial",
    "names": "every file of a scan bears its index and slice, and is in its place",
    "layout": "keys or fields of points, their types and shapes",
    "metadata": "rate, slices, sensors, frame and timescale are the same wherever they stand",
    "grid": "windows and slices begin and end on the grid: no gap, no overlap, no drift",
    "index": "index and slice are those of the window, and increase",
    "t_init": "scan 0 begins at t_init, a line of the grid",
    "stamps": "log time, publish time and header stamp are the start of the window",
    "columns": "every column's stamp lies inside its window",
    "order": "stamps never decrease; points lie in the order of their columns",
    "times": "no point is older than its column, or later than its end",
    "finite": "coordinates and ranges are numbers; empty slots of organized scans are empty",
    "geometry": "points lie as far from their sensor as was measured",
    "sensors": "lidar_id names a sensor, that of the column",
    "rings": "rings of different sensors are different, in the order of the sensors",
    "returns": "return types are those of the table",
    "duplicates": "no column is there twice",
    "table": "scans.csv and the scans agree",
    "ledger": "everything that was read is written or counted",
    "report": "counts and figures of the report are those of the output",
    "tf_static": "one message before all others places every sensor",
    "imu": "IMU messages never step back, at the time of their header",
    "messages": "recorded messages that pass through are as many as the report says",
}
# Violations that are kept; all are counted.
MOST_KEPT = 1000


class VerifyError(MlbatchError):
    """An output that cannot be judged: missing, foreign, damaged beyond reading."""


class DamageError(Exception):
    """Bytes that are not what their format wants; says what was wanted and got."""

    def __init__(self, wanted: str, got: str) -> None:
        super().__init__(f"wanted {wanted}, got {got}")
        self.wanted = wanted
        self.got = got


@dataclass(frozen=True, slots=True)
class Violation:
    """What broke a check; `where`: file, then scan, column or point."""

    check: str
    where: str
    wanted: str
    got: str

    def __str__(self) -> str:
        return f"{self.check}: {self.where}: wanted {self.wanted}, got {self.got}"


@dataclass(frozen=True, slots=True)
class Check:
    """Outcome of a check; judged: how many things were held against it; limit: what stays open."""

    name: str
    judged: int
    violations: int
    limit: str

    @property
    def outcome(self) -> str:
        """One of ok, violated, not provable."""
        if self.violations:
            return "violated"
        return "ok" if self.judged else "not provable"


@dataclass(frozen=True, slots=True)
class Verdict:
    """The proof of one output; columns: None where the format does not show them."""

    path: str
    format: str
    scans: int
    points: int
    columns: int | None
    checks: tuple[Check, ...]
    violations: tuple[Violation, ...]

    @property
    def count(self) -> int:
        """All violations, also those that are not kept."""
        return sum(check.violations for check in self.checks)

    @property
    def ok(self) -> bool:
        """Whether nothing was broken."""
        return self.count == 0


@dataclass(slots=True)
class Judge:
    """Collects what was judged and what broke."""

    judged: Counter[str] = field(default_factory=Counter)
    broken: Counter[str] = field(default_factory=Counter)
    violations: list[Violation] = field(default_factory=list)

    def passed(self, check: str, count: int = 1) -> None:
        """Note that `count` things were held against a check."""
        self.judged[check] += count

    def blame(self, check: str, where: str, wanted: object, got: object) -> None:
        """Note a violation."""
        self.broken[check] += 1
        if len(self.violations) < MOST_KEPT:
            self.violations.append(Violation(check, where, _short(wanted), _short(got)))

    def equal(self, check: str, where: str, wanted: object, got: object) -> bool:
        """Hold one value against another."""
        self.judged[check] += 1
        if wanted == got:
            return True
        self.blame(check, where, wanted, got)
        return False

    def none(
        self, check: str, where: str, bad: BoolArray, wanted: str, got: Callable[[int], object]
    ) -> bool:
        """Wanted: nothing is bad. Names the first that is by its flat index, and how many are."""
        self.judged[check] += bad.size
        if not bad.any():
            return True
        first, count = int(bad.argmax()), int(np.count_nonzero(bad))
        more = f" ({count} of {bad.size})" if count > 1 else ""
        self.blame(check, f"{where} {first}", wanted, f"{got(first)}{more}")
        return False

    def checks(self, limits: dict[str, str]) -> tuple[Check, ...]:
        """All checks and their outcome; limits: what stays open in this output, by check."""
        return tuple(
            Check(
                name,
                self.judged[name],
                self.broken[name],
                limits.get(name, "" if self.judged[name] else "nothing of the kind in this output"),
            )
            for name in CHECKS
        )


def _short(value: object) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= 160 else f"{text[:157]}..."
