"""`mlbatch view`: scans of the server are those of the library, on loopback, few in memory."""

from __future__ import annotations

import base64
import contextlib
import http.client
import json
import re
import signal
import socket
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mlbatch
from mlbatch.errors import RecordingError
from mlbatch.outputs.read import read
from mlbatch.page.view_server import LOOPBACK, MOST_KEPT, ViewScans, ViewServer
from tests.builders.sessions import FIXTURE
from tests.contract.tree import run_mlbatch
from tests.page.browser import CHROMIUM, NO_CHROMIUM, Browser
from tests.page.test_page import points_of

CAPTURE = FIXTURE / "two_lidars.pcap"
RIG = FIXTURE / "rig.yaml"
# fixtures/two_lidars/SOURCE.md.
SCANS = 7
OUTPUTS = {
    "mcap": ("s.mcap", ()),
    "organized": ("s.mcap", ("--layout", "organized")),
    "split": ("s", ("--split",)),
    "kitti": ("s", ("-f", "kitti")),
}


@contextlib.contextmanager
def served(
    scans: ViewScans, total: int | None = None, expected: int | None = None
) -> Iterator[ViewServer]:
    with ViewServer("drive <b>", scans, total, expected=expected) as server:
        thread = threading.Thread(target=server.serve_forever, args=[0.01])
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()
            scans.close()


def header_of(answer: bytes) -> Any:
    """The header of an answer, with its points as a page has them."""
    size = int.from_bytes(answer[:4], "little")
    header = json.loads(answer[4 : 4 + size])
    return header | {"data": base64.b64encode(answer[4 + size :]).decode()}


def fetched(server: ViewServer, number: int) -> Any:
    with urllib.request.urlopen(f"{server.url}scans/{number}") as answer:
        return header_of(answer.read())


def status(server: ViewServer, path: str, **headers: str) -> int:
    connection = http.client.HTTPConnection(LOOPBACK, server.server_port)
    headers = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request("GET", path, headers=headers)
    found = connection.getresponse().status
    connection.close()
    return found


def some_scans(count: int, error: Exception | None = None) -> Iterator[mlbatch.Scan]:
    """Scans of two points; the last one ends with an error, if there is any."""
    scan = next(mlbatch.scans(CAPTURE, rig=RIG))
    few = {name: getattr(scan, name)[:2] for name in ("xyz", "intensity", "time_ns", "ring")}
    for number in range(count):
        start_ns = scan.start_ns + number * 100_000_000
        yield replace(
            scan,
            index=number,
            start_ns=start_ns,
            end_ns=start_ns + 100_000_000,
            lidar_id=scan.lidar_id[:2],
            **few,
        )
    if error is not None:
        raise error


def convert(folder: Path, output: str, *options: str) -> Path:
    words = ["convert", str(CAPTURE), "-r", str(RIG), "-o", output, "-q", *options]
    done = run_mlbatch(words, folder)
    assert done.returncode == 0, done.stderr
    return folder / output


def same(shown: Any, scan: mlbatch.Scan) -> None:
    """A scan of the server against one of the library; fields as in clouds.py."""
    points = points_of(shown)
    valid = scan.is_valid
    columns = scan.lidar_id if scan.lidar_id.ndim == valid.ndim else scan.lidar_id[:, None]
    lidar = np.broadcast_to(columns, valid.shape)[valid]
    time_ns = scan.time_ns[valid].astype(np.int64)
    order = np.lexsort((time_ns, scan.ring[valid], lidar))
    np.testing.assert_array_equal(points.lidar, lidar[order])
    np.testing.assert_array_equal(points.ring, scan.ring[valid][order])
    assert np.abs(points.xyz - scan.xyz[valid][order]).max() <= 0.5 * shown["step"] + 1e-5
    assert np.abs(points.time_ms - time_ns[order] / 1e6).max() <= 100 / 65535


