"""Gathered writes, checksums, and scratch that threads share."""

from __future__ import annotations

import io
import zlib
from pathlib import Path

from mlbatch.writers.output_file import Bytes, WriteBehind, borrow, crc32, write_all


def test_parts_are_written_one_after_the_other(tmp_path: Path) -> None:
    """More parts than a system takes at once, empty ones, and any kind of bytes."""
    parts: list[Bytes] = [bytes([number % 251]) * (number % 7) for number in range(3000)]
    parts += [bytearray(b"abc"), memoryview(bytes(100_000)), b""]
    with io.FileIO(tmp_path / "file", "w") as file:
        write_all(file, parts)
    assert (tmp_path / "file").read_bytes() == b"".join(parts)


def test_checksums_are_those_of_zlib() -> None:
    data = bytes(range(256)) * 9
    assert crc32(data[100:], crc32(data[:100], 0)) == zlib.crc32(data)


def test_scratch_is_reused() -> None:
    idle = [["first"]]
    taken = borrow(idle, list)
    assert (taken, idle) == (["first"], [])
    assert borrow(idle, list) == []


def test_files_that_are_gone_need_no_dropping(tmp_path: Path) -> None:
    behind = WriteBehind()
    for number in range(3):
        behind.add(tmp_path / f"{number}", 50 << 20)
