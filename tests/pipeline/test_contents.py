"""What `inspect` shows of recordings besides packets: other topics, start, duration, size."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from mlbatch.pipeline.contents import recording_report
from mlbatch.readers import open_recording
from mlbatch.types import StreamTable
from tests.builders.bags import Body, Recorded, fixture_messages
from tests.builders.mcaps import write_mcap
from tests.builders.rosbag1 import write_rosbag1
from tests.builders.rosbag2 import write_rosbag2
from tests.builders.sessions import EPOCH_NS, NS_PER_MS, NS_PER_S, Shell, Unit
from tests.builders.sessions_of_bags import unit_messages

EVERY_NS = 50 * NS_PER_MS


def _drive(turns: int) -> list[Recorded]:
    """A lidar; /note with 20 messages a second from its first packet to its last."""
    messages = unit_messages(Unit(turns=turns), "top")
    first_ns = min(one.log_ns for one in messages)
    notes = [
        Recorded("/note", "std_msgs/String", first_ns + at * EVERY_NS, _text(at))
        for at in range(turns * 2)
    ]
    return sorted([*messages, *notes], key=lambda message: message.log_ns)


def _text(number: int) -> bytes:
    return Body("cdr").text(str(number)).done()


def _inspected(shell: Shell, words: str) -> dict[str, Any]:
    outcome = shell(f"inspect {words} --json")
    assert outcome.code == 0, outcome.err
    found: dict[str, Any] = json.loads(outcome.out)
    return found


def test_other_topics_are_counted(shell: Shell, tmp_path: Path) -> None:
    bag = write_mcap(tmp_path / "drive.mcap", _drive(turns=10))
    (note,) = [one for one in _inspected(shell, str(bag))["topics"] if one["topic"] == "/note"]
    assert (note["type"], note["messages"]) == ("std_msgs/String", 20)
    assert note["rate_hz"] == pytest.approx(20)
    text = shell(f"inspect {bag}").out
    row = next(line for line in text.splitlines() if line.startswith("/note"))
    assert row.split() == ["/note", "std_msgs/String", "20", "20.0"]


def test_a_recording_of_messages_alone_is_counted(shell: Shell, tmp_path: Path) -> None:
    messages = _drive(turns=130)
    notes = [one for one in messages if one.topic == "/note"]
    first = write_mcap(tmp_path / "drive.mcap", [one for one in messages if one.topic != "/note"])
    second = write_mcap(tmp_path / "notes.mcap", notes)
    ten = _inspected(shell, f"{first} {second}")
    whole = _inspected(shell, f"{first} {second} --whole")

    def count(found: dict[str, Any]) -> int:
        (note,) = [one for one in found["topics"] if one["topic"] == "/note"]
        return int(note["messages"])

    assert count(whole) == len(notes) == 260
    # 10 s of 13, and what a portion of the file has more.
    assert 200 <= count(ten) <= 260


@pytest.mark.parametrize("more", ["", " --whole"])
def test_start_duration_and_size_of_a_long_bag(shell: Shell, tmp_path: Path, more: str) -> None:
    bag = write_mcap(tmp_path / "drive.mcap", _drive(turns=120))
    found = _inspected(shell, f"{bag}{more}")
    # 2027-01-15T08:00:00Z is EPOCH_NS; the first packet is full 3.125 ms after the first column.
    assert EPOCH_NS == 1_800_000_000 * NS_PER_S
    assert found["start"].startswith("2027-01-15T08:00:00.02")
    assert found["duration_s"] == pytest.approx(12, abs=0.01)
    (recording,) = found["recordings"]
    assert (recording["container"], recording["bytes"]) == ("MCAP", bag.stat().st_size)


def test_a_bag_without_a_summary_shows_its_length_with_whole(shell: Shell, tmp_path: Path) -> None:
    bag = write_mcap(tmp_path / "drive.mcap", _drive(turns=120))
    data = bag.read_bytes()
    bag.write_bytes(data[: len(data) * 95 // 100])
    assert _inspected(shell, str(bag))["duration_s"] is None
    assert "see --whole" in shell(f"inspect {bag}").out
    assert _inspected(shell, f"{bag} --whole")["duration_s"] > 10


@pytest.mark.parametrize(
    ("name", "encoding", "write"),
    [
        ("drive.mcap", "cdr", write_mcap),
        ("drive.db3", "cdr", write_rosbag2),
        ("drive.bag", "ros1", write_rosbag1),
    ],
)
def test_the_index_of_a_bag_states_its_end(
    tmp_path: Path, name: str, encoding: str, write: Callable[[Path, Sequence[Recorded]], Path]
) -> None:
    messages = fixture_messages(encoding)
    bag = write(tmp_path / name, messages)
    recording = open_recording(bag, StreamTable())
    assert recording.last_ns == max(one.log_ns for one in messages)
    assert recording_report(recording).last_host_ns == recording.last_ns
