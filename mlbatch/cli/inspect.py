"""`mlbatch inspect`: content of a recording."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from mlbatch.errors import one_line


def inspect(
    recordings: Annotated[
        list[Path], typer.Argument(help="Recordings of one session: pcap, pcapng, MCAP, ROS bags.")
    ],
    metadata: Annotated[
        list[Path] | None,
        typer.Option(
            *("--metadata", "-m"),
            help="Metadata or calibration; repeatable.  [default: next to RECORDING]",
            metavar="FILE",
        ),
    ] = None,
    whole: Annotated[
        bool,
        typer.Option("--whole", help="Packets, loss and clocks of the whole recording, not 10 s."),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, for programs.")] = False,
    write_rig: Annotated[
        Path | None,
        typer.Option(
            help="Write a rig file that `convert` accepts; -: print only it.", metavar="FILE"
        ),
    ] = None,
) -> None:
    """Show streams, sensors, modes, rates, loss, clocks and extrinsics (from the first 10 s)."""
    from mlbatch.cli.tables import table_lines
    from mlbatch.discovery.inspect import inspect as inspect_recordings

    prints_rig = write_rig == Path("-")
    if prints_rig and as_json:
        from mlbatch.errors import UsageError

        raise UsageError(
            "--write-rig -: expected standard output for the rig alone, found --json; leave one out"
        )
    found = inspect_recordings(tuple(recordings), tuple(metadata or ()), whole=whole)
    if prints_rig:
        typer.echo(found.rig_text(Path()), nl=False)
        for note in found.notes:
            typer.echo(one_line(f"mlbatch: note: {note}"), err=True)
        return
    if write_rig is not None:
        from mlbatch.errors import ExportError
        from mlbatch.writers import write_text

        if write_rig.exists():
            raise ExportError(
                f"{write_rig}: expected a new rig file, found an existing one; choose another name"
            )
        write_text(write_rig, found.rig_text(write_rig.parent))
    if as_json:
        typer.echo(json.dumps(found.as_json(), indent=1))
        return
    for line in table_lines(found.rows()):
        typer.echo(line)
    if found.clocks is not None:
        typer.echo("\n" + "\n".join(found.clock_lines()))
    for note in found.notes:
        typer.echo(one_line(f"note: {note}"))
    if write_rig is not None:
        typer.echo(f"wrote {write_rig}")
