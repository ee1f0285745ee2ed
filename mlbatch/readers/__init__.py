"""Readers of recordings. A module here without leading underscore is a plug-in for one container.

A plug-in has `CONTAINER`, `recognises(head)` and `open_packets(path, streams)`, as in `Reader`.
"""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path
from typing import Protocol, cast

from mlbatch.errors import RecordingError
from mlbatch.readers._knowledge import decode_bytes, decode_string, decode_transforms
from mlbatch.readers._merge import merge
from mlbatch.readers._source import read_head
from mlbatch.types import Recording, StreamTable

__all__ = [
    "Reader",
    "decode_bytes",
    "decode_string",
    "decode_transforms",
    "merge",
    "open_recording",
    "readers",
]

_SHOWN_BYTES = 8


class Reader(Protocol):
    """What a plug-in module offers; `head` is the first 64 bytes after decompression."""

    CONTAINER: str

    def recognises(self, head: bytes) -> bool:
        """Whether a file that begins with `head` is such a container."""
        ...

    def open_packets(self, path: Path, streams: StreamTable) -> Recording:
        """Open the recording; RecordingError where it cannot be read at all."""
        ...


def readers() -> list[Reader]:
    """All plug-ins, by name."""
    names = [info.name for info in pkgutil.iter_modules(__path__) if not info.name.startswith("_")]
    modules = [importlib.import_module(f"{__name__}.{name}") for name in sorted(names)]
    return [cast(Reader, module) for module in modules]


def open_recording(path: Path, streams: StreamTable) -> Recording:
    """Open a recording by its content, whatever its name; streams are numbered in `streams`."""
    head = read_head(path)
    known = readers()
    for reader in known:
        if reader.recognises(head):
            return reader.open_packets(path, streams)
    containers = ", ".join(reader.CONTAINER for reader in known)
    raise RecordingError(
        f"{path}: wanted a recording ({containers}; also gzip or zstd of them), got a file that "
        f"begins with {head[:_SHOWN_BYTES].hex(' ')}; check that it is the right file"
    )
