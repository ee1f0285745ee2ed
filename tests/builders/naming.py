"""What packets are called, in the tests."""

from __future__ import annotations

from mlbatch.sensors import plugins
from mlbatch.types import U8Array

LACKING = ": no decoder in this version"


def named(packets: U8Array) -> str | None:
    """What the vendors but Ouster, which names packets by their sizes, call payloads (k, size)."""
    vendors = (plugin for plugin in plugins() if plugin.VENDOR != "Ouster")
    names = (vendor.describe(packets.shape[1], packets) for vendor in vendors)
    return next((name for name in names if name is not None), None)
