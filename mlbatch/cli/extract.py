"""`mlbatch extract`: raw packets of chosen lidars and times, into another container."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, cast

import typer

from mlbatch.cli.parameters import Recordings, Verbose, shared, with_parameters
from mlbatch.errors import one_line


def extract(
    recordings: Recordings,
    output: Annotated[
        Path,
        typer.Option("-o", "--output", help="Recording to write: .pcap, .mcap, .db3 or .bag."),
    ],
    duration: Annotated[
        float | None,
        typer.Option(help="Instead of --end: s after the start.", metavar="S"),
    ] = None,
    verbose: Verbose = False,
    **values: Any,
) -> None:
    """Extract raw packets of lidars and times, unchanged, into another container."""
    from mlbatch.cli.progress import progress_bar
    from mlbatch.cli.tables import paragraph, table_lines
    from mlbatch.cli.values import long_name
    from mlbatch.pipeline.extract import extract as extract_packets
    from mlbatch.pipeline.interrupts import interruptible
    from mlbatch.python.extract import ExtractOptions, extraction

    quiet, passed = values.pop("quiet"), values.pop("pass_")
    options = cast(ExtractOptions, {**values, "duration": duration, "copy_topics": passed})
    request = extraction(tuple(recordings), output, options, long_name)
    with interruptible(), progress_bar("extract", is_shown=not quiet, is_verbose=verbose) as shown:
        found = extract_packets(request, shown)
    for note in found.notes:
        typer.echo(one_line(f"mlbatch: warning: {note}"), err=True)
    if quiet:
        return
    for line in table_lines(found.rows()):
        typer.echo(line)
    for line in found.lines():
        typer.echo(paragraph(line))


with_parameters(
    extract,
    shared(
        *("rig", "metadata", "only", "ignore", "start", "end", "pass", "overwrite", "quiet"),
        rig="Rig file (YAML); one for the output is written.",
        start="Packets received at or after: epoch s, ISO time (UTC), or +S after the first.",
        end="Packets received before: as --start.",
        overwrite="Replace existing files.",
        quiet="No counts, no progress.",
    ),
)
