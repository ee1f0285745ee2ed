"""Conversions that are killed at random and resumed: is the output that of a run in one piece?

    python -m tests.resume_storm --count 200 --seed 1

Every conversion is a forked process that gets the next signal (KILL, INT, TERM, HUP), after a
random time or at a random call that touches a file (write, flush, fsync, rename ...). It is
resumed, perhaps killed again, and left to end. All files must be those of an uninterrupted run, but
the report's timings, and no others may be left. Signals other than KILL have to end a run in order.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import itertools
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import threading
import time
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

from mlbatch.cli import main as mlbatch
from mlbatch.pipeline.run import _Output
from mlbatch.simulate.ouster.encode import OusterSpec
from mlbatch.writers.formats import webdataset
from tests.builders.bags import Body, Recorded, imu_message, packet_message
from tests.builders.captures import write_pcap
from tests.builders.mcaps import write_mcap
from tests.builders.run import command
from tests.builders.sessions import NS_PER_MS, NS_PER_S, Unit, twin, write_metadata

TURN_NS = 100 * NS_PER_MS
SPEC = OusterSpec(beams=32, columns_per_frame=512, serial=111)
TWO = ("--identity-extrinsics", "--keep-partial", "--no-pose-check")
ZSTD = ("--compression", "zstd:1")
FILES = ("--format", "rosbag2", "--max-bag-duration", "0.2", "--pass", "/chatter")
TARS = ("--format", "webdataset")
TOUCHES = frozenset(
    {
        *("write", "writev", "flush", "truncate", "fsync"),
        *("rename", "replace", "unlink", "mkdir", "rmdir"),
    }
)
SIGNALS = (signal.SIGKILL, signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
# Exit codes of a child whose command raised something else than an exit.
RAISED = 99
# Of one that was interrupted before or after its command.
OUTSIDE = 98
INTERRUPTED = 130
HANG_S = 300


@dataclass(frozen=True, slots=True)
class Case:
    """A conversion; output: its name; recording: a file of `write_recordings`."""

    recording: str
    output: str
    options: tuple[str, ...] = ()


_ONE_JOB = {
    "mcap": Case("session/drive.pcap", "out.mcap", TWO),
    "mcap slices": Case("session/drive.pcap", "out.mcap", (*TWO, "--slices", "4")),
    "mcap split": Case("session/drive.pcap", "out.mcap", (*TWO, "--split")),
    "mcap organized": Case("session/drive.pcap", "out.mcap", (*TWO, "--layout", "organized")),
    "mcap passed": Case("bag/drive.mcap", "out.mcap", (*TWO, "--pass", "/chatter")),
    "mcap zstd": Case("session/drive.pcap", "out.mcap", (*TWO, *ZSTD, "--slices", "2")),
    "rosbag1": Case("session/drive.pcap", "out.bag", (*TWO, "--slices", "3")),
    "rosbag2": Case("bag/drive.mcap", "out", (*TWO, "--format", "rosbag2", "--pass", "/chatter")),
    "rosbag2 zstd": Case("bag/drive.mcap", "out", (*TWO, "--format", "rosbag2", *ZSTD)),
    "bag files": Case("bag/drive.mcap", "out", (*TWO, *FILES)),
    "bag files split": Case("bag/drive.mcap", "out", (*TWO, *FILES, "--split", *ZSTD)),
    "bag files shard": Case("bag/drive.mcap", "out", (*TWO, *FILES, "--shard", "2/3")),
    "npz": Case("session/drive.pcap", "out", TWO),
    "npz shard": Case("session/drive.pcap", "out", (*TWO, "--shard", "2/3")),
    "npz split": Case("session/drive.pcap", "out", (*TWO, "--split", "--slices", "2")),
    "webdataset": Case("session/drive.pcap", "out", (*TWO, *TARS)),
    "webdataset shard": Case("session/drive.pcap", "out", (*TWO, *TARS, "--shard", "2/3")),
    "webdataset split": Case("session/drive.pcap", "out", (*TWO, *TARS, "--split")),
    "ply": Case("session/drive.pcap", "out", (*TWO, "--format", "ply", "--min-range", "4.1")),
    "jumps": Case("jumps/drive.pcap", "out.mcap", ("--on-jump", "split", "--keep-partial")),
}
_THREE_JOBS = {
    f"{name} jobs": replace(case, options=(*case.options, "--jobs", "3"))
    for name, case in _ONE_JOB.items()
}
CASES = _ONE_JOB | _THREE_JOBS


def write_recordings(folder: Path, turns: int) -> None:
    """What is converted: two lidars as a capture and as a bag, and one whose clock jumps."""
    left = Unit(SPEC)
    right = twin(replace(left, begin_ns=left.begin_ns + 37 * NS_PER_MS), 222)
    for name in ("session", "bag", "jumps"):
        (folder / name).mkdir(parents=True)
        for serial in (111, 222)[: 1 if name == "jumps" else 2]:
            write_metadata(folder / name / f"{serial}.json", replace(SPEC, serial=serial))
    records = [
        one for unit in (left, right) for turn in _turns(unit, turns) for one in turn.records
    ]
    records += left.imu_records(turns * 10)
    write_pcap(folder / "session" / "drive.pcap", sorted(records))
    write_mcap(folder / "bag" / "drive.mcap", _messages(left, right, turns))
    pieces = []
    begin_ns = left.begin_ns
    for number, step_ns in enumerate((0, 37 * NS_PER_S, -20 * NS_PER_S)):
        begin_ns += step_ns
        ahead_ns = left.begin_ns + number * 10 * TURN_NS - begin_ns
        unit = replace(left, begin_ns=begin_ns, host_ns=left.host_ns + ahead_ns)
        pieces += _turns(replace(unit, first_frame=5 + 10 * number), 10)
        begin_ns += 10 * TURN_NS
    records = [one for turn in pieces for one in turn.records]
    write_pcap(folder / "jumps" / "drive.pcap", sorted(records))


def _turns(unit: Unit, count: int) -> list[Unit]:
    """Turns of a lidar, each with ranges of its own, so that no two scans are alike."""
    return [
        replace(
            unit,
            begin_ns=unit.begin_ns + turn * TURN_NS,
            first_frame=unit.first_frame + turn,
            turns=1,
            range_mm=4000 + 16 * (turn + unit.first_frame),
        )
        for turn in range(count)
    ]


def _messages(left: Unit, right: Unit, turns: int) -> list[Recorded]:
    """Packets of two lidars, an IMU, and large texts."""
    kind = "ouster_sensor_msgs/PacketMsg"
    found = []
    for name, unit in (("left", left), ("right", right)):
        topic = f"/{name}/ouster/lidar_packets"
        for turn in _turns(unit, turns):
            found += [
                Recorded(topic, kind, host_ns, packet_message("cdr", payload))
                for host_ns, payload in turn.payloads
            ]
    for at in range(left.begin_ns, left.begin_ns + turns * TURN_NS, 10 * NS_PER_MS):
        found.append(Recorded("/imu/data", "sensor_msgs/Imu", at, imu_message("cdr", at, "i", 9.8)))
        text = Body("cdr").text(str(at) * 1500).done()
        found.append(Recorded("/chatter", "std_msgs/String", at, text))
    return sorted(found, key=lambda message: message.log_ns)


@dataclass(slots=True)
class End:
    """When a process is to be killed: after so many seconds, or at a call; neither: not at all."""

    after_s: float | None = None
    at_call: int | None = None
    signal: signal.Signals = signal.SIGKILL


def run(folder: Path, words: list[str], end: End) -> int:
    """Convert in a process of its own; gives its exit code, negative when a signal ended it.

    With `at_call` 0 all calls are counted: the number is left in the file `calls`.
    """
    child = os.fork()
    if not child:
        _convert(folder, words, end)
    # One that hangs shows where.
    timers = [threading.Timer(HANG_S, _kill, (child, signal.SIGABRT))]
    if end.after_s is not None:
        timers.append(threading.Timer(end.after_s, _kill, (child, end.signal)))
    for timer in timers:
        timer.start()
    _, status = os.waitpid(child, 0)
    for timer in timers:
        timer.cancel()
        timer.join()
    return os.waitstatus_to_exitcode(status)


def _kill(child: int, number: signal.Signals) -> None:
    # It may have ended by itself.
    with contextlib.suppress(ProcessLookupError):
        os.kill(child, number)


def _convert(folder: Path, words: list[str], end: End) -> NoReturn:
    os.chdir(folder)
    with open("said", "a") as said:
        os.dup2(said.fileno(), 1)
        os.dup2(said.fileno(), 2)
    faulthandler.enable(2)
    sys.argv = ["mlbatch", *words]
    # Few windows of a session are several files.
    webdataset.WINDOWS_PER_FILE = 2
    calls = 0
    begun = False
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)

    def count(frame: FrameType, event: str, call: Any) -> None:
        nonlocal calls
        if begun and event == "c_call" and call.__name__ in TOUCHES:
            calls += 1
            if calls == end.at_call:
                os.kill(os.getpid(), end.signal)

    begin = _Output._begin

    def begin_and_count(output: _Output) -> None:
        nonlocal begun
        begun = True
        begin(output)

    if end.at_call is not None:
        # Files are written by threads that are there when the output begins.
        sys.setprofile(count)
        threading.setprofile(count)
        # What comes before, random times strike.
        setattr(_Output, "_begin", begin_and_count)  # noqa: B010 - no type allows it
    code = OUTSIDE
    try:
        code = RAISED
        mlbatch()
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else 0
    finally:
        sys.setprofile(None)
        if end.at_call == 0:
            Path("calls").write_text(str(calls))
        os._exit(code)


def contents(folder: Path) -> dict[str, object]:
    """All that an output consists of; reports without timings."""
    found: dict[str, object] = {}
    for path in sorted(folder.glob("out*/**/*")) + sorted(folder.glob("out*")):
        name = path.relative_to(folder).as_posix()
        if path.is_dir():
            found[name] = None
        elif path.name.endswith("report.json"):
            found[name] = {
                k: v
                for k, v in json.loads(path.read_text()).items()
                if k not in ("timing", "command")
            }
        elif path.name == "shard.json":
            account = json.loads(path.read_text())
            for key in ("timing", "command"):
                del account["report"][key]
            found[name] = account
        elif path.name == "files.jsonl":
            found[name] = valid_lines(path)
        else:
            found[name] = path.read_bytes()
    return found


def valid_lines(path: Path) -> set[bytes]:
    """The lines of `files.jsonl` that count, in no order: one that is cut off does not."""
    lines = path.read_bytes().splitlines()
    return {line for line in lines if line[:8] == b"%08x" % zlib.crc32(line[9:])}


class Storm:
    """Kills conversions, and compares what they leave in the end."""

    def __init__(self, folder: Path, seed: int, turns: int, again: int) -> None:
        self._folder = folder
        self._chance = random.Random(seed)
        self._signals = itertools.cycle(SIGNALS)
        self._again = again
        self.kills = dict.fromkeys(SIGNALS, 0)
        self.resumed = 0
        write_recordings(folder / "in", turns)
        # Loads the modules once for all processes.
        command("convert", folder / "in" / "bag" / "drive.mcap", "-o", folder / "first.mcap", *TWO)
        self._whole: dict[str, tuple[dict[str, object], int, float]] = {}

    def strike(self, name: str) -> str:
        """One output of the case: killed, resumed, compared; gives what is wrong."""
        whole, calls, wall_s = self._whole.get(name) or self._measure(name)
        place = self._folder / "work"
        place.mkdir()
        for number in range(1 + self._chance.randint(0, self._again)):
            fault = self._kill(place, name, calls, wall_s)
            if fault:
                return fault
            if number:
                self._tear(place)
        code = run(place, [*self._words(name), "--resume"], End())
        said = (place / "said").read_text()
        self.resumed += "resumed after" in said
        if code:
            return f"{name}: exit code {code}: {said}"
        wrong = self._differences(contents(place), whole)
        shutil.rmtree(place)
        return f"{name}: {wrong}: {said}" if wrong else ""

    def _words(self, name: str) -> list[str]:
        case = CASES[name]
        return ["convert", f"../in/{case.recording}", "-o", case.output, *case.options]

    def _measure(self, name: str) -> tuple[dict[str, object], int, float]:
        """An uninterrupted run: its output, its calls and its time."""
        place = self._folder / "whole"
        place.mkdir()
        began_s = time.perf_counter()
        code = run(place, self._words(name), End())
        wall_s = time.perf_counter() - began_s
        if code:
            raise SystemExit(f"{name}: exit code {code}: {(place / 'said').read_text()}")
        whole = contents(place)
        run(place, [*self._words(name), "--overwrite"], End(at_call=0))
        calls = int((place / "calls").read_text())
        shutil.rmtree(place)
        self._whole[name] = whole, calls, wall_s
        return self._whole[name]

    def _kill(self, place: Path, name: str, calls: int, wall_s: float) -> str:
        """A run that gets a signal; gives what is wrong with how it ends."""
        words = [*self._words(name), "--resume"]
        number = next(self._signals)
        chance = self._chance.random()
        if self._chance.random() < 0.5:
            end = End(after_s=(0.1 + chance) * wall_s, signal=number)
        else:
            # The last calls complete the output and are fewer than those before.
            late = self._chance.random() < 0.3
            at_call = max(1, calls - int(40 * chance) if late else int(calls * chance))
            end = End(at_call=at_call, signal=number)
        before = (place / "said").stat().st_size if (place / "said").exists() else 0
        code = run(place, words, end)
        said = (place / "said").read_text()[before:]
        ended = {-number, INTERRUPTED} - ({INTERRUPTED} if number == signal.SIGKILL else set())
        self.kills[number] += code in ended
        in_order = code != INTERRUPTED or said.rstrip("\n").splitlines()[-1].startswith(
            "mlbatch: error: interrupted"
        )
        if code not in ended | {0, OUTSIDE} or not in_order or "Traceback" in said:
            return f"{name}: {number.name} with {end}: exit code {code}: {said}"
        return ""

    def _tear(self, place: Path) -> None:
        """Cut off the end of files.jsonl, as if its last line had not been written whole."""
        for path in place.glob("*.partial/files.jsonl"):
            size = path.stat().st_size
            text = path.read_bytes()
            last = size - text.rfind(b"\n", 0, -1)
            if self._chance.random() < 0.3:
                os.truncate(path, size - self._chance.randrange(max(1, last)))

    def _differences(self, found: dict[str, object], wanted: dict[str, object]) -> str:
        names = sorted(found.keys() ^ wanted.keys())
        if names:
            return f"files that are only in one of both: {', '.join(names)}"
        return ", ".join(name for name in wanted if found[name] != wanted[name])


@contextlib.contextmanager
def storm(seed: int, turns: int, again: int) -> Iterator[Storm]:
    """A storm in a temporary folder."""
    with tempfile.TemporaryDirectory() as folder:
        yield Storm(Path(folder), seed, turns, again)


def main() -> None:
    """Strike the cases in turn until there were `--count` kills."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200, help="kills")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--turns", type=int, default=40, help="length of recordings, 0.1 s")
    parser.add_argument("--again", type=int, default=2, help="most further kills of an output")
    given = parser.parse_args()
    outputs = 0
    fault = ""
    # Mixed, so that a short storm has some of every format.
    names = random.Random(given.seed).sample(list(CASES), len(CASES))
    with storm(given.seed, given.turns, given.again) as one:
        while sum(one.kills.values()) < given.count and not fault:
            fault = one.strike(names[outputs % len(names)])
            outputs += 1
        kills = ", ".join(f"{count} {number.name}" for number, count in one.kills.items())
        print(
            f"{sum(one.kills.values())} kills, {outputs} outputs, {one.resumed} of them resumed "
            f"after scans, {int(bool(fault))} not as in one piece ({kills})"
        )
        print(fault, end="")
    sys.exit(bool(fault))


if __name__ == "__main__":
    main()
