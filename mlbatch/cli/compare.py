"""`mlbatch compare`: frame-level fusion against windows, on the same recording."""

from __future__ import annotations

import json
import shlex
import sys
from functools import partial
from pathlib import Path
from typing import Annotated, Any, cast

import typer

from mlbatch.cli.parameters import (
    AsJson,
    Recordings,
    Verbose,
    is_stdout,
    shared,
    with_parameters,
)
from mlbatch.errors import UsageError, one_line


def compare(
    recordings: Recordings,
    tolerance: Annotated[
        str,
        typer.Option(
            help="Approximate time: sweeps begin within this many s of each other.", metavar="S"
        ),
    ] = "0.05",
    timeout: Annotated[
        str,
        typer.Option(help="Timeout collate: a set is closed after this many s.", metavar="S"),
    ] = "0.1",
    figures: Annotated[
        Path | None,
        typer.Option(
            help="Also write figures for papers (PDF, PNG); needs the extra plot.", metavar="DIR"
        ),
    ] = None,
    speed: Annotated[
        str | None,
        typer.Option(
            help="Speed of an object on the page, m/s.  [default: 10]",
            metavar="M/S",
            show_default=False,
        ),
    ] = None,
    as_json: AsJson = False,
    verbose: Verbose = False,
    **values: Any,
) -> None:
    """Compare frame-level fusion of lidars with windows: time spans, columns, stale data."""
    from mlbatch.api import run_comparison
    from mlbatch.cli.progress import progress_bar
    from mlbatch.cli.tables import paragraph, table_lines
    from mlbatch.cli.values import long_name
    from mlbatch.page.policies import DEFAULT_MPS
    from mlbatch.python.options import ScanOptions, session_job, window_job

    html = values.pop("html")
    prints_page = is_stdout(html)
    if speed is not None and html is None:
        raise UsageError("--speed: expected a page to print it on, found none; add --html FILE")
    if prints_page and as_json:
        raise UsageError(
            "--html -: expected standard output for the page alone, found --json; leave one out"
        )
    overwrite = values.pop("overwrite")
    options = cast(ScanOptions, values)
    session = session_job(tuple(recordings), options, long_name)
    with progress_bar("compare", is_verbose=verbose) as progress:
        found, written = run_comparison(
            window_job(session, options, long_name),
            tolerance=tolerance,
            timeout=timeout,
            html=None if prints_page else html,
            figures=figures,
            speed=DEFAULT_MPS if speed is None else speed,
            overwrite=overwrite,
            shown=long_name,
            show=partial(typer.echo, nl=False) if prints_page else None,
            command=shlex.join(["mlbatch", *sys.argv[1:]]),
            progress=progress,
        )
    for note in found.notes:
        typer.echo(one_line(f"mlbatch: warning: {note.code}: {note.message}"), err=True)
    if prints_page:
        return
    if as_json:
        typer.echo(json.dumps(found.as_json(), indent=1))
        return
    typer.echo(paragraph(found.title()))
    for line in table_lines(found.rows(), transposable=True):
        typer.echo(line)
    for path in written:
        typer.echo(one_line(f"wrote {path}"))


with_parameters(
    compare,
    shared(
        *("rig", "rate", "metadata", "clock", "html", "overwrite"),
        rate="Windows per second, Hz: 10, 29.97.  [default: rig's, or 10]",
        html="Also write a page (HTML) with plots; -: print only it.",
        overwrite="Replace an existing page and figures.",
    ),
)
