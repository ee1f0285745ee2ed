"""`mlbatch report`: a page of a run."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from mlbatch.cli.parameters import is_stdout, shared, with_parameters


def report(
    source: Annotated[
        Path,
        typer.Argument(
            help="A report (JSON; -: from standard input), or an output of convert with its report "
            "in or next to it.",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            help="The page; -: print it.  [default: OUTPUT.html, or REPORT with suffix .html]",
        ),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(help="Report of the run (JSON). [default: in OUTPUT or next to it]"),
    ] = None,
    **values: Any,
) -> None:
    """Write a page (HTML) of a run: verdict, timeline, fill, clocks, accounts, scans."""
    from mlbatch.bounded import MOST_BYTES
    from mlbatch.errors import UsageError, one_line
    from mlbatch.page import check_page, find_source, shown_scans, source_of_text, write_page
    from mlbatch.page.document import page_text

    if source == Path("-"):
        if output is None:
            raise UsageError(
                "-o: expected a name for the page of standard input, found none; give -o run.html, "
                "or -o - to print it"
            )
        text = sys.stdin.buffer.read(MOST_BYTES + 1)
        if len(text) > MOST_BYTES:
            raise UsageError(
                f"standard input: expected a report, found more than {MOST_BYTES} bytes; give the "
                "report of `mlbatch convert`"
            )
        found = source_of_text(Path("standard input"), text)
    else:
        found = find_source(source, report)
    found = replace(found, scans=shown_scans(values["html_scans"]))
    page = output or found.page
    if is_stdout(output):
        typer.echo(page_text(found), nl=False)
        return
    check_page(page, overwrite=values["overwrite"])
    write_page(page, found)
    typer.echo(one_line(f"wrote {page}"))


with_parameters(report, shared("html_scans", "overwrite", overwrite="Replace an existing page."))
