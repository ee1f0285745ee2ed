"""Final lines and summary of commands that make an output."""

from __future__ import annotations

from collections.abc import Sequence

import typer

from mlbatch.cli import EXIT_LIMIT
from mlbatch.cli.tables import paragraph, table_lines, terminal_width
from mlbatch.errors import one_line
from mlbatch.reports.report import RunReport, summary_lines, summary_rows


def say(text: str) -> None:
    """Print a line to stderr."""
    typer.echo(one_line(f"mlbatch: {text}"), err=True)


def print_summary(report: RunReport) -> None:
    """Print the summary of a run, without its warnings; as a table on a terminal."""
    lines = [line for line in summary_lines(report) if not line.startswith("warning ")]
    if terminal_width() is not None:
        rows = summary_rows(report)
        lines = [*table_lines(rows), *map(paragraph, lines[len(rows) :])]
    else:
        lines = [one_line(line) for line in lines]
    for line in lines:
        typer.echo(line)


def exit_beyond(beyond: Sequence[str]) -> None:
    """Print the limits that a run exceeded; typer.Exit if there are any."""
    for line in beyond:
        say(f"limit exceeded: {line}")
    if beyond:
        raise typer.Exit(EXIT_LIMIT)
