"""Errors and interrupts end a run with any number of jobs alike; outputs: test_digests.py.

Recordings are those of `tests.resume_storm`: two lidars with an IMU, a bag, a clock that jumps.
"""

from __future__ import annotations

import faulthandler
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from mlbatch.decode.decoder import Decoder
from mlbatch.errors import ExportError, PacketError
from mlbatch.writers import output_file
from mlbatch.writers.mcap_container import Chunk
from tests.builders.run import command
from tests.resume_storm import CASES, write_recordings

_HANGS_AFTER_S = 300
_TURNS = 14
JOBS = (1, 2, 3)


@pytest.fixture(autouse=True)
def _guard() -> Iterator[None]:
    """What waits for ever ends the whole test run, and says where."""
    faulthandler.dump_traceback_later(_HANGS_AFTER_S, exit=True)
    yield
    faulthandler.cancel_dump_traceback_later()


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the cases convert."""
    folder = tmp_path_factory.mktemp("jobs")
    write_recordings(folder / "in", _TURNS)
    return folder


def _words(name: str, *more: str) -> list[str]:
    case = CASES[name]
    return ["convert", f"../in/{case.recording}", "-o", case.output, *case.options, *more]


def _place(recordings: Path, name: str) -> Path:
    place = recordings / name
    place.mkdir()
    return place


@pytest.mark.parametrize("name", ["mcap", "npz", "rosbag1"])
def test_a_strict_run_fails_alike(
    recordings: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A packet in the midst has another size; scans before it may be under way."""
    monkeypatch.chdir(_place(recordings, f"{name} strict"))
    words = ("--fault", "truncate:ouster_111:1%", "--strict", "--overwrite")
    outcome = [command(*_words(name, *words, "--jobs", str(jobs))) for jobs in JOBS]
    assert outcome[0].code == 1
    assert outcome[0].err.count("\n") == 1
    assert outcome[1:] == outcome[:1] * 2


class Nth:
    """Fails at one of its calls."""

    def __init__(self, number: int, error: BaseException) -> None:
        self._left = number
        self._error = error

    def call(self) -> None:
        """Count a call."""
        self._left -= 1
        if not self._left:
            raise self._error


# What fails in a stage, how, and what is said of it.
STAGES: dict[str, tuple[object, str, BaseException, str]] = {
    "decode": (Decoder, "scan", PacketError("spoilt"), "spoilt"),
    "compress": (Chunk, "compress", MemoryError(), "out of memory"),
    "write": (output_file, "write_all", OSError(28, "No space left"), "No space left"),
}


@pytest.mark.parametrize("jobs", JOBS)
@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.parametrize("number", [1, 3])
def test_an_error_of_any_stage_ends_the_run(
    recordings: Path, stage: str, jobs: int, number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(_place(recordings, f"{stage} {jobs} {number}"))
    place, name, error, message = STAGES[stage]
    nth = Nth(number, error)
    call = getattr(place, name)

    def failing(*given: object) -> object:
        nth.call()
        return call(*given)

    monkeypatch.setattr(place, name, failing)
    outcome = command(*_words("mcap", "--jobs", str(jobs)))
    assert outcome.code == 1
    assert outcome.err.count("\n") == 1
    assert message in outcome.err
    assert not Path("out.mcap").exists()


def test_the_earliest_failed_scan_is_reported(
    recordings: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fourth fails at once, the second after a while: one job never comes to the fourth."""
    monkeypatch.chdir(_place(recordings, "earliest"))
    scan = Decoder.scan

    def failing(decoder: Decoder, *given: object) -> object:
        found = scan(decoder, *given)  # type: ignore[arg-type]
        if found.index == 1:
            time.sleep(0.3)
        if found.index in (1, 3):
            raise ExportError(f"scan {found.index}")
        return found

    monkeypatch.setattr(Decoder, "scan", failing)
    for jobs in JOBS:
        outcome = command(*_words("npz", "--jobs", str(jobs), "--overwrite"))
        assert outcome.err.splitlines()[-1] == "mlbatch: error: scan 1"
