"""One measured process: CPU, wall time and peak memory, told by the system and not by itself.

CPU is user plus system time of the process and its threads, memory its largest resident set, both
of wait4(2). Linux counts a parent's pages at the fork into the peak of its child, so nothing that
the measuring process loads imports numpy.
"""

from __future__ import annotations

import os
import platform
import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Final

import mlbatch
from mlbatch.errors import MlbatchError

# macOS tells bytes, Linux KiB.
_RSS_UNIT_BYTES: Final = 1 if os.uname().sysname == "Darwin" else 1024
_BYTES_PER_MB: Final = 1_000_000
# Processes that are measured load the same mlbatch as the one that measures.
_PACKAGE_PLACE: Final = str(Path(__file__).resolve().parents[2])


class BenchError(MlbatchError):
    """A benchmark that cannot run, or whose document cannot be read."""


@dataclass(frozen=True, slots=True)
class Usage:
    """What one process used; rss_mb: largest resident set in MB (1e6 bytes)."""

    cpu_s: float
    wall_s: float
    rss_mb: float


def measure(name: str, command: Sequence[str], folder: Path) -> Usage:
    """Run a command in a folder to its end.

    Raises BenchError with the last line of its stderr if it fails or cannot be started.
    """
    paths = filter(None, [_PACKAGE_PLACE, os.environ.get("PYTHONPATH")])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    # What is installed was compiled then; else each run compiles the modules it loads.
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    with tempfile.TemporaryFile("w+", errors="replace") as err:
        began_s = time.perf_counter()
        try:
            process = subprocess.Popen(
                command, stdout=subprocess.DEVNULL, stderr=err, env=environment, cwd=folder
            )
        except OSError as error:
            raise BenchError(
                f"{name}: wanted a program, got {command[0]}: {error.strerror}; give another path"
            ) from error
        _, status, used = os.wait4(process.pid, 0)
        wall_s = time.perf_counter() - began_s
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            err.seek(0)
            last = (err.read().strip().splitlines() or ["no message"])[-1]
            raise BenchError(f"{name}: wanted exit code 0, got {process.returncode}: {last}")
    cpu_s = used.ru_utime + used.ru_stime
    return Usage(cpu_s, wall_s, used.ru_maxrss * _RSS_UNIT_BYTES / _BYTES_PER_MB)


_LIBRARIES: Final = ("numpy", "numba", "llvmlite", "isal", "mcap", "zstandard")


def machine() -> dict[str, int | float | str]:
    """Processor, memory, system, load and versions."""
    memory_bytes = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return {
        "cpu": _cpu(),
        "cores": os.cpu_count() or 0,
        "memory_mb": memory_bytes // _BYTES_PER_MB,
        "system": f"{platform.system()} {platform.release().split('-')[0]} {platform.machine()}",
        "load": os.getloadavg()[0],
        "mlbatch": mlbatch.__version__,
        "python": platform.python_version(),
        **{name: version(name) for name in _LIBRARIES if version(name)},
    }


def version(distribution: str) -> str:
    """Version of what is installed; empty if it is not."""
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return ""


def _cpu() -> str:
    """The processor by its own name, where the system tells it."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        text = ""
    names = [line.partition(":")[2].strip() for line in text.splitlines() if "model name" in line]
    return names[0] if names else platform.processor() or platform.machine()
