"""`mlbatch calibrate`: poses of the lidars of a rig, from a recording."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path
from typing import Annotated, Any, cast

import typer

from mlbatch.cli.parameters import AsJson, Recordings, Verbose, shared, with_parameters
from mlbatch.errors import one_line


def calibrate(
    recordings: Recordings,
    rig: Annotated[
        Path,
        typer.Option(
            *("--rig", "-r"),
            help="Rig file (YAML) with a guess of each pose, within 20 degrees and 1 m.",
            metavar="FILE",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Rig file to write.  [default: none]", metavar="FILE"),
    ] = None,
    time_offset: Annotated[
        bool,
        typer.Option("--time-offset", help="Also find the delay of each lidar's timestamps."),
    ] = False,
    from_motion: Annotated[
        bool,
        typer.Option(
            "--from-motion", help="Begin with poses by the motion of each lidar, without a guess."
        ),
    ] = False,
    as_json: AsJson = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")] = False,
    verbose: Verbose = False,
    **values: Any,
) -> None:
    """Refine the poses of a rig's lidars by the surfaces that they share."""
    from mlbatch.api import run_calibration
    from mlbatch.cli.progress import progress_bar, stage_lines
    from mlbatch.cli.tables import paragraph, table_lines
    from mlbatch.cli.values import long_name
    from mlbatch.python.calibrate import CalibrateOptions, calibrate_job

    html, overwrite = values.pop("html"), values.pop("overwrite")
    options = cast(CalibrateOptions, values)
    job = calibrate_job(tuple(recordings), rig, options, from_motion=from_motion, shown=long_name)
    with (
        progress_bar("calibrate", is_shown=not quiet, is_verbose=verbose) as progress,
        stage_lines("calibrate", is_shown=not quiet),
    ):
        found = run_calibration(
            job,
            output,
            html,
            time_offset=time_offset,
            from_motion=from_motion,
            overwrite=overwrite,
            command=shlex.join(["mlbatch", *sys.argv[1:]]),
            progress=progress,
        )
    if as_json:
        typer.echo(json.dumps(found.as_json(), indent=1))
        return
    typer.echo(paragraph(found.title()))
    for line in table_lines(found.rows()):
        typer.echo(line)
    for rows in (found.pair_rows() if found.pairs else [], found.imu_rows()):
        for line in ["", *table_lines(rows)] if rows else []:
            typer.echo(line)
    for note in found.notes():
        typer.echo("")
        typer.echo(paragraph(f"note: {note}"))
    for path in (output, html):
        if path is not None:
            typer.echo(one_line(f"wrote {path}"))


with_parameters(
    calibrate,
    shared(
        *("metadata", "only", "clock", "align_clocks", "start", "end", "html", "overwrite"),
        start="First time: ISO, epoch seconds, +S from the start.",
        end="Time to stop before, as --start.",
        align_clocks="Align clocks that are not synchronised.",
        html="Also write a page (HTML): before and after.",
        overwrite="Replace an existing rig file and page.",
    ),
)
