"""CPU, wall time and peak memory of one process.

CPU is user plus system time of the process and its threads, memory its largest resident set, both
from wait4(2). Linux counts a parent's pages at the fork in the peak of its child, so nothing that
the measuring process loads imports numpy.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from mlbatch.errors import MlbatchError

BYTES_PER_MB: Final = 1_000_000
# ru_maxrss is in bytes on macOS, in KiB on Linux.
_RSS_UNIT_BYTES: Final = 1 if os.uname().sysname == "Darwin" else 1024
# Measured processes import the mlbatch of the measuring process.
_PACKAGE_FOLDER: Final = str(Path(__file__).resolve().parents[2])


class BenchError(MlbatchError):
    """A benchmark that cannot run."""


@dataclass(frozen=True, slots=True)
class Usage:
    """Resources of one process; rss_mb: largest resident set in MB (1e6 bytes)."""

    cpu_s: float
    wall_s: float
    rss_mb: float


def measure(name: str, command: Sequence[str], folder: Path) -> Usage:
    """Run a command in a folder to its end.

    Raises BenchError with the last line of its stderr if it fails or cannot be started.
    """
    paths = filter(None, [_PACKAGE_FOLDER, os.environ.get("PYTHONPATH")])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    # An installed package has its bytecode; without it every run would compile its imports.
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    with tempfile.TemporaryFile("w+", errors="replace") as stderr:
        began_s = time.perf_counter()
        try:
            process = subprocess.Popen(
                command, stdout=subprocess.DEVNULL, stderr=stderr, env=environment, cwd=folder
            )
        except OSError as err:
            raise BenchError(
                f"{name}: expected a program, found {command[0]}: {err.strerror}; give another path"
            ) from err
        _, status, usage = os.wait4(process.pid, 0)
        wall_s = time.perf_counter() - began_s
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            stderr.seek(0)
            last_line = (stderr.read().strip().splitlines() or ["no message"])[-1]
            raise BenchError(
                f"{name}: expected exit code 0, found {process.returncode}: {last_line}"
            )
    cpu_s = usage.ru_utime + usage.ru_stime
    return Usage(cpu_s, wall_s, usage.ru_maxrss * _RSS_UNIT_BYTES / BYTES_PER_MB)
