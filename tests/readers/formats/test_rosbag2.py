"""ROS 2 SQLite bags: real ones by their manifest and by rosbags, made ones by their capture."""

from __future__ import annotations

import gzip
import os
import random
import shutil
import sqlite3
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import numpy.typing as npt
import pytest
import zstandard
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mlbatch.errors import RecordingError
from mlbatch.readers import open_recording
from mlbatch.readers.bag.recording import BagRecording
from mlbatch.ros import decode_transforms
from mlbatch.types import Message, StreamTable
from tests.builders.bags import Recorded, fixture_messages, fixture_packets, packet_message
from tests.builders.reading import RECORDINGS, Seen, assert_balanced, seen_of
from tests.builders.rosbag2 import Form, write_folder, write_rosbag2

PACKETS = [Seen(host_ns, topic, payload) for topic, host_ns, payload in fixture_packets()]
OUSTER = "ouster_sensor_msgs/PacketMsg"
# MANIFEST.md, columns "packets" and "transport": packets per message, bytes of a packet.
MANIFEST: Mapping[str, tuple[list[int], int]] = {
    "hesai/pandar40p/1673400149412331409": ([360, 359, 360, 360], 1262),
    "hesai/pandar64/1673403880599376836": ([600] * 4, 1198),
    "hesai/pandar64_all-points/all_points": ([600] * 4, 1198),
    "hesai/pandarqt64/1673401195788312575": ([300] * 4, 1072),
    "hesai/pandarxt16/1732848127890747768": ([126, 500, 500, 500], 568),
    "hesai/pandarxt32/1673400677802009732": ([500] * 4, 1080),
    "velodyne/vlp16_ros2_dual/1673400471837873222": ([151, 151, 151, 150], 1206),
    "velodyne/vlp32c_ros2/1713492677464078412": ([76, 76, 76, 75, 76], 1206),
}
TEXTS = {
    "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data",
    "velodyne_msgs/msg/VelodyneScan": "std_msgs/Header header\nVelodynePacket[] packets",
    "pandar_msgs/msg/PandarPacket": "builtin_interfaces/Time stamp\nuint8[1500] data\nuint32 size",
    "pandar_msgs/msg/PandarScan": "std_msgs/Header header\nPandarPacket[] packets",
}


def recorded(name: str) -> Path:
    """A folder of the recordings; the test is skipped where it is absent."""
    path = RECORDINGS / name
    if not path.is_dir():
        pytest.skip(f"recording {name} is not there")
    return path


def opened(path: Path) -> BagRecording:
    """A bag, opened by its content."""
    recording = open_recording(path, StreamTable())
    assert isinstance(recording, BagRecording)
    return recording


def read(recording: BagRecording) -> tuple[list[Seen], list[Message]]:
    """All packets and kept messages; the ledger must balance afterwards."""
    seen: list[Seen] = []
    messages: list[Message] = []
    for batch in recording.packets():
        seen += seen_of(batch, recording.streams)
        messages += batch.messages
    assert_balanced(recording)
    assert all("\n" not in note for note in recording.notes)
    return seen, messages


