"""Names of packets, and packets of neighbouring streams, for tests of all vendors."""

from __future__ import annotations

import numpy as np

from mlbatch.arrays import U8Array
from mlbatch.lidar.interface import Beside
from mlbatch.sensors import plugins
from mlbatch.types import Stream

LACKING = ": no decoder in this version"


def named(packets: U8Array) -> str | None:
    """What the vendors but Ouster, which names packets by their sizes, call payloads (k, size)."""
    vendors = (plugin for plugin in plugins() if plugin.VENDOR != "Ouster")
    names = (vendor.describe(packets.shape[1], packets) for vendor in vendors)
    return next((name for name in names if name is not None), None)


def beside(stream: Stream, payload: bytes) -> Beside:
    """One packet from the same source."""
    sample = np.frombuffer(payload, np.uint8)[None]
    return Beside(stream, len(payload), sample, np.zeros(1, np.int64))