@pytest.mark.parametrize("case", OUTPUTS)
def test_scans_of_an_output(case: str, tmp_path: Path) -> None:
    name, options = OUTPUTS[case]
    output = convert(tmp_path, name, *options)
    scans = list(read(output, by_window=True))
    with served(ViewScans(lambda: read(output, by_window=True), pytest.fail)) as server:
        for number in range(SCANS):
            shown = fetched(server, number)
            assert shown["title"] == f"Scan {number}, +0.{number} s"
            if case == "split":
                left, right = scans[2 * number : 2 * number + 2]
                assert shown["shown"] == left.point_count + right.point_count
            elif case == "kitti":
                # Neither lidars nor times, which `same` compares.
                assert shown["has"] == {"lidar": False, "time": False, "ring": False}
                xyz = np.sort(scans[number].xyz, axis=0)
                found = np.sort(points_of(shown).xyz, axis=0)
                assert np.abs(found - xyz).max() <= 0.5 * shown["step"] + 1e-5
            else:
                same(shown, scans[number])
        assert fetched(server, SCANS)["total"] == SCANS
        # Kept, and the same.
        assert fetched(server, 0)["title"] == "Scan 0, +0.0 s"


def test_scans_of_a_recording() -> None:
    scans = list(mlbatch.scans(CAPTURE, rig=RIG, rate=20))
    begin = lambda: mlbatch.scans(CAPTURE, rig=RIG, rate=20)  # noqa: E731
    with served(ViewScans(begin, pytest.fail)) as server:
        # From the middle on.
        for number in (9, 3, len(scans) - 1):
            same(fetched(server, number), scans[number])
        assert fetched(server, 1000)["total"] == len(scans)


def test_scans_are_made_when_asked_for_and_few_are_kept() -> None:
    begun: list[list[int]] = []

    def begin() -> Iterator[mlbatch.Scan]:
        made: list[int] = []
        begun.append(made)
        for scan in some_scans(100):
            made.append(scan.index)
            yield scan

    scans = ViewScans(begin, pytest.fail)
    first = scans.get(0)
    assert begun == [[0]]
    for number in range(60):
        scans.get(number)
        assert len(begun[0]) == number + 1
        assert scans.kept <= MOST_KEPT
    scans.get(60 - MOST_KEPT)
    assert len(begun) == 1
    assert scans.get(0) == first
    assert len(begun) == 2
    assert scans.get(99) != first
    assert scans.kept <= MOST_KEPT
    assert header_of(scans.get(100))["total"] == 100


def test_an_error_comes_after_its_scans_and_is_said_once() -> None:
    said: list[str] = []
    error = RecordingError("drive.pcap: expected a packet, found none; record again")
    scans = ViewScans(lambda: some_scans(3, error), said.append)
    for number in (5, 3, 4):
        assert header_of(scans.get(number))["error"] == f"After 3 scans: {error}"
    assert "low" in header_of(scans.get(2))
    assert said == [str(error)]
    assert scans.error == str(error)


def test_a_damaged_output_says_where(tmp_path: Path) -> None:
    output = convert(tmp_path, "s")
    (output / "000003.npz").write_bytes(b"damaged")
    scans = ViewScans(lambda: read(output), lambda text: None)
    assert "low" in header_of(scans.get(2))
    assert "000003.npz" in header_of(scans.get(3))["error"]


