"""The MCAP container, checked by the reference reader: chunks, index, compression, metadata."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader

from tests.builders.run import TWO_LIDARS, command
from tests.builders.scans import PERIOD_NS, START_NS, SUMMARY, dense_scan
from tests.builders.written_bags import read_back, written

SESSION = ("convert", TWO_LIDARS / "two_lidars.pcap", "--rig", TWO_LIDARS / "rig.yaml", "--quiet")
WORDS = ("none", "lz4", "zstd", "zstd:1", "zstd:19")


def messages(path: Path) -> list[tuple[Schema | None, Channel, Message]]:
    """Return all messages in the order of the file."""
    with path.open("rb") as file:
        return list(make_reader(file, validate_crcs=True).iter_messages(log_time_order=False))


def test_definitions_are_those_of_ros_2(tmp_path: Path) -> None:
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    # In capitals before rosbags 0.10.
    names = ("fielddefs", "FIELDDEFS")
    known = next(getattr(store, name) for name in names if hasattr(store, name))
    path = written("mcap", tmp_path / "out.mcap", [dense_scan()])
    schemas = [schema for schema, _, _ in messages(path)]
    texts = {schema.name: schema.data.decode() for schema in schemas if schema is not None}
    assert len(texts) == 3
    for name, text in texts.items():
        parsed = typesys.get_types_from_msg(text, name)
        for part, fields in parsed.items():
            assert fields == known[part], part
        assert text.count("=" * 80) == len(parsed) - 1


@pytest.mark.parametrize(
    ("name", "target", "file"),
    [("mcap", "out.mcap", "out.mcap"), ("rosbag2", "out", "out/out_0.mcap")],
)
def test_metadata_and_table_of_scans(name: str, target: str, file: str, tmp_path: Path) -> None:
    written(name, tmp_path / target, [dense_scan()])
    with (tmp_path / file).open("rb") as opened:
        reader = make_reader(opened)
        header = reader.get_header()
        assert (header.profile, header.library) == ("ros2", "mlbatch 0.1.0")
        notes = {note.name: note.metadata for note in reader.iter_metadata()}
        [attachment] = reader.iter_attachments()
    assert notes["mlbatch.report"] == {"json": SUMMARY.report_json}
    grid = notes["mlbatch.grid"]
    assert json.loads(grid.pop("sensors")) == ["left", "right"]
    assert grid == {
        "rate_hz": "10",
        "t_init_ns": str(START_NS),
        "slices": "1",
        "timescale": "utc",
        "frame_id": "base_link",
        "sort": "columns",
    }
    assert notes["mlbatch.fill"] == SUMMARY.fill
    assert (attachment.name, attachment.data.decode()) == ("scans.csv", SUMMARY.scans_csv)


def test_files_are_chunked_and_indexed(tmp_path: Path) -> None:
    # 24 bytes a point: three scans of 1.92 MB end a chunk each, ten of 0.48 MB are collected in
    # chunks that end above 4 MiB, after the ninth; the last has the tenth and an IMU sample.
    large = [dense_scan(index, 80_000) for index in range(3)]
    small = [dense_scan(index, 20_000) for index in range(3, 13)]
    path = written("mcap", tmp_path / "out.mcap", [*large, *small])
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        found = [(channel.topic, message) for _, channel, message in reader.iter_messages()]
    times_ns = [message.log_time for _, message in found]
    assert times_ns == sorted(times_ns)
    assert summary is not None
    statistics = summary.statistics
    assert statistics is not None
    assert statistics.message_count == len(found) == 1 + 3 + 13
    assert statistics.message_start_time == START_NS - 5
    assert statistics.message_end_time == START_NS + 12 * PERIOD_NS
    assert statistics.chunk_count == len(summary.chunk_indexes) == 3 + 2
    clouds = [message.data for topic, message in found if topic == "/points"]
    for data, scan in zip(clouds, [*large, *small], strict=True):
        last = struct.unpack("<fff", data[-25:-13])
        assert last == tuple(scan.xyz[-1].tolist())


# -- compression ----------------------------------------------------------------------------------


def _converted(folder: Path, compression: str, *words: str) -> Path:
    target = folder / f"{compression.replace(':', '-')}{'' if words else '.mcap'}"
    done = command(*SESSION, "-o", target, "--compression", compression, *words)
    assert (done.code, done.err) == (0, "")
    return target


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """An MCAP file of each kind."""
    folder = tmp_path_factory.mktemp("compressed")
    return {word: _converted(folder, word) for word in WORDS}


@pytest.mark.parametrize("word", WORDS[1:])
def test_compressed_chunks(files: dict[str, Path], word: str) -> None:
    """The same messages; a stream reader compares checksums, indexes are the summary's."""
    expected = messages(files["none"])
    assert len(expected) > 100
    assert messages(files[word]) == expected
    plain = _indexes(files["none"])
    compressed = _indexes(files[word])
    assert [one[:3] for one in compressed] == [one[:3] for one in plain]
    assert {one[3] for one in compressed} == {word.partition(":")[0]}
    assert all(one[4] < one[2] for one in compressed)
    assert files[word].stat().st_size < files["none"].stat().st_size
    with files[word].open("rb") as file:
        records = list(StreamReader(file, validate_crcs=True).records)
    assert type(records[0]).__name__ == "Header"
    assert type(records[-1]).__name__ == "Footer"
    assert sum(isinstance(record, Message) for record in records) == len(expected)


def _indexes(path: Path) -> list[tuple[int, int, int, str, int]]:
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return [
        (
            *(one.message_start_time, one.message_end_time, one.uncompressed_size),
            *(one.compression, one.compressed_size),
        )
        for one in summary.chunk_indexes
    ]


@pytest.mark.parametrize("word", ["lz4", "zstd"])
def test_rosbags_reads_compressed_bags(word: str, tmp_path: Path) -> None:
    plain = read_back(_converted(tmp_path, "none", "--format", "rosbag2"))
    bag = _converted(tmp_path, word, "--format", "rosbag2")
    assert [(m.topic, m.log_ns, m.raw) for m in read_back(bag)] == [
        (m.topic, m.log_ns, m.raw) for m in plain
    ]
    # Any MCAP reader opens the file: it is not compressed as a whole.
    assert 'compression_format: ""\n' in (bag / "metadata.yaml").read_text()
