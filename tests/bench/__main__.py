"""Measures mlbatch on this machine, with floors and peers: `python -m tests.bench --help`.

Exit codes: 1, a benchmark that failed; 2, wrong options.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from mlbatch.errors import MlbatchError, UsageError
from tests.bench.cases import CASES
from tests.bench.measure import BenchError
from tests.bench.results import document, lines
from tests.bench.runner import Settings, bench, no_progress

MAX_SECONDS = 3600.0
MAX_RUNS = 1000


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argparse.ArgumentParser(
        "python -m tests.bench",
        description="Measure conversions of standard recordings: CPU, time and memory, "
        "with floors and peers.",
    )
    options.add_argument("--seconds", type=float, default=12.0, help="length of a recording, s")
    options.add_argument("--repeat", type=int, default=5, help="runs of each program")
    options.add_argument(
        "--case", action="append", default=[], help="measure this case only; repeatable"
    )
    options.add_argument(
        "--peer-python",
        action="append",
        default=[],
        type=Path,
        help="Python that has ouster-sdk or velodyne-decoder, to compare; repeatable",
    )
    options.add_argument("--keep", type=Path, help="folder to keep and reuse the recordings in")
    options.add_argument("--against", type=Path, help="earlier result (JSON) to compare with")
    options.add_argument("--json", action="store_true", help="print JSON, for programs")
    return options


def settings_from(options: argparse.Namespace) -> Settings:
    """Check the options; raises UsageError."""
    if not 1 <= options.seconds <= MAX_SECONDS:
        raise UsageError(
            f"--seconds: expected 1 to {MAX_SECONDS:g}, found {options.seconds:g}; write 12"
        )
    if not 1 <= options.repeat <= MAX_RUNS:
        raise UsageError(f"--repeat: expected 1 to {MAX_RUNS}, found {options.repeat}; write 5")
    cases = {case.name: case for case in CASES}
    for name in options.case:
        if name not in cases:
            raise UsageError(f"--case: expected one of {', '.join(cases)}, found {name!r}")
    return Settings(
        cases=tuple(cases[name] for name in dict.fromkeys(options.case or cases)),
        seconds=options.seconds,
        repeat=options.repeat,
        # Not resolved: the python of an environment is a link; its path names the environment.
        peer_pythons=tuple(str(path.absolute()) for path in options.peer_python),
        keep=options.keep,
        against=options.against,
        progress=_show if sys.stderr.isatty() else no_progress,
    )


def main(arguments: list[str] | None = None) -> None:
    """Measure, print the result."""
    options = parser().parse_args(arguments)
    try:
        result = bench(settings_from(options))
        print(json.dumps(document(result), indent=1) if options.json else "\n".join(lines(result)))
        if result.failed:
            raise BenchError(
                f"{len(result.failed)} conversion(s) failed, {result.failed[0]} first; "
                "see the notes"
            )
    except MlbatchError as err:
        print(f"bench: error: {err}", file=sys.stderr)
        sys.exit(2 if isinstance(err, UsageError) else 1)


def _show(text: str) -> None:
    print(f"bench: {text}", file=sys.stderr)


if __name__ == "__main__":
    main()
