"""`mlbatch inspect`: transcripts of tables and rigs; loss as a conversion counts it."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from mlbatch.pipeline.contents import recording_report
from mlbatch.readers import open_recording
from mlbatch.simulate.velodyne.encode import VelodyneSpec
from mlbatch.types import StreamTable
from tests.builders.bags import Body, Recorded, fixture_messages
from tests.builders.captures import udp_frame
from tests.builders.mcaps import write_mcap
from tests.builders.rosbag1 import write_rosbag1
from tests.builders.rosbag2 import write_rosbag2
from tests.builders.sessions import (
    FIXTURE,
    NS_PER_MS,
    NS_PER_S,
    SMALL,
    Shell,
    Unit,
    twin,
    write_metadata,
    write_session,
)
from tests.builders.sessions_of_bags import unit_messages
from tests.builders.transcripts import transcripts
from tests.builders.vendor_sessions import framed, lidar_payloads, write_capture

CASES = transcripts("inspect")


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sessions of all transcripts."""
    folder = tmp_path_factory.mktemp("sessions")
    (folder / "fix").symlink_to(FIXTURE)
    one = Unit()
    write_session(folder / "bare", one, metadata=False)
    write_session(folder / "single", one)
    write_session(folder / "pair", one, twin(one, 222))
    since_ns, host_ns = 1000 * NS_PER_S, 1_700_000_000 * NS_PER_S
    capture = write_session(folder / "uptime", replace(one, begin_ns=since_ns, host_ns=host_ns))
    # Without three packets.
    raw = capture.read_bytes()
    capture.write_bytes(raw[: 24 + 10 * 1338] + raw[24 + 13 * 1338 :])
    pose = [0.0, -1.0, 0.0, 1.5, 1.0, 0.0, 0.0, -0.25, 0.0, 0.0, 1.0, 2.0, 0.0, 0.0, 0.0, 1.0]
    write_session(folder / "posed", Unit(replace(SMALL, extrinsic_m=pose)))
    old = replace(SMALL, profile="LEGACY")
    other = Unit(replace(old, serial=222, beams=32), ip="10.0.0.2")
    write_session(folder / "legacy", Unit(old), other)
    first = Unit(replace(SMALL, serial=1000), ip="10.0.0.9")
    early = replace(first, begin_ns=first.begin_ns - NS_PER_MS)
    write_session(folder / "order", first, twin(early, 999, "10.0.0.8"))
    for name, head in (("a.mcap", b"\x89MCAP0\r\n"), ("a.bag", b"#ROSBAG V2.0\n")):
        (folder / name).write_bytes(head + bytes(1 << 20))
    _write_long(folder / "long")
    _write_bags(folder)
    return folder


def _write_long(folder: Path) -> None:
    """12.8 s of a lidar that loses 5 packets after 11 s; others that begin after 10.5 s."""
    unit = Unit(turns=128)
    late_ns = unit.begin_ns + 10_500 * NS_PER_MS
    # 320 packets a second.
    kept = [one for number, one in enumerate(unit.records) if not 3600 <= number < 3605]
    foreign = [
        (late_ns + number * 100 * NS_PER_MS, udp_frame(b"x" * 100, "10.0.0.9", dport=9000)[0])
        for number in range(11)
    ]
    other = twin(replace(unit, begin_ns=late_ns, turns=10), 222)
    write_session(folder, more=[*kept, *foreign, *other.records])
    write_metadata(folder / "111.json", SMALL)


def _write_bags(folder: Path) -> None:
    """A lidar, and /note with 20 messages a second from its first packet to its last."""
    for name in ("notes", "cut", "split"):
        (folder / name).mkdir()
    for turns in (120, 130):
        sent = unit_messages(Unit(turns=turns), "top")
        first_ns = sent[0].log_ns
        notes = [
            Recorded("/note", "std_msgs/String", first_ns + at * 50 * NS_PER_MS, _text(at))
            for at in range(turns * 2)
        ]
        if turns == 130:
            write_mcap(folder / "split" / "drive.mcap", sent)
            write_mcap(folder / "split" / "notes.mcap", notes)
            continue
        whole = sorted([*sent, *notes], key=lambda message: message.log_ns)
        data = write_mcap(folder / "notes" / "drive.mcap", whole).read_bytes()
        (folder / "cut" / "drive.mcap").write_bytes(data[: len(data) * 95 // 100])


def _text(number: int) -> bytes:
    return Body("cdr").text(str(number)).done()


@pytest.mark.parametrize("name", CASES)
def test_transcript(shell: Shell, place: Path, tmp_path: Path, name: str) -> None:
    CASES[name].check_with(place, shell, tmp_path)


@pytest.mark.parametrize("whole", ["", "--whole"])
def test_loss_is_that_of_a_conversion(shell: Shell, tmp_path: Path, whole: str) -> None:
    """Also of a sensor whose packets carry no number, among duplicates and damaged timestamps."""
    spec = VelodyneSpec("VLP-16", "strongest")
    sent = lidar_payloads(spec, 800)
    lost = {200, 201, 500}
    kept = [one for number, one in enumerate(sent) if number not in lost]
    at_ns, payload = kept[300]
    # The last six bytes are the timestamp, us of the hour, and two factory bytes.
    kept[300] = at_ns, payload[:-6] + (3_000_000_000).to_bytes(4, "little") + payload[-2:]
    kept.insert(100, kept[99])
    capture = write_capture(tmp_path, framed(kept, "10.0.0.9", 2368))
    (stream,) = json.loads(shell(f"inspect {capture} --json {whole}").out)["streams"]
    outcome = shell(f"convert {capture} --identity-extrinsics --dry-run --quiet --keep-partial")
    (sensor,) = json.loads(outcome.out)["sensors"]
    assert sensor["packets"]["rejected"] == {"bad_stamp": 1, "duplicate": 1}
    # The damaged packet is missing, too, where packets are counted by their timestamps.
    assert stream["lost"] == sensor["packets"]["lost"] == len(lost) + 1


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
