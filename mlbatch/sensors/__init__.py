"""Lidar vendors as plug-ins: models, calibration files, names of unknown streams.

Each folder of this package is a vendor; its module `sensor` is the plug-in (`Plugin`), found by its
place. Vendors are asked in alphabetical order. The folder itself says cheaply which packets and
files cannot be the vendor's (`Vendor`), so that `sensor` is imported only where it is needed. Other
distributions add vendors by entry points of the group `mlbatch.sensors`; they are asked last.
"""

from __future__ import annotations

import errno
import importlib
import pkgutil
import sys
from collections.abc import Collection, Iterable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Protocol, cast

from mlbatch import entry_points
from mlbatch.arrays import U8Array
from mlbatch.bounded import read_bytes
from mlbatch.errors import RigError
from mlbatch.lidar.headers import content_keys
from mlbatch.lidar.interface import Calibration, Recorded, SensorModel
from mlbatch.sensors.options import DECODE_OPTIONS

__all__ = [
    "DECODE_OPTIONS",
    "MAX_CALIBRATION_BYTES",
    "Plugin",
    "Vendor",
    "built_in",
    "content_keys",
    "describe",
    "models",
    "parse_calibration",
    "plugins",
    "read_calibration",
    "recorded",
    "senders",
    "vendor_of",
]

# Calibration files are far smaller; a larger file is a recording or something else.
MAX_CALIBRATION_BYTES = 16_000_000


class Vendor(Protocol):
    """Interface of the folder of a vendor: necessary conditions, tested without `sensor`."""

    def may_send(self, size: int, packets: U8Array) -> bool:
        """Return False for payloads (k, >= size) that `describe` and `match_score` do not know."""
        ...

    def may_calibrate(self, content: bytes) -> bool:
        """Return False for files that are none of this vendor's calibrations, not even damaged."""
        ...


class Plugin(Protocol):
    """Interface of the module `sensor` of a vendor."""

    VENDOR: str
    MODELS: tuple[SensorModel, ...]
    # Calibrations without a file: models whose beams do not differ from unit to unit.
    BUILT_IN: tuple[Calibration, ...]

    # Optional: `RECORDED`, of type `Recorded`; without it packets are not extracted to bags.

    def read_calibration(self, path: Path, content: bytes) -> Calibration | None:
        """Parse a calibration file; None if it is another vendor's, RigError if it is damaged."""
        ...

    def describe(self, size: int, sample: U8Array) -> str | None:
        """Name payloads (k, size) of an unknown stream; None if they are not this vendor's."""
        ...


def plugins() -> tuple[Plugin, ...]:
    """All plug-ins by name; plug-ins of other distributions come last."""
    return tuple(_load_lazily(_names()))


def _load_lazily(built_in: Iterable[str]) -> Iterator[Plugin]:
    """These built-in plug-ins and all others, each imported when the iterator reaches it."""
    yield from _load(built_in)
    for name in entry_points.names(entry_points.SENSORS, _names()):
        yield cast(Plugin, entry_points.load(entry_points.SENSORS, name))


def _load(built_in: Iterable[str]) -> Iterator[Plugin]:
    for name in built_in:
        yield cast(Plugin, importlib.import_module(f"{__name__}.{name}.sensor"))


@lru_cache(maxsize=1)
def _names() -> tuple[str, ...]:
    return tuple(sorted(module.name for module in pkgutil.iter_modules(__path__) if module.ispkg))


def _vendor(name: str) -> Vendor:
    return cast(Vendor, importlib.import_module(f"{__name__}.{name}"))


def senders(size: int, packets: U8Array) -> list[str]:
    """Names of the built-in vendors that may have sent payloads (k, >= size), in their order."""
    return [name for name in _names() if _vendor(name).may_send(size, packets)]


def vendor_of(model: str) -> tuple[str, ...]:
    """Name of the built-in vendor that has a model of this name; () if none has.

    Vendors that are loaded are searched first; the result is the same, since names differ.
    """
    by_loading = sorted(_names(), key=lambda name: f"{__name__}.{name}.sensor" not in sys.modules)
    for name in by_loading:
        (plugin,) = _load([name])
        if any(row.name == model for row in plugin.MODELS):
            return (name,)
    return ()


def models(vendors: Collection[str] | None = None) -> tuple[SensorModel, ...]:
    """Supported models, of these built-in vendors (None: all) and of other distributions."""
    return tuple(model for plugin in _load_lazily(_chosen(vendors)) for model in plugin.MODELS)


def built_in(vendors: Collection[str] | None = None) -> tuple[Calibration, ...]:
    """Calibrations without a file, of these built-in vendors and of other distributions."""
    plugins = _load_lazily(_chosen(vendors))
    return tuple(calibration for plugin in plugins for calibration in plugin.BUILT_IN)


def _chosen(vendors: Collection[str] | None) -> list[str]:
    return [name for name in _names() if vendors is None or name in vendors]


def read_calibration(path: Path) -> Calibration | None:
    """Read a calibration file of any vendor; None if it is none, RigError if it is unreadable."""
    try:
        content = read_bytes(path, MAX_CALIBRATION_BYTES)
    except OSError as err:
        if err.errno == errno.EFBIG:
            return None
        is_missing = isinstance(err, FileNotFoundError)
        found = "no such file" if is_missing else (err.strerror or str(err)).lower()
        raise RigError(
            f"{path}: expected a calibration file, found {found}; check the path"
        ) from err
    return parse_calibration(path, content)


def parse_calibration(origin: Path, content: bytes) -> Calibration | None:
    """Parse a calibration from a file or a topic (`origin`); None if it is none."""
    vendors = [name for name in _names() if _vendor(name).may_calibrate(content)]
    calibrations = (plugin.read_calibration(origin, content) for plugin in _load_lazily(vendors))
    return next((calibration for calibration in calibrations if calibration is not None), None)


def describe(size: int, sample: U8Array) -> str | None:
    """Name payloads (k, size) of an unknown stream; None if no vendor knows them."""
    texts = (plugin.describe(size, sample) for plugin in _load_lazily(senders(size, sample)))
    return next((text for text in texts if text is not None), None)


def recorded(size: int, sample: U8Array) -> Recorded | None:
    """How drivers of the vendor that knows payloads (k, size) record them; None if not known."""
    for plugin in _load_lazily(senders(size, sample)):
        if plugin.describe(size, sample) is not None:
            return cast("Recorded | None", getattr(plugin, "RECORDED", None))
    return None
