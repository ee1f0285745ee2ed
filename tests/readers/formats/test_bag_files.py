"""What one kind of bag has alone: records of MCAP, headers of ROS 1, databases of ROS 2."""

from __future__ import annotations

import random
import shutil
import sqlite3
import struct
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import pytest
import zstandard
from mcap.writer import Writer
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tests.builders.bags import Recorded, fixture_messages, fixture_packets, packet_message
from tests.builders.mcaps import FORMS, LZ4, NONE, ZSTD, Form, write_mcap
from tests.builders.reading import RECORDINGS, Seen, open_bag, read, refusal
from tests.builders.rosbag2 import write_folder, write_rosbag2
from tests.builders.sessions_of_bags import packets_only

PACKETS = [Seen(host_ns, topic, payload) for topic, host_ns, payload in fixture_packets()]
SENT = packets_only("cdr")
OUSTER = "ouster_sensor_msgs/PacketMsg"
MAGIC = b"\x89MCAP0\r\n"

# -- MCAP -----------------------------------------------------------------------------------------


def record(kind: int, body: bytes, length: int | None = None) -> bytes:
    """A record, with a length that may be wrong."""
    return struct.pack("<BQ", kind, len(body) if length is None else length) + body


def chunk(size: int, compression: bytes, stored: bytes, length: int | None = None) -> bytes:
    """A chunk, with sizes that may be wrong."""
    head = struct.pack("<QQQII", 0, 0, size, 0, len(compression)) + compression
    return record(6, head + struct.pack("<Q", len(stored) if length is None else length) + stored)


def records(data: bytes, at: int) -> list[tuple[int, int, int]]:
    """Kind, begin and end of the records from byte `at` to the closing magic."""
    found = []
    while at + 9 <= len(data) - len(MAGIC):
        kind, length = struct.unpack_from("<BQ", data, at)
        found.append((kind, at, at + 9 + length))
        at += 9 + length
    return found


def test_chunks_without_wanted_topics_are_not_looked_into(tmp_path: Path) -> None:
    images = [Recorded("/camera", "sensor_msgs/Image", i, bytes(5000)) for i in range(100)]
    sent = [*SENT[:3], *images, *SENT[3:6]]
    path = write_mcap(tmp_path / "a.mcap", sent, Form(compression=ZSTD, chunk_bytes=20_000))
    data = bytearray(path.read_bytes())
    # Damage in the middle chunks would be noted, were they unpacked.
    places = [at for at in range(len(data)) if data.startswith(b"\x28\xb5\x2f\xfd", at)]
    for at in places[2:-2]:
        data[at : at + 4] = bytes(4)
    path.write_bytes(data)
    recording = open_bag(path, buffer_bytes=4096)
    assert read(recording) == PACKETS[:6]
    assert recording.notes == []


def test_other_mcap_records_are_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=NONE, chunk_size=3000)
        writer.start("ros2")
        schema = writer.register_schema(
            "ouster_sensor_msgs/msg/PacketMsg", "ros2msg", b"uint8[] buf\n"
        )
        channel = writer.register_channel("/a", "cdr", schema)
        for number in range(6):
            writer.add_message(channel, number, packet_message("cdr", bytes(2304)), number)
            writer.add_attachment(number, number, "photo", "image/png", bytes(9000))
            writer.add_metadata("about", {"number": str(number)})
        end: Callable[[], None] = writer.finish
        end()
    # A record of an application between header and first record.
    data = path.read_bytes()
    (_, _, at), *_ = records(data, 8)
    path.write_bytes(data[:at] + record(0x81, bytes(50)) + data[at:])
    assert [one.host_ns for one in read(open_bag(path, buffer_bytes=4096))] == list(range(6))


