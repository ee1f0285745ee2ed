"""Little that becomes much: bombs in every kind of compression, gigabytes next to a recording."""

from __future__ import annotations

import bz2
import gzip
import importlib
import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import zstandard

from mlbatch.discovery.calibrations import find_calibrations, read_given
from mlbatch.errors import MlbatchError, RigError
from mlbatch.readers import open_recording
from mlbatch.rig.rig import read_rig
from mlbatch.types import Recording, StreamTable
from tests.builders.bags import Recorded, packet_message
from tests.builders.captures import Section, pcap_bytes, section_bytes
from tests.builders.rosbag2 import Form, write_rosbag2
from tests.fuzz import readers
from tests.fuzz.harness import MOST_BYTES, Tally, Target, campaign

MB = 1 << 20
_ZEROS_MB = 16
_MAGIC = b"\x89MCAP0\r\n"
_lz4 = importlib.import_module("lz4.frame")


def _gzipped(head: bytes, size_mb: int) -> bytes:
    """Members are read one after the other, so that one piece serves again and again."""
    return gzip.compress(head, 1) + gzip.compress(bytes(_ZEROS_MB * MB)) * (size_mb // _ZEROS_MB)


def _zstd(head: bytes, size_mb: int) -> bytes:
    packer = zstandard.ZstdCompressor()
    return packer.compress(head) + packer.compress(bytes(_ZEROS_MB * MB)) * (size_mb // _ZEROS_MB)


def _mcap_chunk(word: bytes, said: int, packed: bytes) -> bytes:
    """A file of one chunk; said: its size by its own word."""
    head = struct.pack("<QQQII", 0, 0, said, 0, len(word)) + word
    body = head + struct.pack("<Q", len(packed)) + packed
    return _MAGIC + struct.pack("<BQ", 6, len(body)) + body


def _bag_chunk(word: bytes, said: int, packed: bytes) -> bytes:
    """A ROS 1 bag of one chunk."""
    fields = (b"op=\x05", b"compression=" + word, b"size=" + struct.pack("<I", said))
    head = b"".join(struct.pack("<I", len(field)) + field for field in fields)
    record = struct.pack("<I", len(head)) + head + struct.pack("<I", len(packed)) + packed
    return b"#ROSBAG V2.0\n" + record


def _examined(data: bytes, run: Callable[[bytes, Path], None]) -> Tally:
    """One input within LONGEST_S and 500 MB; the errors of mlbatch are as good as its answers."""
    return campaign(Target("bomb", lambda: (data,), run), range(1))


def _sound(tally: Tally) -> None:
    assert not tally.failures, str(tally.failures[0])
    assert tally.peak_bytes < MOST_BYTES


def _read(data: bytes, folder: Path) -> None:
    path = folder / "bomb"
    path.write_bytes(data)
    streams = StreamTable()
    recording: Recording = open_recording(path, streams)
    for batch in recording.packets():
        readers.check_batch(batch, streams)


# What is unpacked piece by piece needs no more than the pieces.
STREAMED: dict[str, Callable[[], bytes]] = {
    "pcap, gzip": lambda: _gzipped(pcap_bytes([]), 128),
    "pcap, zstd": lambda: _zstd(pcap_bytes([]), 128),
    "pcapng, zstd": lambda: _zstd(section_bytes(Section([])), 1024),
    "MCAP, gzip": lambda: _gzipped(_mcap_chunk(b"", 8, bytes(8)), 1024),
    "MCAP, zstd": lambda: _zstd(_mcap_chunk(b"zstd", 8, bytes(8)), 1024),
    "bag, zstd": lambda: _zstd(_bag_chunk(b"none", 8, bytes(8)), 1024),
}
CHUNKS: dict[str, Callable[[], bytes]] = {
    "chunk, zstd": lambda: _mcap_chunk(b"zstd", 200 * MB, _zstd(b"", 1024)),
    "chunk, zstd, gigabyte": lambda: _mcap_chunk(b"zstd", 1 << 30, _zstd(b"", 1024)),
    "chunk, zstd, most": lambda: _mcap_chunk(b"zstd", (1 << 64) - 1, _zstd(b"", 1024)),
    "chunk, zstd, more than it says": lambda: _mcap_chunk(b"zstd", 4096, _zstd(b"", 1024)),
    "chunk, lz4": lambda: _mcap_chunk(b"lz4", 200 * MB, _lz4.compress(bytes(256 * MB))),
    "bag chunk, lz4": lambda: _bag_chunk(b"lz4", 200 * MB, _lz4.compress(bytes(256 * MB))),
    "bag chunk, bz2": lambda: _bag_chunk(b"bz2", 128 * MB, bz2.compress(bytes(128 * MB))),
    "bag chunk, most": lambda: _bag_chunk(b"bz2", (1 << 32) - 1, bz2.compress(bytes(MB))),
}


@pytest.mark.parametrize("name", STREAMED)
def test_a_file_that_swells_is_read_in_pieces(name: str) -> None:
    tally = _examined(STREAMED[name](), _read)
    _sound(tally)
    assert tally.peak_bytes < 64 * MB


@pytest.mark.parametrize("name", CHUNKS)
def test_a_chunk_that_swells_is_read_in_bounds(name: str) -> None:
    _sound(_examined(CHUNKS[name](), _read))


@pytest.mark.parametrize("pack", [_gzipped, _zstd])
def test_a_compressed_database_is_unpacked_no_further_than_its_pages(
    pack: Callable[[bytes, int], bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    whole = write_rosbag2(tmp_path / "a.db3", []).read_bytes()
    path = tmp_path / "a.db3.packed"
    path.write_bytes(pack(whole, 1024))
    recording = open_recording(path, StreamTable())
    assert sum(file.stat().st_size for file in temporary.rglob("*.db3")) == len(whole)
    assert list(recording.packets()) == []
    path.write_bytes(pack(b"no database", 1024))
    with pytest.raises(MlbatchError, match="expected a recording"):
        open_recording(path, StreamTable())


def test_a_message_that_claims_to_swell_is_not_unpacked() -> None:
    # A frame whose header states 1 TB: magic, descriptor (8 byte size, no checksum), window, size.
    wrong = b"\x28\xb5\x2f\xfd\xc0\x58" + struct.pack("<Q", 1 << 40) + b"\x01\x00\x00"
    kind = "ouster_sensor_msgs/PacketMsg"

    def run(data: bytes, folder: Path) -> None:
        message = Recorded("/left/lidar_packets", kind, 10**18, data)
        path = write_rosbag2(folder / "a.db3", [message, message], Form())
        streams = StreamTable()
        recording = open_recording(path, streams)
        readers.read_all(recording, streams)
        assert recording.counts.skipped == {"truncated": 2}

    _sound(_examined(wrong, run))


def _sparse(path: Path, size: int, begin: bytes = b"") -> Path:
    with path.open("wb") as file:
        file.write(begin)
        file.truncate(size)
    return path


@pytest.mark.parametrize(
    ("name", "begin"), [("a.json", b'{"sensor_info": {'), ("a.csv", b""), ("a.yaml", b"lasers:\n")]
)
def test_a_gigabyte_next_to_the_recording_is_not_read(
    name: str, begin: bytes, tmp_path: Path
) -> None:
    def run(data: bytes, folder: Path) -> None:
        (folder / "a.pcap").write_bytes(pcap_bytes([]))
        path = _sparse(tmp_path / name, 1 << 30, data)
        found, looked = find_calibrations([tmp_path / "a.pcap"], [])
        assert (found, looked) == ([], [])
        with pytest.raises(RigError, match="expected the metadata"):
            read_given(path)

    _sound(_examined(begin, run))


def test_a_gigabyte_rig_is_not_read(tmp_path: Path) -> None:
    def run(data: bytes, folder: Path) -> None:
        with pytest.raises(RigError, match="expected at most"):
            read_rig(_sparse(tmp_path / "rig.yaml", 1 << 30, data))

    _sound(_examined(b"sensors:\n", run))


def test_gigabytes_of_bag_metadata_are_not_read(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    write_rosbag2(bag / "bag_0.db3", [])

    def run(data: bytes, folder: Path) -> None:
        _sparse(bag / "metadata.yaml", 1 << 30, data)
        notes = open_recording(bag, StreamTable()).notes
        assert notes == ["metadata.yaml: cannot be read; the files in the folder are read"]

    _sound(_examined(b"rosbag2_bagfile_information:\n", run))


def test_an_mcap_that_names_very_many_topics_takes_seconds() -> None:
    """65,000 channels of packets, without a summary."""
    schema = struct.pack("<H", 1)
    for text in (b"ouster_sensor_msgs/msg/PacketMsg", b"ros2msg", b"uint8[] buf"):
        schema += struct.pack("<I", len(text)) + text
    parts = [(3, schema)]
    for number in range(65_000):
        topic, encoding = b"/%d/lidar_packets" % number, b"cdr"
        body = struct.pack("<HH", number, 1) + struct.pack("<I", len(topic)) + topic
        parts.append((4, body + struct.pack("<I", len(encoding)) + encoding + bytes(4)))
    message = struct.pack("<HIQQ", 64_999, 0, 10**18, 10**18) + packet_message("cdr", b"")
    parts.append((5, message))
    data = _MAGIC + b"".join(struct.pack("<BQ", op, len(body)) + body for op, body in parts)
    _sound(_examined(data, partial(_read)))
