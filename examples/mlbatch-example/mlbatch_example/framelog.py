"""Frame logs: the 8 bytes `FRAMELOG`, then one record a UDP payload.

Record, little endian: u64 receive time (ns), u8[4] source IPv4, u16 destination port, u16 size of
the payload, payload.
"""

from __future__ import annotations

import ipaddress
import struct
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mlbatch.readers.source import Source, Window
from mlbatch.types import CaptureCounts, PacketBatch, Recording, Stream, StreamTable

CONTAINER = "frame log"

_MAGIC = b"FRAMELOG"
_RECORD = struct.Struct("<Q4sHH")


def recognises(head: bytes) -> bool:
    """Return whether a file with these first bytes is a frame log."""
    return head.startswith(_MAGIC)


def open_packets(path: Path, streams: StreamTable) -> Recording:
    """Open a frame log; its streams are numbered in `streams`."""
    return FrameLog(path, CONTAINER, path.stat().st_size, streams)


@dataclass(slots=True)
class FrameLog(Recording):
    """A frame log."""

    streams: StreamTable

    def packets(self) -> Generator[PacketBatch, None, None]:
        """Yield all packets from the start, in file order; each call is a new pass."""
        self.counts = CaptureCounts()
        self.notes = []
        with Source(self.path) as source:  # decompresses gzip and zstd
            window = Window(source)  # one reused buffer
            window.refill()
            window.begin += len(_MAGIC)
            while True:
                batch = self._batch(window)
                self.position_bytes = source.position_bytes
                if len(batch):
                    yield batch
                if not window.refill():
                    break
            if window.begin < window.end:
                self.counts.frames += 1
                self.counts.skip("truncated")
                self.notes.append("the file ends within a record; all others were read")

    def _batch(self, window: Window) -> PacketBatch:
        """Return the payloads of all whole records in the window, and move past them."""
        rows = []
        while window.begin + _RECORD.size <= window.end:
            host_ns, address, port, size = _RECORD.unpack_from(window.data.data, window.begin)
            start = window.begin + _RECORD.size
            if start + size > window.end:
                break
            stream = Stream(source_ip=str(ipaddress.IPv4Address(address)), port=port)
            rows.append((start, size, self.streams.number(stream), host_ns))
            window.begin = start + size
        self.counts.frames += len(rows)
        self.counts.datagrams += len(rows)
        table = np.array(rows, np.int64).reshape(-1, 4)
        return PacketBatch(
            data=window.data,
            start=table[:, 0],
            size=table[:, 1],
            stream=table[:, 2],
            host_ns=table[:, 3],
        )
