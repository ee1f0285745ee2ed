"""Bags of every kind: the packets and messages they were made from, whole, in parts and damaged."""

from __future__ import annotations

import os
import random
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from rosbags.typesys import get_types_from_msg

from mlbatch.errors import RecordingError
from tests.builders import rosbag2
from tests.builders.bags import (
    OUSTER_ROS1,
    Body,
    Recorded,
    definition,
    fixture_messages,
    fixture_packets,
    packet_message,
)
from tests.builders.containers import BAGS, Bag, database, mcap, rosbag1
from tests.builders.mcaps import LZ4, ZSTD, Form
from tests.builders.reading import Seen, open_bag, read, read_kept
from tests.builders.rosbag1 import open_chunk, without_index
from tests.builders.sessions_of_bags import packets_only

PACKETS = [Seen(host_ns, topic, payload) for topic, host_ns, payload in fixture_packets()]
LATCHED = {"/left/ouster/metadata", "/right/ouster/metadata", "/tf_static"}
OUSTER = {"cdr": "ouster_sensor_msgs/PacketMsg", "ros1": OUSTER_ROS1}
CHUNKS = {
    "MCAP": mcap(Form(chunk_bytes=20_000)),
    "MCAP, zstd": mcap(Form(compression=ZSTD, chunk_bytes=20_000)),
    "MCAP, lz4": mcap(Form(compression=LZ4, chunk_bytes=20_000)),
    "ROS 1, bz2": rosbag1("bz2"),
}
ONE_OF_EACH = ["MCAP, none", "MCAP, unchunked", "MCAP, zstd", "ROS 1, lz4", "ROS 2"]


@pytest.mark.parametrize("name", BAGS)
def test_packets_and_topics_are_those_that_were_recorded(name: str, tmp_path: Path) -> None:
    bag = BAGS[name]
    messages = fixture_messages(bag.encoding)
    path = bag.write(tmp_path, messages)
    content = path.read_bytes()
    temporary = Path(os.environ.get("TMPDIR", "/tmp"))
    before = set(temporary.glob("mlbatch-*"))
    # Each is smaller than chunks and messages.
    for buffer_bytes in (None, 4096):
        recording = open_bag(path, buffer_bytes=buffer_bytes)
        assert recording.container == bag.container
        for _ in range(2):  # A second pass starts anew.
            assert read(recording) == PACKETS
            assert len(recording.notes) == bag.notes
            assert (recording.counts.datagrams, recording.counts.skipped) == (len(PACKETS), {})
        topics = recording.topics
        assert {(one.name, one.type) for one in topics} == {(m.topic, m.type) for m in messages}
        form = "ros1msg" if bag.encoding == "ros1" else "ros2msg"
        assert {(one.encoding, one.format) for one in topics} == {(bag.encoding, form)}
        assert {one.name for one in topics if one.latched} == LATCHED
        for one in topics:
            if "ROS 2" in name and "schema 4" not in name:
                # Bags of schema 3 have none: writers of MCAP need one for all topics.
                key = one.type.replace("/", "/msg/")
                assert key in get_types_from_msg(one.definition, key)
            else:
                assert one.definition == definition(one.type, bag.encoding)
        assert recording.size_bytes == len(content)
        del recording
    # Nothing is written to, next to or for the file.
    assert path.read_bytes() == content
    assert list(tmp_path.iterdir()) == [path]
    assert set(temporary.glob("mlbatch-*")) <= before


@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_kept_messages_come_whole_and_in_order(name: str, tmp_path: Path) -> None:
    bag = BAGS[name]
    sent = []
    for number, message in enumerate(fixture_messages(bag.encoding)[:60]):
        text = Body(bag.encoding).text(f"{number} " + "x" * 1000 * number).done()
        sent += [message, Recorded("/note", "std_msgs/String", message.log_ns, text)]
        sent.append(Recorded("/camera", "sensor_msgs/Image", message.log_ns, bytes(30_000)))
    expected = [one for one in PACKETS if one.host_ns <= sent[-1].log_ns]
    for keep in ({"/note"}, {"/note", "/tf_static", "/imu/data"}, set[str]()):
        recording = open_bag(bag.write(tmp_path, sent), keep=keep, buffer_bytes=4096)
        seen, messages = read_kept(recording)
        assert seen == expected
        found = [(m.topic.name, m.topic.type, m.host_ns, m.data) for m in messages]
        wanted = [m for m in sent if m.topic in keep]
        assert found == [(m.topic, m.type, m.log_ns, m.data) for m in wanted]
        next(tmp_path.iterdir()).unlink()


