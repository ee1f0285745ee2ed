"""`mlbatch inspect`: content of a recording."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from mlbatch.cli.parameters import AsJson, Recordings, Verbose, shared, with_parameters
from mlbatch.errors import one_line


def inspect(
    recordings: Recordings,
    whole: Annotated[
        bool,
        typer.Option("--whole", help="Packets, loss and clocks of the whole recording, not 10 s."),
    ] = False,
    as_json: AsJson = False,
    write_rig: Annotated[
        Path | None,
        typer.Option(
            help="Write a rig file that `convert` accepts; -: print only it.", metavar="FILE"
        ),
    ] = None,
    verbose: Verbose = False,
    **values: Any,
) -> None:
    """Show streams, sensors, modes, rates, loss, clocks and extrinsics (from the first 10 s)."""
    from mlbatch.cli.progress import progress_bar
    from mlbatch.cli.tables import fits, paragraph, table_lines
    from mlbatch.pipeline.inspect import inspect as inspect_recordings
    from mlbatch.readers.inputs import expand

    rig = values["rig"]
    if values["dataset"] is not None:
        from mlbatch.rig.recipes import rig_of

        rig = rig_of(rig, values["dataset"])
    prints_rig = write_rig == Path("-")
    if prints_rig and as_json:
        from mlbatch.errors import UsageError

        raise UsageError(
            "--write-rig -: expected standard output for the rig alone, found --json; leave one out"
        )
    with progress_bar("inspect", is_shown=whole, is_verbose=verbose) as progress:
        found = inspect_recordings(
            expand(recordings),
            tuple(values["metadata"] or ()),
            rig=rig,
            whole=whole,
            progress=progress,
        )
    if prints_rig:
        typer.echo(found.rig_text(Path()), nl=False)
        for note in found.notes:
            typer.echo(one_line(f"mlbatch: note: {note}"), err=True)
        return
    if write_rig is not None:
        from mlbatch.errors import ExportError
        from mlbatch.writers.atomic import write_text

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
    if found.topics:
        _print("", *table_lines(found.topic_rows()))
    _print("", *table_lines(found.recording_rows()))
    if found.clocks is not None:
        _print("", *map(paragraph, found.clock_lines()))
        matrix = found.clock_matrix()
        if matrix:
            rows = matrix if fits(matrix) else found.clocks_to_reference()
            _print("", *table_lines(rows))
    if found.point_times:
        _print("", *(paragraph(one.describe()) for one in found.point_times))
    if found.poses is not None:
        _print("", *map(paragraph, found.pose_lines()))
    for note in found.notes:
        typer.echo(paragraph(f"note: {note}"))
    if write_rig is not None:
        typer.echo(one_line(f"wrote {write_rig}"))


with_parameters(
    inspect,
    shared("rig", "dataset", "metadata", rig="Rig file (YAML): its sensors, names and poses."),
)


def _print(*lines: str) -> None:
    for line in lines:
        typer.echo(line)
