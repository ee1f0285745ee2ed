"""Compressed chunks are proven as others are; what their heads claim is not believed."""

from __future__ import annotations

import importlib
import struct
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import zstandard

from mlbatch.verify import verify
from mlbatch.verify.containers import unpacked
from mlbatch.verify.verdict import DamageError
from tests.builders.outputs import forget, found, made, spoiled, spoiled_places

MB = 1 << 20
NAMES = ("zstd", "lz4")
PACK: dict[str, Callable[[bytes], bytes]] = {
    "zstd": zstandard.ZstdCompressor().compress,
    "lz4": importlib.import_module("lz4.frame").compress,
}
# Magic of the file; opcode and length of a record; what a chunk has before its compression.
_MAGIC_BYTES, _HEAD, _CHUNK = 8, struct.Struct("<BQ"), struct.Struct("<QQQII")


@pytest.fixture(scope="module", autouse=True)
def _clean() -> Iterator[None]:
    yield
    forget()


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
def test_the_same_is_proven(name: str) -> None:
    plain, packed = verify(made("scans.mcap")), verify(made(f"{name}.mcap"))
    assert packed.ok, packed.violations
    assert [(one.name, one.checked) for one in packed.checks] == [
        (one.name, one.checked) for one in plain.checks
    ]
    assert made(f"{name}.mcap").stat().st_size < made("scans.mcap").stat().st_size


def _size(change: int) -> Callable[[bytearray, Chunk], None]:
    return lambda data, chunk: struct.pack_into("<Q", data, chunk.size_at, chunk.size + change)


def _name(data: bytearray, chunk: Chunk) -> None:
    data[chunk.name_at] ^= 1


def _middle(data: bytearray, chunk: Chunk) -> None:
    data[chunk.stored_at + chunk.stored // 2] ^= 0xFF


def _magic(data: bytearray, chunk: Chunk) -> None:
    data[chunk.stored_at] ^= 0xFF


SPOILT: dict[str, tuple[Callable[[bytearray, Chunk], None], str]] = {
    "larger than it says": (_size(-1), "bytes of records"),
    "smaller than it says": (_size(1), "size"),
    "much smaller": (_size(1 << 40), "that are stored"),
    "another compression": (_name, "packed by lz4 or zstd"),
    "no frame": (_magic, "a frame of"),
    "damaged inside": (_middle, ""),
}


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("how", SPOILT)
def test_damage_is_found(name: str, how: str, tmp_path: Path) -> None:
    change, wanted = SPOILT[how]

    def edit(path: Path) -> None:
        data = bytearray(path.read_bytes())
        change(data, next(chunks(bytes(data))))
        path.write_bytes(data)

    violations = spoiled(f"{name}.mcap", tmp_path, edit).violations
    found = [one for one in violations if one.check == "container"]
    assert found
    assert wanted in " ".join(str(one) for one in found)


@pytest.mark.parametrize("name", NAMES)
def test_what_is_said_bounds_what_is_held(name: str) -> None:
    """Little that becomes much: 256 MB of zeros in a chunk."""
    stored = memoryview(PACK[name](bytes(256 * MB)))
    tracemalloc.start()
    try:
        with pytest.raises(DamageError):
            unpacked(name, stored, 1000)
        with pytest.raises(DamageError):
            unpacked(name, stored[: len(stored) // 100], 300 * MB * 256)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert most < 8 * MB
    assert len(unpacked(name, stored, 256 * MB)) == 256 * MB


@pytest.mark.parametrize("name", NAMES)
def test_a_message_index_that_claims_more_than_it_has(name: str, tmp_path: Path) -> None:
    def lie(path: Path) -> None:
        data, at = bytearray(path.read_bytes()), _MAGIC_BYTES
        while data[at] != 7:
            at += _HEAD.size + _HEAD.unpack_from(data, at)[1]
        # The length of its entries stands behind the number of the channel.
        struct.pack_into("<I", data, at + _HEAD.size + 2, 19_849)
        path.write_bytes(data)

    found(spoiled_places(f"{name}.mcap", tmp_path, lie), "container", "message index at byte")
