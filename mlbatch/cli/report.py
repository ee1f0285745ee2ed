"""`mlbatch report`: a page of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def report(
    source: Annotated[
        Path,
        typer.Argument(
            help="A report (JSON), or an output of convert with its report in or next to it.",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", help="The page. [default: OUTPUT.html, or REPORT with suffix .html]"
        ),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(help="Report of the run (JSON). [default: in OUTPUT or next to it]"),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing page.")] = (
        False
    ),
) -> None:
    """Write a page (HTML) of a run: verdict, timeline, fill, clocks, accounts, scans."""
    from mlbatch.errors import one_line
    from mlbatch.page import check_page, find_source, write_page

    found = find_source(source, report)
    page = output or found.page
    check_page(page, overwrite=overwrite)
    write_page(page, found)
    typer.echo(one_line(f"wrote {page}"))
