"""Plug-ins of other distributions: modules named by entry points of three groups.

Source: packaging.python.org, "Entry points specification". They are looked up only where no
built-in plug-in fits: `importlib.metadata` takes up to 0.05 s to import and to read all of them.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Collection
from functools import cache
from importlib.machinery import PathFinder
from pathlib import Path
from typing import TYPE_CHECKING

from mlbatch.errors import UsageError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

READERS = "mlbatch.readers"
SENSORS = "mlbatch.sensors"
WRITERS = "mlbatch.writers"
# Names that a module of each group must define; the interfaces: docs/extend.md.
_REQUIRED = {
    READERS: ("CONTAINER", "recognises", "open_packets"),
    SENSORS: ("VENDOR", "MODELS", "BUILT_IN", "read_calibration", "describe"),
    WRITERS: ("FORMAT", "SUFFIX", "COMPRESSES", "extras", "open_writer"),
}


def names(group: str, built_in: Collection[str] = ()) -> tuple[str, ...]:
    """Names of the plug-ins of a group, sorted; none is imported.

    UsageError if a name is taken by a built-in plug-in, or by another distribution.
    """
    found = _entry_points(group)
    for name in sorted(found):
        if name in built_in:
            raise UsageError(
                f"{describe(group, name)}: expected a name of its own, found that of a built-in "
                "plug-in; uninstall the distribution"
            )
        if len(found[name]) > 1:
            others = " and ".join(sorted({_distribution(one) for one in found[name]}))
            raise UsageError(
                f"{group} {name}: expected one plug-in of this name, found those of {others}; "
                "uninstall one of them"
            )
    return tuple(sorted(found))


def load(group: str, name: str) -> object:
    """The module of a plug-in; UsageError if it cannot be imported, or lacks a part."""
    (entry_point,) = _entry_points(group)[name]
    advice = "correct, update or uninstall the distribution"
    try:
        module: object = entry_point.load()
    # Any code may run here.
    except Exception as err:
        raise UsageError(
            f"{describe(group, name)}: expected to import {entry_point.value}, found "
            f"{type(err).__name__}: {err}; {advice}"
        ) from err
    missing = [part for part in _REQUIRED[group] if not hasattr(module, part)]
    if missing:
        raise UsageError(
            f"{describe(group, name)}: expected {', '.join(_REQUIRED[group])} in "
            f"{entry_point.value}, found no {', '.join(missing)}; {advice}"
        )
    return module


def describe(group: str, name: str) -> str:
    """A plug-in with its distribution, for errors."""
    return f"{group} {name} of {_distribution(_entry_points(group)[name][0])}"


def forget() -> None:
    """Look installed distributions up again, for tests."""
    _entry_points.cache_clear()


def _distribution(entry_point: EntryPoint) -> str:
    return "an unknown distribution" if entry_point.dist is None else entry_point.dist.name


@cache
def _entry_points(group: str) -> dict[str, list[EntryPoint]]:
    """Entry points by name; the same one is found twice where a path is listed twice."""
    if not _may_be_installed(group):
        return {}
    # Slow to import.
    metadata = importlib.import_module("importlib.metadata")
    found: dict[str, list[EntryPoint]] = {}
    for entry_point in metadata.entry_points(group=group):
        known = found.setdefault(entry_point.name, [])
        if entry_point not in known:
            known.append(entry_point)
    return found


def _may_be_installed(group: str) -> bool:
    """False if no distribution on the path has entry points of a group.

    Their files are searched for its name, in a twentieth of the time that `importlib.metadata`
    takes. True if something on the path is not a folder, or has a finder of its own.
    """
    finders = (finder for finder in sys.meta_path if hasattr(finder, "find_distributions"))
    if any(finder is not PathFinder for finder in finders):
        return True
    head = f"[{group}]".encode()
    return any(_may_have(Path(place), head) for place in sys.path)


def _may_have(place: Path, head: bytes) -> bool:
    """Whether a folder of the path may have a distribution whose entry points have this head."""
    if place.is_file() or place.suffix == ".egg":
        return True
    try:
        names = os.listdir(place)
    except OSError:
        return False
    for name in names:
        if name.lower().endswith((".dist-info", ".egg-info")):
            try:
                found = head in (place / name / "entry_points.txt").read_bytes()
            except OSError:
                continue
            if found:
                return True
    return False
