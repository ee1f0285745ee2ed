"""`mlbatch view`: scans in the browser, from a server on this machine."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mlbatch import options
from mlbatch.cli.parameters import parameter, with_parameters
from mlbatch.errors import UsageError, one_line

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from mlbatch.discovery.types import Note
    from mlbatch.outputs.scan import Scan
    from mlbatch.pipeline.job import Job

# Of `convert`: what selects lidars, times and points.
OPTIONS = (
    *("rig", "metadata", "identity_extrinsics", "rate", "deskew", "start", "end"),
    *("only", "ignore", "min_range", "exclude_box", "clock", "align_clocks"),
)


def view(
    sources: Annotated[
        list[Path],
        typer.Argument(
            help="Output of convert, or recordings of one session, converted while they are shown.",
            metavar="OUTPUT|RECORDING...",
        ),
    ],
    port: Annotated[
        int, typer.Option(help="Port of the page.  [default: a free one]", show_default=False)
    ] = 0,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Open no browser, print the address alone.")
    ] = False,
    **values: Any,
) -> None:
    """Show the scans of an output or a recording in the browser, on this machine alone."""
    from mlbatch.page.view_server import ViewScans, ViewServer
    from mlbatch.pipeline.interrupts import interruptible

    begin, total, job = _source(sources, values)
    title = ", ".join(path.name or str(path) for path in sources)
    with interruptible():
        scans = ViewScans(
            begin, lambda text: typer.echo(f"mlbatch: error: {one_line(text)}", err=True)
        )
        try:
            expected = None if job is None else _expected(job, scans.first)
            with ViewServer(title, scans, total, port, expected) as server:
                typer.echo(f"{server.url} shows {one_line(title)}; Ctrl-C ends")
                sys.stdout.flush()
                # Elsewhere only a browser in the terminal could be opened.
                has_screen = sys.platform != "linux" or any(
                    map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY"))
                )
                if not no_browser and has_screen:
                    import webbrowser

                    # Some browsers return when they end.
                    threading.Thread(target=webbrowser.open, args=[server.url], daemon=True).start()
                # Ctrl-C is the usual end.
                with contextlib.suppress(KeyboardInterrupt):
                    server.serve_forever()
        finally:
            scans.close()
    if scans.error:
        raise typer.Exit(1)


with_parameters(view, (parameter(options.BY_NAME[name]) for name in OPTIONS))


def _source(
    paths: list[Path], values: dict[str, Any]
) -> tuple[Callable[[], Iterator[Scan]], int | None, Job | None]:
    """Return a function that starts the scans, their number if known, and the job of recordings."""
    from mlbatch.outputs.read import read
    from mlbatch.outputs.run_files import RunFiles, is_output

    if len(paths) == 1 and is_output(paths[0]):
        for name in OPTIONS:
            if (values[name] or None) not in (None, options.BY_NAME[name].default):
                raise UsageError(
                    f"{options.BY_NAME[name].long}: expected with recordings alone, found the "
                    f"output {paths[0]}, which is shown as it is; leave it out"
                )
        table = RunFiles.of(paths[0]).texts()[1]
        total = None if table is None else _windows_of(table)
        return lambda: read(paths[0], by_window=True), total, None
    from mlbatch.cli.values import job_of
    from mlbatch.python.recording import scans_of

    job = job_of(paths, {"no_pose_check": True} | values)
    said: set[Note] = set()

    def warn(note: Note) -> None:
        # Scans are made anew to go back.
        if note not in said:
            typer.echo(one_line(f"mlbatch: warning: {note.code}: {note.message}"), err=True)
        said.add(note)

    return lambda: scans_of(job, warn), None, job


def _expected(job: Job, first: Scan) -> int | None:
    """About how many scans recordings have, by their ends; None where only reading shows them."""
    from mlbatch.pipeline.contents import recording_report
    from mlbatch.readers import open_recordings
    from mlbatch.types import StreamTable
    from mlbatch.units import NS_PER_S, parse_rate

    opened = open_recordings(job.recordings, StreamTable(), job.selection.rig)
    lasts_ns = [recording_report(one).last_host_ns for one in opened]
    known_ns = [last_ns for last_ns in lasts_ns if last_ns is not None]
    if len(known_ns) < len(lasts_ns) or not first.ready_host_ns:
        return None
    periods = (max(known_ns) - first.ready_host_ns) * parse_rate(first.rate_hz) / NS_PER_S
    return 1 + max(0, round(periods))


def _windows_of(table: str) -> int:
    """Number of windows in scans.csv."""
    import numpy as np

    from mlbatch.outputs.table import read_table

    return len(np.unique(read_table(table, "scans.csv")["start_ns"]))
