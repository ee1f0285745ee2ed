"""`mlbatch view`: a page on the loopback interface that asks for the scans it shows."""

from __future__ import annotations

import json
import re
import threading
from collections import OrderedDict
from collections.abc import Callable, Generator, Iterator
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import numpy as np

from mlbatch.errors import MlbatchError, RecordingError, UsageError, system_error
from mlbatch.outputs.scan import Scan
from mlbatch.page.clouds import CloudPoints, Place, joined_cloud
from mlbatch.page.document import COLOURS, cloud_data, lacking
from mlbatch.page.templates import asset, page_json, render
from mlbatch.units import NS_PER_S, parse_rate

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


# The only address: scans of vehicles are nobody else's.
LOOPBACK = "127.0.0.1"
# Another name that resolves to it would let a foreign page read the scans (DNS rebinding). The port
# may be that of a tunnel.
_HOST = re.compile(r"(127\.0\.0\.1|localhost)(:\d{1,5})?")
_SCAN = re.compile(r"/scans/(\d{1,9})")
_IDLE_S = 60
# Scans that the page asks for while it shows one.
_AHEAD = 3


class ViewServer(ThreadingHTTPServer):
    """The server of a page; port: 0 for a free one. Raises UsageError for a port in use."""

    daemon_threads = True

    def __init__(
        self,
        title: str,
        scans: ViewScans,
        total: int | None,
        port: int = 0,
        expected: int | None = None,
    ) -> None:
        """total: number of scans, None if unknown; expected: about as many, for the slider."""
        self.scans = scans
        self.page = _page(title, scans.first, total, expected)
        try:
            super().__init__((LOOPBACK, port), _Handler)
        except (OSError, OverflowError) as err:
            raise UsageError(
                f"--port: expected a free port of {LOOPBACK}, found {port}: "
                f"{getattr(err, 'strerror', None) or err}; leave it out, or choose another"
            ) from err

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{LOOPBACK}:{self.server_port}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore browsers that end a connection."""


class _Handler(BaseHTTPRequestHandler):
    server: ViewServer
    protocol_version = "HTTP/1.1"
    timeout = _IDLE_S

    def do_GET(self) -> None:
        """Answer with the page or a scan."""
        scan = _SCAN.fullmatch(self.path)
        if not _HOST.fullmatch(self.headers.get("Host", "")):
            self._send(HTTPStatus.FORBIDDEN, "text/plain", b"expected the address that was printed")
        elif self.path == "/":
            self._send(HTTPStatus.OK, "text/html; charset=utf-8", self.server.page)
        elif scan is None:
            self._send(HTTPStatus.NOT_FOUND, "text/plain", b"expected / or /scans/NUMBER")
        elif self.headers.get("Sec-Fetch-Site", "same-origin") not in ("same-origin", "none"):
            self._send(HTTPStatus.FORBIDDEN, "text/plain", b"expected a request of the page")
        else:
            data = self.server.scans.get(int(scan[1]))
            self._send(HTTPStatus.OK, "application/octet-stream", data)

    def _send(self, status: HTTPStatus, kind: str, data: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("Content-Security-Policy", "frame-ancestors 'none'")
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *args: Any) -> None:
        """Print nothing of requests."""


def _page(title: str, first: Scan, total: int | None, expected: int | None) -> bytes:
    poses = [sensor.body_from_sensor for sensor in first.info.sensors]
    data = {
        "sensors": first.sensors,
        "poses": [
            pose[:3].ravel().tolist() if bool(np.isfinite(pose).all()) else None for pose in poses
        ],
        # The head of a run is partial.
        "begin": int(first.index < 0 and (total or 0) > 1),
        "ahead": _AHEAD,
        "is_played": True,
        "play_ms": float(1000 / (parse_rate(first.rate_hz) * first.slices)),
        "total": total,
        "expected": expected or 0,
    }
    text = render(
        "view.html",
        title=title,
        about=f"{', '.join(first.sensors)} at {first.rate_hz} Hz, all points; coordinates rounded "
        "to 5 mm, or 1/65535 of the size of the scan if that is more.",
        colours=COLOURS,
        lacking=lacking(first.absent),
        data=page_json(data),
        script="".join(map(asset, ("viewer.js", "player.js", "view.js"))),
    )
    return text.encode("utf-8", "backslashreplace")
