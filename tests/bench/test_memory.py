"""Memory of whole conversions does not depend on the length of what is no lidar data."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from mlbatch.discovery.sampler import MOST_KINDS
from tests.builders.bags import Body, Recorded
from tests.builders.captures import udp_frame
from tests.builders.mcaps import write_mcap
from tests.builders.sessions import NS_PER_S, REPOSITORY, Unit, write_session
from tests.builders.sessions_of_bags import unit_messages

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/status").exists(), reason="needs the peak memory of a process"
)

SPAN_NS = 60 * NS_PER_S
KB_PER_MB = 1024


# Prints the peak of a process at its end; `getrusage` would include that of its parent.
_RUN = """
import atexit, re, sys
from pathlib import Path
def peak():
    print(re.search(r"VmHWM:\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1])
atexit.register(peak)
sys.argv = ["mlbatch", "convert", *sys.argv[1:], "--quiet"]
from mlbatch.cli import main
main()
"""


def peak_mb(*arguments: str | Path) -> float:
    """Peak memory of a conversion in a process of its own."""
    words = [sys.executable, "-c", _RUN, *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return int(done.stdout.split()[-1]) / KB_PER_MB


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
    # In memory, 108,000 messages of 300 bytes more took 97 MB.
    assert found[1] - found[0] < 24


@pytest.mark.parametrize("packets", [2, 20])
def test_streams_that_no_sensor_sends(tmp_path: Path, packets: int) -> None:
    """A lidar among 1,000 and 8,000 streams of as many ports, each with some packets."""
    found = []
    for streams in (1000, 8000):
        folder = tmp_path / str(streams)
        unit = Unit(turns=10)
        times = range(streams * packets)
        noise = [
            (
                unit.begin_ns + number * NS_PER_S // len(times),
                udp_frame(bytes([number % 251]) * 300, "10.1.1.1", dport=1024 + number // packets)[
                    0
                ],
            )
            for number in times
        ]
        recording = write_session(folder, unit, more=noise)
        report = folder / "report.json"
        target = folder / "out.mcap"
        options = ("--identity-extrinsics", "--report", report)
        found.append(peak_mb(recording, "-o", target, *options))
        content = json.loads(report.read_text())
        unassigned = content["unassigned"]
        assert len(unassigned) == MOST_KINDS + 1
        assert sum(row["packets"] for row in unassigned) == len(noise)
        [rest] = [row for row in unassigned if row["stream"] == "other streams"]
        assert rest["packets"] == len(noise) - MOST_KINDS * packets
        assert str(streams - MOST_KINDS) in rest["what"]
        assert content["sensors"][0]["packets"]["read"] == 320
    # 7,000 streams more, with samples of their packets, would take about 50 to 200 MB.
    assert found[1] - found[0] < 16
