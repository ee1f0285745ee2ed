"""Faults of the machine: devices, pipes, full and read-only disks, closed streams."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import mlbatch
from mlbatch.errors import RecordingError
from tests.builders.sessions import CAPTURE, RIG, Shell

PAIR = f"{CAPTURE} -r {RIG}"


@pytest.fixture(autouse=True)
def _no_wait() -> Iterator[None]:
    """A run that waits for the writer of a pipe fails."""
    signal.alarm(60)
    yield
    signal.alarm(0)


@pytest.fixture
def output(shell: Shell) -> str:
    """A finished output in the folder of the shell."""
    assert shell(f"convert {PAIR} -o out -f npz -q").code == 0
    return "out"


def _one_line(shell: Shell, command: str, code: int, message: str) -> None:
    outcome = shell(command)
    assert outcome.out == ""
    assert outcome.err.splitlines() == [f"mlbatch: error: {message}"]
    assert outcome.code == code


# -- devices and pipes ------------------------------------------------------------------------


def test_a_pipe_among_the_scans_is_damage(shell: Shell, output: str) -> None:
    first = Path(output) / "000000.npz"
    first.unlink()
    os.mkfifo(first)
    with pytest.raises(RecordingError, match="found a pipe"):
        list(mlbatch.read(output))
    assert shell(f"batch {first} -o sessions").code == 3


# -- large and deep content -------------------------------------------------------------------


def test_an_archive_that_unpacks_to_a_thousand_times_its_size(shell: Shell, output: str) -> None:
    """300 MB of zeros; the limit is 256 MB, or 256 times the stored bytes."""
    bomb = Path(output) / "000000.npz"
    with (
        zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("xyz.npy", "w", force_zip64=True) as member,
    ):
        for _ in range(300):
            member.write(bytes(1 << 20))
    assert bomb.stat().st_size < 1 << 20
    limit = "expected at most 268435456 bytes"
    with pytest.raises(RecordingError, match=limit):
        next(mlbatch.read(output))
    for command in (f"digest {output}", f"diff {output} {output}"):
        outcome = shell(command)
        assert (outcome.code, limit in outcome.err) == (1, True)


# -- disks ------------------------------------------------------------------------------------

WRITTEN = {
    "mcap": (f"convert {PAIR} -o ro/x.mcap", "ro/x.mcap.partial"),
    "folder": (f"convert {PAIR} -o ro/x", "ro/x.partial"),
    "report": (f"convert {PAIR} --dry-run --report ro/r.json", "ro/r.json"),
    "page": (f"convert {PAIR} --dry-run --html ro/r.html", "ro/r.html"),
    "page of an output": ("report out -o ro/r.html", "ro/r.html"),
    "golden": ("digest out -o ro/g.json", "ro/g.json"),
    "rig": (f"inspect {PAIR} --write-rig ro/rig.yaml", "ro/rig.yaml"),
}


@pytest.mark.parametrize("name", WRITTEN)
def test_a_read_only_folder(
    shell: Shell, output: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    Path("ro").mkdir()

    def refusing(method: Callable[..., Any]) -> Callable[..., Any]:
        def refuse(path: Path, *values: Any, **options: Any) -> Any:
            if path.parent.name == "ro":
                raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))
            return method(path, *values, **options)

        return refuse

    for change in ("unlink", "mkdir", "touch", "write_bytes", "write_text"):
        monkeypatch.setattr(Path, change, refusing(getattr(Path, change)))
    command, path = WRITTEN[name]
    outcome = shell(command)
    assert outcome.err.splitlines()[-1] == (
        f"mlbatch: error: {path}: expected to write it, found 'Read-only file system'; choose an "
        "output on a disk that is not read-only"
    )
    assert "internal error" not in outcome.err
    assert outcome.code == 1
    assert output == "out"


def _mlbatch(words: str) -> subprocess.CompletedProcess[str]:
    """A shell line of its own process; mlbatch: this one."""
    line = words.replace("mlbatch", f"{sys.executable} -m mlbatch", 1)
    return subprocess.run(
        ["sh", "-c", line], capture_output=True, text=True, check=False, timeout=300
    )


@pytest.mark.parametrize(
    "command", ["--help", "schema rig", f"inspect {PAIR}", f"convert {PAIR} --dry-run"]
)
def test_a_full_standard_output(command: str) -> None:
    run = _mlbatch(f"mlbatch {command} > /dev/full")
    assert run.stderr == (
        "mlbatch: error: standard output or another stream: expected to read or write it, found "
        "'No space left on device'; free space on this disk or choose another output\n"
    )
    assert run.returncode == 1


def test_closed_streams() -> None:
    run = _mlbatch(f"mlbatch inspect {PAIR} >&- 2>&- <&-")
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")
    run = _mlbatch("mlbatch convert none.pcap -o x.mcap 2> /dev/full")
    assert (run.returncode, run.stdout, run.stderr) == (1, "", "")


def test_a_fault_of_the_system_without_a_path_or_number(
    shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE), "a/b")

    monkeypatch.setattr("mlbatch.rig.yaml_tree.read_yaml", fail)
    monkeypatch.setattr("mlbatch.cli.rig_options._may_have_section", lambda rig: True)
    _one_line(
        shell,
        f"convert {PAIR} --dry-run",
        1,
        "a/b: expected to read or write it, found 'Too many open files'; raise the limit of open "
        "files (ulimit -n)",
    )


def test_reports_are_read_from_standard_input_up_to_a_limit(
    shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mlbatch.bounded.MOST_BYTES", 100)
    with Path("/dev/zero").open(encoding="utf-8") as zeros:
        monkeypatch.setattr("sys.stdin", zeros)
        _one_line(
            shell,
            "report - -o x.html",
            2,
            "standard input: expected a report, found more than 100 bytes; give the report of "
            "`mlbatch convert`",
        )


# -- names and words --------------------------------------------------------------------------


def test_names_that_are_no_text(shell: Shell) -> None:
    """The bytes of a name need not be UTF-8; a direction mark is not printed as it is."""
    Path("a\udcff.pcap").write_bytes(CAPTURE.read_bytes())
    for command in (
        f"convert a\udcff.pcap -r {RIG} -o b\udcff\u202e.mcap",
        "report b\udcff\u202e.mcap",
        f"batch a\udcff.pcap -r {RIG} -o sessions",
        "batch-status sessions --page page.html",
    ):
        outcome = shell(command)
        assert (outcome.code, outcome.err) == (0, ""), command
        assert "\udcff" not in outcome.out
        assert "\u202e" not in outcome.out
    assert "a%FF" in Path("page.html").read_text(encoding="utf-8")
