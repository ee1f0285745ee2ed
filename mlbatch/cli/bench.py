"""`mlbatch bench`: measure mlbatch on this machine, with floors and peers."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mlbatch.errors import UsageError

if TYPE_CHECKING:
    from mlbatch.bench.runner import Settings

MAX_SECONDS = 3600.0
MAX_RUNS = 1000


def bench(
    seconds: Annotated[float, typer.Option(help="Length of the recordings, s.")] = 12.0,
    repeat: Annotated[int, typer.Option(help="Runs of each program.")] = 5,
    case: Annotated[
        list[str] | None, typer.Option(help="Measure this case only; repeatable. [default: all]")
    ] = None,
    peer_python: Annotated[
        list[Path] | None,
        typer.Option(
            help="Python that has ouster-sdk or velodyne-decoder, to compare; repeatable."
        ),
    ] = None,
    keep: Annotated[
        Path | None,
        typer.Option(help="Folder to keep and reuse the recordings in. [default: temporary]"),
    ] = None,
    against: Annotated[
        Path | None, typer.Option(help="Earlier result (JSON) to compare with.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, for programs.")] = False,
) -> None:
    """Measure conversions of standard recordings: CPU, time and memory, with floors and peers."""
    from mlbatch.bench.measure import BenchError
    from mlbatch.bench.results import document, lines
    from mlbatch.bench.runner import bench as measure

    result = measure(settings_from(seconds, repeat, case or [], peer_python or [], keep, against))
    if as_json:
        typer.echo(json.dumps(document(result), indent=1))
    else:
        for line in lines(result):
            typer.echo(line)
    if result.failed:
        raise BenchError(
            f"{len(result.failed)} conversion(s) failed, {result.failed[0]} first; see the notes"
        )


def settings_from(
    seconds: float,
    repeat: int,
    case: list[str],
    peer_python: list[Path],
    keep: Path | None,
    against: Path | None,
) -> Settings:
    """Check the options; raises UsageError."""
    from mlbatch.bench.cases import CASES
    from mlbatch.bench.runner import Settings, no_progress

    if not 1 <= seconds <= MAX_SECONDS:
        raise UsageError(f"--seconds: expected 1 to {MAX_SECONDS:g}, found {seconds:g}; write 12")
    if not 1 <= repeat <= MAX_RUNS:
        raise UsageError(f"--repeat: expected 1 to {MAX_RUNS}, found {repeat}; write 5")
    cases = {known.name: known for known in CASES}
    for name in case:
        if name not in cases:
            raise UsageError(f"--case: expected one of {', '.join(cases)}, found {name!r}")
    return Settings(
        cases=tuple(cases[name] for name in dict.fromkeys(case or cases)),
        seconds=seconds,
        repeat=repeat,
        # Not resolved: the python of an environment is a link; its path names the environment.
        peer_pythons=tuple(str(path.absolute()) for path in peer_python),
        keep=keep,
        against=against,
        progress=_show if sys.stderr.isatty() else no_progress,
    )


def _show(text: str) -> None:
    typer.echo(f"mlbatch: {text}", err=True)
