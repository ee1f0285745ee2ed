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

ENGINES = ("all", "numpy", "native", "auto")
MAX_SECONDS = 3600.0
MAX_RUNS = 1000


def bench(
    seconds: Annotated[float, typer.Option(help="Length of the recordings, s.")] = 12.0,
    repeat: Annotated[int, typer.Option(help="Runs of each program.")] = 5,
    case: Annotated[
        list[str] | None, typer.Option(help="Measure this case only; repeatable. [default: all]")
    ] = None,
    engine: Annotated[
        str,
        typer.Option(help="all (installed), numpy, native, or auto: the choice of convert."),
    ] = "all",
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

    result = measure(
        settings_from(seconds, repeat, case or [], engine, peer_python or [], keep, against)
    )
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
    engine: str,
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
    # Checked here: the helpers of other commands import numpy, which would count in the peak
    # memory of measured processes (measure.py).
    if engine not in ENGINES:
        raise UsageError(f"--engine: expected one of {', '.join(ENGINES)}, found {engine!r}")
    cases = {known.name: known for known in CASES}
    for name in case:
        if name not in cases:
            raise UsageError(f"--case: expected one of {', '.join(cases)}, found {name!r}")
    engines, notes = engines_to_measure(engine)
    return Settings(
        cases=tuple(cases[name] for name in dict.fromkeys(case or cases)),
        engines=engines,
        seconds=seconds,
        repeat=repeat,
        # Not resolved: the python of an environment is a link; its path names the environment.
        peer_pythons=tuple(str(path.absolute()) for path in peer_python),
        keep=keep,
        against=against,
        notes=notes,
        progress=_show if sys.stderr.isatty() else no_progress,
    )


def engines_to_measure(engine: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Engines to measure, and notes on the others."""
    from mlbatch.native import library_path

    if engine != "all":
        return (engine,), ()
    if library_path() is not None:
        return ("numpy", "native"), ()
    return ("numpy",), ("engine native was not measured: its library is not installed",)


def _show(text: str) -> None:
    typer.echo(f"mlbatch: {text}", err=True)
