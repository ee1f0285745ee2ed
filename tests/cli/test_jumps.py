"""Clocks that jump, or are not the capture host's; messages next to them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from tests.builders.bags import Body, Recorded, transforms_message
from tests.builders.mcaps import write_mcap
from tests.builders.sessions import (
    EPOCH_NS,
    NS_PER_MS,
    NS_PER_S,
    Shell,
    Unit,
    twin,
    write_session,
)
from tests.builders.sessions_of_bags import unit_messages
from tests.builders.transcripts import transcripts

CASES = transcripts("clocks")
TURN_NS = 100 * NS_PER_MS
EVERY_NS = 20 * NS_PER_MS


def _pieces(unit: Unit, *steps_ns: int, turns: int = 6) -> list[Unit]:
    """The same lidar, whose clock steps after every piece; the capture host's does not."""
    pieces = []
    begin_ns = unit.begin_ns
    ahead_ns = unit.host_ns
    for number, step_ns in enumerate((0, *steps_ns)):
        begin_ns, ahead_ns = begin_ns + step_ns, ahead_ns - step_ns
        frame = 5 + number * turns
        piece = replace(unit, begin_ns=begin_ns, host_ns=ahead_ns, turns=turns, first_frame=frame)
        pieces.append(piece)
        begin_ns += turns * TURN_NS
    return pieces


def _near_host() -> list[Recorded]:
    """A clock 0.9 s behind that of the capture host steps to 0.9 s ahead of it."""
    one, two = _pieces(Unit(host_ns=900 * NS_PER_MS), 1_800 * NS_PER_MS)
    return unit_messages(one, "top") + unit_messages(two, "top")[1:]


def _notes(messages: list[Recorded], count: int) -> list[Recorded]:
    """Messages of /note every 20 ms from the first on."""
    first_ns = messages[0].log_ns
    return [
        Recorded("/note", "std_msgs/String", first_ns + n * EVERY_NS, Body("cdr").text("n").done())
        for n in range(count)
    ]


def _with_notes(ahead_s: float, imu_ahead_s: float | None = None) -> list[Recorded]:
    """A lidar, messages of /note, and those of an IMU, each ahead of the capture host."""
    messages = unit_messages(Unit(turns=6).ahead(round(ahead_s * NS_PER_S)), "top")
    notes = _notes(messages, 25)
    if imu_ahead_s is not None:
        shift_ns = round(imu_ahead_s * NS_PER_S)
        for log_ns in [note.log_ns for note in notes]:
            body = Body("cdr").header(log_ns + shift_ns, "imu").put("d", *[0.0] * 37).done()
            notes.append(Recorded("/imu", "sensor_msgs/Imu", log_ns, body))
    return messages + notes


def _latched() -> list[Recorded]:
    """What late subscribers get belongs in every part, `/tf` does not."""
    messages = _near_host()
    still = transforms_message("cdr", [("base_link", "camera", (1, 0, 0), (0, 0, 0, 1))])
    kind, first_ns = "tf2_msgs/TFMessage", messages[0].log_ns
    moving = [Recorded("/tf", kind, first_ns + at * TURN_NS, still) for at in range(12)]
    static = [
        Recorded("/camera/tf_static", kind, first_ns + at * TURN_NS, still, latched=True)
        for at in range(2)
    ]
    return messages + moving + static


def write_all(folder: Path) -> None:
    """Sessions and recordings of the transcripts."""
    steps_ns = (700 * NS_PER_MS + 3 * NS_PER_S, -3_700 * NS_PER_MS)
    write_session(folder / "others", Unit(turns=12), *_pieces(twin(Unit(), 222), *steps_ns))
    start = Unit(begin_ns=50 * NS_PER_S, host_ns=EPOCH_NS)
    write_session(folder / "epoch", *_pieces(start, EPOCH_NS))
    for name, messages in {
        "near_host": _near_host() + _notes(_near_host(), 60),
        "latched": _latched(),
        "tai": _with_notes(37),
        "behind": _with_notes(-1.5),
        "power_on": _with_notes(866 - 1_800_000_000),
        "imu_on_tai": _with_notes(0, 37),
        "both_ahead": _with_notes(540.793, 540.79),
    }.items():
        write_mcap(folder / f"{name}.mcap", sorted(messages, key=lambda one: one.log_ns))


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all of them."""
    folder = tmp_path_factory.mktemp("clocks")
    write_all(folder)
    return folder


@pytest.mark.parametrize("name", CASES)
def test_transcript(shell: Shell, place: Path, tmp_path: Path, name: str) -> None:
    CASES[name].check_with(place, shell, tmp_path)


def test_the_other_sensors_are_cut_at_the_same_time(shell: Shell, place: Path) -> None:
    """Beyond 1 s the second part of one is not comparable with the others; the first is kept."""
    words = "-o out.mcap --on-jump split --identity-extrinsics"
    outcome = shell(f"convert {place / 'others/drive.pcap'} {words}")
    assert outcome.code == 1
    assert "clocks of the sensors cannot be compared" in outcome.err
    assert Path("out.seg1.mcap").is_file()
