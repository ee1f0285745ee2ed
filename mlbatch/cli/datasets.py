"""`mlbatch datasets`: public datasets with a recipe."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from mlbatch.cli.parameters import AsJson


def datasets(
    name: Annotated[
        str | None,
        typer.Argument(help="Print this recipe, a rig to change.", show_default=False),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List public datasets that `--dataset` knows, with the pages of every fact."""
    from mlbatch.rig.recipes import recipe, recipe_names, recipe_path

    if name is not None and not as_json:
        typer.echo(recipe_path(name, "datasets").read_text(encoding="utf-8"), nl=False)
        return
    found = {one: recipe(one) for one in ([name] if name else recipe_names())}
    if as_json:
        every = [{"name": one, **facts._asdict()} for one, facts in found.items()]
        typer.echo(json.dumps(every, indent=1))
        return
    from mlbatch.cli.tables import table_lines

    rows = [["name", "lidars", "data", "size", "licence", "recipe"]]
    for one, facts in found.items():
        rows.append([one, *facts[2:6], "refused" if facts.refused else facts.mark])
    for line in table_lines(rows):
        typer.echo(line)
    typer.echo("not verified: no page that was read states it; look for it before you use the data")
    typer.echo("mlbatch convert RECORDING --dataset NAME -o scans.mcap")
