"""`mlbatch verify`: checks of an output from the output alone."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mlbatch.cli.parameters import AsJson, Verbose

if TYPE_CHECKING:
    from mlbatch.verification import Verdict

# Violations in text output; the others are counted. JSON has up to 1000.
SHOWN = 20


def verify(
    output: Annotated[
        Path, typer.Argument(help="Output of convert: folder of npz or PLY, .mcap, .bag, rosbag2.")
    ],
    report: Annotated[
        Path | None,
        typer.Option(help="Report of the run (JSON). [default: in OUTPUT or next to it]"),
    ] = None,
    as_json: AsJson = False,
    verbose: Verbose = False,
) -> None:
    """Check grid, order, times, counts and ledgers of an output, from the output alone."""
    from mlbatch.cli.progress import progress_bar
    from mlbatch.verification import VerifyError
    from mlbatch.verification import verify as check

    with progress_bar("verify", unit="scans", is_verbose=verbose) as progress:
        verdict = check(output, report, progress)
    if as_json:
        typer.echo(json.dumps(_values(verdict), indent=1))
    else:
        for line in _lines(verdict):
            typer.echo(line)
    if not verdict.ok:
        violated = sum(one.violations > 0 for one in verdict.checks)
        raise VerifyError(
            f"{output}: expected no violation, found {verdict.count} of {violated} check(s); "
            "see above, and convert again"
        )


def _values(verdict: Verdict) -> dict[str, object]:
    """The verdict as JSON; the names of its fields are fixed."""
    return {
        "schema": "mlbatch.verdict/2",
        "output": verdict.path,
        "format": verdict.format,
        "ok": verdict.ok,
        "scans": verdict.scans,
        "points": verdict.points,
        "columns": verdict.columns,
        "checks": [
            {
                "name": check.name,
                "outcome": check.outcome,
                "checked": check.checked,
                "violations": check.violations,
                "limit": check.limit,
            }
            for check in verdict.checks
        ],
        "violations": [
            {"check": one.check, "where": one.where, "expected": one.expected, "found": one.found}
            for one in verdict.violations
        ],
    }


def _lines(verdict: Verdict) -> list[str]:
    from mlbatch.cli.tables import paragraph, table_lines

    size = f"{verdict.scans} scans, {verdict.points} points"
    if verdict.columns is not None:
        size += f", {verdict.columns} columns"
    rows = [
        (
            check.name,
            str(check.checked or ""),
            f"{check.violations} violated" if check.violations else check.outcome,
            check.limit,
        )
        for check in verdict.checks
    ]
    lines = [paragraph(f"{verdict.path}: {verdict.format}, {size}")]
    lines += table_lines([("check", "checked", "outcome", "not checkable"), *rows])
    shown = verdict.violations[:SHOWN]
    lines += [paragraph(str(one)) for one in shown]
    if verdict.count > len(shown):
        lines.append(f"and {verdict.count - len(shown)} more")
    return lines
