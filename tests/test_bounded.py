"""Files are read as a whole only where they are regular and within a limit; JSON only if finite."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from mlbatch.bounded import parse_json, read_bytes, read_text


def test_a_file_up_to_the_limit(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"\xef\xbb\xbfabc")
    assert read_bytes(tmp_path / "file", 6) == b"\xef\xbb\xbfabc"
    assert read_text(tmp_path / "file", encoding="utf-8-sig") == "abc"
    with pytest.raises(OSError, match="more than 5 bytes"):
        read_bytes(tmp_path / "file", 5)


def test_anything_else_is_named_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(os.path.relpath(tmp_path / "socket"))
    for path, found in (
        (tmp_path, "a folder"),
        (tmp_path / "pipe", "a pipe"),
        (tmp_path / "socket", "a socket"),
        (Path("/dev/zero"), "a device"),
        (tmp_path / "none", "No such file"),
        (tmp_path / "a\0b", "null (byte|character)"),
    ):
        with pytest.raises(OSError, match=found):
            read_bytes(path)


def test_a_large_hole_is_not_read(tmp_path: Path) -> None:
    with (tmp_path / "hole").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(OSError, match="more than"):
        read_bytes(tmp_path / "hole")


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ('{"a": NaN}', "NaN, which is no number"),
        ("[-Infinity]", "-Infinity, which is no number"),
        ("[1e999]", "1e999, which is no number"),
        ("[" * 100_000, "nested too deeply"),
        ("[" * 100_000 + "]" * 100_000, "nested too deeply"),
        ("{", "Expecting"),
    ],
)
def test_json_that_is_refused(text: str, found: str) -> None:
    with pytest.raises(ValueError, match=found):
        parse_json(text)


def test_json() -> None:
    assert parse_json('{"a": [1, 2.5, -1e300]}') == {"a": [1, 2.5, -1e300]}
