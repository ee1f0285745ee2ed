"""MCAP files and bags: damaged records are found, and declared sizes bound no memory."""

from __future__ import annotations

import importlib
import struct
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import zstandard

from mlbatch.outputs.damage import DamageError
from mlbatch.outputs.mcap_file import unpacked
from mlbatch.verification import VerifyError, verify
from tests.builders.verify_outputs import Case, Edit, cases, check_case, damaged, made, raw

MB = 1 << 20
NAMES = ("zstd", "lz4")
PACK: dict[str, Callable[[bytes], bytes]] = {
    "zstd": zstandard.ZstdCompressor().compress,
    "lz4": importlib.import_module("lz4.frame").compress,
}
# Magic of the file; opcode and length of a record; what a chunk has before its compression.
_MAGIC_BYTES, _HEAD, _CHUNK = 8, struct.Struct("<BQ"), struct.Struct("<QQQII")


@dataclass(frozen=True, slots=True)
class Chunk:
    """Where the parts of a chunk begin; size, stored: bytes of its records, and in the file."""

    size_at: int
    name_at: int
    stored_at: int
    size: int
    stored: int


def chunks(data: bytes) -> Iterator[Chunk]:
    """The chunks of a file (mcap.dev/spec)."""
    at = _MAGIC_BYTES
    while at + _HEAD.size < len(data):
        opcode, length = _HEAD.unpack_from(data, at)
        begin = at + _HEAD.size
        if opcode == 6:
            _, _, size, _, letters = _CHUNK.unpack_from(data, begin)
            name_at = begin + _CHUNK.size
            (stored,) = struct.unpack_from("<Q", data, name_at + letters)
            yield Chunk(begin + 16, name_at, name_at + letters + 8, size, stored)
        at = begin + length


@pytest.mark.parametrize("name", NAMES)
def test_compressed_chunks_are_checked_alike(name: str) -> None:
    plain, packed = verify(made("scans.mcap")), verify(made(f"{name}.mcap"))
    assert packed.ok, packed.violations
    assert [(one.name, one.checked) for one in packed.checks] == [
        (one.name, one.checked) for one in plain.checks
    ]
    assert made(f"{name}.mcap").stat().st_size < made("scans.mcap").stat().st_size


def first_chunk(change: Callable[[bytearray, Chunk], None]) -> Edit:
    """Change the first chunk of a file."""

    def edit(path: Path) -> None:
        data = bytearray(path.read_bytes())
        change(data, next(chunks(bytes(data))))
        path.write_bytes(data)

    return edit


def size(change: int) -> Edit:
    """Another uncompressed size."""
    return first_chunk(
        lambda data, chunk: struct.pack_into("<Q", data, chunk.size_at, chunk.size + change)
    )


def stored(change: int) -> Edit:
    """Another number of stored bytes."""
    return first_chunk(
        lambda data, chunk: struct.pack_into("<Q", data, chunk.stored_at - 8, chunk.stored + change)
    )


def compression(data: bytearray, chunk: Chunk) -> None:
    data[chunk.name_at] ^= 1


