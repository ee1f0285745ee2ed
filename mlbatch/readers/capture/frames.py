"""Frames of captures, as a file format finds them, and the link types that are read.

Numbers of link types: tcpdump.org/linktypes.html; their headers: `native/capture.c`, `odd.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import I64Array

RAW_IP = 101
LINKS = frozenset((0, 1, 9, 12, 14, 50, 51, RAW_IP, 108, 113, 228, 229, 276))
# Frames of a pcapng interface that the file does not describe.
NO_LINK = -1
_NAMES = {
    NO_LINK: "no interface block",
    105: "IEEE 802.11",
    127: "IEEE 802.11 radiotap",
    189: "USB",
    192: "PPI",
    220: "USB",
    227: "CAN",
    239: "NFLOG",
}


def unknown_link(number: int) -> str:
    """Text of an error about frames of this link type."""
    name = _NAMES.get(number, "unknown")
    known = ", ".join(map(str, sorted(LINKS)))
    return (
        f"expected frames of link type {known}, found {number} ({name}); "
        "capture on the network interface that the sensors are connected to"
    )


@dataclass(slots=True)
class Frames:
    """n link-layer frames in a buffer, in file order; all fields (n,) int64.

    start: first byte; captured, original: bytes in the file and on the wire; link: link type.
    """

    start: I64Array
    captured: I64Array
    original: I64Array
    link: I64Array
    host_ns: I64Array

    @classmethod
    def none(cls) -> Frames:
        """No frames."""
        empty = np.zeros(0, np.int64)
        return cls(empty, empty, empty, empty, empty)

    def __len__(self) -> int:
        return len(self.start)

    def take(self, rows: slice) -> Frames:
        """The frames at `rows`."""
        return Frames(
            self.start[rows],
            self.captured[rows],
            self.original[rows],
            self.link[rows],
            self.host_ns[rows],
        )
