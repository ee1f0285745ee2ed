"""All makers' modules behind one door: models, calibration files, names of unknown streams.

A folder of this package is a vendor. Its module `sensor` is the plug-in, found by its place; it
offers what `Plugin` lists.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Protocol, cast

from mlbatch.errors import RigError
from mlbatch.lidar import Calibration, SensorModel
from mlbatch.sensors.base import content_keys
from mlbatch.sensors.options import DECODE_OPTIONS
from mlbatch.types import U8Array

__all__ = [
    "DECODE_OPTIONS",
    "MAX_CALIBRATION_BYTES",
    "Plugin",
    "built_in",
    "content_keys",
    "describe",
    "models",
    "parse_calibration",
    "plugins",
    "read_calibration",
]

# No calibration file comes near; what is larger is a recording or something else altogether.
MAX_CALIBRATION_BYTES = 16_000_000


class Plugin(Protocol):
    """What a maker's module offers."""

    VENDOR: str
    MODELS: tuple[SensorModel, ...]
    # Calibrations that need no file: of models whose beams do not differ from unit to unit.
    BUILT_IN: tuple[Calibration, ...]

    def read_calibration(self, path: Path, content: bytes) -> Calibration | None:
        """The calibration in a file; None if it is not this maker's, RigError if unusable."""
        ...

    def describe(self, size: int, sample: U8Array) -> str | None:
        """What payloads (k, size) of an unknown stream are; None if not this maker's."""
        ...


def plugins() -> tuple[Plugin, ...]:
    """The makers' modules, in the order of their names."""
    return tuple(_one_by_one())


def _one_by_one() -> Iterator[Plugin]:
    """The same; a maker's tables are loaded when it is asked, and those before could not answer."""
    for name in _names():
        yield cast(Plugin, importlib.import_module(f"{__name__}.{name}.sensor"))


@lru_cache(maxsize=1)
def _names() -> tuple[str, ...]:
    return tuple(sorted(module.name for module in pkgutil.iter_modules(__path__) if module.ispkg))


def models() -> tuple[SensorModel, ...]:
    """All supported models."""
    return tuple(model for plugin in plugins() for model in plugin.MODELS)


def built_in() -> tuple[Calibration, ...]:
    """Calibrations of all makers that need no file."""
    return tuple(calibration for plugin in plugins() for calibration in plugin.BUILT_IN)


def read_calibration(path: Path) -> Calibration | None:
    """The calibration in a file of any maker, or None if it is none; RigError if unreadable."""
    try:
        if not path.is_file():
            kind = "a directory" if path.is_dir() else "no such file"
            raise RigError(f"{path}: expected a calibration file, found {kind}; check the path")
        with path.open("rb") as file:
            content = file.read(MAX_CALIBRATION_BYTES + 1)
    except OSError as err:
        raise RigError(f"{path}: cannot read the calibration file: {err.strerror}") from err
    if len(content) > MAX_CALIBRATION_BYTES:
        return None
    return parse_calibration(path, content)


def parse_calibration(origin: Path, content: bytes) -> Calibration | None:
    """The calibration in a text from a file or a topic (`origin`), or None if it is none."""
    found = (plugin.read_calibration(origin, content) for plugin in _one_by_one())
    return next((calibration for calibration in found if calibration is not None), None)


def describe(size: int, sample: U8Array) -> str | None:
    """What payloads (k, size) of an unknown stream are, or None if no maker knows them."""
    found = (plugin.describe(size, sample) for plugin in _one_by_one())
    return next((text for text in found if text is not None), None)
