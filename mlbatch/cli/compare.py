"""`mlbatch compare`: frame-level fusion against windows, on the same recording."""

from __future__ import annotations

import json
import math
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mlbatch.cli.parameters import AsJson, Clock, Metadata, Recordings, Verbose, is_stdout
from mlbatch.errors import UsageError, one_line
from mlbatch.options import CLOCKS
from mlbatch.units import NS_PER_S

if TYPE_CHECKING:
    from mlbatch.compare.compare import Comparison


def compare(
    recordings: Recordings,
    rig: Annotated[
        Path | None, typer.Option("--rig", "-r", help="Rig file (YAML).", metavar="FILE")
    ] = None,
    rate: Annotated[
        str | None,
        typer.Option(
            help="Windows per second, Hz: 10, 29.97.  [default: rig's, or 10]", metavar="HZ"
        ),
    ] = None,
    metadata: Metadata = None,
    clock: Clock = "sensor",
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
    html: Annotated[
        Path | None,
        typer.Option(help="Also write a page (HTML) with plots; -: print only it.", metavar="FILE"),
    ] = None,
    figures: Annotated[
        Path | None,
        typer.Option(
            help="Also write figures for papers (PDF, PNG); needs the extra plot.", metavar="DIR"
        ),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an existing page and figures.")
    ] = False,
    as_json: AsJson = False,
    verbose: Verbose = False,
) -> None:
    """Compare frame-level fusion of lidars with windows: time spans, columns, stale data."""
    from mlbatch.cli.progress import progress_bar
    from mlbatch.cli.tables import paragraph, table_lines
    from mlbatch.cli.values import rate as read_rate
    from mlbatch.compare.compare import Settings, compare
    from mlbatch.discovery.discover import SensorSelection
    from mlbatch.pipeline.job import Job
    from mlbatch.python.options import choice
    from mlbatch.readers.inputs import expand

    choice("--clock", clock, CLOCKS)
    settings = Settings(
        _duration_ns("--tolerance", tolerance),
        _duration_ns("--timeout", timeout),
    )
    selection = SensorSelection(rig=rig, metadata=tuple(metadata or ()), host_clock=clock == "host")
    job = Job(expand(recordings), selection, rate=None if rate is None else read_rate(rate))
    prints_page = is_stdout(html)
    if prints_page and as_json:
        raise UsageError(
            "--html -: expected standard output for the page alone, found --json; leave one out"
        )
    if html is not None and not prints_page:
        from mlbatch.page import check_page

        check_page(html, overwrite=overwrite)
    if figures is not None:
        from mlbatch.compare.figures import check_figures

        check_figures(figures, overwrite=overwrite)
    with progress_bar("compare", is_verbose=verbose) as progress:
        found = compare(job, settings, progress)
    for note in found.notes:
        typer.echo(one_line(f"mlbatch: warning: {note.code}: {note.message}"), err=True)
    written = _write_figures(found, figures)
    if html is not None:
        page = _page(found, job.recordings)
        if prints_page:
            typer.echo(page, nl=False)
            return
        from mlbatch.page import write_text_page

        write_text_page(html, page)
        written.append(html)
    if as_json:
        typer.echo(json.dumps(found.as_json(), indent=1))
        return
    typer.echo(paragraph(found.title()))
    for line in table_lines(found.rows(), transposable=True):
        typer.echo(line)
    for path in written:
        typer.echo(one_line(f"wrote {path}"))


def _write_figures(found: Comparison, folder: Path | None) -> list[Path]:
    if folder is None:
        return []
    from mlbatch.compare.figures import write_figures

    return write_figures(folder, found.figures())


def _page(found: Comparison, recordings: Sequence[Path]) -> str:
    from mlbatch.page.comparison import comparison_page

    title = ", ".join(path.name for path in recordings)
    notes = [f"{note.code}: {note.message}" for note in found.notes]
    command = shlex.join(["mlbatch", *sys.argv[1:]])
    return comparison_page(title, found.title(), found.figures(), notes, command)


def _duration_ns(option: str, text: str) -> int:
    """A duration in s, above 0."""
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0 < seconds < math.inf:
        raise UsageError(f"{option}: expected seconds above 0, found {text!r}; write 0.05")
    return round(seconds * NS_PER_S)
