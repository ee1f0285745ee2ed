"""Clocks that jump within a recording: named with their times, or cut into outputs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from tests.builders.bags import Body, Recorded, transforms_message
from tests.builders.mcaps import write_mcap
from tests.builders.points import OUSTER, STAMP_NS, cloud_message, write_points
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

TURN_NS = 100 * NS_PER_MS


def _pieces(unit: Unit, *steps_ns: int, turns: int = 6) -> list[Unit]:
    """The same lidar, whose clock steps after every piece; the capture host's does not."""
    pieces = []
    begin_ns = unit.begin_ns
    ahead_ns = unit.host_ns
    for number, step_ns in enumerate((0, *steps_ns)):
        begin_ns, ahead_ns = begin_ns + step_ns, ahead_ns - step_ns
        pieces.append(
            replace(
                unit,
                begin_ns=begin_ns,
                host_ns=ahead_ns,
                turns=turns,
                first_frame=5 + number * turns,
            )
        )
        begin_ns += turns * TURN_NS
    return pieces


FORWARD = 37 * NS_PER_S


def test_the_other_sensors_are_cut_at_the_same_time(shell: Shell, tmp_path: Path) -> None:
    one = Unit(turns=12)
    other = twin(Unit(), 222)
    write_session(tmp_path, one, *_pieces(other, 700 * NS_PER_MS + 3 * NS_PER_S, -3_700_000_000))
    # Beyond 1 s the second stretch of the other is not comparable with the first sensor.
    outcome = shell("convert drive.pcap -o out.mcap --on-jump split --identity-extrinsics")
    assert outcome.code == 1
    assert "clocks of the sensors cannot be compared" in outcome.err
    assert (tmp_path / "out.seg1.mcap").is_file()


def test_a_jump_to_an_epoch_visits_no_empty_windows(shell: Shell, tmp_path: Path) -> None:
    """PTP is found: from 50 s after power-on to today."""
    start = replace(Unit(), begin_ns=50 * NS_PER_S, host_ns=EPOCH_NS)
    write_session(tmp_path, *_pieces(start, EPOCH_NS))
    outcome = shell("convert drive.pcap -o out --on-jump split")
    assert outcome.code == 0, outcome.err
    reports = [
        json.loads(path.read_text()) for path in sorted(tmp_path.glob("out.seg*/report.json"))
    ]
    assert [one["timescale"] for one in reports] == ["uptime", "utc"]
    assert [one["scans"]["empty"] for one in reports] == [0, 0]


# A clock 0.9 s behind that of the capture host, which steps to 0.9 s ahead of it.
NEAR_HOST = (Unit(host_ns=900 * NS_PER_MS), 1_800 * NS_PER_MS)


def test_passed_messages_go_to_one_part(shell: Shell, tmp_path: Path) -> None:
    """The metadata are recorded at the start, and used for both."""
    one, two = _pieces(*NEAR_HOST)
    messages = unit_messages(one, "top") + unit_messages(two, "top")[1:]
    first_ns = messages[0].log_ns
    last_ns = messages[-1].log_ns
    messages += [
        Recorded("/note", "std_msgs/String", at, Body("cdr").text("here").done())
        for at in range(first_ns, last_ns, 20 * NS_PER_MS)
    ]
    write_mcap(tmp_path / "drive.mcap", sorted(messages, key=lambda message: message.log_ns))
    outcome = shell("convert drive.mcap -o out.mcap --on-jump split --pass /note --keep-partial")
    assert outcome.code == 0, outcome.err
    reports = [json.loads((tmp_path / f"out.seg{n}.mcap.report.json").read_text()) for n in (1, 2)]
    assert [one["messages"] for one in reports] == 2 * [
        [{"topic": "/note", "read": 30, "written": 30, "dropped": {}}]
    ]


def test_decoded_clouds_are_cut_where_their_clock_jumps(shell: Shell, tmp_path: Path) -> None:
    columns = 100
    clouds = 10
    turn = [(5, 1, ring, 9, at * 10**6, ring) for at in range(columns) for ring in (0, 1)]
    stamps_ns = [STAMP_NS + n * TURN_NS + FORWARD * (n >= clouds) for n in range(2 * clouds)]
    messages = [cloud_message(OUSTER, turn, stamp_ns) for stamp_ns in stamps_ns]
    write_mcap(tmp_path / "drive.mcap", write_points("/points", messages))
    outcome = shell("convert drive.mcap -o out --on-jump split --keep-partial")
    assert outcome.code == 0, outcome.err
    for number in (1, 2):
        report = json.loads((tmp_path / f"out.seg{number}" / "report.json").read_text())
        assert report["sensors"][0]["packets"]["read"] == clouds * columns
        assert report["capture"] == {
            "frames": clouds * columns,
            "datagrams": clouds * columns,
            "skipped": {},
        }


def test_what_teaches_passes_to_later_parts_only_if_it_is_latched(
    shell: Shell, tmp_path: Path
) -> None:
    """A part is a recording of its own: what late subscribers get belongs in it, `/tf` does not."""
    one, two = _pieces(*NEAR_HOST)
    messages = unit_messages(one, "top") + unit_messages(two, "top")[1:]
    first_ns = messages[0].log_ns
    still = transforms_message("cdr", [("base_link", "camera", (1, 0, 0), (0, 0, 0, 1))])
    for topic in ("/tf", "/camera/tf_static"):
        latched = topic != "/tf"
        messages += [
            Recorded(topic, "tf2_msgs/TFMessage", first_ns + at * TURN_NS, still, latched)
            for at in (range(0, 12) if topic == "/tf" else range(2))
        ]
    write_mcap(tmp_path / "drive.mcap", sorted(messages, key=lambda message: message.log_ns))
    outcome = shell(
        "convert drive.mcap -o out.mcap --on-jump split --keep-partial --pass /tf "
        "--pass /camera/tf_static --pass /top/ouster/metadata"
    )
    assert outcome.code == 0, outcome.err
    parts = []
    for n in (1, 2):
        report = json.loads((tmp_path / f"out.seg{n}.mcap.report.json").read_text())
        parts.append({one["topic"]: (one["read"], one["written"]) for one in report["messages"]})
    latched_ones = {"/camera/tf_static": (2, 2), "/top/ouster/metadata": (1, 1)}
    assert parts == [{"/tf": (6, 6), **latched_ones}, {"/tf": (6, 6), **latched_ones}]
