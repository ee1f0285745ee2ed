"""Output formats, one module each; they are found by their place here.

A format that writes one file per scan uses its own name as the suffix of these files.
"""

from __future__ import annotations

import importlib
import pkgutil
from functools import lru_cache
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from mlbatch.writers.base import WriterModule


@lru_cache(maxsize=1)
def format_names() -> tuple[str, ...]:
    """Return the names of all formats, sorted, without importing them."""
    return tuple(sorted(module.name for module in pkgutil.iter_modules(__path__)))


def format_module(name: str) -> WriterModule:
    """Return the module of one of the formats."""
    return cast("WriterModule", importlib.import_module(f"{__name__}.{name}"))
