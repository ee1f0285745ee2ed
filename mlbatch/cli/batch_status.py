"""`mlbatch batch-status`: the state of a batch."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mlbatch.cli.parameters import AsJson

if TYPE_CHECKING:
    from mlbatch.batch.status import BatchStatus


def batch_status(
    output: Annotated[str, typer.Argument(help="Output of mlbatch batch: a folder, or a URL.")],
    as_json: AsJson = False,
    page: Annotated[
        Path | None, typer.Option(help="Write a page (HTML) of all sessions.", metavar="FILE")
    ] = None,
) -> None:
    """Show the sessions of a batch: state, loss, fill, clocks, bytes, time."""
    from mlbatch.batch.status import STATES, status_of
    from mlbatch.cli.batch import print_status
    from mlbatch.errors import one_line

    status = status_of(output)
    if as_json:
        typer.echo(json.dumps(_values(status), indent=1))
    elif page is None:
        print_status(status.sessions, STATES, len(status.sessions))
    if page is not None:
        from mlbatch.batch.status_page import write_status_page

        write_status_page(page, status)
        typer.echo(one_line(f"wrote {page}"), err=as_json)


def _values(status: BatchStatus) -> dict[str, object]:
    from dataclasses import asdict

    from mlbatch.batch.status import STATES

    return {
        "schema": "mlbatch.status/1",
        "output": status.output,
        "states": {state: status.count(state) for state in STATES},
        "sessions": [
            {
                "name": one.name,
                "state": one.state,
                "page": one.page,
                "clocks": one.clock_codes,
                "record": None if one.record is None else asdict(one.record),
            }
            for one in status.sessions
        ],
    }
