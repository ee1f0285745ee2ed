"""MCAP files that are cut off or lie: what is whole is read, what is lost is told."""

from __future__ import annotations

import random
import struct
from dataclasses import replace
from pathlib import Path

import pytest

from mlbatch.errors import RecordingError
from mlbatch.readers import open_recording
from mlbatch.types import StreamTable
from tests.builders.mcaps import FORMS, LZ4, ZSTD, Form, packet_messages, write_mcap
from tests.readers.formats.test_mcap import EXPECTED, PACKETS, packets_of

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
    """All packets; nothing is known to be lost, but the missing end is told."""
    path = write_mcap(tmp_path / "a.mcap", packet_messages(PACKETS), replace(form, summary=False))
    data = path.read_bytes()
    if form.chunked:  # Behind the last chunk stand its indexes: kind 7.
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
    """A record, with a length that may lie."""
    return struct.pack("<BQ", kind, len(body) if length is None else length) + body


def chunk(size: int, compression: bytes, stored: bytes, length: int | None = None) -> bytes:
    """A chunk, with sizes that may lie."""
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
