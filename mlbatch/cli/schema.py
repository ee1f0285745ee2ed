"""`mlbatch schema`: JSON schemas of files that users write."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from mlbatch.errors import UsageError

NAMES = ("rig",)


def schema(
    name: Annotated[
        str,
        typer.Argument(help="rig: the rig file.", metavar="NAME", autocompletion=lambda: NAMES),
    ],
) -> None:
    """Print the JSON schema of a rig file, for editors and checks."""
    if name not in NAMES:
        raise UsageError(f"schema: expected {' or '.join(NAMES)}, found {name!r}; write schema rig")
    from mlbatch.rig.schema import rig_schema

    typer.echo(json.dumps(rig_schema(), indent=1))
