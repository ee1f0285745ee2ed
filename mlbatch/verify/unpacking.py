"""Records of compressed chunks (mcap.dev/spec: a frame of LZ4 or Zstandard for each chunk).

Memory follows what comes out, never what a size claims; and a small file cannot fill it.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from typing import TypeAlias

from mlbatch.verify.verdict import DamageError

_PIECE_BYTES = 1 << 20
# A chunk may always be so large, and so many times larger than what is stored of it: scans shrink
# to a half or a tenth, while what is made to fill the memory shrinks to thousandths.
_USUAL_BYTES, _MOST_TIMES = 1 << 28, 256
Pieces: TypeAlias = Callable[[memoryview], Iterator[bytes]]


def unpacked(compression: str, stored: memoryview, size: int) -> memoryview:
    """The records of a chunk, `size` bytes by its head; DamageError where they are not."""
    if not compression:
        return stored
    pieces = _PIECES.get(compression)
    if pieces is None:
        raise DamageError("a chunk as it is, or packed by lz4 or zstd", repr(compression))
    most = max(_USUAL_BYTES, _MOST_TIMES * len(stored))
    if size > most:
        raise DamageError(f"at most {most} bytes in {len(stored)} that are stored", f"{size}")
    records = bytearray()
    for piece in pieces(stored):
        records += piece
        if len(records) > size:
            raise DamageError(f"{size} bytes of records", "more")
    return memoryview(records)


def _of_zstd(stored: memoryview) -> Iterator[bytes]:
    import zstandard

    with zstandard.ZstdDecompressor().stream_reader(stored, read_across_frames=True) as reader:
        try:
            while piece := reader.read(_PIECE_BYTES):
                yield piece
        except zstandard.ZstdError as err:
            raise DamageError("a frame of zstd", str(err)) from err


def _of_lz4(stored: memoryview) -> Iterator[bytes]:
    # The package tells no types, so that a plain import would not pass the type checker.
    frame = importlib.import_module("lz4.frame").LZ4FrameDecompressor()
    try:
        piece = frame.decompress(stored, _PIECE_BYTES)
        while piece:
            yield piece
            piece = b"" if frame.eof else frame.decompress(b"", _PIECE_BYTES)
    except RuntimeError as err:
        raise DamageError("a frame of lz4", str(err)) from err


_PIECES: dict[str, Pieces] = {"zstd": _of_zstd, "lz4": _of_lz4}