def refusal(path: Path) -> str:
    """The one line that says why `path` cannot be opened."""
    with pytest.raises(RecordingError) as caught:
        opened(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("name", MANIFEST)
def test_recordings_hold_the_packets_of_the_manifest(name: str) -> None:
    recording = opened(recorded(name))
    seen, _ = read(recording)
    counts, size = MANIFEST[name]
    assert len(seen) == sum(counts)
    assert {len(packet.payload) for packet in seen} == {size}
    assert (recording.notes, recording.streams.untimed) == ([], set())
    assert recording.position_bytes == recording.size_bytes
    single = next(recorded(name).glob("*.db3"))
    assert read(opened(single))[0] == seen


@pytest.mark.parametrize("name", MANIFEST)
def test_recordings_read_as_rosbags_decodes_them(name: str) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    for key, text in TEXTS.items():
        store.register(get_types_from_msg(text, key))
    expected = []
    with AnyReader([recorded(name)], default_typestore=store) as reader:
        for connection, _, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            for packet in cast("Sequence[object]", getattr(message, "packets")):  # noqa: B009
                stamp = getattr(packet, "stamp")  # noqa: B009
                data = bytes(cast("npt.NDArray[np.uint8]", getattr(packet, "data")))  # noqa: B009
                data = data[: getattr(packet, "size", len(data))]
                host_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
                expected.append(Seen(host_ns, connection.topic, data))
    assert read(opened(recorded(name)))[0] == expected


@pytest.mark.parametrize("field", ["storage_identifier: sqlite3", "serialization_format: cdr", ""])
def test_recordings_with_emptied_fields_read_the_same(tmp_path: Path, field: str) -> None:
    name = "hesai/pandarxt16/1732848127890747768"
    folder = tmp_path / "bag"
    shutil.copytree(recorded(name), folder)
    metadata = folder / "metadata.yaml"
    text = metadata.read_text()
    if field:
        assert field in text
        metadata.write_text(text.replace(field, field.split(":")[0] + ': ""'))
    else:
        metadata.unlink()
    with sqlite3.connect(next(folder.glob("*.db3"))) as connection:
        connection.execute("UPDATE topics SET serialization_format = ''")
    connection.close()
    assert read(opened(folder)) == read(opened(recorded(name)))


FORMS = {
    "schema 3": Form(),
    "schema 4": Form(schema=4),
    "no format": Form(serialization=""),
    "zstd messages": Form(zstd_messages=True),
    "no index": Form(index=False),
}


@pytest.mark.parametrize("form", FORMS)
def test_packets_are_those_of_the_capture(tmp_path: Path, form: str) -> None:
    path = write_rosbag2(tmp_path / "a.db3", fixture_messages("cdr"), FORMS[form])
    recording = opened(path)
    assert read(recording)[0] == PACKETS
    assert read(recording)[0] == PACKETS  # A second pass starts anew.
    assert recording.notes == []
    assert {topic.encoding for topic in recording.topics} == {"cdr"}
    assert {topic.name for topic in recording.topics if topic.latched} == {
        *("/left/ouster/metadata", "/right/ouster/metadata", "/tf_static"),
    }


@pytest.mark.parametrize("squeeze", [zstandard.compress, gzip.compress])
def test_compressed_files_read_as_plain_ones(tmp_path: Path, squeeze: object) -> None:
    assert callable(squeeze)
    plain = write_rosbag2(tmp_path / "a.db3", fixture_messages("cdr"))
    folder = tmp_path / "bag"
    folder.mkdir()
    packed = folder / "bag_0.db3.zstd"
    packed.write_bytes(squeeze(plain.read_bytes()))
    before = set(Path(os.environ.get("TMPDIR", "/tmp")).glob("mlbatch-*"))
    for path in (packed, folder):
        recording = opened(path)
        assert read(recording)[0] == PACKETS
        assert recording.size_bytes == packed.stat().st_size
        del recording
    assert set(Path(os.environ.get("TMPDIR", "/tmp")).glob("mlbatch-*")) <= before


def test_files_of_a_split_bag_follow_their_times_not_their_names(tmp_path: Path) -> None:
    messages = fixture_messages("cdr")
    parts = [messages[500:], messages[:200], [], messages[200:500]]
    recording = opened(write_folder(tmp_path / "bag", parts))
    recording.keep = frozenset({"/imu/data"})
    seen, kept = read(recording)
    assert seen == PACKETS
    assert [m.host_ns for m in kept] == [m.log_ns for m in messages if m.topic == "/imu/data"]
    assert recording.notes == []


def test_files_on_disk_win_over_the_metadata(tmp_path: Path) -> None:
    messages = fixture_messages("cdr")
    folder = write_folder(tmp_path / "bag", [messages[:200], messages[200:500], messages[500:]])
    (folder / "bag_2.db3").rename(folder / "renamed.db3")
    (folder / "bag_9.db3").touch()
    recording = opened(folder)
    assert read(recording)[0] == PACKETS
    assert recording.notes == [
        "bag_9.db3: has 0 bytes and is left out",
        "bag_2.db3: listed in metadata.yaml, but missing",
        "renamed.db3: not listed in metadata.yaml, but read",
    ]
    (folder / "metadata.yaml").write_text("{", encoding="utf-8")
    assert read(opened(folder))[0] == PACKETS
    (folder / "metadata.yaml").unlink()
    assert read(opened(folder))[0] == PACKETS


def test_messages_come_by_time_whatever_the_order_of_rows(tmp_path: Path) -> None:
    messages = fixture_messages("cdr")
    shuffled = list(messages)
    random.Random(1).shuffle(shuffled)
    path = write_rosbag2(tmp_path / "a.db3", shuffled)
    seen, _ = read(opened(path))
    key = [(one.host_ns, one.stream, one.payload) for one in seen]
    assert sorted(key) == sorted((p.host_ns, p.stream, p.payload) for p in PACKETS)
    assert [one.host_ns for one in seen] == sorted(p.host_ns for p in PACKETS)


def test_kept_messages_are_handed_over(tmp_path: Path) -> None:
    messages = fixture_messages("cdr")
    recording = opened(write_rosbag2(tmp_path / "a.db3", messages))
    recording.keep = frozenset({"/tf_static"})
    _, kept = read(recording)
    assert [m.data for m in kept] == [m.data for m in messages if m.topic == "/tf_static"]
    edges = [decode_transforms(m.topic, bytes(m.data))[0] for m in kept]
    assert [edge[1] for edge in edges] == ["left/os_sensor", "right/os_sensor"]
    assert edges[0][2] == (0.3, 0.95, 2.45)


def test_definitions_that_are_missing_are_ours(tmp_path: Path) -> None:
    """Writers of MCAP need a text for every topic that is passed on."""
    path = write_rosbag2(tmp_path / "a.db3", fixture_messages("cdr"))
    for topic in opened(path).topics:
        key = topic.type.replace("/", "/msg/")
        assert key in get_types_from_msg(topic.definition, key)
        assert topic.format == "ros2msg"


def test_messages_larger_than_the_buffer_are_read(tmp_path: Path) -> None:
    large = packet_message("cdr", b"\x55" * (9 << 20))
    small = packet_message("cdr", b"\x66" * 9)
    messages = [Recorded("/p", OUSTER, at, large if at == 3 else small) for at in range(1, 6)]
    recording = opened(write_rosbag2(tmp_path / "a.db3", messages))
    sizes = [size for batch in recording.packets() for size in batch.size.tolist()]
    assert sizes == [9, 9, 9 << 20, 9, 9]


def test_last_messages_of_a_crashed_capture_are_read_from_the_log(tmp_path: Path) -> None:
    messages = fixture_messages("cdr")
    path = write_rosbag2(tmp_path / "a.db3", messages[:400])
    connection = sqlite3.connect(path)
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("PRAGMA wal_autocheckpoint = 0")
    numbers = dict(connection.execute("SELECT name, id FROM topics").fetchall())
    rows = [(numbers[m.topic], m.log_ns, m.data) for m in messages[400:]]
    connection.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
    connection.commit()
    crashed = tmp_path / "crashed"
    crashed.mkdir()
    for name in ("a.db3", "a.db3-wal"):
        shutil.copy(tmp_path / name, crashed / name)
    connection.close()
    assert read(opened(crashed))[0] == PACKETS


def test_what_is_whole_of_a_cut_database_is_read(tmp_path: Path) -> None:
    """Pages are filled one after another; the first one of the table leads to them all."""
    messages = fixture_messages("cdr")[:400]
    path = write_rosbag2(tmp_path / "a.db3", messages)
    total, content = len(read(opened(path))[0]), path.read_bytes()
    for share in (0.9, 0.5, 0.3):
        path.write_bytes(content[: int(len(content) * share)])
        recording = opened(path)
        seen, _ = read(recording)
        assert seen == PACKETS[: len(seen)]
        assert len(seen) > (share - 0.05) * total
        assert "the rest of the file was not read" in recording.notes[-1]
        assert recording.counts.skipped == {"truncated": 1}


def test_damaged_bytes_never_raise_anything_else(tmp_path: Path) -> None:
    path = write_rosbag2(tmp_path / "a.db3", fixture_messages("cdr"))
    content, rng = path.read_bytes(), random.Random(2)
    for _ in range(30):
        damaged = bytearray(content)
        for _ in range(rng.choice([1, 20])):
            at = rng.randrange(100, len(damaged) - 40)
            damaged[at : at + 40] = rng.randbytes(40)
        path.write_bytes(damaged[: rng.choice([len(damaged), rng.randrange(len(damaged))])])
        try:
            recording = opened(path)
        except RecordingError as err:
            message = str(err)
        else:
            message = " ".join(recording.notes)
            read(recording)
        assert "\n" not in message


def test_rows_that_are_no_messages_are_counted(tmp_path: Path) -> None:
    good = packet_message("cdr", b"packet")
    messages = [Recorded("/p", OUSTER, at, good) for at in range(1, 6)]
    path = write_rosbag2(tmp_path / "a.db3", messages)
    with sqlite3.connect(path) as connection:
        connection.execute("UPDATE messages SET data = 'text' WHERE id = 2")
        connection.execute("UPDATE messages SET data = x'0001' WHERE id = 3")
    connection.close()
    recording = opened(path)
    seen, _ = read(recording)
    assert [one.host_ns for one in seen] == [1, 4, 5]
    assert recording.counts.skipped == {"truncated": 2}


def test_the_file_is_not_written_to(tmp_path: Path) -> None:
    path = write_rosbag2(tmp_path / "a.db3", fixture_messages("cdr"))
    content = path.read_bytes()
    read(opened(path))
    assert path.read_bytes() == content
    assert list(tmp_path.iterdir()) == [path]


def test_what_cannot_be_read_is_said_in_one_line(tmp_path: Path) -> None:
    foreign = tmp_path / "foreign.db3"
    with sqlite3.connect(foreign) as connection:
        connection.execute("CREATE TABLE other(a)")
    connection.close()
    assert "expected a ROS 2 bag (tables topics and messages), found a database" in refusal(foreign)
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "found a folder without .db3 or .mcap files; name" in refusal(empty)
    (empty / "a.db3").touch()
    assert "found 0 bytes" in refusal(empty)
    (empty / "a.db3").write_text("no database")
    assert "check that it is the right file" in refusal(empty)
    (empty / "a.db3").write_bytes(b"\xd4\xc3\xb2\xa1" + bytes(16) + b"\1\0\0\0")
    assert "expected the folder of a bag, found one with files of pcap" in refusal(empty)


def test_topics_that_are_not_wanted_are_left_out(tmp_path: Path) -> None:
    image = Recorded("/image", "sensor_msgs/Image", 0, bytes(3 << 20))
    messages = []
    for number, packet in enumerate(fixture_messages("cdr")[:60]):
        messages += [packet, replace(image, log_ns=packet.log_ns)] if number % 4 else [packet]
    path = write_rosbag2(tmp_path / "a.db3", messages)
    expected = [m.log_ns for m in messages if m.type == OUSTER]
    assert [one.host_ns for one in read(opened(path))[0]] == expected