@pytest.mark.parametrize("name", [*ONE_OF_EACH, "MCAP, lz4", "ROS 1, one chunk"])
def test_messages_longer_than_the_buffer(name: str, tmp_path: Path) -> None:
    bag = BAGS[name]
    sizes = [9, 9, 9 << 20, 9, 300_000]
    messages = [
        Recorded("/p", OUSTER[bag.encoding], at, packet_message(bag.encoding, b"\x55" * size))
        for at, size in enumerate(sizes, 1)
    ]
    path = bag.write(tmp_path, messages)
    for buffer_bytes in (None, 1024):
        packets = read(open_bag(path, buffer_bytes=buffer_bytes))
        assert [len(packet.payload) for packet in packets] == sizes


@pytest.mark.parametrize(("suffix", "name"), [("mcap", "MCAP, zstd"), ("db3", "ROS 2")])
def test_files_of_one_bag_follow_their_times_not_their_names(
    suffix: str, name: str, tmp_path: Path
) -> None:
    """Channels and topics differ in number from file to file."""
    messages = fixture_messages("cdr")
    folder = tmp_path / "bag"
    folder.mkdir()
    for number, part in enumerate((messages[500:], messages[:200], [], messages[200:500])):
        BAGS[name].write(tmp_path, part).rename(folder / f"bag_{number}.{suffix}")
    recording = open_bag(folder, keep={"/imu/data"})
    seen, kept = read_kept(recording)
    assert seen == PACKETS
    assert [m.host_ns for m in kept] == [m.log_ns for m in messages if m.topic == "/imu/data"]
    assert recording.path == folder
    assert recording.notes == []
    assert recording.size_bytes == sum(path.stat().st_size for path in folder.iterdir())
    if suffix == "db3":
        return
    # The damage of a file is under its name; what follows it is read.
    cut = folder / f"bag_3.{suffix}"
    cut.write_bytes(cut.read_bytes()[:-200_000])
    recording = open_bag(folder)
    seen = read(recording)
    assert [one for one in PACKETS if one in set(seen)] == seen
    assert (seen[0], seen[-1]) == (PACKETS[0], PACKETS[-1])
    assert recording.notes[0].startswith(f"bag_3.{suffix}: ")


# Bags that are cut, and which share of their packets comes at least if a share of the file is left;
# None: all that are whole.
CUT: dict[str, tuple[Bag, Callable[[float], float] | None]] = {
    "MCAP": (mcap(Form(summary=False, chunk_bytes=20_000)), None),
    "MCAP, unchunked": (mcap(Form(chunked=False, summary=False)), None),
    "MCAP, one chunk, zstd": (
        mcap(Form(compression=ZSTD, summary=False, chunk_bytes=1 << 30)),
        lambda share: 0.5 * (share >= 0.75),
    ),
    "MCAP, one chunk, lz4": (
        mcap(Form(compression=LZ4, summary=False, chunk_bytes=1 << 30)),
        lambda share: 0.5 * (share >= 0.75),
    ),
    "ROS 1": (rosbag1("none"), None),
    "ROS 1, lz4": (rosbag1("lz4"), lambda share: 0.0),
    "ROS 2": (database(rosbag2.Form()), lambda share: share - 0.05),
}


@pytest.mark.parametrize("name", CUT)
def test_what_is_whole_of_a_cut_bag_is_read(name: str, tmp_path: Path) -> None:
    """The place of each payload in an uncompressed bag says which messages are whole."""
    bag, least = CUT[name]
    # Pages of a database are filled in order; of so few, the first one of the table leads to all.
    expected = PACKETS[:350] if name == "ROS 2" else PACKETS
    path = bag.write(tmp_path, packets_only(bag.encoding)[: len(expected)])
    content = path.read_bytes()
    ends, at = [], 0
    for packet in expected if least is None else ():
        at = content.index(packet.payload, at) + len(packet.payload)
        ends.append(at)
    rng = random.Random(12)
    shares = [0.3, 0.5, 0.75, 0.9, *(rng.uniform(0.3 if least else 0.0, 1) for _ in range(25))]
    sizes = [int(share * len(content)) for share in shares]
    for size in (*sizes, *(len(content) - bytes_ for bytes_ in (1, 10, 99))):
        path.write_bytes(content[: max(size, 64)])
        recording = open_bag(path, buffer_bytes=4096)
        seen = read(recording)
        assert seen == expected[: len(seen)]
        if least is None:
            assert len(seen) == sum(end <= size for end in ends)
        else:
            assert len(seen) >= least(size / len(content)) * len(expected)
        assert recording.notes
        assert recording.counts.skipped in ({}, {"truncated": 1})


