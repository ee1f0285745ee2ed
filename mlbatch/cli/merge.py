"""`mlbatch merge`: the parts of `convert --shard` to one output."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer


def merge(
    parts: Annotated[
        list[Path], typer.Argument(help="Folders of all shards, in any order; they are kept.")
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder of all scans, as of one run.")
    ],
    fail_on: Annotated[
        list[str] | None,
        typer.Option(
            help="Exit with 3 beyond limits, as loss>0.1%,underfilled>0; repeatable.",
            metavar="LIMITS",
        ),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an existing output.")
    ] = False,
    no_fsync: Annotated[
        bool, typer.Option("--no-fsync", help="Do not wait until the output is on the disk.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No summary.")] = False,
) -> None:
    """Join the shards of a conversion to the output of one run."""
    from mlbatch.cli import EXIT_LIMIT
    from mlbatch.errors import one_line
    from mlbatch.pipeline.interrupts import interruptible
    from mlbatch.pipeline.shard_merge import merge as merge_parts
    from mlbatch.pipeline.shard_merge import read_parts
    from mlbatch.report.limits import exceeded, parse_limits
    from mlbatch.report.report import build_report, summary_lines

    limits = parse_limits(fail_on or ())
    command = shlex.join(["mlbatch", *sys.argv[1:]])
    with interruptible():
        report = merge_parts(
            read_parts(parts), output, command=command, overwrite=overwrite, fsync=not no_fsync
        )
    for item in report.warnings:
        typer.echo(one_line(f"mlbatch: warning: {item.code}: {item.message}"), err=True)
    if not quiet:
        for line in summary_lines(report):
            if not line.startswith("warning "):
                typer.echo(one_line(line))
        typer.echo(one_line(f"wrote {output}, {len(parts)} shards merged"))
    beyond = exceeded(limits, build_report(report))
    for line in beyond:
        typer.echo(one_line(f"mlbatch: limit exceeded: {line}"), err=True)
    if beyond:
        raise typer.Exit(EXIT_LIMIT)
