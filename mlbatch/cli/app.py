"""All commands; what they need is imported when they run, so that `--help` is quick."""

from __future__ import annotations

from typing import Annotated

import typer

import mlbatch
from mlbatch.cli.bench import bench
from mlbatch.cli.compare import compare
from mlbatch.cli.convert import convert
from mlbatch.cli.inspect import inspect
from mlbatch.cli.sensors import sensors
from mlbatch.cli.verify import verify

app = typer.Typer(
    name="mlbatch",
    help="Time-consistent merged scans from raw packets of many lidars, offline.",
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"mlbatch {mlbatch.__version__}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def root(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Time-consistent merged scans from raw packets of many lidars, offline."""
    if context.invoked_subcommand is None:
        typer.echo(context.get_help(), err=True)
        raise typer.Exit(2)


app.command()(convert)
app.command()(inspect)
app.command()(compare)
app.command()(sensors)
app.command()(verify)
app.command()(bench)
