"""Proof of an output from the output alone: `verify(path)` gives a `Verdict`.

Nothing here is shared with the writers but the types: grid, formats and point layouts are written
down once more, so that a fault on one side does not hide on the other.
"""

from __future__ import annotations

from pathlib import Path

from mlbatch.verify.outputs import Proof, examine
from mlbatch.verify.report_checks import Beside
from mlbatch.verify.verdict import (
    CHECKS,
    Check,
    Judge,
    Verdict,
    VerifyError,
    Violation,
)

__all__ = ["CHECKS", "Check", "Verdict", "VerifyError", "Violation", "verify"]

_PARTIAL = ".partial"


def verify(path: Path, report: Path | None = None) -> Verdict:
    """Prove an output; report: where the run was told to put it, None for its usual place.

    Raises VerifyError where there is nothing to judge.
    """
    if path.name.endswith(_PARTIAL):
        raise VerifyError(
            f"{path}: wanted a finished output, got what an unfinished run left; convert again"
        )
    if not path.exists():
        raise VerifyError(f"{path}: wanted an output, got no such file or folder; check the name")
    judge = Judge()
    left = path.with_name(path.name + _PARTIAL)
    judge.passed("container")
    if left.exists():
        judge.blame("container", left.name, "no unfinished run beside the output", "one")
    return examine(Proof(path, Beside.of(path, report), report is not None, judge))
