"""ROS 1 bags: the same packets as the capture they were made from, whatever happened to the bag."""

from __future__ import annotations

import contextlib
import gzip
import random
import struct
from pathlib import Path

import pytest
from rosbags.rosbag1 import Reader

from mlbatch.errors import RecordingError
from mlbatch.readers import open_recording
from mlbatch.readers.bag.recording import BagRecording
from mlbatch.ros import decode_string
from mlbatch.types import Message, StreamTable, Topic
from tests.builders.bags import (
    OUSTER_ROS1,
    Body,
    Recorded,
    fixture_messages,
    fixture_packets,
    packet_message,
)
from tests.builders.reading import Seen, assert_balanced, seen_of
from tests.builders.rosbag1 import definition_of, open_chunk, without_index, write_rosbag1

PACKETS = [Seen(host_ns, topic, payload) for topic, host_ns, payload in fixture_packets()]


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


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """An uncompressed bag of the two lidars."""
    path = tmp_path_factory.mktemp("bags") / "plain.bag"
    return write_rosbag1(path, fixture_messages("ros1")).read_bytes()


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
@pytest.mark.parametrize("callers", [1, 3])
def test_packets_are_those_of_the_capture(tmp_path: Path, compression: str, callers: int) -> None:
    path = tmp_path / "a.bag"
    write_rosbag1(path, fixture_messages("ros1"), compression, callers=callers)
    recording = opened(path)
    assert recording.container == "ROS 1 bag"
    assert read(recording)[0] == PACKETS
    assert read(recording)[0] == PACKETS  # A second pass starts anew.
    assert recording.notes == []
    assert recording.counts.datagrams == len(PACKETS)
    assert recording.position_bytes == recording.size_bytes == path.stat().st_size


def test_chunks_larger_than_the_buffer_are_read(tmp_path: Path) -> None:
    messages = fixture_messages("ros1") * 3
    path = write_rosbag1(tmp_path / "a.bag", messages, chunk_bytes=1 << 30)
    assert read(opened(path))[0] == PACKETS * 3


def test_topics_are_those_that_rosbags_finds(tmp_path: Path) -> None:
    path = write_rosbag1(tmp_path / "a.bag", fixture_messages("ros1"))
    with Reader(path) as reader:
        expected = {
            connection.topic: (
                connection.msgtype.replace("/msg/", "/"),
                definition_of(connection),
                bool(getattr(connection.ext, "latching", 0)),
            )
            for connection in reader.connections
        }
    topics = opened(path).topics
    assert {
        topic.name: (topic.type, topic.definition, topic.latched) for topic in topics
    } == expected
    assert {(topic.encoding, topic.format) for topic in topics} == {("ros1", "ros1msg")}


@pytest.mark.parametrize("compression", ["none", "lz4"])
@pytest.mark.parametrize("damage", [without_index, open_chunk])
def test_bags_that_were_never_closed_are_read(
    tmp_path: Path, compression: str, damage: object
) -> None:
    assert callable(damage)
    path = tmp_path / "a.bag"
    write_rosbag1(path, fixture_messages("ros1"), compression)
    topics = opened(path).topics
    path.write_bytes(damage(path.read_bytes()))
    recording = opened(path)
    seen, _ = read(recording)
    assert set(recording.topics) == set(topics)
    assert "no index" in recording.notes[0]
    if compression == "none" or damage is without_index:
        assert seen == PACKETS
        assert recording.counts.skipped == {}
    else:  # Compressed bytes without their length cannot be found again.
        assert seen == PACKETS[: len(seen)]
        assert set(recording.counts.skipped) == {"truncated"}


@pytest.mark.parametrize("compression", ["none", "lz4"])
def test_whole_messages_before_a_cut_are_read(tmp_path: Path, compression: str) -> None:
    """The place of each payload in an uncompressed bag says which messages are whole."""
    path = tmp_path / "a.bag"
    bag = write_rosbag1(path, fixture_messages("ros1"), compression).read_bytes()
    ends, at = [], 0
    for packet in PACKETS if compression == "none" else ():
        at = bag.index(packet.payload, at) + len(packet.payload)
        ends.append(at)
    rng = random.Random(3)
    for size in [len(bag) - 1, *(rng.randrange(64, len(bag)) for _ in range(25))]:
        path.write_bytes(bag[:size])
        recording = opened(path)
        seen, _ = read(recording)
        assert seen == PACKETS[: len(seen)]
        assert recording.notes
        if ends:
            assert len(seen) == sum(end <= size for end in ends)


def test_damaged_bytes_never_raise_anything_else(tmp_path: Path, plain: bytes) -> None:
    rng, path = random.Random(4), tmp_path / "a.bag"
    for _ in range(25):
        bag = bytearray(plain)
        for _ in range(rng.choice([1, 30])):
            bag[rng.randrange(4000, len(bag))] = rng.randrange(256)
        at = rng.randrange(4109, len(bag) - 4)
        bag[at : at + 4] = rng.randbytes(4)
        path.write_bytes(bag)
        # An unknown encoding ends a pass, with a note of one line.
        with contextlib.suppress(RecordingError):
            read(opened(path))


