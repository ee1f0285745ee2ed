"""The parser of the command line, made once in a process: that takes 10 ms."""

from __future__ import annotations

from functools import cache

import typer.main
from typer.core import TyperGroup

from mlbatch.cli.app import command_line


@cache
def parser(first: str = "") -> TyperGroup:
    """In the place of `app.command_line`, which is called for each command."""
    made = typer.main.get_command(command_line(first))
    assert isinstance(made, TyperGroup)
    return made
