"""The commands; each imports what it needs when it runs, so that `--help` is fast."""

from __future__ import annotations

import importlib
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

import mlbatch
from mlbatch.errors import UsageError

_PATH_TYPES = ("path", "file", "directory")
# Modules of this package, each with a function of the same name, in the order of `--help`.
COMMANDS = (
    *("convert", "batch", "batch-status", "inspect", "compare", "sensors", "verify", "report"),
    *("digest", "diff", "bench"),
)


# Options that may be `-`, standard output: command and parameter.
PRINTABLE = frozenset({("convert", "report"), ("inspect", "write_rig")})


class Command(TyperCommand):
    """A command that takes `-` for standard output where it can be that, and refuses it elsewhere.

    Otherwise `-` would name a file.
    """

    def invoke(self, ctx: Any) -> Any:
        """Check the paths, run the command."""
        for param in self.params:
            value = ctx.params.get(param.name)
            values = value if isinstance(value, (list, tuple)) else [value]
            is_path = param.type.name in _PATH_TYPES
            if is_path and "-" in map(str, values) and (self.name, param.name) not in PRINTABLE:
                name = param.human_readable_name if param.param_type_name == "argument" else ""
                raise UsageError(
                    f"{name or param.opts[0]}: expected a path, found -: neither standard input "
                    "nor standard output can be used here; give a file or folder"
                )
        return super().invoke(ctx)


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
        word = name.replace("-", "_")
        module = importlib.import_module(f"mlbatch.cli.{word}")
        app.command(cls=Command)(getattr(module, word))
    return app


def root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Show the version.")] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="With --version: the engine, too.")
    ] = False,
) -> None:
    """Time-consistent merged scans from raw packets of many lidars, offline."""
    if version:
        typer.echo(f"mlbatch {mlbatch.__version__}")
        if verbose:
            _print_engine()
        raise typer.Exit
    if context.invoked_subcommand is None:
        typer.echo(context.get_help(), err=True)
        raise typer.Exit(2)


def _print_engine() -> None:
    """Print which engine `auto` chooses, and why it is not the compiled one."""
    from mlbatch.native import BUILD_ADVICE
    from mlbatch.native.library import trouble

    why = trouble()
    typer.echo(f"engine numpy; native: {why}; {BUILD_ADVICE}" if why else "engine native")
