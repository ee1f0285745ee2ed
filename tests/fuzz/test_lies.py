"""Inputs that are wrong on purpose: numbers, paths and tags that a file must not get away with."""

from __future__ import annotations

import json
import sqlite3
import struct
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from mlbatch.errors import RecordingError, RigError, one_line
from mlbatch.readers import open_recording
from mlbatch.readers.bag.packet_messages import Unpacker
from mlbatch.rig.rig import read_rig
from mlbatch.ros.messages import decode_transforms
from mlbatch.types import StreamTable, Topic
from tests.builders.bags import Recorded, found_in, packet_message
from tests.builders.rosbag2 import write_folder, write_rosbag2
from tests.builders.run import command
from tests.fuzz import packets
from tests.fuzz.framing import Part, joined
from tests.fuzz.harness import Target, campaign, fault_of_line

OUSTER = "ouster_sensor_msgs/PacketMsg"


def check(seeds: Sequence[bytes], run: Callable[[bytes, Path], None]) -> None:
    """Run all inputs; each within 5 s and 500 MB, with errors of one line."""
    tally = campaign(Target("lies", lambda: seeds, run), range(len(seeds)))
    assert tally.inputs == len(seeds)
    assert not tally.failures, str(tally.failures[0])


# -- definitions ----------------------------------------------------------------------------------

DEFINITIONS = {
    "of itself": "uint8[] buf\n{0} inner",
    "of itself, first": "{0} inner\nuint8[] buf",
    "of nothing, often": "std_msgs/Empty[4000000000] a\nuint8[] buf\n===\nMSG: std_msgs/Empty\n",
    "several sizes": "uint8[] buf\nuint8[] buf\nuint32 size",
    "too many": "uint8[99999999999999999999] buf",
    "too many digits": "uint8[" + "9" * 5000 + "] buf",
    "too long": "uint8[] buf\n" + "# \n" * 400_000,
    "a tree": "uint8[] buf\na/A a\n"
    + "".join(
        f"===\nMSG: a/{c}\na/{d}[9] x\na/{d}[9] y\n"
        for c, d in zip("ABCDEFGH", "BCDEFGHI", strict=True)
    ),
}


@pytest.mark.parametrize("name", DEFINITIONS)
def test_definitions_may_not_take_for_ever(name: str) -> None:
    text = DEFINITIONS[name].format(OUSTER)

    def run(data: bytes, folder: Path) -> None:
        for encoding in ("cdr", "ros1"):
            topic = Topic("/a", OUSTER, encoding, data.decode(), "ros2msg")
            array = np.frombuffer(packet_message(encoding, bytes(64)) + bytes(128), np.uint8)
            try:
                found_in(topic, array, 0, len(array) - 128)
            except RecordingError:
                continue

    check([text.encode()], run)


@pytest.mark.parametrize(
    "text",
    [
        "/*" * 100_000,
        "\n" * 200_000,
        '\\"' * 100_000,
        '@a("' * 80_000,
        "@a(" * 100_000,
        "{" * 200_000,
    ],
)
def test_idl_that_never_ends_is_passed_over(text: str) -> None:
    def run(data: bytes, folder: Path) -> None:
        topic = Topic("/a", "velodyne_msgs/VelodyneScan", "cdr", data.decode(), "ros2idl")
        with pytest.raises(RecordingError):
            found_in(topic, np.zeros(200, np.uint8), 0, 70)

    check([text.encode()], run)


@pytest.mark.parametrize(
    "text", ["time stamp\ntime stamp\nuint8[] data", "time stamp\nuint8[] data\n" * 2]
)
def test_packets_have_one_time_each_whatever_a_definition_says(text: str) -> None:
    topic = Topic("/a", "nebula_msgs/NebulaPacket", "ros1", text, "ros1msg")
    message = np.zeros(400, np.uint8)
    found = Unpacker(topic).find_many(message, *(np.array([value]) for value in (0, 60, 0)))
    assert len(found.start) == len(found.host_ns)


def test_transforms_of_another_definition_are_an_error() -> None:
    text = "geometry_msgs/TransformStamped[] transforms\n===\nMSG: geometry_msgs/TransformStamped\n"
    topic = Topic("/tf", "tf2_msgs/TFMessage", "ros1", text + "string child_frame_id\n", "ros1msg")
    with pytest.raises(RecordingError, match="found a definition without"):
        decode_transforms(topic, struct.pack("<II", 1, 1) + b"a")


# -- paths ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "path",
    ["../../etc/passwd", "/etc/passwd", "../secret_0.db3", "loop", "~/a.db3", "a\0b", "file:///x"],
)
def test_a_bag_reads_no_file_outside_its_folder(path: str, tmp_path: Path) -> None:
    bag = write_folder(tmp_path / "bag", [[]])
    (bag / "loop").symlink_to(bag)
    (tmp_path / "secret_0.db3").write_bytes(b"not to be opened")
    about = {"relative_file_paths": [path, {"a": path}, [path], None]}
    text = json.dumps({"rosbag2_bagfile_information": about})
    (bag / "metadata.yaml").write_text(text, encoding="utf-8")
    recording = open_recording(bag, StreamTable())
    assert list(recording.packets()) == []
    assert all(fault_of_line(one_line(note)) == "" for note in recording.notes)


