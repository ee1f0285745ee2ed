"""Gathered writes, checksums, and scratch that threads share."""

from __future__ import annotations

import io
import zlib
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from mlbatch.writers.output_file import (
    Bytes,
    WriteBehind,
    borrow,
    file_crc,
    joined_crc,
    write_all,
    write_summed,
)


def test_parts_are_written_one_after_the_other(tmp_path: Path) -> None:
    """More parts than a system takes at once, empty ones, and any kind of bytes."""
    parts: list[Bytes] = [bytes([number % 251]) * (number % 7) for number in range(3000)]
    parts += [bytearray(b"abc"), memoryview(bytes(100_000)), b""]
    with io.FileIO(tmp_path / "file", "w") as file:
        write_all(file, parts)
    assert (tmp_path / "file").read_bytes() == b"".join(parts)


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


def test_scratch_is_reused() -> None:
    idle = [["first"]]
    taken = borrow(idle, list)
    assert (taken, idle) == (["first"], [])
    assert borrow(idle, list) == []


def test_files_that_are_gone_need_no_dropping(tmp_path: Path) -> None:
    behind = WriteBehind()
    for number in range(3):
        behind.add(tmp_path / f"{number}", 50 << 20)
