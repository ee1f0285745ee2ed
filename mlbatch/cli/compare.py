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
    from mlbatch.comparison.compare import Comparison


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
    speed: Annotated[
        str | None,
        typer.Option(
            help="Of an object on the page, m/s.  [default: 10]",
            metavar="M/S",
            show_default=False,
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
    from mlbatch.comparison.compare import Settings, compare
    from mlbatch.discovery.discover import SensorSelection
    from mlbatch.page.policies import DEFAULT_MPS
    from mlbatch.pipeline.job import Job
    from mlbatch.python.options import choice
    from mlbatch.readers.inputs import expand

    choice("--clock", clock, CLOCKS)
    settings = Settings(
        round(_above_0("--tolerance", tolerance, "seconds", "0.05") * NS_PER_S),
        round(_above_0("--timeout", timeout, "seconds", "0.05") * NS_PER_S),
    )
    speed_mps = DEFAULT_MPS if speed is None else _above_0("--speed", speed, "m/s", "10")
    if speed is not None and html is None:
        raise UsageError("--speed: expected a page to print it on, found none; add --html FILE")
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
        from mlbatch.comparison.figures import check_figures

        check_figures(figures, overwrite=overwrite)
    with progress_bar("compare", is_verbose=verbose) as progress:
        found = compare(job, settings, progress, finds_instant=html is not None)
    for note in found.notes:
        typer.echo(one_line(f"mlbatch: warning: {note.code}: {note.message}"), err=True)
    written = _write_figures(found, figures)
    if html is not None:
        page = _page(found, job.recordings, speed_mps)
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
    from mlbatch.comparison.figures import write_figures

    return write_figures(folder, found.figures())


def _page(found: Comparison, recordings: Sequence[Path], speed_mps: float) -> str:
    from mlbatch.page.comparison import comparison_page

    title = ", ".join(path.name for path in recordings)
    notes = [f"{note.code}: {note.message}" for note in found.notes]
    command = shlex.join(["mlbatch", *sys.argv[1:]])
    figures = found.figures()
    return comparison_page(title, found.title(), figures, notes, command, found.instant, speed_mps)


def _above_0(option: str, text: str, unit: str, example: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise UsageError(f"{option}: expected {unit} above 0, found {text!r}; write {example}")
    return value
