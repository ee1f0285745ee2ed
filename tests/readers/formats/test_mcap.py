"""MCAP files, whole and damaged; the reference library writes them."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from mcap import records as mcap_records
from mcap.stream_reader import StreamReader
from mcap.writer import IndexType, Writer

from mlbatch.errors import RecordingError
from mlbatch.readers import open_recording
from mlbatch.readers.formats import mcap
from mlbatch.types import Message, Recording, StreamTable
from tests.builders.mcaps import (
    FORMS,
    LZ4,
    NONE,
    ZSTD,
    Form,
    Sent,
    fixture_packets,
    packet_message,
    packet_messages,
    text_message,
    write_mcap,
)
from tests.builders.reading import Seen, assert_balanced, seen_of

PACKETS = fixture_packets()
EXPECTED = [Seen(p.host_ns, p.topic, p.payload) for p in PACKETS]


def read(recording: Recording, streams: StreamTable) -> tuple[list[Seen], list[Message]]:
    """All packets and kept messages; the ledger must balance."""
    seen: list[Seen] = []
    messages: list[Message] = []
    for batch in recording.packets():
        seen += seen_of(batch, streams)
        messages += batch.messages
    assert_balanced(recording)
    assert recording.position_bytes <= recording.size_bytes
    return seen, messages


def opened(path: Path, buffer_bytes: int = 4096, keep: str = "") -> tuple[Recording, StreamTable]:
    """A file read through a buffer that is smaller than its chunks and some messages."""
    streams = StreamTable()
    recording = mcap.open_folder(path, [path], streams, buffer_bytes=buffer_bytes)
    recording.keep = frozenset({keep} if keep else ())
    return recording, streams


def packets_of(path: Path) -> tuple[list[Seen], Recording]:
    """The packets of a file, read through a small buffer."""
    recording, streams = opened(path)
    return read(recording, streams)[0], recording


@pytest.mark.parametrize("name", FORMS)
def test_every_form_gives_the_packets_of_the_pcap(name: str, tmp_path: Path) -> None:
    form = FORMS[name]
    path = write_mcap(tmp_path / "a.mcap", packet_messages(PACKETS, form.ros), form)
    streams = StreamTable()
    recording = open_recording(path, streams)
    assert recording.container == "MCAP"
    assert {topic.name for topic in recording.topics} == {packet.topic for packet in PACKETS}
    assert read(recording, streams)[0] == EXPECTED
    assert recording.counts.skipped == {}
    assert len(recording.notes) == (0 if form.summary else 1)
    # A second pass gives the same again, and so does another buffer.
    assert read(recording, streams)[0] == EXPECTED
    assert packets_of(path)[0] == EXPECTED


@pytest.mark.parametrize("name", ["none", "zstd", "ROS 1"])
def test_topics_are_those_of_the_file(name: str, tmp_path: Path) -> None:
    ros = FORMS[name].ros
    qos = {"latching": "1"} if ros == 1 else {"offered_qos_profiles": "- durability: 1\n"}
    form = replace(FORMS[name], qos=qos)
    sent = Sent("/left/metadata", "std_msgs/String", 5, text_message("{}", ros))
    [topic] = open_recording(write_mcap(tmp_path / "a.mcap", [sent], form), StreamTable()).topics
    assert (topic.name, topic.type) == ("/left/metadata", "std_msgs/String")
    assert topic.encoding == ("cdr" if ros == 2 else "ros1")
    assert (topic.definition, topic.format) == ("string data\n", f"ros{ros}msg")
    assert topic.latched
    assert topic.qos == ("- durability: 1\n" if ros == 2 else "")


@pytest.mark.parametrize("form", [Form(), Form(ZSTD), Form(chunked=False)])
def test_kept_messages_come_whole_and_in_order(form: Form, tmp_path: Path) -> None:
    sent: list[Sent] = []
    for number, message in enumerate(packet_messages(PACKETS[:20])):
        text = text_message(f"{number} " + "x" * 1000 * number)
        sent += [Sent("/note", "std_msgs/String", message.log_ns, text), message]
        sent.append(Sent("/camera", "sensor_msgs/Image", message.log_ns, bytes(30_000)))
    path = write_mcap(tmp_path / "a.mcap", sent, form)
    recording, streams = opened(path, keep="/note")
    seen, messages = read(recording, streams)
    assert seen == EXPECTED[:20]
    expected = [(m.log_ns, m.data) for m in sent if m.topic == "/note"]
    assert [(message.host_ns, message.data) for message in messages] == expected
    recording.keep = frozenset()
    assert read(recording, streams) == (seen, [])


def test_chunks_without_wanted_topics_are_not_looked_into(tmp_path: Path) -> None:
    images = [Sent("/camera", "sensor_msgs/Image", i, bytes(5000)) for i in range(100)]
    sent = [*packet_messages(PACKETS[:3]), *images, *packet_messages(PACKETS[3:6])]
    path = write_mcap(tmp_path / "a.mcap", sent, Form(ZSTD, chunk_bytes=20_000))
    data = bytearray(path.read_bytes())
    # Damage in the middle chunks would be noted, were they unpacked.
    magic = b"\x28\xb5\x2f\xfd"
    places = [at for at in range(len(data)) if data.startswith(magic, at)]
    for at in places[2:-2]:
        data[at : at + 4] = bytes(4)
    path.write_bytes(data)
    seen, recording = packets_of(path)
    assert seen == EXPECTED[:6]
    assert recording.notes == []


def test_several_files_are_one_bag(tmp_path: Path) -> None:
    """In the order of their first messages, whatever their names; channels differ in number."""
    late = write_mcap(tmp_path / "a_1.mcap", packet_messages(PACKETS[301:]), Form(ZSTD))
    early = write_mcap(tmp_path / "a_9.mcap", packet_messages(PACKETS[:301]))
    empty = write_mcap(tmp_path / "a_0.mcap", [])
    streams = StreamTable()
    recording = open_recording(tmp_path, streams)
    assert read(recording, streams)[0] == EXPECTED
    assert recording.size_bytes == sum(path.stat().st_size for path in (late, early, empty))
    assert recording.path == tmp_path
    late.write_bytes(late.read_bytes()[:-200_000])
    recording = mcap.open_folder(tmp_path, [empty, late, early], streams, ["a note"])
    seen, _ = read(recording, streams)
    assert EXPECTED[:301] == seen[:301]
    assert seen == EXPECTED[: len(seen)]
    assert recording.notes[0] == "a note"
    assert recording.notes[1].startswith("a_1.mcap: byte ")


def test_messages_longer_than_the_buffer(tmp_path: Path) -> None:
    sent = [Sent("/a", "std_msgs/String", i, text_message("x" * 300_000)) for i in range(3)]
    for form in (Form(), Form(LZ4), Form(chunked=False)):
        recording, streams = opened(write_mcap(tmp_path / "a.mcap", sent, form), 1024, "/a")
        assert [message.data for message in read(recording, streams)[1]] == [m.data for m in sent]


def test_other_mcap_recordsare_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=NONE, chunk_size=3000)
        writer.start("ros2")
        schema = writer.register_schema(
            "ouster_sensor_msgs/msg/PacketMsg", "ros2msg", b"uint8[] buf\n"
        )
        channel = writer.register_channel("/a", "cdr", schema)
        for number in range(6):
            writer.add_message(channel, number, packet_message(bytes(2304)), number)
            writer.add_attachment(number, number, "photo", "image/png", bytes(9000))
            writer.add_metadata("about", {"number": str(number)})
        end: Callable[[], None] = writer.finish
        end()
    # A record of an application between header and first record.
    data = path.read_bytes()
    at = 8 + 9 + int.from_bytes(data[9:17], "little")
    path.write_bytes(data[:at] + struct.pack("<BQ", 0x81, 50) + bytes(50) + data[at:])
    assert [seen.host_ns for seen in packets_of(path)[0]] == list(range(6))


def test_the_reference_reader_agrees(tmp_path: Path) -> None:
    """Messages of the reference library's own stream reader, in the order of the file."""
    path = write_mcap(tmp_path / "a.mcap", packet_messages(PACKETS), Form(ZSTD))
    with path.open("rb") as file:
        found = StreamReader(file).records
        times = [record.log_time for record in found if isinstance(record, mcap_records.Message)]
    assert [seen.host_ns for seen in packets_of(path)[0]] == times


