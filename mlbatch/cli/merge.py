"""`mlbatch merge`: the parts of `convert --shard` to one output."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from mlbatch.cli.parameters import shared, with_parameters


def merge(
    parts: Annotated[
        list[Path], typer.Argument(help="Folders of all shards, in any order; they are kept.")
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder of all scans, as of one run.")
    ],
    **values: Any,
) -> None:
    """Join the shards of a conversion to the output of one run."""
    from mlbatch.cli.summary import exit_beyond, print_summary, say
    from mlbatch.errors import one_line
    from mlbatch.pipeline.interrupts import interruptible
    from mlbatch.pipeline.shards import merge as merge_parts
    from mlbatch.pipeline.shards import read_parts
    from mlbatch.reports.limits import exceeded, parse_limits

    limits = parse_limits(values["fail_on"] or ())
    command = shlex.join(["mlbatch", *sys.argv[1:]])
    with interruptible():
        report = merge_parts(
            read_parts(parts),
            output,
            command=command,
            overwrite=values["overwrite"],
            fsync=not values["no_fsync"],
        )
    for item in report.warnings:
        say(f"warning: {item.code}: {item.message}")
    if not values["quiet"]:
        print_summary(report)
        typer.echo(one_line(f"wrote {output}, {len(parts)} shards merged"))
    exit_beyond(exceeded(limits, report))


with_parameters(merge, shared("fail_on", "overwrite", "no_fsync", "quiet", quiet="No summary."))
