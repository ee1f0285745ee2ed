"""pcap files of libpcap: microseconds or nanoseconds, either byte order.

Layout: draft-ietf-opsawg-pcap, sections 4 (file header) and 5 (packet record).
"""

from __future__ import annotations

import struct
from functools import partial
from pathlib import Path

import numpy as np

from mlbatch.arrays import U8Array
from mlbatch.errors import RecordingError
from mlbatch.native.capture import NO_ROOM, TOO_LONG, CaptureLoops
from mlbatch.readers.capture.frames import LINKS, Frames, unknown_link
from mlbatch.readers.capture.recording import MAX_FRAME_BYTES, CaptureRecording, Walk
from mlbatch.readers.source import read_head
from mlbatch.types import Recording, StreamTable
from mlbatch.units import NS_PER_S, NS_PER_US

CONTAINER = "pcap"

# First bytes of the file: byte order, and nanoseconds per unit of the fraction.
_MAGIC = {
    b"\xd4\xc3\xb2\xa1": ("<", NS_PER_US),
    b"\xa1\xb2\xc3\xd4": (">", NS_PER_US),
    b"\x4d\x3c\xb2\xa1": ("<", 1),
    b"\xa1\xb2\x3c\x4d": (">", 1),
}
# Alexey Kuznetzov's variant with longer record headers, written by some old Linux tools.
_MODIFIED = (b"\x34\xcd\xb2\xa1", b"\xa1\xb2\xcd\x34")
_FILE_HEADER_BYTES = 24
_LINK_AT = 20
_RECORD_BYTES = 16
_LENGTH_AT = 8
_ZEROS = "expected a record, found zeros"
# Shorter than the headers of any UDP packet.
_LEAST_FRAME = 14


def recognises(head: bytes) -> bool:
    """Whether a file that begins with `head` is a pcap file."""
    return head[:4] in _MAGIC or head[:4] in _MODIFIED


def open_packets(path: Path, streams: StreamTable) -> Recording:
    """Open a pcap file; its payloads come from streams (source IP, destination port)."""
    head = read_head(path)
    if head[:4] in _MODIFIED:
        raise RecordingError(
            f"{path}: expected a pcap file, found the modified kind (magic a1b2cd34); "
            f"convert it: editcap -F pcap {path.name} plain.pcap"
        )
    if head[:4] not in _MAGIC or len(head) < _FILE_HEADER_BYTES:
        raise RecordingError(
            f"{path}: expected a pcap header of {_FILE_HEADER_BYTES} bytes, found {len(head)} "
            f"({head[:8].hex(' ')}); record or copy it again"
        )
    record = head[_FILE_HEADER_BYTES : _FILE_HEADER_BYTES + _RECORD_BYTES]
    if record == bytes(_RECORD_BYTES):
        raise RecordingError(
            f"{path}: {_ZEROS} at byte {_FILE_HEADER_BYTES}; nothing was recorded, or the disk was "
            "full: record or copy it again"
        )
    order, unit_ns = _MAGIC[head[:4]]
    link = struct.unpack_from(order + "I", head, _LINK_AT)[0] & 0xFFFF
    if link not in LINKS:
        raise RecordingError(f"{path}: {unknown_link(link)}")
    walker = partial(_Walker, order, unit_ns, link)
    return CaptureRecording(
        path,
        CONTAINER,
        path.stat().st_size,
        walker,
        streams,
        first_record=partial(_first_record, order, unit_ns),
        head_bytes=_FILE_HEADER_BYTES,
    )


def _first_record(order: str, unit_ns: int, tail: U8Array, is_all: bool) -> int | None:
    """Start of a record near the start of the last bytes of a file; None if there is none.

    Every record begins where the one before ends, and the last one ends with the file. is_all: the
    first record begins with the bytes.
    """
    count = len(tail) - _RECORD_BYTES + 1
    if count < 1:
        return None
    word = np.dtype(order + "u4")
    fraction, captured, original = (
        np.ndarray(count, word, tail.data, at, (1,)) for at in (4, _LENGTH_AT, 12)
    )
    is_record = (captured >= _LEAST_FRAME) & (captured <= original)
    is_record &= (original <= MAX_FRAME_BYTES) & (fraction < NS_PER_S // unit_ns)
    # From the end: the next start in the chain, for each start that reaches the end of the file.
    after = {len(tail): len(tail)}
    first = len(tail)
    for start in np.flatnonzero(is_record)[::-1].tolist():
        end = start + _RECORD_BYTES + int(captured[start])
        if end in after:
            after[start] = end
            first = start
    if is_all:
        return 0 if first == 0 else None
    if first >= MAX_FRAME_BYTES + _RECORD_BYTES:
        return None
    # Bytes of a frame may look like the first header.
    second = after[first]
    return second if second < len(tail) else None


class _Walker:
    """Steps from record to record."""

    def __init__(self, order: str, unit_ns: int, link: int) -> None:
        self.length = struct.Struct(order + "I")
        self.unit_ns = unit_ns
        self.link = link
        self.loops = CaptureLoops()
        self.is_swapped = order == ">"
        self.skip = _FILE_HEADER_BYTES

    def walk(self, data: U8Array, begin: int, end: int) -> Walk:
        """The frames in `data[begin:end]`, as far as their records are complete.

        At most as many frames as the loops have room for.
        """
        begin += self.skip
        self.skip = 0
        records, place, why = self.loops.walk(
            data, begin, end, self.is_swapped, self.unit_ns, MAX_FRAME_BYTES
        )
        start, captured, original, host_ns = records
        link = np.full(len(start), self.link, np.int64)
        frames = Frames(start, captured, original, link, host_ns)
        more = 0
        if place <= end - _RECORD_BYTES:
            more = self.length.unpack_from(data.data, place + _LENGTH_AT)[0]
        if why == NO_ROOM:
            walk = Walk(place, frames=frames)
        elif why == TOO_LONG:
            fault = f"expected a frame of at most {MAX_FRAME_BYTES} bytes, found {more}"
            walk = Walk(place, fault=fault, frames=frames)
        else:
            walk = Walk(place, _RECORD_BYTES + more, frames=frames)
        return _up_to_zeros(walk)


def _up_to_zeros(walk: Walk) -> Walk:
    """End a walk at a record of zeros, which nobody wrote: the disk was full, or power failed."""
    frames = walk.frames
    if frames.captured.all():
        return walk
    is_zero = (frames.captured == 0) & (frames.original == 0) & (frames.host_ns == 0)
    rows = np.flatnonzero(is_zero)
    if not len(rows):
        return walk
    first = int(rows[0])
    place = int(frames.start[first]) - _RECORD_BYTES
    return Walk(place, fault=_ZEROS, frames=frames.take(slice(0, first)))