def test_a_compressed_file(tmp_path: Path) -> None:
    zstandard = pytest.importorskip("zstandard")
    plain = write_mcap(tmp_path / "a.mcap", packet_messages(PACKETS[:40]), FORMS["no index"])
    path = tmp_path / "a.mcap.zst"
    path.write_bytes(zstandard.ZstdCompressor().compress(plain.read_bytes()))
    streams = StreamTable()
    recording = open_recording(path, streams)
    assert read(recording, streams)[0] == EXPECTED[:40]
    assert recording.notes == []


def test_an_index_that_names_no_channel_is_not_trusted(tmp_path: Path) -> None:
    form = Form(index=IndexType.CHUNK, chunk_bytes=20_000)
    path = write_mcap(tmp_path / "a.mcap", packet_messages(PACKETS[:60]), form)
    assert packets_of(path)[0] == EXPECTED[:60]


def test_a_summary_may_name_channels_before_schemas(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", packet_messages(PACKETS[:60]), Form(ZSTD))
    data = path.read_bytes()
    start, _, _ = struct.unpack("<QQI", data[-28:-8])
    at, groups = start, {3: b"", 4: b"", 0: b""}
    while at < len(data) - 37:
        kind, length = struct.unpack_from("<BQ", data, at)
        groups[kind if kind in groups else 0] += data[at : at + 9 + length]
        at += 9 + length
    path.write_bytes(data[:start] + groups[4] + groups[3] + groups[0] + data[-37:])
    assert packets_of(path)[0] == EXPECTED[:60]


def test_big_messages_of_other_topics_are_not_read(tmp_path: Path) -> None:
    """A hole in the file costs no time and no memory."""
    form = Form(chunked=False, summary=False)
    sent = [*packet_messages(PACKETS[:3]), Sent("/camera", "sensor_msgs/Image", 1, b"")]
    path = write_mcap(tmp_path / "a.mcap", sent, form)
    data = path.read_bytes()
    hole = 3 << 30
    last = data[-(9 + 22) :]
    message = struct.pack("<BQ", 5, 22 + hole) + last[9:]
    again = packet_message(PACKETS[3].payload)
    more = struct.pack("<BQHIQQ", 5, 22 + len(again), 1, 9, 77, 77) + again
    with path.open("wb") as file:
        file.write(data[: -(9 + 22)] + message)
        file.seek(hole, 1)
        file.write(more)
    seen, _ = packets_of(path)
    assert [s.host_ns for s in seen] == [*(p.host_ns for p in PACKETS[:3]), 77]


MAGIC = b"\x89MCAP0\r\n"
HEADER = struct.pack("<BQII", 1, 8, 0, 0)


def whole_messages(data: bytes) -> int:
    """Messages in the front part of a file without compression, by walking its records by hand."""
    at, count = 8, 0
    while at + 9 <= len(data):
        kind, length = struct.unpack_from("<BQ", data, at)
        if kind == 6:
            at += 9 + 40
            continue
        at += 9 + length
        count += kind == 5 and at <= len(data)
    return count


@pytest.mark.parametrize("chunked", [True, False])
def test_a_cut_file_gives_what_is_whole(chunked: bool, tmp_path: Path) -> None:
    form = Form(chunked=chunked, chunk_bytes=20_000, summary=False)
    path = write_mcap(tmp_path / "a.mcap", packet_messages(PACKETS[:60]), form)
    data = path.read_bytes()
    rng = random.Random(12)
    for cut in [8, 9, len(data) - 1, *(rng.randrange(8, len(data)) for _ in range(150))]:
        path.write_bytes(data[:cut])
        seen, recording = packets_of(path)
        assert seen == EXPECTED[: whole_messages(data[:cut])], cut
        assert len(recording.notes) == 1
        assert recording.notes[0].startswith("byte ")
        assert recording.counts.skipped.get("truncated", 0) <= 1


@pytest.mark.parametrize("form", [Form(), Form(ZSTD), Form(LZ4), Form(chunked=False)])
def test_a_file_cut_after_its_last_message(form: Form, tmp_path: Path) -> None:
    """All packets; nothing is known to be lost, but the missing end is reported."""
    path = write_mcap(tmp_path / "a.mcap", packet_messages(PACKETS), replace(form, summary=False))
    data = path.read_bytes()
    if form.chunked:  # The indexes of the last chunk follow it: kind 7.
        at, end = 8, 0
        while at < len(data):
            kind, length = struct.unpack_from("<BQ", data, at)
            at += 9 + length
            end = at if kind == 6 else end
        data = data[:end]
    path.write_bytes(data)
    seen, recording = packets_of(path)
    assert seen == EXPECTED
    assert recording.counts.skipped == {}
    assert recording.notes == [
        f"byte {len(data)}: the file was cut off between records: expected its footer; the rest "
        "was read"
    ]


@pytest.mark.parametrize("compression", [ZSTD, LZ4])
def test_a_cut_chunk_gives_its_front(compression: object, tmp_path: Path) -> None:
    form = Form(ZSTD if compression is ZSTD else LZ4, chunk_bytes=1 << 30, summary=False)
    path = write_mcap(tmp_path / "a.mcap", packet_messages(PACKETS), form)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 3 // 4])
    seen, recording = packets_of(path)
    assert len(EXPECTED) // 2 < len(seen) < len(EXPECTED)
    assert seen == EXPECTED[: len(seen)]
    assert recording.counts.skipped == {"truncated": 1}


def test_a_corrupt_chunk_costs_itself(tmp_path: Path) -> None:
    for compression, magic in ((ZSTD, b"\x28\xb5\x2f\xfd"), (LZ4, b"\x04\x22\x4d\x18")):
        form = Form(compression, chunk_bytes=20_000)
        path = write_mcap(tmp_path / "a.mcap", packet_messages(PACKETS[:60]), form)
        data = bytearray(path.read_bytes())
        at = data.index(magic, data.index(magic) + 4)
        data[at : at + 4] = bytes(4)
        path.write_bytes(data)
        seen, recording = packets_of(path)
        assert recording.counts.skipped == {"truncated": 1}
        [note] = recording.notes
        assert "found 0 before their end or a fault; the rest of the chunk was not read" in note
        assert 0 < len(seen) < 60
        assert [s for s in EXPECTED[:60] if s in seen] == seen
        assert seen[-1] == EXPECTED[59]


def broken(kind: int, body: bytes, length: int | None = None) -> bytes:
    """A record, with a length that may be wrong."""
    return struct.pack("<BQ", kind, len(body) if length is None else length) + body


def chunk(size: int, compression: bytes, stored: bytes, length: int | None = None) -> bytes:
    """A chunk, with sizes that may be wrong."""
    head = struct.pack("<QQQII", 0, 0, size, 0, len(compression)) + compression
    return broken(6, head + struct.pack("<Q", len(stored) if length is None else length) + stored)


@pytest.mark.parametrize(
    ("tail", "said"),
    [
        (
            bytes(500),
            "expected a record, found one of kind 0x00; the rest of the file was not read",
        ),
        (broken(0x33, b"abc"), "found one of kind 0x33"),
        (broken(5, b"abc"), "expected a message, found a record of 3 bytes"),
        (broken(5, struct.pack("<H", 1), 1 << 62), "expected a record of at most 268435456 bytes"),
        (broken(5, struct.pack("<H", 9), 1 << 62), "ends within a record"),
        (broken(3, b"", 1 << 40), "expected a record of at most 16777216 bytes"),
        (broken(3, b"", 1 << 20), "ends within a record: expected 1048585 bytes, found 9"),
        (broken(3, bytes(50)), ""),
        (broken(4, b"\1\0\1\0\xff\xff\xff\xff"), "expected a channel, found garbage"),
        (broken(6, b""), "expected a chunk whose lengths agree"),
        (chunk(5, b"", b"abc", 1 << 60), "expected a chunk whose lengths agree"),
        (chunk(1 << 40, b"zstd", b"abc"), "expected a record of at most 268435456 bytes"),
        (chunk(1 << 28, b"zstd", b"abc"), "expected 268435456 bytes of zstd data, found 0"),
        (chunk(1 << 28, b"lz4", b"abc"), "expected 268435456 bytes of lz4 data, found 0"),
        (chunk(9, b"brotli", b"abc"), "lz4 or zstd, found 'brotli'; the chunk was not read"),
        (chunk(0, b"", broken(6, b"")), "expected a record of a chunk, found one of kind 0x06"),
        (chunk(0, b"", broken(0x90, b"", 99)), "expected a record that ends within its chunk"),
        (chunk(0, b"", b"\5\0"), "expected a record that ends within its chunk"),
    ],
)
def test_lies_are_noted_and_what_precedes_is_read(tail: bytes, said: str, tmp_path: Path) -> None:
    form = Form(chunked=False, summary=False)
    path = write_mcap(tmp_path / "a.mcap", packet_messages(PACKETS[:5]), form)
    path.write_bytes(path.read_bytes() + tail)
    seen, recording = packets_of(path)
    assert seen == EXPECTED[:5]
    assert said in recording.notes[0]


def test_a_fault_in_a_chunk_leaves_the_next(tmp_path: Path) -> None:
    form = Form(chunk_bytes=20_000)
    path = write_mcap(tmp_path / "a.mcap", packet_messages(PACKETS[:60]), form)
    data = bytearray(path.read_bytes())
    at = data.index(struct.pack("<BQ", 5, 22 + 8 + 2304))
    data[at] = 0
    path.write_bytes(data)
    seen, recording = packets_of(path)
    assert recording.notes == [
        f"byte {at}: expected a record, found one of kind 0x00; the rest of the chunk was not read"
    ]
    assert 0 < len(seen) < 60
    assert seen[-1] == EXPECTED[59]


def test_damaged_bytes_never_raise(tmp_path: Path) -> None:
    rng = random.Random(5)
    path = tmp_path / "a.mcap"
    for form in (Form(), Form(ZSTD), Form(LZ4), Form(chunked=False), FORMS["ROS 1"]):
        sent = packet_messages(PACKETS[:20], form.ros)
        data = write_mcap(path, sent, replace(form, chunk_bytes=10_000)).read_bytes()
        for _ in range(60):
            changed = bytearray(data)
            for _ in range(rng.randrange(1, 6)):
                changed[rng.randrange(8, len(data))] = rng.randrange(256)
            path.write_bytes(changed[: rng.randrange(8, len(data) + 1)])
            packets_of(path)


@pytest.mark.parametrize("name", ["zstd", "none", "unchunked"])
def test_a_summary_may_lie(name: str, tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", packet_messages(PACKETS[:60]), FORMS[name])
    data = path.read_bytes()
    for start in (1, len(data) // 2, len(data) - 40, 1 << 60):
        footer = struct.pack("<BQQQI", 2, 20, start, 0, 0)
        path.write_bytes(data[:-37] + footer + MAGIC)
        assert packets_of(path)[0] == EXPECTED[:60], start


def test_a_file_of_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    for data in (MAGIC, MAGIC + HEADER, MAGIC + HEADER + b"\x0f"):
        path.write_bytes(data)
        seen, recording = packets_of(path)
        assert (seen, recording.topics, len(recording.notes)) == ([], (), 1)
    path.write_bytes(MAGIC[:7])
    with pytest.raises(RecordingError, match="expected a recording"):
        open_recording(path, StreamTable())
