"""Opening by content, compressed files, and reading from several threads."""

from __future__ import annotations

import gzip
import os
import random
from collections.abc import Generator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import pytest
import zstandard

from mlbatch.readers import merge, open_recording
from mlbatch.readers.formats import rosbag2
from mlbatch.types import CutOff, PacketBatch, StreamTable
from tests.builders.bags import fixture_messages
from tests.builders.captures import Packet, Section, pcap_bytes, section_bytes, udp_frame
from tests.builders.containers import CONTAINERS
from tests.builders.reading import open_capture, read, refusal
from tests.builders.rosbag2 import write_rosbag2

CONTENT = pcap_bytes((i, udp_frame(random.Random(i).randbytes(1000))[0]) for i in range(300))


def _corrupt() -> bytes:
    """The head of the second stored block (RFC 1951, 3.2.4): a kind that does not exist."""
    packed = bytearray(gzip.compress(CONTENT, 0))
    packed[10 + 5 + 65_535] = 0xFF
    return bytes(packed)


def _half(packed: bytes) -> bytes:
    return packed[: len(packed) // 2]


FAULT = "corrupt or cut-off compressed data"
# Content, and what is said of it if it is not whole.
COMPRESSED: Mapping[str, tuple[bytes, str]] = {
    "gzip": (gzip.compress(CONTENT), ""),
    "zstd": (zstandard.compress(CONTENT), ""),
    "gzip, members": (gzip.compress(CONTENT[:7777]) + gzip.compress(CONTENT[7777:]), ""),
    "zstd, frames": (zstandard.compress(CONTENT[:7777]) + zstandard.compress(CONTENT[7777:]), ""),
    "gzip, padding": (gzip.compress(CONTENT) + bytes(512), ""),
    "gzip, cut": (_half(gzip.compress(CONTENT)), FAULT),
    "zstd, cut": (_half(zstandard.compress(CONTENT)), "the file ends within a record"),
    "gzip, corrupt": (_corrupt(), FAULT),
}


@pytest.mark.parametrize("name", COMPRESSED)
def test_compressed_captures_read_as_plain_ones(tmp_path: Path, name: str) -> None:
    content, fault = COMPRESSED[name]
    (tmp_path / "plain.bin").write_bytes(CONTENT)
    (tmp_path / "packed.pcap").write_bytes(content)
    recording = open_capture(tmp_path / "packed.pcap", buffer_bytes=4000)
    expected, seen = read(open_capture(tmp_path / "plain.bin")), read(recording)
    assert seen == expected[: len(seen)]
    if fault:
        assert 50 < len(seen) < 200
        assert fault in recording.notes[0]
    else:
        assert len(seen) == 300
        assert recording.notes == []
        assert recording.size_bytes == len(content) == recording.position_bytes


@pytest.mark.parametrize("name", CONTAINERS)
def test_a_recording_that_ends_early_is_cut_off(tmp_path: Path, name: str) -> None:
    """Half of the file, or of the largest file of a folder; and not one that is whole."""
    (tmp_path / "whole").mkdir()
    path = CONTAINERS[name](tmp_path / "whole")
    for is_whole in (True, False):
        if not is_whole:
            files = [path] if path.is_file() else [one for one in path.iterdir() if one.is_file()]
            last = max(files, key=lambda one: one.stat().st_size)
            os.truncate(last, last.stat().st_size // 2)
        recording = open_recording(path, StreamTable())
        with closing(recording.packets()) as batches:
            for _ in batches:
                pass
        ends = [note for note in recording.notes if isinstance(note, CutOff)]
        assert bool(ends) == (not is_whole or "cut off" in name), recording.notes


def test_content_decides_not_the_name(tmp_path: Path) -> None:
    frame = udp_frame(b"x")[0]
    (tmp_path / "a.pcap").write_bytes(section_bytes(Section([Packet(frame)])))
    (tmp_path / "b.pcapng").write_bytes(pcap_bytes([(0, frame)]))
    names = ("a.pcap", "b.pcapng")
    opened = [open_recording(tmp_path / name, StreamTable()) for name in names]
    assert [recording.container for recording in opened] == ["pcapng", "pcap"]


def test_what_is_no_file_or_may_not_be_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    os.mkfifo(tmp_path / "pipe")
    assert "regular file" in refusal(tmp_path / "pipe")
    (tmp_path / "a").write_bytes(CONTENT)

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    # The modes of files do not stop root.
    monkeypatch.setattr(Path, "open", refuse)
    assert "no permission" in refusal(tmp_path / "a")


@pytest.mark.parametrize("bags", [1, 3])
def test_another_thread_goes_on_or_ends(bags: int, tmp_path: Path) -> None:
    """Errors at the end of objects are failures of tests (see pyproject.toml)."""
    messages = fixture_messages("cdr")
    step = len(messages) // bags
    paths = [
        write_rosbag2(tmp_path / f"{number}.db3", messages[number * step : (number + 1) * step])
        for number in range(bags)
    ]

    def batches(*paths: Path) -> Generator[PacketBatch, None, None]:
        # Several batches a file.
        return merge(
            [
                rosbag2.open_folder(path, [path], StreamTable(), buffer_bytes=1 << 16)
                for path in paths
            ]
        )

    whole = [len(batch) for batch in batches(*paths)]
    begun = batches(*paths)
    first = len(next(begun))
    with ThreadPoolExecutor(1) as thread:
        rest = thread.submit(lambda: [len(batch) for batch in begun]).result()
    assert [first, *rest] == whole
    assert len(whole) > 1
    begun = batches(*paths)
    next(begun)
    with ThreadPoolExecutor(1) as thread:
        thread.submit(begun.close).result()
    assert next(begun, None) is None
    with closing(batches(paths[0])) as again:
        assert len(next(again))
