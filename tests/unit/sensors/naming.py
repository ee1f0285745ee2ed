"""What packets of makers without a decoder are called, in the tests."""

from __future__ import annotations

from mlbatch.sensors import plugins
from mlbatch.types import U8Array

LACKING = ": no decoder in this version"
(OTHERS,) = (plugin for plugin in plugins() if not plugin.MODELS)


def named(packets: U8Array) -> str | None:
    """The description of payloads (k, size)."""
    return OTHERS.describe(packets.shape[1], packets)


def lidar(packets: U8Array) -> str:
    """The name of lidar packets, without what all of them end with."""
    text = named(packets)
    assert text is not None
    assert " lidar " in text
    assert text.endswith(LACKING)
    return text[: -len(LACKING)]