def test_links_that_lead_to_themselves_are_one_line(tmp_path: Path) -> None:
    loop = tmp_path / "loop.db3"
    loop.symlink_to(loop)
    with pytest.raises(RecordingError, match="loop"):
        open_recording(loop, StreamTable())
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "bag_0.db3").symlink_to(bag / "bag_0.db3")
    with pytest.raises(RecordingError, match="expected a recording"):
        open_recording(bag, StreamTable())


def test_a_rig_may_name_files_next_to_its_folder_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "rigs").mkdir()
    (tmp_path / "left.json").write_text("{}", encoding="utf-8")
    rig = tmp_path / "rigs" / "rig.yaml"
    rig.write_text("sensors: [{name: left, metadata: ../left.json}]\n", encoding="utf-8")
    metadata = read_rig(rig).sensors[0].metadata
    assert metadata is not None
    assert metadata.samefile(tmp_path / "left.json")
    for path in ("/dev/zero", "/dev/stdin", "..", "/dev/fd/0", "a\\0b"):
        rig.write_text(f'sensors: [{{name: left, metadata: "{path}"}}]\n', encoding="utf-8")
        with pytest.raises(RigError, match="expected an existing file"):
            read_rig(rig)


def test_a_database_may_not_compute_its_messages(tmp_path: Path) -> None:
    """A view without end; columns that are made when they are read."""
    endless = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT"
    tricks = (
        f"CREATE VIEW messages AS {endless} x AS id, 1 AS topic_id, x AS timestamp, x AS data "
        "FROM c",
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
        "data BLOB GENERATED ALWAYS AS (zeroblob(1000000000)) VIRTUAL)",
    )
    for number, trick in enumerate(tricks):
        path = write_rosbag2(tmp_path / f"{number}.db3", [])
        with sqlite3.connect(path) as connection:
            connection.execute("DROP TABLE messages")
            connection.execute(trick)
        connection.close()
        with pytest.raises(RecordingError, match="is computed"):
            open_recording(path, StreamTable())


# -- texts ----------------------------------------------------------------------------------------

YAML = {
    "tag": "sensors: !!python/object/apply:os.system ['false']\n",
    "new tag": "%TAG ! tag:example.com,2000:\n---\nsensors: !x []\n",
    "anchors": "a: &a [x, x]\nb: &b [*a, *a]\nsensors: [*b, *b]\n",
    "merge": "sensors: [{<<: {name: a}}]\n",
    "nested": "sensors: " + "[" * 100_000,
    "nested mappings": "sensors: " + "{a: " * 50_000,
    "documents": "---\nsensors: []\n" * 1000,
    "very many values": "sensors: [" + "1," * 140_000 + "]\n",
    "nan": "rate_hz: .nan\nsensors: [{name: a}]\n",
    "infinite": "sensors: [{name: a, max_range_m: .inf}]\n",
    "huge": "sensors: [{name: a, clock: {offset_s: 1e999999999}}]\n",
    "huge matrix": "sensors: [{name: a, extrinsics: {matrix: "
    "[[1e200, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}}]\n",
}


@pytest.mark.parametrize("name", YAML)
def test_yaml_is_never_more_than_plain_values(name: str) -> None:
    def run(data: bytes, folder: Path) -> None:
        path = folder / "rig.yaml"
        path.write_bytes(data)
        with pytest.raises(RigError, match=r"rig\.yaml:\d+: "):
            read_rig(path)
        bag = folder / "bag"
        write_folder(bag, [[]])
        (bag / "metadata.yaml").write_bytes(data)
        assert "cannot be read" in open_recording(bag, StreamTable()).notes[0]

    check([YAML[name].encode()], run)


def test_a_capture_of_very_many_kinds_takes_seconds() -> None:
    """Every packet of another size, to another port, from one sender: a camera, a download."""
    rng = np.random.default_rng(1)
    sent = [
        Part(1024 + number % 3, 10**18 + number * 1000, rng.bytes(size + 1))
        for number, size in enumerate(rng.permutation(1400).tolist())
    ]
    target = next(one for one in packets.TARGETS if one.name == "packets livox")
    check([joined(sent)], target.run)


def test_names_of_topics_cannot_command_a_terminal(tmp_path: Path) -> None:
    message = packet_message("cdr", bytes(100))
    name = "/left\x1b]0;owned\x07\nnote: all is well"
    path = write_rosbag2(tmp_path / "a.db3", [Recorded(name, OUSTER, 10**18, message)] * 2)
    result = command("inspect", path)
    assert result.code == 0
    assert "owned" in result.out
    assert "\x1b" not in result.out
    assert not any(line.startswith("note: all") for line in result.out.splitlines())


def test_lines_hold_nothing_that_a_terminal_obeys() -> None:
    assert one_line("a\x1b[31mb\r\nc\u202ed\u0085") == "a\\x1b[31mb\\r\\nc\\u202ed\\x85"
    assert one_line("é 漢 ok") == "é 漢 ok"
    assert str(RigError("a\nb")) == "a\\nb"
    assert len(one_line("x" * 10**6)) < 2000