@pytest.mark.parametrize("compression", ["none", "lz4"])
@pytest.mark.parametrize("damage", [without_index, open_chunk])
def test_ros_1_bags_that_were_never_closed(
    tmp_path: Path, compression: str, damage: Callable[[bytes], bytes]
) -> None:
    path = BAGS[f"ROS 1, {compression}"].write(tmp_path, fixture_messages("ros1"))
    topics = open_bag(path).topics
    path.write_bytes(damage(path.read_bytes()))
    recording = open_bag(path)
    seen = read(recording)
    assert set(recording.topics) == set(topics)
    assert "no index" in recording.notes[0]
    if compression == "none" or damage is without_index:
        assert seen == PACKETS
        assert recording.counts.skipped == {}
    else:  # Compressed bytes without their length cannot be found again.
        assert seen == PACKETS[: len(seen)]
        assert set(recording.counts.skipped) == {"truncated"}


@pytest.mark.parametrize(
    ("name", "magic", "zeros", "note"),
    [
        (
            "MCAP",
            struct.pack("<BQ", 5, 22 + 8 + 2304),
            slice(0, 1),
            "expected a record, found one of kind 0x00; the rest of the chunk was not read",
        ),
        (
            "MCAP, zstd",
            b"\x28\xb5\x2f\xfd",
            slice(0, 4),
            "found 0 before their end or a fault; the rest of the chunk was not read",
        ),
        (
            "MCAP, lz4",
            b"\x04\x22\x4d\x18",
            slice(0, 4),
            "found 0 before their end or a fault; the rest of the chunk was not read",
        ),
        ("ROS 1, bz2", b"BZh9", slice(40, 60), "a chunk (bz2): expected"),
    ],
)
def test_a_corrupt_chunk_costs_only_itself(
    name: str, magic: bytes, zeros: slice, note: str, tmp_path: Path
) -> None:
    bag = CHUNKS[name]
    path = bag.write(tmp_path, fixture_messages(bag.encoding)[:100])
    expected = read(open_bag(path))
    content = bytearray(path.read_bytes())
    at = content.index(magic, content.index(magic) + 4)
    content[at + zeros.start : at + zeros.stop] = bytes(zeros.stop - zeros.start)
    path.write_bytes(content)
    recording = open_bag(path, buffer_bytes=4096)
    seen = read(recording)
    assert recording.counts.skipped == {"truncated": 1}
    [said] = recording.notes
    assert note in said
    assert 0 < len(seen) < len(expected)
    assert [one for one in expected if one in set(seen)] == seen
    assert seen[-1] == expected[-1]


@pytest.mark.parametrize("name", ["MCAP, none", "ROS 1, none", "ROS 2"])
def test_messages_that_cannot_be_read_are_counted(name: str, tmp_path: Path) -> None:
    """Cut by 2 bytes of 6."""
    bag = BAGS[name]
    good = packet_message(bag.encoding, b"packet")
    messages = [
        Recorded("/p", OUSTER[bag.encoding], number, good[: None if number % 2 else -2])
        for number in range(1, 8)
    ]
    messages.append(Recorded("/q", OUSTER[bag.encoding], 8, good[:-2]))
    recording = open_bag(bag.write(tmp_path, messages))
    assert [one.host_ns for one in read(recording)] == [1, 3, 5, 7]
    assert recording.counts.skipped == {"truncated": 4}
    first, second = recording.notes
    assert first == (
        "/p: 3 messages could not be read; the first: expected a length of at most 4 at byte 0 "
        "of a message, found 6; it was cut off, or is of another type"
    )
    assert second.startswith("/q: ")


@pytest.mark.parametrize("name", [*ONE_OF_EACH, "MCAP, lz4", "ROS 1, none"])
def test_damaged_bytes_are_noted_or_refused_in_one_line(name: str, tmp_path: Path) -> None:
    bag = BAGS[name]
    path = bag.write(tmp_path, fixture_messages(bag.encoding)[:120])
    content, rng = path.read_bytes(), random.Random(4)
    for _ in range(40):
        damaged = bytearray(content)
        for _ in range(rng.choice([1, 6, 30])):
            at, size = rng.randrange(100, len(damaged) - 40), rng.choice([1, 4, 40])
            damaged[at : at + size] = rng.randbytes(size)
        path.write_bytes(damaged[: rng.choice([len(damaged), rng.randrange(100, len(damaged))])])
        line = ""
        try:
            read(open_bag(path))
        except RecordingError as err:
            line = str(err)
        assert "\n" not in line
