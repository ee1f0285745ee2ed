"""`mlbatch sensors`: the supported models."""

from __future__ import annotations

import json

import typer

from mlbatch.cli.parameters import AsJson

HEAD = ("model", "vendor", "channels", "returns", "clock", "calibration", "verified")


def sensors(
    as_json: AsJson = False,
) -> None:
    """List the supported lidars, what they need, and how each was verified."""
    from mlbatch.sensors import models

    rows: list[dict[str, object]] = [
        {
            "model": model.name,
            "vendor": model.vendor,
            "channels": model.channels,
            "returns": list(model.returns),
            "clock": model.clock,
            "calibration": model.calibration,
            "verified": model.verified,
        }
        for model in models()
    ]
    if as_json:
        typer.echo(json.dumps(rows, indent=1))
        return
    from mlbatch.cli.tables import table_lines

    cells = [[_cell(row[key]) for key in HEAD] for row in rows]
    for line in table_lines([list(HEAD), *cells]):
        typer.echo(line)


def _cell(value: object) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)