def test_loopback_alone() -> None:
    with served(ViewScans(lambda: some_scans(2), pytest.fail)) as server:
        port = server.server_port
        assert server.server_address[0] == "127.0.0.1"
        # Another address of this machine, which a server of all interfaces would answer.
        with pytest.raises(OSError), socket.create_connection(("127.0.0.2", port), 5):
            pass
        for host in (f"{LOOPBACK}:{port}", f"localhost:{port}", "localhost"):
            assert status(server, "/scans/0", Host=host) == 200
        for host in ("evil.example", f"evil.example:{port}", "127.0.0.1.evil.example", ""):
            assert status(server, "/", Host=host) == 403
            assert status(server, "/scans/0", Host=host) == 403
        assert status(server, "/scans/0", Sec_Fetch_Site="cross-site") == 403
        for path in ("/scans/", "/scans/-1", "/scans/x", "/../etc/passwd", "/scans/0/"):
            assert status(server, path) == 404
        with urllib.request.urlopen(server.url) as answer:
            page = answer.read().decode()
        assert "drive &lt;b&gt;" in page
        assert "drive <b>" not in page


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_ends(number: signal.Signals, tmp_path: Path) -> None:
    words = ["view", str(CAPTURE), "-r", str(RIG), "--no-browser"]
    command = [sys.executable, "-m", "mlbatch", *words]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=FIXTURE.parents[1]
    ) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.endswith(" shows two_lidars.pcap; Ctrl-C ends\n")
        with urllib.request.urlopen(line.split()[0]) as answer:
            # For the slider, before the end is known.
            found = re.search(rb'"total":null,"expected":(\d+)', answer.read())
            assert found is not None
            assert abs(int(found[1]) - SCANS) <= 1
        with urllib.request.urlopen(f"{line.split()[0]}scans/6") as answer:
            assert header_of(answer.read())["title"] == "Scan 6, +0.6 s"
        process.send_signal(number)
        _, err = process.communicate()
        assert (process.returncode, err) == (0, "")


def test_warnings_come_after_the_last_scan(tmp_path: Path) -> None:
    capture = tmp_path / "cut.pcap"
    capture.write_bytes(CAPTURE.read_bytes()[:-100])
    command = [sys.executable, "-m", "mlbatch", "view", str(capture), "-r", str(RIG)]
    with subprocess.Popen(
        [*command, "--no-browser"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        url = process.stdout.readline().split()[0]
        # Twice from the beginning on.
        for number in (1000, 0, 1000):
            with urllib.request.urlopen(f"{url}scans/{number}") as answer:
                answer.read()
        process.send_signal(signal.SIGINT)
        _, err = process.communicate()
    assert process.returncode == 0
    assert err.count("mlbatch: warning: cut_off: ") == 1


@pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)
def test_in_a_browser(tab: Browser) -> None:
    shown = "document.documentElement.dataset.shown"
    click = "document.getElementById('play').click()"
    why = "document.getElementById('cloudwhy').textContent"
    slide = (
        "(() => {{ const s = document.getElementById('scan'); s.value = {0}; "
        "s.dispatchEvent(new Event('input')); return s.value; }})()"
    )
    begin = lambda: mlbatch.scans(CAPTURE, rig=RIG)  # noqa: E731
    with served(ViewScans(begin, pytest.fail), expected=20) as server:
        tab.open(server.url)
        tab.wait(shown, "0")
        # Scans that are not loaded; those that do not exist are the last.
        for number, last in (("4", "4"), ("15", "6"), ("0", "0")):
            assert tab.run(slide.format(number)) == number
            tab.wait(shown, last)
        assert tab.run("document.getElementById('scan').max") == "6"
        tab.run(click)
        # All scans, and the first again.
        for number in ("3", "6", "0"):
            tab.wait(f"{shown} === '{number}'", True)
        tab.run(click)
        # That of the tests.
        assert "no WebGL with a graphics processor" in tab.run(why)
        assert {url.removeprefix(server.url).split("/")[0] for url in tab.requests} == {
            "",
            "scans",
        }
        assert tab.errors == []
    error = RecordingError("drive.pcap: damaged")
    with served(ViewScans(lambda: some_scans(3, error), lambda text: None)) as server:
        tab.open(server.url)
        tab.wait(shown, "0")
        tab.run(click)
        tab.wait(why, "After 3 scans: drive.pcap: damaged")
        assert tab.run(shown) == "2"
        assert tab.run("document.getElementById('play').textContent") == "Play"
        assert tab.errors == []
