"""Names of packets, and packets of neighbouring streams, for tests of all vendors."""

from __future__ import annotations

import numpy as np

from mlbatch.arrays import U8Array
from mlbatch.lidar.interface import NeighbourStream
from mlbatch.types import Stream
from tests.builders.vendors import vendors

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