def test_a_summary_may_name_channels_before_schemas(tmp_path: Path) -> None:
    data = write_mcap(tmp_path / "a.mcap", SENT[:60], Form(compression=ZSTD)).read_bytes()
    start, _, _ = struct.unpack("<QQI", data[-28:-8])
    groups = {4: b"", 3: b"", 0: b""}
    for kind, begin, end in records(data, start)[:-1]:
        groups[kind if kind in groups else 0] += data[begin:end]
    (tmp_path / "a.mcap").write_bytes(data[:start] + b"".join(groups.values()) + data[-37:])
    assert read(open_bag(tmp_path / "a.mcap", buffer_bytes=4096)) == PACKETS[:60]


@pytest.mark.parametrize("name", ["zstd", "none", "unchunked"])
def test_a_summary_may_lie(name: str, tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", SENT[:60], FORMS[name])
    data = path.read_bytes()
    for start in (1, len(data) // 2, len(data) - 40, 1 << 60):
        path.write_bytes(data[:-37] + record(2, struct.pack("<QQI", start, 0, 0)) + MAGIC)
        assert read(open_bag(path, buffer_bytes=4096)) == PACKETS[:60], start


def test_big_messages_of_other_topics_are_not_read(tmp_path: Path) -> None:
    """A hole in the file costs no time and no memory."""
    sent = [*SENT[:3], Recorded("/camera", "sensor_msgs/Image", 1, b"")]
    path = write_mcap(tmp_path / "a.mcap", sent, Form(chunked=False, summary=False))
    data = path.read_bytes()
    hole = 3 << 30
    again = struct.pack("<HIQQ", 1, 9, 77, 77) + packet_message("cdr", PACKETS[3].payload)
    with path.open("wb") as file:
        file.write(data[:-31] + record(5, data[-22:], 22 + hole))
        file.seek(hole, 1)
        file.write(record(5, again))
    seen = read(open_bag(path, buffer_bytes=4096))
    assert [one.host_ns for one in seen] == [*(one.host_ns for one in PACKETS[:3]), 77]


@pytest.mark.parametrize(
    "form",
    [
        Form(summary=False),
        Form(compression=ZSTD, summary=False),
        Form(compression=LZ4, summary=False),
        Form(chunked=False, summary=False),
    ],
)
def test_a_file_cut_after_its_last_message(form: Form, tmp_path: Path) -> None:
    """All packets; nothing is known to be lost, but the missing end is reported."""
    path = write_mcap(tmp_path / "a.mcap", SENT, form)
    data = path.read_bytes()
    # The indexes of the last chunk follow it.
    cut = max(end for kind, _, end in records(data + MAGIC, 8) if kind in (5, 6))
    path.write_bytes(data[:cut])
    recording = open_bag(path, buffer_bytes=4096)
    assert read(recording) == PACKETS
    assert recording.counts.skipped == {}
    assert recording.notes == [
        f"byte {cut}: the file was cut off between records: expected its footer; the rest was read"
    ]


@pytest.mark.parametrize(
    ("tail", "said"),
    [
        (
            bytes(500),
            "expected a record, found one of kind 0x00; the rest of the file was not read",
        ),
        (record(0x33, b"abc"), "found one of kind 0x33"),
        (record(5, b"abc"), "expected a message, found a record of 3 bytes"),
        (record(5, struct.pack("<H", 1), 1 << 62), "expected a record of at most 268435456 bytes"),
        (record(5, struct.pack("<H", 9), 1 << 62), "ends within a record"),
        (record(3, b"", 1 << 40), "expected a record of at most 16777216 bytes"),
        (record(3, b"", 1 << 20), "ends within a record: expected 1048585 bytes, found 9"),
        (record(3, bytes(50)), ""),
        (record(4, b"\1\0\1\0\xff\xff\xff\xff"), "expected a channel, found garbage"),
        (record(6, b""), "expected a chunk whose lengths agree"),
        (chunk(5, b"", b"abc", 1 << 60), "expected a chunk whose lengths agree"),
        (chunk(1 << 40, b"zstd", b"abc"), "expected a record of at most 268435456 bytes"),
        (chunk(1 << 28, b"zstd", b"abc"), "expected 268435456 bytes of zstd data, found 0"),
        (chunk(1 << 28, b"lz4", b"abc"), "expected 268435456 bytes of lz4 data, found 0"),
        (chunk(9, b"brotli", b"abc"), "lz4 or zstd, found 'brotli'; the chunk was not read"),
        (chunk(0, b"", record(6, b"")), "expected a record of a chunk, found one of kind 0x06"),
        (chunk(0, b"", record(0x90, b"", 99)), "expected a record that ends within its chunk"),
        (chunk(0, b"", b"\5\0"), "expected a record that ends within its chunk"),
    ],
)
def test_lies_are_noted_and_what_precedes_is_read(tail: bytes, said: str, tmp_path: Path) -> None:
    form = Form(chunked=False, summary=False, tail=tail)
    path = write_mcap(tmp_path / "a.mcap", SENT[:5], form)
    recording = open_bag(path, buffer_bytes=4096)
    assert read(recording) == PACKETS[:5]
    assert said in recording.notes[0]


@pytest.mark.parametrize("records_given", [b"", record(1, bytes(8)), record(1, bytes(8)) + b"\x0f"])
def test_a_file_of_nothing(records_given: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(MAGIC + records_given)
    recording = open_bag(path)
    assert (read(recording), recording.topics, len(recording.notes)) == ([], (), 1)


# -- ROS 1 ----------------------------------------------------------------------------------------


def _encrypted() -> bytes:
    fields = (
        b"op=\x03",
        b"index_pos=" + bytes(8),
        b"conn_count=" + bytes(4),
        b"chunk_count=" + bytes(4),
        b"encryptor=rosbag/AesCbcEncryptor",
    )
    head = b"".join(struct.pack("<I", len(field)) + field for field in fields)
    return b"#ROSBAG V2.0\n" + struct.pack("<I", len(head)) + head + bytes(4)


# -- ROS 2 ----------------------------------------------------------------------------------------

RECORDED = sorted({path.parent for path in RECORDINGS.rglob("*.db3")})
TEXTS = {
    "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data",
    "velodyne_msgs/msg/VelodyneScan": "std_msgs/Header header\nVelodynePacket[] packets",
    "pandar_msgs/msg/PandarPacket": "builtin_interfaces/Time stamp\nuint8[1500] data\nuint32 size",
    "pandar_msgs/msg/PandarScan": "std_msgs/Header header\nPandarPacket[] packets",
}


@pytest.mark.parametrize("folder", RECORDED, ids=lambda folder: folder.parent.name)
def test_recordings_read_as_rosbags_decodes_them(folder: Path) -> None:
    """Their numbers of packets: tests/golden/test_containers.py."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    for key, text in TEXTS.items():
        store.register(get_types_from_msg(text, key))
    expected = []
    with AnyReader([folder], default_typestore=store) as reader:
        for connection, _, raw in reader.messages():
            message: Any = reader.deserialize(raw, connection.msgtype)
            for packet in cast("Sequence[Any]", message.packets):
                data = bytes(packet.data)[: getattr(packet, "size", len(packet.data))]
                host_ns = packet.stamp.sec * 1_000_000_000 + packet.stamp.nanosec
                expected.append(Seen(host_ns, connection.topic, data))
    for path in (folder, next(folder.glob("*.db3"))):
        recording = open_bag(path)
        assert read(recording) == expected
        assert (recording.notes, recording.streams.untimed) == ([], set())
        assert recording.position_bytes == recording.size_bytes


def test_files_on_disk_win_over_the_metadata(tmp_path: Path) -> None:
    messages = fixture_messages("cdr")
    folder = write_folder(tmp_path / "bag", [messages[:200], messages[200:500], messages[500:]])
    packed = zstandard.compress((folder / "bag_2.db3").read_bytes())
    (folder / "bag_2.db3").unlink()
    (folder / "renamed.db3.zstd").write_bytes(packed)
    (folder / "bag_9.db3").touch()
    recording = open_bag(folder)
    assert read(recording) == PACKETS
    assert recording.notes == [
        "bag_9.db3: has 0 bytes and is left out",
        "bag_2.db3: listed in metadata.yaml, but missing",
        "renamed.db3.zstd: not listed in metadata.yaml, but read",
    ]
    (folder / "metadata.yaml").write_text("{", encoding="utf-8")
    assert read(open_bag(folder)) == PACKETS
    (folder / "metadata.yaml").unlink()
    assert read(open_bag(folder)) == PACKETS


def test_messages_come_by_time_whatever_the_order_of_rows(tmp_path: Path) -> None:
    shuffled = fixture_messages("cdr")
    random.Random(1).shuffle(shuffled)
    seen = read(open_bag(write_rosbag2(tmp_path / "a.db3", shuffled)))
    assert set(seen) == set(PACKETS)
    assert [one.host_ns for one in seen] == sorted(one.host_ns for one in PACKETS)


def test_last_messages_of_a_crashed_recorder_are_read_from_the_log(tmp_path: Path) -> None:
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
    assert read(open_bag(crashed)) == PACKETS


def test_rows_that_are_no_messages_are_counted(tmp_path: Path) -> None:
    good = packet_message("cdr", b"packet")
    path = write_rosbag2(
        tmp_path / "a.db3", [Recorded("/p", OUSTER, at, good) for at in range(1, 6)]
    )
    with sqlite3.connect(path) as connection:
        connection.execute("UPDATE messages SET data = 'text' WHERE id = 2")
        connection.execute("UPDATE messages SET data = x'0001' WHERE id = 3")
    connection.close()
    recording = open_bag(path)
    assert [one.host_ns for one in read(recording)] == [1, 4, 5]
    assert recording.counts.skipped == {"truncated": 2}


def test_a_message_in_a_page_that_is_cut_off_is_counted(tmp_path: Path) -> None:
    """SQLite reads zeros for the missing bytes: a packet that looks whole and is not."""
    path = write_rosbag2(tmp_path / "a.db3", SENT)
    content = path.read_bytes()
    page_bytes = int.from_bytes(content[16:18], "big")
    for bytes_ in (1, 2, 7, 64):
        path.write_bytes(content[:-bytes_])
        recording = open_bag(path)
        seen = read(recording)
        # Where zeros make no row, SQLite stops before it.
        assert seen == PACKETS[: len(seen)]
        assert len(PACKETS) - len(seen) in ((1,) if bytes_ == 1 else (1, 2))
        assert recording.counts.skipped in ({"truncated": 1}, {"truncated": 2})
        found = f"expected {page_bytes} bytes, found {page_bytes - bytes_}"
        assert recording.notes[0] == f"a.db3: its last page was cut off: {found}"
    # What follows the pages is no part of the database.
    path.write_bytes(content + b"more")
    recording = open_bag(path)
    assert (read(recording), recording.notes) == (PACKETS, [])


# -- refusals -------------------------------------------------------------------------------------


# Files of a folder, and what is said of it; others are in tests/cli/cases/bags.txt.
REFUSED: Mapping[str, tuple[bytes, str]] = {
    "a.mcap": (MAGIC[:7], "expected a recording"),
    "a.bag": (
        b"#ROSBAG V1.2\n" + bytes(90),
        "expected a bag of version 2.0 (#ROSBAG V2.0), found #ROSBAG V1.2; ",
    ),
    "b.bag": (_encrypted(), "; decrypt it with"),
    "above/drive/a.pcapng": (b"", "found 1 folder(s) with recordings (drive); name "),
    "capture/a.db3": (
        b"\xd4\xc3\xb2\xa1" + bytes(16) + b"\1\0\0\0",
        "expected the folder of a bag, found one with files of pcap",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_read_is_said_in_one_line(name: str, tmp_path: Path) -> None:
    content, said = REFUSED[name]
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_bytes(content)
    assert said in refusal(tmp_path / name.partition("/")[0])
    assert "found no such file; check the path" in refusal(tmp_path / "none")
