"""`mlbatch extract`: raw packets of chosen lidars and times, into another container."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mlbatch.cli.parameters import Metadata, Recordings, Verbose
from mlbatch.errors import one_line


def extract(
    recordings: Recordings,
    output: Annotated[
        Path,
        typer.Option("-o", "--output", help="Recording to write: .pcap, .mcap, .db3 or .bag."),
    ],
    rig: Annotated[
        Path | None,
        typer.Option(
            "--rig", "-r", help="Rig file (YAML); one for the output is written.", metavar="FILE"
        ),
    ] = None,
    metadata: Metadata = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            "--only", help="Extract this lidar (name or serial); repeatable.", metavar="NAME"
        ),
    ] = None,
    ignore: Annotated[
        list[str] | None,
        typer.Option(
            "--ignore",
            help="Leave out this lidar (name, serial number, topic or IP:PORT); repeatable.",
            metavar="NAME",
        ),
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(
            help="Packets received at or after: epoch s, ISO time (UTC), or +S after the first.",
            metavar="T",
        ),
    ] = None,
    end: Annotated[
        str | None, typer.Option(help="Packets received before: as --start.", metavar="T")
    ] = None,
    duration: Annotated[
        float | None,
        typer.Option(help="Instead of --end: s after the start.", metavar="S"),
    ] = None,
    passed: Annotated[
        list[str] | None,
        typer.Option(
            "--pass", help="Copy this topic (or pattern) of a bag; repeatable.", metavar="TOPIC"
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No counts, no progress.")] = False,
    verbose: Verbose = False,
) -> None:
    """Extract raw packets of lidars and times, unchanged, into another container."""
    from mlbatch.cli.progress import progress_bar
    from mlbatch.cli.tables import paragraph, table_lines
    from mlbatch.pipeline.extract import extract as extract_packets
    from mlbatch.pipeline.interrupts import interruptible
    from mlbatch.python.extract import extraction

    request = extraction(
        tuple(recordings),
        output,
        {
            "rig": rig,
            "metadata": metadata or (),
            "only": only or (),
            "ignore": ignore or (),
            "start": start,
            "end": end,
            "duration": duration,
            "copy_topics": passed or (),
            "overwrite": overwrite,
        },
        lambda name: f"--{name}",
    )
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
