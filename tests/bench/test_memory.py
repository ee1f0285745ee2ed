"""Memory of whole conversions does not depend on the length of what is no lidar data."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from tests.builders.bags import Body, Recorded
from tests.builders.sessions import NS_PER_S, REPOSITORY, Unit
from tests.builders.sessions_of_bags import unit_messages, write_mcap

SPAN_NS = 60 * NS_PER_S
KB_PER_MB = 1024


def peak_mb(*arguments: str | Path) -> float:
    """Peak memory of a conversion in a process of its own."""
    words = [sys.executable, "-m", "mlbatch", "convert", *map(str, arguments), "--quiet"]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    process = os.posix_spawn(sys.executable, words, environment)
    _, status, usage = os.wait4(process, 0)
    assert os.waitstatus_to_exitcode(status) == 0
    unit = KB_PER_MB if sys.platform != "darwin" else KB_PER_MB * 1024
    return usage.ru_maxrss / unit


def _with_notes(path: Path, count: int) -> Path:
    """A lidar that is silent for a minute; messages before it, in its gap and after it."""
    unit = Unit(turns=4)
    resumed = replace(unit, begin_ns=unit.begin_ns + SPAN_NS, first_frame=605)
    packets = [*unit_messages(unit, "top"), *unit_messages(resumed, "top")[1:]]
    begin_ns = packets[0].log_ns
    text = Body("cdr").text("x" * 300).done()
    notes = [
        Recorded("/note", "std_msgs/String", begin_ns + part * SPAN_NS + NS_PER_S + at_ns, text)
        for part in (-1, 0, 1)
        for at_ns in range(0, SPAN_NS - 2 * NS_PER_S, (SPAN_NS - 2 * NS_PER_S) // count)
    ]
    return write_mcap(path, sorted([*packets, *notes], key=lambda one: one.log_ns))


@pytest.mark.parametrize("jobs", ["1", "3"])
def test_messages_without_lidar_packets(tmp_path: Path, jobs: str) -> None:
    found = []
    for count in (12_000, 48_000):
        recording = _with_notes(tmp_path / f"{count}.mcap", count)
        target = tmp_path / f"{count}-out.mcap"
        options = ("--pass", "/note", "--identity-extrinsics", "--jobs", jobs)
        found.append(peak_mb(recording, "-o", target, *options))
    # In memory, 108,000 messages of 300 bytes more would take about 80 MB.
    assert found[1] - found[0] < 16
