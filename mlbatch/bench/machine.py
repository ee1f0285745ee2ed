"""What a benchmark ran on: without it figures mean little."""

from __future__ import annotations

import os
import platform
from importlib import metadata
from pathlib import Path
from typing import Final

import mlbatch
from mlbatch.bench.results import Json

_LIBRARIES: Final = ("numpy", "numba", "llvmlite", "isal", "mcap", "zstandard")
_BYTES_PER_MB: Final = 1_000_000


def machine() -> dict[str, Json]:
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
