"""A headless Chromium, driven through a pipe: loads a page, evaluates scripts, takes screenshots.

Source: Chrome DevTools Protocol, domains Page, Runtime, Log, Network and Emulation; with
`--remote-debugging-pipe` the browser reads commands from file descriptor 3 and answers on 4, each
message ended by a zero byte.
"""

from __future__ import annotations

import base64
import contextlib
import json
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
NO_CHROMIUM = "chromium is not installed (Debian: apt-get install chromium)"
_FLAGS = (
    *("--headless", "--no-sandbox", "--disable-quic", "--no-first-run"),
    # WebGL on the processor.
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    *("--disable-dev-shm-usage", "--remote-debugging-pipe"),
)
_LONGEST_S = 120.0


@dataclass
class Browser:
    """A tab."""

    to: int
    back: int
    session: str = ""
    errors: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)
    _number: int = 0
    _rest: bytes = b""

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """Call a method of the protocol; events that come in between are noted."""
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": params}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.to, json.dumps(message).encode() + b"\0")
        while True:
            found = self._message()
            if found.get("id") == self._number:
                assert "error" not in found, (method, found["error"])
                result: dict[str, Any] = found["result"]
                return result
            self._note(found)

    def _message(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            data = os.read(self.back, 1 << 20)
            assert data, "the browser ended"
            self._rest += data
        text, _, self._rest = self._rest.partition(b"\0")
        found: dict[str, Any] = json.loads(text)
        return found

    def _note(self, event: dict[str, Any]) -> None:
        params = event.get("params", {})
        method = event.get("method")
        if method == "Runtime.exceptionThrown":
            self.errors.append(json.dumps(params["exceptionDetails"]))
        elif method == "Runtime.consoleAPICalled" and params["type"] in ("error", "warning"):
            self.errors.append(json.dumps(params["args"]))
        elif method == "Log.entryAdded" and params["entry"]["level"] in ("error", "warning"):
            self.errors.append(params["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])

    def open(self, page: Path | str, *, width: int = 1400, dark: bool = False) -> None:
        """Load a page, by its file or address, and wait until it is drawn."""
        self.errors.clear()
        self.requests.clear()
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        still = {"name": "prefers-reduced-motion", "value": "reduce"}
        self.call("Emulation.setEmulatedMedia", features=[scheme, still])
        self.call(
            "Emulation.setDeviceMetricsOverride",
            **{"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False},
        )
        self.call("Page.navigate", url=page if isinstance(page, str) else page.resolve().as_uri())
        self.wait(
            "document.readyState === 'complete' && 'drawn' in document.documentElement.dataset",
            True,
        )
        # Widths settle.
        time.sleep(0.2)
        self.run("0")

    @contextlib.contextmanager
    def before_pages(self, script: str) -> Iterator[None]:
        """Run a script in each page before its own."""
        added = self.call("Page.addScriptToEvaluateOnNewDocument", source=script)
        yield
        self.call("Page.removeScriptToEvaluateOnNewDocument", identifier=added["identifier"])

    def press(self, key: str, *, shift: bool = False) -> None:
        """Press a key, as a browser does."""
        text = {"text": key} if len(key) == 1 else {}
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, modifiers=8 * shift, **text)
        time.sleep(0.1)

    def hover(self, selector: str, across: float, down: float) -> None:
        """Point at a place of an element, in shares of its size."""
        box = self._box(selector)
        x, y = box[0] + across * box[2], box[1] + down * box[3]
        self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        time.sleep(0.2)

    def wait(self, script: str, value: object = None) -> None:
        """Wait until an expression has a value; None: any."""
        until = time.monotonic() + _LONGEST_S
        while True:
            found = self.run(script)
            if found == value if value is not None else found is not None:
                break
            assert time.monotonic() < until, (found, self.errors)
            time.sleep(0.02)
        time.sleep(0.1)

    def _box(self, selector: str) -> list[float]:
        """Left, top, width and height of an element, which is scrolled into view."""
        found: list[float] = self.run(
            f"(() => {{ const e = document.querySelector({json.dumps(selector)});"
            "e.scrollIntoView({block: 'center', behavior: 'instant'});"
            "const b = e.getBoundingClientRect(); return [b.left, b.top, b.width, b.height]; })()"
        )
        return found

    def run(self, script: str) -> Any:
        """The value of an expression."""
        found = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def screenshot(self) -> tuple[int, int]:
        """Width and height of a picture of the whole page."""
        found = self.call("Page.captureScreenshot", captureBeyondViewport=True)
        size = base64.b64decode(found["data"])[16:24]
        return int.from_bytes(size[:4], "big"), int.from_bytes(size[4:], "big")

    def drag(self, selector: str, start: float, end: float) -> None:
        """Drag the mouse over an element, between two shares of its width."""
        box = self._box(selector)
        y = box[1] + box[3] / 2
        places = [box[0] + share * box[2] for share in (start, (start + end) / 2, end)]
        for kind, x in zip(("mousePressed", "mouseMoved", "mouseReleased"), places, strict=True):
            button = {"button": "left", "buttons": 1, "clickCount": 1}
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **button)
        time.sleep(0.2)


@contextlib.contextmanager
def browser(folder: Path) -> Iterator[Browser]:
    """A browser with an empty profile in a folder."""
    assert CHROMIUM is not None
    read_commands, to = os.pipe()
    back, write_answers = os.pipe()
    command = f'exec "$@" 3<&{read_commands} 4>&{write_answers}'
    process = subprocess.Popen(
        ["bash", "-c", command, "bash", CHROMIUM, *_FLAGS, f"--user-data-dir={folder}"],
        pass_fds=(read_commands, write_answers),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(read_commands)
    os.close(write_answers)
    tab = Browser(to, back)
    try:
        target = tab.call("Target.createTarget", url="about:blank")["targetId"]
        found = tab.call("Target.attachToTarget", targetId=target, flatten=True)
        tab.session = found["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            tab.call(f"{domain}.enable")
        yield tab
    finally:
        os.close(to)
        os.close(back)
        process.terminate()
        process.wait(60)
