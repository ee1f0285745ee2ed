"""The result of `verify`: its checks, the violations, and what an output cannot show."""

from __future__ import annotations

from dataclasses import dataclass

from mlbatch.outputs.damage import CHECKS, CheckLog, Violation


@dataclass(frozen=True, slots=True)
class Check:
    """Outcome of a check."""

    name: str
    # Number of values that were checked.
    checked: int
    # Number of violations, including those that are not kept.
    violations: int
    # Reason why nothing, or only a part, is checkable in this output.
    limit: str

    @property
    def outcome(self) -> str:
        """One of ok, violated, not checkable."""
        if self.violations:
            return "violated"
        return "ok" if self.checked else "not checkable"


@dataclass(frozen=True, slots=True)
class Verdict:
    """The result for one output."""

    path: str
    # As in `convert --format`.
    format: str
    scans: int
    points: int
    # None where the format does not show columns.
    columns: int | None
    checks: tuple[Check, ...]
    violations: tuple[Violation, ...]

    @property
    def count(self) -> int:
        """All violations, also those that are not kept."""
        return sum(check.violations for check in self.checks)

    @property
    def ok(self) -> bool:
        """Whether there is no violation."""
        return self.count == 0


def outcomes(log: CheckLog, limits: dict[str, str]) -> tuple[Check, ...]:
    """All checks; limits: by check, why it is not or only partly checkable."""
    return tuple(
        Check(
            name,
            log.checked[name],
            log.failed[name],
            limits.get(name, "" if log.checked[name] else "no such data in this output"),
        )
        for name in CHECKS
    )
