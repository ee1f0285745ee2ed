"""Scans by their number, as a page stores them: made when asked for, the last few kept."""

from __future__ import annotations

import json
import threading
from collections import OrderedDict
from collections.abc import Callable, Generator, Iterator

import numpy as np

from mlbatch.errors import MlbatchError, RecordingError, system_error
from mlbatch.outputs.scan import Scan
from mlbatch.page.document import cloud_data
from mlbatch.page.points import CloudPoints, Place, joined_cloud
from mlbatch.units import NS_PER_S

# Scans to go back to without a new start.
MOST_KEPT = 16
# A scan that is being made is waited for, at the end.
_LAST_S = 5.0


class ViewScans:
    """The scans of a source, packed; for several threads.

    begin: gives an iterator over all scans; say: called once with each new error. Scans are made
    one after another, up to the one that is asked for, and never ahead of it. An earlier one that
    is not kept any more is made by a new start.
    """

    def __init__(self, begin: Callable[[], Iterator[Scan]], say: Callable[[str], None]) -> None:
        """Make the first scan. Raises MlbatchError where there is none."""
        self._begin = begin
        self._say = say
        self._lock = threading.Lock()
        self._kept: OrderedDict[int, bytes] = OrderedDict()
        self._windows: Generator[list[Scan], None, None] = _windows(begin())
        self._next = 0  # number of the next scan of `_windows`
        self._end = b""  # the answer from the last scan on, once it is known
        self.error = ""
        parts = next(self._windows, None)
        if parts is None:
            raise RecordingError("view: expected at least one scan, found none; convert again")
        self.first = parts[0]
        self._keep(parts)

    @property
    def kept(self) -> int:
        """Number of scans in memory."""
        return len(self._kept)

    def get(self, number: int) -> bytes:
        """A scan: length of its header (4 bytes, little-endian), header, deflated points.

        After the last scan a header alone: `total`, or `error`, which ended the scans.
        """
        with self._lock:
            if number in self._kept:
                return self._kept[number]
            if self._end and number >= self._next:
                return self._end
            try:
                if number < self._next:
                    self._windows.close()
                    self._next = 0
                    self._end = b""
                    self._windows = _windows(self._begin())
                while self._next <= number:
                    parts = next(self._windows, None)
                    if parts is None:
                        self._end = _answer({"total": self._next})
                        return self._end
                    # Those passed over need no packing.
                    if self._next > number - MOST_KEPT // 2:
                        self._keep(parts)
                    else:
                        self._next += 1
            except Exception as err:
                self._fail(err)
                return self._end
            return self._kept[number]

    def close(self) -> None:
        """End; a scan that is being made is finished."""
        if self._lock.acquire(timeout=_LAST_S):
            self._windows.close()

    def _keep(self, parts: list[Scan]) -> None:
        self._kept[self._next] = _packed(parts, self._next, self.first.start_ns)
        self._next += 1
        while len(self._kept) > MOST_KEPT:
            self._kept.popitem(last=False)

    def _fail(self, err: Exception) -> None:
        """Answer with an error from the next scan on."""
        if isinstance(err, OSError):
            err = system_error(err)
        is_known = isinstance(err, MlbatchError)
        text = str(err) if is_known else f"internal error, please report it: {err!r}"
        self._end = _answer({"error": f"After {self._next} scans: {text}"})
        if text != self.error:
            self._say(text)
        self.error = text


def _windows(scans: Iterator[Scan]) -> Generator[list[Scan], None, None]:
    """The scans of each window: one, with `--split` those of its sensors."""
    parts: list[Scan] = []
    for scan in scans:
        if parts and _window_of(scan) != _window_of(parts[0]):
            yield parts
            parts = []
        parts.append(scan)
        # Not after the next one: that may be an error.
        if not scan.sensor:
            yield parts
            parts = []
    if parts:
        yield parts


def _window_of(scan: Scan) -> tuple[int, int, int]:
    return scan.index, scan.slice, scan.start_ns


def _packed(parts: list[Scan], number: int, first_ns: int) -> bytes:
    first = parts[0]
    place = Place("", number, first.index, first.slice, first.start_ns)
    window_ns = first.end_ns - first.start_ns
    # All columns are shown, whatever their number.
    one, points = np.ones(1, np.int64), list(map(CloudPoints.of, parts))
    cloud = joined_cloud(place, points, window_ns, one, absent=first.absent, is_fast=True)
    return _answer(cloud_data(cloud, (first.start_ns - first_ns) / NS_PER_S), cloud.packed)


def _answer(header: dict[str, object], points: bytes = b"") -> bytes:
    text = json.dumps(header).encode()
    return len(text).to_bytes(4, "little") + text + points
