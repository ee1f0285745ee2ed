"""The commands; each imports what it needs when it runs, so that `--help` is fast."""

from __future__ import annotations

import importlib
from typing import Annotated

import typer

import mlbatch

# Modules of this package, each with a function of the same name, in the order of `--help`.
COMMANDS = ("convert", "inspect", "compare", "sensors", "verify", "bench")


def command_line(first: str = "") -> typer.Typer:
    """The parser of a command line; first: its first word.

    If that is a command, the others are left out, since describing each takes time.
    """
    app = typer.Typer(
        name="mlbatch",
        help="Time-consistent merged scans from raw packets of many lidars, offline.",
        add_completion=False,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
    )
    app.callback(invoke_without_command=True)(root)
    for name in (first,) if first in COMMANDS else COMMANDS:
        module = importlib.import_module(f"mlbatch.cli.{name}")
        app.command()(getattr(module, name))
    return app


def _version(is_given: bool) -> None:
    if is_given:
        typer.echo(f"mlbatch {mlbatch.__version__}")
        raise typer.Exit


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
