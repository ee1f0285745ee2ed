"""`mlbatch bench`: how fast it is here, beside floors and peers."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mlbatch.errors import UsageError

if TYPE_CHECKING:
    from mlbatch.bench.runner import Settings

ENGINES = ("all", "numpy", "numba", "auto")
# The kernels' compiler, which the extra of this name brings.
COMPILER, EXTRA = "numba", "mlbatch[fast]"
MOST_SECONDS, MOST_RUNS = 3600.0, 1000


def bench(
    seconds: Annotated[float, typer.Option(help="Length of the recordings, s.")] = 12.0,
    repeat: Annotated[int, typer.Option(help="Runs of each program.")] = 5,
    case: Annotated[
        list[str] | None, typer.Option(help="Measure this case only; repeatable. [default: all]")
    ] = None,
    engine: Annotated[
        str, typer.Option(help="all (that are installed), numpy, numba, or auto: convert's choice.")
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
        Path | None, typer.Option(help="Earlier result (JSON), to tell what changed.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, for programs.")] = False,
) -> None:
    """Measure conversions of standard recordings: CPU, time, memory, beside floors and peers."""
    from mlbatch.bench.measure import BenchError
    from mlbatch.bench.results import document, lines
    from mlbatch.bench.runner import bench as measure

    result = measure(
        _settings(seconds, repeat, case or [], engine, peer_python or [], keep, against)
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


def _settings(
    seconds: float,
    repeat: int,
    case: list[str],
    engine: str,
    peer_python: list[Path],
    keep: Path | None,
    against: Path | None,
) -> Settings:
    """The options as values, or a UsageError."""
    from mlbatch.bench.cases import CASES
    from mlbatch.bench.runner import Settings

    if not 1 <= seconds <= MOST_SECONDS:
        raise UsageError(f"--seconds: wanted 1 to {MOST_SECONDS:g}, got {seconds:g}; write 12")
    if not 1 <= repeat <= MOST_RUNS:
        raise UsageError(f"--repeat: wanted 1 to {MOST_RUNS}, got {repeat}; write 5")
    # Not by the helpers of other commands: they load numpy, which would count as memory of all
    # processes that are measured (measure.py).
    if engine not in ENGINES:
        raise UsageError(f"--engine: wanted one of {', '.join(ENGINES)}, got {engine!r}")
    cases = {known.name: known for known in CASES}
    for name in case:
        if name not in cases:
            raise UsageError(f"--case: wanted one of {', '.join(cases)}, got {name!r}")
    engines, notes = _engines(engine)
    return Settings(
        *(tuple(cases[name] for name in dict.fromkeys(case or cases)), engines, seconds, repeat),
        # Not resolved: the python of an environment is a link, and its place says which one.
        peer_pythons=tuple(str(path.absolute()) for path in peer_python),
        keep=keep,
        against=against,
        notes=notes,
        tell=_tell if sys.stderr.isatty() else _silent,
    )


def _engines(wanted: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Engines to measure, and what is to be said about others."""
    from mlbatch.bench.measure import version

    if wanted != "all":
        return (wanted,), ()
    if version(COMPILER):
        return ("numpy", "numba"), ()
    return ("numpy",), (f"engine numba was not measured: pip install {EXTRA}",)


def _tell(text: str) -> None:
    typer.echo(f"mlbatch: {text}", err=True)


def _silent(text: str) -> None:
    """Progress is for terminals."""