def test_a_corrupt_chunk_costs_only_itself(tmp_path: Path) -> None:
    path = tmp_path / "a.bag"
    bag = bytearray(write_rosbag1(path, fixture_messages("ros1"), "bz2").read_bytes())
    at = bag.index(b"BZh9", bag.index(b"BZh9") + 4)
    bag[at + 40 : at + 60] = bytes(20)
    path.write_bytes(bag)
    recording = opened(path)
    seen, _ = read(recording)
    assert recording.counts.skipped == {"truncated": 1}
    assert "a chunk (bz2): expected" in recording.notes[0]
    assert 0 < len(PACKETS) - len(seen) < 60
    assert [one for one in PACKETS if one in set(seen)] == seen


def test_messages_are_handed_over_in_file_order(tmp_path: Path) -> None:
    messages = fixture_messages("ros1")
    recording = opened(write_rosbag1(tmp_path / "a.bag", messages, "lz4"))
    assert read(recording)[1] == []
    recording.keep = frozenset({"/tf_static", "/left/ouster/metadata", "/imu/data"})
    seen, kept = read(recording)
    assert seen == PACKETS
    expected = [message for message in messages if message.topic in recording.keep]
    found = [(m.topic.name, m.topic.type, m.host_ns, m.data) for m in kept]
    assert found == [(m.topic, m.type, m.log_ns, m.data) for m in expected]
    metadata = next(message for message in kept if message.topic.type == "std_msgs/String")
    assert '"122647000123"' in decode_string(metadata.topic, bytes(metadata.data))
    assert metadata.topic.latched


def test_unreadable_messages_are_counted_and_reported(tmp_path: Path) -> None:
    good = packet_message("ros1", b"packet")
    messages = [Recorded("/p", OUSTER_ROS1, at, good[: 10 if at % 2 else 8]) for at in range(1, 8)]
    recording = opened(write_rosbag1(tmp_path / "a.bag", messages))
    seen, _ = read(recording)
    assert len(seen) == 4
    assert recording.counts.skipped == {"truncated": 3}
    assert recording.notes == [
        "/p: 3 messages could not be read; the first: expected a length of at most 4 at byte 0 "
        "of a message, found 6; it was cut off, or is of another type"
    ]


def test_the_calibration_of_hesai_is_a_message_of_its_own(tmp_path: Path) -> None:
    text = b"Laser id,Elevation,Azimuth\n"
    body = Body("ros1").header(0).put("I", 2).time(5).blob(b"\xff\xee12").put("I", 4)
    body.time(0).blob(b"\x47\x74\x05\x00" + struct.pack(">I", len(text)) + text)
    path = tmp_path / "a.bag"
    message = Recorded("/pandar", "hesai_lidar/PandarScan", 77, body.put("I", len(text)).done())
    recording = opened(write_rosbag1(path, [message]))
    recording.keep = frozenset({"/pandar"})
    seen, kept = read_hesai(recording)
    assert [(one.host_ns, one.payload) for one in seen] == [(5, b"\xff\xee12")]
    own = Topic("/pandar", "mlbatch/HesaiCorrection", "bytes")
    assert kept[-1] == Message(own, 77, text)
    assert recording.counts.skipped == {"no_stream": 1}


def read_hesai(recording: BagRecording) -> tuple[list[Seen], list[Message]]:
    """As `read`, where a calibration is no stream."""
    batches = list(recording.packets())
    seen = [one for batch in batches for one in seen_of(batch, recording.streams)]
    return seen, [message for batch in batches for message in batch.messages]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"#ROSBAG V1.2\n" + bytes(90), "expected a bag of version 2.0 .*, found #ROSBAG V1.2; "),
        (
            b"#ROSBAG V2.0\n"
            + struct.pack("<I", 94)
            + b"".join(
                struct.pack("<I", len(field)) + field
                for field in (
                    b"op=\x03",
                    b"index_pos=" + bytes(8),
                    b"conn_count=" + bytes(4),
                    b"chunk_count=" + bytes(4),
                    b"encryptor=rosbag/AesCbcEncryptor",
                )
            ),
            "found one that is encrypted .*; decrypt it with",
        ),
    ],
)
def test_what_cannot_be_read_is_said_in_one_line(
    tmp_path: Path, content: bytes, message: str
) -> None:
    path = tmp_path / "a.bag"
    if b"encryptor" in content:
        head = content[17:]
        content = content[:13] + struct.pack("<I", len(head)) + head + bytes(4)
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=message) as caught:
        opened(path)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(f"{path}: ")


def test_a_compressed_bag_has_nothing_wrong_with_it(tmp_path: Path) -> None:
    """Its index cannot be looked at, which is no damage; with --strict a note would be an error."""
    plain = write_rosbag1(tmp_path / "drive.bag", fixture_messages("ros1"))
    packed = tmp_path / "drive.bag.gz"
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    whole, gzipped = (open_recording(path, StreamTable()) for path in (plain, packed))
    assert gzipped.notes == []
    assert gzipped.topics == whole.topics
