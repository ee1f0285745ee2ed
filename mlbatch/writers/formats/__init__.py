"""Output formats, one module each; they are found by their place here, or by entry points.

A format that writes files for each scan uses its own name as their suffix, or `FILE_SUFFIXES`.
"""

from __future__ import annotations

import importlib
import pkgutil
import sys
from functools import lru_cache
from typing import TYPE_CHECKING, cast

from mlbatch import entry_points
from mlbatch.errors import UsageError

if TYPE_CHECKING:
    from mlbatch.writers.base import WriterModule


def built_in_names() -> tuple[str, ...]:
    """Return the names of the formats here, sorted, without importing them."""
    return tuple(sorted(module.name for module in pkgutil.iter_modules(__path__)))


@lru_cache(maxsize=1)
def format_names() -> tuple[str, ...]:
    """Return the names of all formats; those of other distributions last."""
    return (*built_in_names(), *other_names())


def other_names() -> tuple[str, ...]:
    """Return the names of formats of other distributions (`mlbatch.writers`)."""
    return entry_points.names(entry_points.WRITERS, built_in_names())


def _is_built_in(name: str) -> bool:
    """Return whether it is one of the formats here; for a loaded one the folder is not read."""
    return f"{__name__}.{name}" in sys.modules or name in built_in_names()


def is_format(name: str) -> bool:
    """Return whether there is a format of this name."""
    return _is_built_in(name) or (name != "" and name in format_names())


def format_of_files(suffix: str) -> str | None:
    """Return the format whose scans are files with this suffix, without a dot; None: there is none.

    Formats are imported until one has it.
    """
    if is_format(suffix):
        return suffix if format_module(suffix).SUFFIX is None else None
    return next((name for name in built_in_names() if suffix in file_suffixes(name)), None)


def file_suffixes(name: str) -> tuple[str, ...]:
    """Return the suffixes of the files of a scan, without a dot, unless it is the format's name."""
    suffixes: tuple[str, ...] = getattr(format_module(name), "FILE_SUFFIXES", ())
    return suffixes


def windows_of_format(name: str) -> int:
    """Return the number of windows in a file of a format; 0: each scan has files of its own."""
    windows: int = getattr(format_module(name), "WINDOWS_PER_FILE", 0)
    return windows


def format_module(name: str) -> WriterModule:
    """Return the module of one of the formats."""
    if _is_built_in(name):
        return cast("WriterModule", importlib.import_module(f"{__name__}.{name}"))
    module = cast("WriterModule", entry_points.load(entry_points.WRITERS, name))
    if name != module.FORMAT:
        raise UsageError(
            f"{entry_points.describe(entry_points.WRITERS, name)}: expected FORMAT {name!r}, found "
            f"{module.FORMAT!r}; correct the distribution"
        )
    return module
