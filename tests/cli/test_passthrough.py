"""Messages that pass through a conversion: what waits for a scan, and what does not."""

from __future__ import annotations

import itertools
import json
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.reader import make_reader

from mlbatch.discovery.discover import SensorSelection
from mlbatch.pipeline.conversion import Conversion, SkippedWindow
from mlbatch.pipeline.job import Job
from mlbatch.types import MESSAGE_ENCODINGS
from tests.builders.bags import Body, Recorded
from tests.builders.mcaps import write_mcap
from tests.builders.sessions import NS_PER_MS, Shell, Unit, twin
from tests.builders.sessions_of_bags import unit_messages

# Longer than what rates are measured over.
TURNS = 24
TURN_NS = 100 * NS_PER_MS
EVERY_NS = 20 * NS_PER_MS
NOTES = TURNS * TURN_NS // EVERY_NS


def _lidar(name: str, unit: Unit, lost: Collection[int]) -> list[Recorded]:
    """A lidar that lost a third of each of these revolutions, within one window."""
    about, *packets = unit_messages(replace(unit, turns=TURNS), name)
    lossy = [at // 32 in lost and 10 <= at % 32 < 20 for at in range(len(packets))]
    return [about, *(one for one, is_lost in zip(packets, lossy, strict=True) if not is_lost)]


def _messages(*lost: int, also: Collection[int] = ()) -> list[Recorded]:
    """Two lidars that lost parts of revolutions, and messages of /note."""
    messages = _lidar("top", Unit(), lost) + _lidar("low", twin(Unit(), 222), also)
    messages += [
        Recorded("/note", "std_msgs/String", messages[0].log_ns + number * EVERY_NS, _text(number))
        for number in range(NOTES)
    ]
    return sorted(messages, key=lambda message: message.log_ns)


def _never_whole() -> list[Recorded]:
    return _messages(*range(0, TURNS, 2), also=range(1, TURNS, 2))


def _text(number: int) -> bytes:
    return Body("cdr").text(str(number)).done()


def _in_two(folder: Path, messages: Sequence[Recorded]) -> list[Path]:
    """The notes in a recording of their own."""
    notes = [one for one in messages if one.topic == "/note"]
    others = [one for one in messages if one.topic != "/note"]
    return [write_mcap(folder / "drive.mcap", others), write_mcap(folder / "notes.mcap", notes)]


def _notes(path: Path) -> list[tuple[int, bytes]]:
    with path.open("rb") as file:
        found = make_reader(file).iter_messages(["/note"], log_time_order=False)
        return [(message.log_time, message.data) for _, _, message in found]


@pytest.mark.parametrize("jobs", ["1", "3"])
def test_windows_that_are_left_out_hold_no_message_back(
    shell: Shell, tmp_path: Path, jobs: str
) -> None:
    messages = _messages(1, 4, 5, 6, 9)
    write_mcap(tmp_path / "drive.mcap", messages)
    outcome = shell(
        "convert drive.mcap -o out.mcap --pass /note --keep-partial --drop-incomplete 95 "
        "--identity-extrinsics "
        f"--jobs {jobs}"
    )
    assert outcome.code == 0, outcome.err
    report = json.loads((tmp_path / "out.mcap.report.json").read_text())
    assert report["scans"]["dropped_incomplete"] > 3
    expected = [(one.log_ns, one.data) for one in messages if one.topic == "/note"]
    assert _notes(tmp_path / "out.mcap") == expected
    assert report["messages"] == [
        {"topic": "/note", "read": NOTES, "written": NOTES, "dropped": {}}
    ]


def test_what_passes_by_can_be_taken_at_every_window(tmp_path: Path) -> None:
    recording = write_mcap(tmp_path / "drive.mcap", _never_whole())
    selection = SensorSelection(identity_extrinsics=True)
    job = Job(
        (recording,), selection, drop_incomplete=95, passed=("/note",), extras=MESSAGE_ENCODINGS
    )
    run = Conversion(job)
    waiting = []
    for item in run.tasks():
        assert isinstance(item, SkippedWindow)
        run.passed_through(item.end_ns)
        waiting.append(run.messages.waiting)
    assert len(waiting) > TURNS - 3
    assert all(a - b == TURN_NS // EVERY_NS for a, b in itertools.pairwise(waiting[1:]))


@pytest.mark.parametrize("resumed", ["", " --resume"])
def test_messages_alone_are_no_output(shell: Shell, tmp_path: Path, resumed: str) -> None:
    write_mcap(tmp_path / "drive.mcap", _never_whole())
    outcome = shell(
        f"convert drive.mcap -o out.mcap --pass /note --drop-incomplete 95 --identity-extrinsics"
        f"{resumed}"
    )
    assert outcome.code == 1
    assert "no scan: expected a whole window" in outcome.err
    assert [path.name for path in tmp_path.iterdir()] == ["drive.mcap"]


def test_a_recording_of_messages_alone_is_read_along_with_the_packets(tmp_path: Path) -> None:
    # More than is read at once.
    messages = [
        replace(one, data=Body("cdr").text("x" * 200_000).done()) if one.topic == "/note" else one
        for one in _messages()
    ]
    paths = _in_two(tmp_path, messages)
    selection = SensorSelection(identity_extrinsics=True)
    run = Conversion(Job(tuple(paths), selection, passed=("/note",), extras=MESSAGE_ENCODINGS))
    most = taken = 0
    for item in run.tasks():
        most = max(most, run.messages.waiting)
        taken += len(run.passed_through(item.end_ns))
    assert taken + len(run.passed_through(None)) == NOTES
    assert most < NOTES * 2 // 3


@pytest.mark.parametrize("more", ["", "--start +1 --end +1.5"])
def test_messages_in_a_recording_of_their_own_are_those_of_one(
    shell: Shell, tmp_path: Path, more: str
) -> None:
    messages = _messages()
    write_mcap(tmp_path / "one.mcap", messages)
    _in_two(tmp_path, messages)
    found = []
    for recordings in ("one.mcap", "drive.mcap notes.mcap", "notes.mcap drive.mcap"):
        outcome = shell(
            f"convert {recordings} -o out.mcap --pass /note --identity-extrinsics --overwrite "
            f"--compression none {more}"
        )
        assert outcome.code == 0, outcome.err
        found.append(_notes(tmp_path / "out.mcap"))
    assert found[0] == found[1] == found[2]
    assert len(found[0]) == (25 if more else NOTES)
