"""A short campaign on every target; `make fuzz` runs a long one."""

from __future__ import annotations

import contextlib
import random
import threading
from pathlib import Path

import pytest

from mlbatch.errors import MlbatchError
from tests.fuzz import harness
from tests.fuzz.harness import (
    LONGEST_S,
    MOST_BYTES,
    BrokenLaw,
    Target,
    campaign,
)
from tests.fuzz.mutation import Seeds
from tests.fuzz.run import TARGETS

# Inputs of a target by its share; the seeds themselves come first.
_PER_SHARE = 12


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name.replace(" ", "-"))
def test_no_input_breaks_it(target: Target) -> None:
    tally = campaign(target, range(target.share * _PER_SHARE))
    assert tally.inputs == target.share * _PER_SHARE
    assert not tally.failures, "\n\n".join(map(str, tally.failures))
    assert tally.slowest_s < LONGEST_S
    assert tally.peak_bytes < MOST_BYTES


def test_a_campaign_reports_what_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    """A campaign that finds nothing would look the same as one that does not look."""

    def crash(data: bytes, folder: Path) -> None:
        raise BrokenLaw("of thermodynamics")

    def swell(data: bytes, folder: Path) -> None:
        bytearray(2 * MOST_BYTES)

    def turn(data: bytes, folder: Path) -> None:
        while True:
            pass

    def wait(data: bytes, folder: Path) -> None:
        threading.Event().wait()

    monkeypatch.setattr(harness, "LONGEST_S", 0.2)
    monkeypatch.setattr(harness, "WAITING_S", 2.0)
    cases = (
        *((crash, "BrokenLaw: of thermodynamics"), (swell, "MemoryError")),
        *((turn, "TooLate"), (wait, "TooLate")),
    )
    for run, said in cases:
        tally = campaign(Target(run.__name__, lambda: (b"x",), run), range(1))
        assert said in tally.failures[0].what
        assert "(1 bytes)" in str(tally.failures[0])


def test_an_error_does_not_excuse_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory in use before, or used to make the input, does not count."""

    def refuse(data: bytes, folder: Path) -> None:
        raise MlbatchError(f"expected less, found {len(b'1' * (len(data) * 80_000_000))} bytes")

    def seeds() -> tuple[bytes, ...]:
        return (b"", b"1") if len(before) == 80_000_000 else ()

    def making(rng: random.Random, seeds: Seeds) -> bytes:
        return (b"1" * 80_000_000)[:0]

    before = b"1" * 80_000_000
    monkeypatch.setattr(harness, "MOST_BYTES", 60_000_000)
    monkeypatch.setattr(harness, "_in_memory", contextlib.nullcontext)
    tally = campaign(Target("refuse", seeds, refuse), range(2))
    (failure,) = tally.failures
    assert (failure.number, failure.what[:7], tally.refused) == (1, "needed ", 1)
    assert 70 < tally.peak_bytes / 1e6 < 90
    tally = campaign(Target("make", seeds, refuse, making), range(2, 5))
    assert (tally.failures, tally.refused) == ([], 3)
    assert tally.peak_bytes < 10_000_000
