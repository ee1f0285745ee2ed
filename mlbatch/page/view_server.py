"""`mlbatch view`: a page on the loopback interface that asks for the scans it shows."""

from __future__ import annotations

import re
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import numpy as np

from mlbatch.errors import UsageError
from mlbatch.outputs.scan import Scan
from mlbatch.page.document import COLOURS, lacking
from mlbatch.page.templates import asset, page_json, render
from mlbatch.page.view_scans import ViewScans
from mlbatch.units import parse_rate

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
