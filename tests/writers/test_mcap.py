"""MCAP files: one message by hand, and recorded messages of both kinds of ROS."""

from __future__ import annotations

import struct
from pathlib import Path

from mcap.reader import make_reader

from tests.builders.scans import dense_scan, point_scan
from tests.builders.written_bags import ROS1_NOTE, ROS2_NOTE, note, written


def test_one_message_by_hand(tmp_path: Path) -> None:
    with written("mcap", tmp_path / "out.mcap", [point_scan()]).open("rb") as file:
        [(_, _, message)] = make_reader(file).iter_messages(["/points"])

    def field(name: str, offset: int, code: int) -> bytes:
        text = name.encode() + b"\0"
        # Strings end anywhere; the next number starts at a multiple of 4.
        text += b"\0" * (-len(text) % 4)
        return struct.pack("<I", len(name) + 1) + text + struct.pack("<IB3xI", offset, code, 1)

    fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("time", 16, 7)]
    fields += [("ring", 20, 4), ("return_type", 22, 2), ("lidar_id", 23, 2)]
    expected = b"\0\1\0\0" + struct.pack("<iI", 1_700_000_000, 100_000_000)
    expected += struct.pack("<I12s", 10, b"base_link") + struct.pack("<III", 1, 1, 8)
    expected += b"".join(field(*row) for row in fields)
    expected += struct.pack("<B3xIII", 0, 24, 24, 24)
    expected += struct.pack("<fffffHBB", 1.0, 2.0, 3.0, 7.0, 0.0625, 258, 2, 1) + b"\1"
    assert message.data == expected


def test_messages_of_ros_1_and_ros_2(tmp_path: Path) -> None:
    messages = [note(ROS1_NOTE, "one", 1), note(ROS2_NOTE._replace(name="/two"), "two", 2)]
    path = written("mcap", tmp_path / "out.mcap", [dense_scan()], messages)
    with path.open("rb") as file:
        found = list(make_reader(file, validate_crcs=True).iter_messages(["/note", "/two"]))
    assert [(s.name, s.encoding, c.message_encoding) for s, c, _ in found if s is not None] == [
        ("std_msgs/String", "ros1msg", "ros1"),
        ("std_msgs/msg/String", "ros2msg", "cdr"),
    ]
    assert found[0][1].metadata == {"latching": "1"}
    assert [m.data for _, _, m in found] == [m.data for m in messages]
