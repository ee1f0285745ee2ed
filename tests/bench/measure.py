"""CPU, wall time and peak memory of one process, and the machine that it ran on.

CPU is user plus system time of the process and its threads, memory its largest resident set, both
from wait4(2). Linux counts a parent's pages at the fork in the peak of its child, so nothing that
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

BYTES_PER_MB: Final = 1_000_000
# ru_maxrss is in bytes on macOS, in KiB on Linux.
_RSS_UNIT_BYTES: Final = 1 if os.uname().sysname == "Darwin" else 1024
# Measured processes import the mlbatch of the measuring process.
_PACKAGE_FOLDER: Final = str(Path(__file__).resolve().parents[2])
_LIBRARIES: Final = ("numpy", "isal", "mcap", "zstandard")
# Of x86 and Arm, as /proc/cpuinfo names them.
_VECTOR_FLAGS: Final = ("sse", "ssse", "avx", "fma", "asimd", "neon", "sve")


class BenchError(MlbatchError):
    """A benchmark that cannot run, or whose document cannot be read."""


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


def machine() -> dict[str, int | float | str]:
    """Processor and its vector instructions, memory, system, load and versions."""
    memory_bytes = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    try:
        described = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        described = ""
    return {
        "cpu": cpu_model(described) or platform.processor() or platform.machine(),
        "cpu_flags": vector_flags(described),
        "cores": os.cpu_count() or 0,
        "memory_mb": memory_bytes // BYTES_PER_MB,
        "system": f"{platform.system()} {platform.release().split('-')[0]} {platform.machine()}",
        "load": os.getloadavg()[0],
        "mlbatch": mlbatch.__version__,
        "python": platform.python_version(),
        **{name: version(name) for name in _LIBRARIES if version(name)},
    }


def version(distribution: str) -> str:
    """Version of an installed distribution; empty if it is not installed."""
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return ""


def cpu_model(described: str) -> str:
    """Name of the processor in the text of /proc/cpuinfo; empty if it has none."""
    return _value(described, "model name")


def vector_flags(described: str) -> str:
    """Flags of vector instructions in the text of /proc/cpuinfo, in its order."""
    flags = _value(described, "flags") or _value(described, "Features")
    return " ".join(flag for flag in flags.split() if flag.startswith(_VECTOR_FLAGS))


def _value(described: str, key: str) -> str:
    """First value of a key in the text of /proc/cpuinfo; empty without one."""
    pairs = (line.partition(":") for line in described.splitlines())
    return next((value.strip() for name, _, value in pairs if name.strip() == key), "")
