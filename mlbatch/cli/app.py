"""The commands; each imports what it needs when it runs, so that `--help` is fast."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

import mlbatch
from mlbatch.cli import help as help_page
from mlbatch.cli import rig_options
from mlbatch.errors import UsageError

_PATH_TYPES = ("path", "file", "directory")
# Modules of this package, each with a function of the same name, in the order of `--help`.
COMMANDS = (
    *("convert", "merge", "batch", "batch-status", "inspect", "compare", "sensors", "verify"),
    "datasets",
    *("report", "view", "calibrate", "digest", "diff", "extract", "simulate", "schema"),
)


HELP = ("-h", "--help")

# Parameters that may be `-` (standard output or, as a source, standard input), by command.
PRINTABLE = frozenset(
    {
        *(("convert", "report"), ("inspect", "write_rig")),
        *(("report", "source"), ("report", "output"), ("compare", "html")),
    }
)


class Group(TyperGroup):
    """The root: its help lists the commands."""

    def get_help(self, ctx: Any) -> str:
        """Options and commands; on a terminal drawn by rich."""
        if not help_page.is_drawn():
            return super().get_help(ctx)
        groups = help_page.groups_of(self, ctx) | {"Commands": help_page.command_rows(self, ctx)}
        return help_page.drawn(self, ctx, groups)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Commands with their whole summaries, as plain text."""
        with formatter.section("Commands"):
            formatter.write_dl(help_page.command_rows(self, ctx))


class Command(TyperCommand):
    """A command that takes `-` for a standard stream where it can be that; refuses it elsewhere.

    Otherwise `-` would name a file.
    """

    def invoke(self, ctx: Any) -> Any:
        """Check the paths, run the command."""
        for param in self.params:
            value = ctx.params.get(param.name)
            values = value if isinstance(value, (list, tuple)) else [value]
            is_path = param.type.name in _PATH_TYPES
            is_argument = param.param_type_name == "argument"
            name = param.human_readable_name if is_argument else max(param.opts, key=len)
            # As a path, it would be the current folder.
            if is_path and "" in map(str, values):
                raise UsageError(
                    f"{name}: expected a path, found an empty word; check that "
                    "the variable of the shell is set"
                )
            if is_path and "-" in map(str, values) and (self.name, param.name) not in PRINTABLE:
                raise UsageError(
                    f"{name}: expected a path, found -: neither standard input "
                    "nor standard output can be used here; give a file or folder"
                )
        if self.name not in ("convert", "view"):
            return super().invoke(ctx)
        places = rig_options.take(ctx, self.params)
        try:
            return super().invoke(ctx)
        except UsageError as err:
            raise rig_options.located(err, places) from err

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Note whether all options are to be shown."""
        ctx.meta[help_page.HELP_ALL] = help_page.HELP_ALL in args
        return super().parse_args(ctx, args)

    def get_help(self, ctx: Any) -> str:
        """Options in groups; on a terminal drawn by rich."""
        if not help_page.is_drawn():
            return super().get_help(ctx)
        return help_page.drawn(self, ctx, help_page.groups_of(self, ctx))

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Options in groups, as plain text."""
        for title, rows in help_page.groups_of(self, ctx).items():
            with formatter.section(title):
                formatter.write_dl(rows)


def command_line(first: str = "") -> typer.Typer:
    """The parser of a command line; first: its first word.

    If that is a command, the others are left out, since describing each takes time.
    """
    app = typer.Typer(
        name="mlbatch",
        help="Time-consistent merged scans from raw packets of many lidars, offline.",
        cls=Group,
        context_settings={"help_option_names": [*HELP]},
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
    )
    app.callback(invoke_without_command=True)(root)
    for name in (first,) if first in COMMANDS else COMMANDS:
        word = name.replace("-", "_")
        module = importlib.import_module(f"mlbatch.cli.{word}")
        function = getattr(module, word)
        # The page of the root shows no options of commands: describing them takes time.
        described = _summary(function) if first in HELP else function
        words = [*HELP, help_page.HELP_ALL] if name in help_page.COMMON else [*HELP]
        app.command(name, cls=Command, context_settings={"help_option_names": words})(described)
    return app


def _summary(function: Callable[..., None]) -> Callable[[], None]:
    """A command without options, with the summary of another one."""

    def summary() -> None: ...

    summary.__doc__ = function.__doc__
    return summary


def root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Show the version.")] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="With --version: the compiled library, too.")
    ] = False,
) -> None:
    """Time-consistent merged scans from raw packets of many lidars, offline."""
    if version:
        typer.echo(f"mlbatch {mlbatch.__version__}")
        if verbose:
            _print_library()
        raise typer.Exit
    if context.invoked_subcommand is None:
        typer.echo(context.get_help(), err=True)
        raise typer.Exit(2)


def _print_library() -> None:
    """Print whether the compiled library can be used, and why not."""
    from mlbatch.native import BUILD_ADVICE
    from mlbatch.native.library import trouble

    why = trouble()
    typer.echo(f"no compiled library: {why}; {BUILD_ADVICE}" if why else "compiled library: found")
