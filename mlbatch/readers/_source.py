"""Bytes of a recording, plain or compressed, read in order into a caller's buffer.

Magic numbers: RFC 1952 (gzip, 1F 8B) and RFC 8878 (zstd, 28 B5 2F FD). The content decides, never
the file's name. Memory does not depend on how far the data expands.
"""

from __future__ import annotations

import stat
import zlib
from io import FileIO
from pathlib import Path
from types import TracebackType
from typing import Protocol

from mlbatch.errors import RecordingError

_GZIP, _ZSTD = b"\x1f\x8b", b"\x28\xb5\x2f\xfd"
_GZIP_WINDOW = 31  # zlib's word for "gzip header, largest window"
_PIECE_BYTES = 1 << 18
HEAD_BYTES = 64


class _Stream(Protocol):
    """What `Source` reads from; an error leaves the bytes of earlier calls valid."""

    def readinto(self, target: memoryview) -> int | None: ...


class _Inflate:
    """A gzip file, also of several members, as a stream."""

    def __init__(self, file: FileIO) -> None:
        self._file = file
        self._inflate = zlib.decompressobj(_GZIP_WINDOW)
        self._input = b""

    def readinto(self, target: memoryview) -> int:
        """Fill `target` as far as one piece of input goes; 0 at the end."""
        while True:
            if self._inflate.eof:
                self._input = self._input or self._file.read(_PIECE_BYTES)
                if not self._input.startswith(_GZIP):  # The end, or padding after it.
                    return 0
                self._inflate = zlib.decompressobj(_GZIP_WINDOW)
            piece = self._input or self._file.read(_PIECE_BYTES)
            output = self._inflate.decompress(piece, len(target))
            self._input = self._inflate.unconsumed_tail or self._inflate.unused_data
            if output:
                target[: len(output)] = output
                return len(output)
            if not piece and not self._inflate.eof:
                raise EOFError("they end early")


class Source:
    """An open recording; use as a context manager.

    size_bytes: of the file on disk; fault: why reading stopped early, "" while all is well.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.fault = ""
        self._file = _opened(path)
        try:
            self.size_bytes = path.stat().st_size
            magic = self._file.read(len(_ZSTD))
            self._file.seek(0)
            self._stream = _stream(self._file, magic)
        except OSError as err:
            self._file.close()
            raise RecordingError(_unreadable(path, err)) from err

    def __enter__(self) -> Source:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()

    @property
    def position_bytes(self) -> int:
        """Bytes of the file on disk that have been read."""
        return self._file.tell()

    def fill(self, target: memoryview) -> int:
        """Read until `target` is full or the data end; return the number of bytes."""
        done = 0
        while done < len(target) and not self.fault:
            try:
                count = self._stream.readinto(target[done:])
            except OSError as err:
                raise RecordingError(_unreadable(self.path, err)) from err
            except (EOFError, zlib.error, _zstd_error()) as err:
                self.fault = f"corrupt or cut-off compressed data ({err})"
                break
            if not count:
                break
            done += count
        return done


def read_head(path: Path) -> bytes:
    """The first bytes of a recording, decompressed; an error where there is none."""
    head = bytearray(HEAD_BYTES)
    with Source(path) as source:
        count = source.fill(memoryview(head))
        if source.fault and not count:
            raise RecordingError(f"{path}: {source.fault}; nothing can be read, copy it again")
        if not count:
            raise RecordingError(
                f"{path}: wanted a recording, got 0 bytes; record or copy it again"
            )
    return bytes(head[:count])


def _opened(path: Path) -> FileIO:
    try:
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            raise RecordingError(
                f"{path}: wanted a recording, got a folder; name the files inside it"
            )
        if not stat.S_ISREG(mode):
            raise RecordingError(
                f"{path}: wanted a regular file, since it is read more than once; save it first"
            )
        return path.open("rb", buffering=0)
    except OSError as err:
        raise RecordingError(_unreadable(path, err)) from err


def _unreadable(path: Path, err: OSError) -> str:
    if isinstance(err, FileNotFoundError):
        return f"{path}: wanted a recording, got no such file; check the path"
    if isinstance(err, PermissionError):
        return f"{path}: wanted a recording, got no permission to read it; check its access rights"
    return f"{path}: wanted a recording, could not read it ({err.strerror}); check the disk"


def _stream(file: FileIO, magic: bytes) -> _Stream:
    if magic.startswith(_GZIP):
        return _Inflate(file)
    if magic == _ZSTD:
        import zstandard

        reader: _Stream = zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True)
        return reader
    return file


def _zstd_error() -> type[Exception]:
    import zstandard

    return zstandard.ZstdError
