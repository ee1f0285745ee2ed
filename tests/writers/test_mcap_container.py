"""Compressed chunks: what other readers find in them, and that they are always the same bytes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from rosbags.rosbag2 import Reader

from tests.builders.run import TWO_LIDARS, command

SESSION = ("convert", TWO_LIDARS / "two_lidars.pcap", "--rig", TWO_LIDARS / "rig.yaml", "--quiet")
WORDS = ("none", "lz4", "zstd", "zstd:1", "zstd:19")
Messages = list[tuple[str, int, int, bytes]]


def _converted(folder: Path, compression: str, *words: str) -> Path:
    target = folder / f"{compression.replace(':', '-')}{'' if words else '.mcap'}"
    told = command(*SESSION, "-o", target, "--compression", compression, *words)
    assert (told.code, told.err) == (0, "")
    return target


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """An MCAP file of each kind."""
    folder = tmp_path_factory.mktemp("compressed")
    return {word: _converted(folder, word) for word in WORDS}


def _messages(path: Path) -> Messages:
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        return [
            (channel.topic, message.sequence, message.log_time, message.data)
            for _, channel, message in reader.iter_messages(log_time_order=False)
        ]


@pytest.mark.parametrize("word", WORDS[1:])
def test_the_reference_reader_finds_the_same(files: dict[str, Path], word: str) -> None:
    wanted = _messages(files["none"])
    assert len(wanted) > 100
    assert _messages(files[word]) == wanted


@pytest.mark.parametrize("word", WORDS[1:])
def test_chunks_hold_the_same_and_say_so(files: dict[str, Path], word: str) -> None:
    """A stream reader compares checksums as it goes; indexes are those of the summary."""
    plain, packed = _indexes(files["none"]), _indexes(files[word])
    assert [one[:3] for one in packed] == [one[:3] for one in plain]
    assert {one[3] for one in packed} == {word.partition(":")[0]}
    assert all(one[4] < one[2] for one in packed)
    assert files[word].stat().st_size < files["none"].stat().st_size
    with files[word].open("rb") as file:
        assert sum(1 for _ in StreamReader(file, validate_crcs=True).records) > len(packed)


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


def test_a_level_is_heard(files: dict[str, Path]) -> None:
    low, usual, high = (files[word].stat().st_size for word in ("zstd:1", "zstd", "zstd:19"))
    assert high < usual
    assert high < low


@pytest.mark.parametrize("word", ["lz4", "zstd"])
def test_every_run_gives_the_same_bytes(files: dict[str, Path], word: str, tmp_path: Path) -> None:
    again = _converted(tmp_path, word)
    assert again.read_bytes() == files[word].read_bytes()


@pytest.mark.parametrize("word", ["lz4", "zstd"])
def test_a_bag_is_read_by_rosbags(word: str, tmp_path: Path) -> None:
    wanted = list(_of_bag(_converted(tmp_path, "none", "--format", "rosbag2")))
    bag = _converted(tmp_path, word, "--format", "rosbag2")
    assert list(_of_bag(bag)) == wanted
    # The file is one that any reader of its container opens: it is not packed as a whole.
    assert 'compression_format: ""\n' in (bag / "metadata.yaml").read_text()


def _of_bag(folder: Path) -> Iterator[tuple[str, int, bytes]]:
    with Reader(folder) as bag:
        for connection, stamp_ns, data in bag.messages():
            yield connection.topic, stamp_ns, bytes(data)


@pytest.mark.parametrize("name", ["npz", "ply", "rosbag1"])
def test_other_formats_refuse_it(name: str, tmp_path: Path) -> None:
    target = tmp_path / ("out.bag" if name == "rosbag1" else "out")
    told = command(*SESSION, "-o", target, "--format", name, "--compression", "zstd")
    assert told.code == 2
    assert told.err == (
        f"mlbatch: error: --compression: wanted none for {name}, got 'zstd'; leave it out, or "
        "write a .mcap or rosbag2 output\n"
    )
    assert list(tmp_path.iterdir()) == []
