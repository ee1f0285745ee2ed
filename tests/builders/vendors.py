"""Laws of the folders of vendors: what `Vendor` says of packets and files, against the plug-in."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import cast

from mlbatch import sensors
from mlbatch.errors import MlbatchError
from mlbatch.lidar.interface import Evidence
from mlbatch.sensors import Plugin, Vendor


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
