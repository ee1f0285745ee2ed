"""Laws of the folders of vendors: what `Vendor` says of packets and files, against the plug-in."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import cast

import numpy as np

from mlbatch import sensors
from mlbatch.arrays import U8Array
from mlbatch.errors import MlbatchError
from mlbatch.lidar.interface import Evidence, NeighbourStream
from mlbatch.sensors import Plugin, Vendor
from mlbatch.types import Stream


@cache
def vendors() -> Sequence[tuple[str, Vendor, Plugin]]:
    """Name, folder and plug-in of every vendor."""
    names = [info.name for info in pkgutil.iter_modules(sensors.__path__) if info.ispkg]
    return [
        (
            name,
            cast(Vendor, importlib.import_module(f"mlbatch.sensors.{name}")),
            cast(Plugin, importlib.import_module(f"mlbatch.sensors.{name}.sensor")),
        )
        for name in names
    ]


def wrongly_excluded(evidence: Evidence) -> list[str]:
    """Vendors that know packets which their folders say they cannot have sent."""
    return [
        name
        for name, folder, plugin in vendors()
        if not folder.may_send(evidence.size, evidence.sample)
        and (
            plugin.describe(evidence.size, evidence.sample) is not None
            or any(one.match_score(evidence) for one in plugin.BUILT_IN)
        )
    ]


def wrongly_excluded_file(path: Path, content: bytes) -> list[str]:
    """Vendors that know a file, or find it damaged, which their folders say is not theirs."""
    return [
        name
        for name, folder, plugin in vendors()
        if not folder.may_calibrate(content) and _is_known(plugin, path, content)
    ]


def _is_known(plugin: Plugin, path: Path, content: bytes) -> bool:
    try:
        return plugin.read_calibration(path, content) is not None
    except MlbatchError:
        return True


LACKING = ": no decoder in this version"


def named(packets: U8Array) -> str | None:
    """What the vendors but Ouster, which names packets by their sizes, call payloads (k, size).

    A vendor that names them must not exclude them.
    """
    size = packets.shape[1]
    for _, folder, plugin in vendors():
        name = None if plugin.VENDOR == "Ouster" else plugin.describe(size, packets)
        if name is not None:
            assert folder.may_send(size, packets), name
            return name
    return None


def beside(stream: Stream, payload: bytes) -> NeighbourStream:
    """One packet from the same source."""
    sample = np.frombuffer(payload, np.uint8)[None]
    return NeighbourStream(stream, len(payload), sample, np.zeros(1, np.int64))
