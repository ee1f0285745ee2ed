"""Compression of chunks as MCAP knows it: a frame of LZ4 or Zstandard for each (mcap.dev/spec)."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Sequence
from typing import TypeAlias

from mlbatch.errors import UsageError
from mlbatch.writers._chunk import Compress
from mlbatch.writers.output_file import Bytes

NONE = "none"
# What the library takes, and its own default.
_ZSTD_LEVELS = range(1, 23)
_ZSTD_DEFAULT = 3
NewCompress: TypeAlias = Callable[[], Compress]


def compression_of(text: str) -> tuple[str, NewCompress | None]:
    """Name in the file of `--compression`, and what makes a compressor for each thread."""
    if text == NONE:
        return "", None
    if text == "lz4":
        return "lz4", _lz4
    found = re.fullmatch(r"zstd(?::(\d{1,2}))?", text)
    level = int(found[1] or _ZSTD_DEFAULT) if found else 0
    if level not in _ZSTD_LEVELS:
        raise UsageError(
            f"--compression: wanted none, lz4, zstd or zstd:1 to zstd:{_ZSTD_LEVELS[-1]}, got "
            f"{text!r}; choose one"
        )
    return "zstd", lambda: _zstd(level)


def refuse_compression(text: str, name: str) -> None:
    """Refuse it for a format without a place for it."""
    if text != NONE:
        compression_of(text)
        raise UsageError(
            f"--compression: wanted {NONE} for {name}, got {text!r}; leave it out, or write a "
            ".mcap or rosbag2 output"
        )


def _zstd(level: int) -> Compress:
    import zstandard

    compressor = zstandard.ZstdCompressor(level=level)

    def compress(parts: Sequence[Bytes], size: int) -> list[Bytes]:
        frame = compressor.compressobj(size=size)
        return [*map(frame.compress, parts), frame.flush()]

    return compress


def _lz4() -> Compress:
    # The package tells no types, so that a plain import would not pass the type checker.
    frames = importlib.import_module("lz4.frame")

    def compress(parts: Sequence[Bytes], size: int) -> list[Bytes]:
        frame = frames.LZ4FrameCompressor()
        return [frame.begin(size), *map(frame.compress, parts), frame.flush()]

    return compress
