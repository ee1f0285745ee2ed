"""Datasets of small sessions, and drivers of batches as processes that can be killed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from tests.builders.run import ROOT
from tests.builders.sessions import NS_PER_MS, SMALL, Unit, write_session

# Imported by every Python process that has it on its path: the process of a session `crash*` ends
# by SIGSEGV at once; that of a session `killed*` by SIGKILL at its first attempt, when it writes;
# that of a session `full*` at its first attempt by the line of a full disk. Those of `slow*` and
# `big*` never end at their first attempt; `big*` has written 3 MB.
SABOTEUR = """
import os, signal, sys, threading, time
words = getattr(sys, "orig_argv", [])
if "mlbatch.cli.child" in words:
    target = words[words.index("-o") + 1]
    name = os.path.basename(os.path.dirname(target))
    if name.startswith("crash"):
        os.kill(os.getpid(), signal.SIGSEGV)
    marker = os.path.join(os.environ["SABOTEUR_MARKS"], name)
    if name.startswith("full") and not os.path.exists(marker):
        open(marker, "w").close()
        reason = os.strerror(28)
        line = f"{target}: expected to write it, found {reason!r}; free space on this disk"
        os.write(2, f"mlbatch: error: {line}\\n".encode())
        os._exit(1)
    if name.startswith(("slow", "big")) and not os.path.exists(marker):
        open(marker, "w").close()
        if name.startswith("big"):
            with open(target + ".partial", "wb") as file:
                file.write(bytes(3_000_000))
        time.sleep(3600)
    if name.startswith("killed") and not os.path.exists(marker):
        open(marker, "w").close()
        def kill():
            while not os.path.exists(target + ".partial"):
                time.sleep(0.001)
            os.kill(os.getpid(), signal.SIGKILL)
        threading.Thread(target=kill, daemon=True).start()
"""
WAIT_S = 90.0

Options = Mapping[str, str | bool]


@dataclass(frozen=True, slots=True)
class Dataset:
    """A folder `raw` with one folder per session, a manifest, and an environment for drivers."""

    folder: Path

    @property
    def manifest(self) -> Path:
        """The manifest of all sessions."""
        return self.folder / "manifest.yaml"

    @property
    def env(self) -> dict[str, str]:
        """The environment of drivers: with the saboteur."""
        path = f"{self.folder / 'saboteur'}{os.pathsep}{ROOT}"
        return os.environ | {"PYTHONPATH": path, "SABOTEUR_MARKS": str(self.folder / "marks")}

    def forget_kills(self) -> None:
        """Let the saboteur kill again."""
        for mark in (self.folder / "marks").iterdir():
            mark.unlink()


def write_dataset(
    folder: Path,
    names: Iterable[str],
    options: Mapping[str, Options] | None = None,
    more: str = "",
) -> Dataset:
    """Sessions of one lidar, each with its own ranges.

    options: of `convert`, by session; more: lines of the manifest.

    `hopeless*` is no recording, that of `cut*` ends early, and `segments*` is longer.
    """
    for name in ("raw", "saboteur", "marks"):
        (folder / name).mkdir(parents=True)
    lines = ["schema: mlbatch.batch/1", "options: {rate: 20}", more, "sessions:"]
    for number, name in enumerate(names):
        own = json.dumps((options or {}).get(name, {}))
        lines.append(f'  - {{glob: "raw/{name}/", name: "{{folder}}", options: {own}}}')
        if name.startswith("hopeless"):
            (folder / "raw" / name).mkdir()
            (folder / "raw" / name / "drive.pcap").write_text("no recording", encoding="utf-8")
            continue
        unit = replace(
            Unit(SMALL, turns=6 if name.startswith("segments") else 3, range_mm=4000 + 8 * number),
            begin_ns=Unit().begin_ns + number * 1000 * NS_PER_MS,
        )
        capture = write_session(folder / "raw" / name, unit)
        if name.startswith("cut"):
            # Within the last record: all packets before it are there, and none counts as lost.
            capture.write_bytes(capture.read_bytes()[:-100])
    (folder / "saboteur" / "sitecustomize.py").write_text(SABOTEUR, encoding="utf-8")
    (folder / "manifest.yaml").write_text("\n".join(lines), encoding="utf-8")
    return Dataset(folder)


def start(data: Dataset, out: Path, *words: str) -> subprocess.Popen[str]:
    """A driver; its output is piped."""
    command = [sys.executable, "-m", "mlbatch", "batch", str(data.manifest), "-o", str(out)]
    return subprocess.Popen(
        [*command, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        stdin=subprocess.DEVNULL,
        text=True,
        env=data.env,
    )


@dataclass(frozen=True, slots=True)
class Ended:
    """A driver that ended; table: state by session."""

    code: int
    out: str
    err: str

    @property
    def table(self) -> dict[str, str]:
        """States of the last table."""
        lines = [line.split() for line in self.out.splitlines()]
        return {words[0]: words[1] for words in lines[1:-1]}

    @property
    def last(self) -> str:
        """The last line."""
        return self.out.splitlines()[-1]


def end(driver: subprocess.Popen[str]) -> Ended:
    """Wait for a driver."""
    out, err = driver.communicate(timeout=WAIT_S)
    return Ended(driver.returncode, out, err)


def run(data: Dataset, out: Path, *words: str) -> Ended:
    """A whole batch."""
    return end(start(data, out, *words))


def wait_for(condition: Callable[[], object]) -> None:
    """Wait until something has happened."""
    deadline_s = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline_s, "it did not happen"
        time.sleep(0.005)


def scans(out: Path) -> dict[str, bytes]:
    """Content of all outputs, without what has times of the run."""
    return {
        path.relative_to(out).as_posix(): path.read_bytes()
        for path in sorted(out.rglob("scans*"))
        if path.is_file()
    }


def processes_of(text: str) -> Iterator[int]:
    """Processes whose command line contains a text."""
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                words = (entry / "cmdline").read_bytes()
            except OSError:
                continue
            if text.encode() in words and int(entry.name) != os.getpid():
                yield int(entry.name)
