"""What packets are called, in the tests."""

from __future__ import annotations

from mlbatch.sensors import plugins
from mlbatch.types import U8Array

LACKING = ": no decoder in this version"


def named(packets: U8Array) -> str | None:
    """What the makers but Ouster, which names packets by their sizes, call payloads (k, size)."""
    makers = (plugin for plugin in plugins() if plugin.VENDOR != "Ouster")
    names = (maker.describe(packets.shape[1], packets) for maker in makers)
    return next((name for name in names if name is not None), None)
