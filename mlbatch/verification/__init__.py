"""Checks of an output from the output alone: `verify(path)` gives a `Verdict`.

The readers of `outputs` report damage, the modules here check the rest. They define grid,
formats and point layouts a second time: only types are shared with the writers, so that a fault of
the writers is not hidden by the same fault here.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path

from mlbatch.outputs.damage import CHECKS, CheckLog, VerifyError, Violation
from mlbatch.outputs.run_files import RunFiles
from mlbatch.verification.examination import Progress
from mlbatch.verification.outputs import Check, Verdict, check_output

__all__ = ["CHECKS", "Check", "Verdict", "VerifyError", "Violation", "verify"]

_PARTIAL = ".partial"


def verify(
    path: str | PathLike[str],
    report: str | PathLike[str] | None = None,
    progress: Progress | None = None,
) -> Verdict:
    """Check an output; report: path of `--report`, None for the usual one.

    progress: called with the number of scans checked, and of all scans (0: unknown).
    Raises VerifyError if there is nothing to check.
    """
    path = Path(path)
    report = None if report is None else Path(report)
    if path.name.endswith(_PARTIAL):
        raise VerifyError(
            f"{path}: expected a finished output, found that of an unfinished run; convert again"
        )
    if not path.exists():
        raise VerifyError(
            f"{path}: expected an output, found no such file or folder; check the name"
        )
    log = CheckLog()
    # Not by its name: `.` and `/` have none.
    unfinished = Path(f"{path}{_PARTIAL}")
    log.ok("container")
    if unfinished.exists():
        log.fail("container", unfinished.name, "no unfinished run next to the output", "one")
    return check_output(path, RunFiles.of(path, report), log, progress)
