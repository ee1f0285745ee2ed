"""Damage that readers of outputs find: a log that `verify` listens to.

A reader gives what it can read, and notes what is not as it should be under the name of a check.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from mlbatch.arrays import BoolArray
from mlbatch.errors import RecordingError

# Every check, in the order in which a verdict shows them; docs/verify.md says what each requires.
CHECKS: Final = (
    "container",
    "names",
    "layout",
    "metadata",
    "grid",
    "index",
    "t_init",
    "stamps",
    "columns",
    "order",
    "times",
    "finite",
    "geometry",
    "sensors",
    "rings",
    "returns",
    "duplicates",
    "table",
    "checksum",
    "ledger",
    "report",
    "tf_static",
    "frames",
    "imu",
    "messages",
)
# Violations that are kept; all are counted.
MAX_KEPT = 1000
_MAX_TEXT = 160


class VerifyError(RecordingError):
    """An output that cannot be read: missing, of another program, damaged beyond reading."""


class DamageError(Exception):
    """Bytes that do not follow their format."""

    def __init__(self, expected: str, found: str) -> None:
        super().__init__(f"expected {expected}, found {found}")
        self.expected = expected
        self.found = found


@dataclass(frozen=True, slots=True)
class Violation:
    """A value that breaks a check; `where`: file, then scan, column or point."""

    check: str
    where: str
    expected: str
    found: str

    def __str__(self) -> str:
        return f"{self.check}: {self.where}: expected {self.expected}, found {self.found}"


@dataclass(slots=True)
class CheckLog:
    """Counts checked values and collects violations; KeyError for a check that `CHECKS` lacks."""

    checked: dict[str, int] = field(default_factory=lambda: dict.fromkeys(CHECKS, 0))
    failed: dict[str, int] = field(default_factory=lambda: dict.fromkeys(CHECKS, 0))
    violations: list[Violation] = field(default_factory=list)

    def ok(self, check: str, count: int = 1) -> None:
        """Count `count` checked values."""
        self.checked[check] += count

    def fail(self, check: str, where: str, expected: object, found: object) -> None:
        """Add a violation."""
        self.failed[check] += 1
        if len(self.violations) < MAX_KEPT:
            self.violations.append(Violation(check, where, _short(expected), _short(found)))

    def equal(self, check: str, where: str, expected: object, found: object) -> bool:
        """Check one value against another."""
        self.checked[check] += 1
        if expected == found:
            return True
        self.fail(check, where, expected, found)
        return False

    def none(
        self,
        check: str,
        where: str,
        bad: BoolArray,
        expected: str,
        found: Callable[[int], object],
    ) -> bool:
        """Check that no value is bad; a violation has the flat index of the first, and the count.

        found: value at a flat index.
        """
        self.checked[check] += bad.size
        if not bad.any():
            return True
        first = int(bad.argmax())
        count = int(np.count_nonzero(bad))
        more = f" ({count} of {bad.size})" if count > 1 else ""
        self.fail(check, f"{where} {first}", expected, f"{found(first)}{more}")
        return False


def _short(value: object) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= _MAX_TEXT else f"{text[: _MAX_TEXT - 3]}..."
