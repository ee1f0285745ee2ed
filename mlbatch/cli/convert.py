"""`mlbatch convert`: the main job."""

import sys
from typing import Any

import typer

from mlbatch import options
from mlbatch.cli.parameters import Recordings, parameter, with_parameters


def convert(
    recordings: Recordings,
    **values: Any,
) -> None:
    """Turn raw lidar packets into merged scans at an exact rate."""
    # As a path, s3://bucket/name is s3:/bucket/name.
    given = (*recordings, *(values["metadata"] or ()), values["output"], values["rig"])
    paths = [str(path).partition(":/") for path in given]
    if any(colon and scheme.isalnum() for scheme, colon, _ in paths):
        from mlbatch.cli.convert_remote import convert_remote

        return convert_remote(sys.argv[2:])
    from mlbatch.cli.run import run
    from mlbatch.cli.values import job_of, target_of

    if values["engine"]:
        typer.echo("mlbatch: --engine is ignored, since everything is compiled", err=True)
    run(job_of(recordings, values), target_of(values))


with_parameters(convert, map(parameter, options.CONVERT))
