"""Files of outputs: parts of any length, also past the page cache, and their checksums."""

from __future__ import annotations

import errno
import io
import os
import zlib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mlbatch.writers import output_file
from mlbatch.writers.output_file import (
    BLOCK_BYTES,
    DirectWrites,
    OutputFile,
    file_crc,
    joined_crc,
    write_summed,
)

STAGE_BYTES = 4 * BLOCK_BYTES
# Lengths about the bounds of blocks and of the stage.
LENGTHS = st.one_of(
    st.integers(0, 3 * STAGE_BYTES),
    st.sampled_from((BLOCK_BYTES, STAGE_BYTES)).flatmap(
        lambda bound: st.integers(bound - 2, bound + 2)
    ),
)


def content(size: int, seed: int) -> bytes:
    return bytes((seed * 31 + number * 7 + number // 251) % 256 for number in range(size))


@pytest.fixture(scope="module", autouse=True)
def small_stage() -> object:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(output_file, "_STAGE_BYTES", STAGE_BYTES)
        yield


@given(position=st.integers(0, 2 * BLOCK_BYTES + 1), lengths=st.lists(LENGTHS, max_size=6))
@settings(max_examples=40)
def test_parts_follow_each_other(
    position: int, lengths: list[int], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("direct") / "file"
    expected = content(position, 99)
    path.write_bytes(expected)
    descriptor = os.open(path, os.O_RDWR)
    try:
        direct = DirectWrites(descriptor, position)
        for seed, length in enumerate(lengths):
            part = content(length, seed)
            direct.put(memoryview(part))
            expected += part
            # All but the stage is handed over.
            written = path.read_bytes()
            assert written == expected[: len(written)]
            assert len(expected) - len(written) < STAGE_BYTES
        direct.finish()
    finally:
        os.close(descriptor)
    assert path.read_bytes() == expected


@pytest.mark.parametrize("refused", [1, 2])
def test_bytes_of_a_refused_write_go_through_the_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: int
) -> None:
    """A file system may refuse at the first write, or later."""
    path = tmp_path / "file"
    path.write_bytes(b"head")
    write = os.pwrite
    calls = []

    def refusing(descriptor: int, data: bytes, position: int) -> int:
        calls.append(position)
        if len(calls) == refused:
            raise OSError(errno.EINVAL, "refused")
        return write(descriptor, data, position)

    monkeypatch.setattr(os, "pwrite", refusing)
    descriptor = os.open(path, os.O_RDWR)
    direct = DirectWrites(descriptor, 4)
    if not direct.is_direct:
        os.close(descriptor)
        pytest.skip("the file system has no such writes")
    part = content(3 * STAGE_BYTES, 1)
    direct.put(part)
    direct.finish()
    os.close(descriptor)
    assert path.read_bytes() == b"head" + part
    assert not direct.is_direct


def test_a_full_disk_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int, data: bytes, position: int) -> int:
        raise OSError(errno.ENOSPC, "full")

    path = tmp_path / "file"
    path.write_bytes(b"")
    descriptor = os.open(path, os.O_RDWR)
    direct = DirectWrites(descriptor, 0)
    monkeypatch.setattr(os, "pwrite", full)
    with pytest.raises(OSError, match="full"):
        direct.put(content(STAGE_BYTES, 1))
    os.close(descriptor)
    assert path.read_bytes() == b""


def test_large_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(output_file, "_DROP_BYTES", 3 * BLOCK_BYTES)
    parts = [content(length, length) for length in (5000, 1, 9000, 40_000, 0, 3, 70_001)]
    path = tmp_path / "file"
    file = OutputFile(path)
    for part in parts:
        file.put(part, b"-") if part is parts[-1] else file.put(part)
    assert file.position_bytes == len(b"".join(parts)) + 1
    file.complete()
    assert path.read_bytes() == b"".join(parts) + b"-"
    assert file.crc == zlib.crc32(path.read_bytes())


# -- gathered writes, checksums, scratch ----------------------------------------------------------


def test_written_bytes_are_summed(tmp_path: Path) -> None:
    """Parts smaller and larger than a piece, and none."""
    path = tmp_path / "file"
    for lengths in ([], [0], [3, 700_000, 0, 1 << 18, 5], [1] * 2000):
        parts = [bytes([number % 251]) * length for number, length in enumerate(lengths)]
        whole = b"".join(parts)
        with io.FileIO(path, "w") as file:
            assert write_summed(file, parts) == zlib.crc32(whole)
        assert path.read_bytes() == whole
        assert file_crc(path) == zlib.crc32(whole)


@given(st.binary(max_size=200), st.integers(0, 1 << 17), st.integers(0, 255))
def test_a_joined_checksum_is_that_of_all_bytes(first: bytes, size: int, value: int) -> None:
    second = bytes([value]) * size
    joined = joined_crc(zlib.crc32(first), zlib.crc32(second), size)
    assert joined == zlib.crc32(first + second)
