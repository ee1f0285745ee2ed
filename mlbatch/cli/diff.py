"""`mlbatch diff`: two outputs, array by array."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated

import typer

from mlbatch.cli.parameters import AsJson

if TYPE_CHECKING:
    from mlbatch.digests.diff import FieldDifference, OutputDiff

# Differences of the run, and scans of one output only, that are printed; the others are counted.
SHOWN = 20


def diff(
    a: Annotated[
        str, typer.Argument(metavar="A", help="Output of convert, of any format, or its URL.")
    ],
    b: Annotated[str, typer.Argument(metavar="B", help="Output to compare with it.")],
    tolerance: Annotated[
        float,
        typer.Option(help="Allowed difference of coordinates and ranges (m) and intensities."),
    ] = 0.0,
    as_json: AsJson = False,
) -> None:
    """Compare two outputs: first differing scan, field and point, and by how much; exit 1."""
    from mlbatch.batch.remote import local_output
    from mlbatch.digests.diff import check_tolerance
    from mlbatch.digests.diff import diff as compare
    from mlbatch.errors import RecordingError, one_line

    check_tolerance(tolerance)
    with local_output(a) as one, local_output(b) as other:
        found = compare(one, other, tolerance)
    if as_json:
        typer.echo(json.dumps(_values(a, b, found), indent=1))
    else:
        for line in _lines(found):
            typer.echo(one_line(line))
    if not found.same:
        raise RecordingError(
            f"{b}: expected the scans of {a}, found differences; see above, or allow for "
            "rounding with --tolerance"
        )


def _values(a: str, b: str, found: OutputDiff) -> dict[str, object]:
    """The differences as JSON."""
    from dataclasses import asdict

    return {
        "schema": "mlbatch.diff/1",
        "a": a,
        "b": b,
        "same": found.same,
        "compared": found.compared,
        "run": [{"where": one.where, "a": one.expected, "b": one.found} for one in found.run],
        "only_in_a": found.only_in_a,
        "only_in_b": found.only_in_b,
        "first": None if found.first is None else asdict(found.first),
        "fields": [asdict(one) for one in found.fields.values()],
    }


def _lines(found: OutputDiff) -> list[str]:
    from mlbatch.cli.tables import table_lines

    if found.same:
        return [f"the same: {found.compared} scans"]
    lines = _some([f"{one.where}: {one.expected} in A, {one.found} in B" for one in found.run])
    for name, scans in (("A", found.only_in_a), ("B", found.only_in_b)):
        lines += _some([f"scan {scan}: only in {name}" for scan in scans])
    first = found.first
    if first is None:
        return [*lines, f"{found.compared} scans in both have the same points"]
    lines.append(f"first difference: scan {first.scan}, {first.field}, {_point(first)}")
    head = ("field", "scans", "values", "first scan", "point", "largest difference")
    rows = [
        (
            one.field,
            str(one.scans),
            str(one.values or ""),
            one.scan,
            str(one.point),
            "" if one.by is None else f"{one.by:g}",
        )
        for one in found.fields.values()
    ]
    return [*lines, f"of {found.compared} scans in both:", *table_lines([head, *rows])]


def _some(lines: list[str]) -> list[str]:
    left = len(lines) - SHOWN
    return [*lines[:SHOWN], f"and {left} more"] if left > 0 else lines


def _point(one: FieldDifference) -> str:
    if one.by is None:
        return f"from point {one.point} on: shape {one.a} in A, {one.b} in B"
    return f"point {one.point}: {one.a} in A, {one.b} in B"
