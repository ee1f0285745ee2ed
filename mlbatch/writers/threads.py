"""Number of scans that are made at the same time: `--jobs`."""

from __future__ import annotations

import os

from mlbatch.errors import UsageError
from mlbatch.writers.base import NO_COMPRESSION, WriterOptions
from mlbatch.writers.formats import format_module

AUTO = "auto"
MOST_JOBS = 64
_MOST_AUTO = 4


def parse_jobs(option: str, text: str) -> int | None:
    """Return the number of jobs, None for auto; option: for the error, as the user wrote it."""
    if text == AUTO:
        return None
    number = int(text) if text.isascii() and text.isdigit() and len(text) < len("1000") else 0
    if not 1 <= number <= MOST_JOBS:
        raise UsageError(
            f"{option}: expected 1 to {MOST_JOBS}, or {AUTO}, found {text}; give the number of "
            "free cores"
        )
    return number


def jobs_for(asked: int | None, name: str, options: WriterOptions) -> int:
    """Return the number of jobs for an output of format `name`; asked: None for auto.

    auto: one for each core, at most 4, where writing a scan takes longer than decoding it: with
    compression, and in formats with `WriterModule.IS_SLOW`; else 1.
    """
    if asked is not None:
        return asked
    is_slow = bool(getattr(format_module(name), "IS_SLOW", False))
    if options.compression == NO_COMPRESSION and not is_slow:
        return 1
    return min(_cores(), _MOST_AUTO)


def _cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