def middle(data: bytearray, chunk: Chunk) -> None:
    data[chunk.stored_at + chunk.stored // 2] ^= 0xFF


def magic(data: bytearray, chunk: Chunk) -> None:
    data[chunk.stored_at] ^= 0xFF


def message_index(change: Callable[[bytearray, int], None]) -> Edit:
    """Change the first message index."""

    def edit(path: Path) -> None:
        data = bytearray(path.read_bytes())
        at = _MAGIC_BYTES
        while data[at] != 7:
            at += _HEAD.size + _HEAD.unpack_from(data, at)[1]
        change(data, at + _HEAD.size)
        path.write_bytes(data)

    return edit


def more_entries(data: bytearray, at: int) -> None:
    # The length of the entries is behind the number of the channel.
    struct.pack_into("<I", data, at + 2, 19_849)


def other_offset(data: bytearray, at: int) -> None:
    data[at + 14] ^= 1


SIZES: dict[str, Case] = {
    "more stored bytes": (stored(1 << 40), "container", "chunk at byte"),
    "fewer stored bytes": (stored(-1), "container", "chunk at byte"),
    "entries past the index": (message_index(more_entries), "container", "message index at byte"),
    "offset of a message": (message_index(other_offset), "container", "message indexes after"),
}
DAMAGED: dict[str, tuple[Edit, str]] = {
    "larger than declared": (size(-1), "bytes of records"),
    "smaller than declared": (size(1), "size"),
    "much smaller": (size(1 << 40), "that are stored"),
    "another compression": (first_chunk(compression), "packed by lz4 or zstd"),
    "no frame": (first_chunk(magic), "a frame of"),
    "damaged inside": (first_chunk(middle), ""),
}


@pytest.mark.parametrize(("kind", "case"), cases({f"{name}.mcap": SIZES for name in NAMES}))
def test_damage_is_found(kind: str, case: Case, tmp_path: Path) -> None:
    check_case(kind, case, tmp_path)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("how", DAMAGED)
def test_damaged_chunks_are_found(name: str, how: str, tmp_path: Path) -> None:
    edit, expected = DAMAGED[how]
    violations = damaged(f"{name}.mcap", tmp_path, edit).violations
    found = [str(one) for one in violations if one.check == "container"]
    assert found
    assert expected in " ".join(found)


@pytest.mark.parametrize("name", NAMES)
def test_declared_sizes_bound_memory(name: str) -> None:
    """256 MB of zeros in a chunk."""
    packed = PACK[name](bytes(256 * MB))
    tracemalloc.start()
    try:
        with pytest.raises(DamageError):
            unpacked(name, packed, 1000)
        with pytest.raises(DamageError):
            unpacked(name, packed[: len(packed) // 100], 300 * MB * 256)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert most < 8 * MB
    assert len(unpacked(name, packed, 256 * MB)) == 256 * MB


# -- ROS 1 bags -----------------------------------------------------------------------------------


CHUNK, INDEX, CHUNK_INFO = 5, 4, 6


def bag_record(data: bytearray, op: int) -> tuple[int, int, int]:
    """Begin, begin of the data and end of the first record of a type."""
    at = len(b"#ROSBAG V2.0\n")
    while True:
        (head,) = struct.unpack_from("<I", data, at)
        (size,) = struct.unpack_from("<I", data, at + 4 + head)
        begin = at + 8 + head
        if data[data.index(b"op=", at) + 3] == op:
            return at, begin, begin + size
        at = begin + size


def repeated_index(data: bytearray) -> bytes:
    """Thousands of entries of the index are one chunk."""
    begin, _, end = bag_record(data, CHUNK_INFO)
    count_at = data.index(b"chunk_count=") + 12
    (count,) = struct.unpack_from("<I", data, count_at)
    struct.pack_into("<I", data, count_at, count + 5000)
    return bytes(data) + bytes(data[begin:end]) * 5000


def inside_a_chunk(data: bytearray) -> bytearray:
    data[data.index(b"chunk_pos=") + 10] ^= 1
    return data


def huge_header(data: bytearray) -> bytearray:
    struct.pack_into("<I", data, bag_record(data, CHUNK)[0], 0xFFFFFFF0)
    return data


def huge_record(data: bytearray) -> bytearray:
    struct.pack_into("<I", data, bag_record(data, CHUNK)[1] - 4, 0xFFFFFFF0)
    return data


def other_time(data: bytearray) -> bytearray:
    data[bag_record(data, INDEX)[1] + 4] ^= 1
    return data


REFUSED: dict[str, Callable[[bytearray], bytes | bytearray]] = {
    "thousands of chunks in the index": repeated_index,
    "position inside a chunk": inside_a_chunk,
    "header past the end": huge_header,
    "record past the end": huge_record,
    "other type in a chunk": lambda data: data.replace(b"type=sensor_msgs", b"type=sensor_msgz", 1),
    "no type in a chunk": lambda data: data.replace(b"type=sensor_msgs", b"typo=sensor_msgs", 1),
    "compressed chunk": lambda data: data.replace(b"compression=none", b"compression=bz22", 1),
}


@pytest.mark.parametrize("name", REFUSED)
def test_damaged_bags_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(VerifyError, match="convert again") as error:
        damaged("scans.bag", tmp_path, raw("", REFUSED[name]))
    assert "\n" not in str(error.value)


def test_indexes_of_bags_are_checked(tmp_path: Path) -> None:
    check_case("scans.bag", (raw("", other_time), "container", "index of the"), tmp_path)
