"""Opening by content, compressed files, and reading from several threads."""

from __future__ import annotations

import gzip
import os
import random
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import pytest
import zstandard

from mlbatch.errors import RecordingError
from mlbatch.readers import merge, open_recording, readers
from mlbatch.readers.formats import rosbag2
from mlbatch.readers.source import Source
from mlbatch.types import CutOff, Recording, StreamTable, WrappedRecording
from tests.builders.bags import fixture_messages
from tests.builders.captures import Packet, Section, pcap_bytes, section_bytes, udp_frame
from tests.builders.reading import open_capture, read
from tests.builders.rosbag2 import write_rosbag2
from tests.builders.sessions_of_bags import CONTAINERS

CONTENT = pcap_bytes((i, udp_frame(random.Random(i).randbytes(1000))[0]) for i in range(300))


def zstd(data: bytes) -> bytes:
    """One zstd frame."""
    return zstandard.ZstdCompressor().compress(data)


def refusal(path: Path) -> str:
    """The one line that says why `path` cannot be opened."""
    with pytest.raises(RecordingError) as caught:
        open_recording(path, StreamTable())
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message


def test_both_capture_formats_are_found() -> None:
    assert {"pcap", "pcapng"} <= {reader.CONTAINER for reader in readers()}


@pytest.mark.parametrize("squeeze", [gzip.compress, zstd])
def test_compressed_captures_read_as_plain_ones(tmp_path: Path, squeeze: object) -> None:
    assert callable(squeeze)
    plain, packed = tmp_path / "plain.bin", tmp_path / "packed.pcap"
    plain.write_bytes(CONTENT)
    packed.write_bytes(squeeze(CONTENT))
    recording = open_capture(packed, buffer_bytes=5000)
    assert read(recording) == read(open_capture(plain))
    assert recording.size_bytes == packed.stat().st_size == recording.position_bytes


@pytest.mark.parametrize("squeeze", [gzip.compress, zstd])
def test_several_members_are_one_stream(tmp_path: Path, squeeze: object) -> None:
    assert callable(squeeze)
    (tmp_path / "a").write_bytes(squeeze(CONTENT[:7777]) + squeeze(CONTENT[7777:]))
    assert len(read(open_capture(tmp_path / "a"))) == 300


def test_padding_after_gzip_data_is_ignored(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(gzip.compress(CONTENT) + bytes(512))
    recording = open_capture(tmp_path / "a")
    assert len(read(recording)) == 300
    assert recording.notes == []


@pytest.mark.parametrize("squeeze", [gzip.compress, zstd])
def test_cut_off_compressed_data_give_what_is_whole(tmp_path: Path, squeeze: object) -> None:
    assert callable(squeeze)
    packed = squeeze(CONTENT)
    (tmp_path / "a").write_bytes(packed[: len(packed) // 2])
    recording = open_capture(tmp_path / "a", buffer_bytes=4000)
    seen = read(recording)
    assert 50 < len(seen) < 200
    assert [one.host_ns for one in seen] == list(range(len(seen)))
    assert recording.notes


def test_corrupt_compressed_data_end_the_reading(tmp_path: Path) -> None:
    packed = bytearray(gzip.compress(CONTENT, 0))
    # The head of the second stored block (RFC 1951, 3.2.4): a kind that does not exist.
    packed[10 + 5 + 65_535] = 0xFF
    (tmp_path / "a").write_bytes(packed)
    recording = open_capture(tmp_path / "a", buffer_bytes=4000)
    assert len(read(recording)) < 300
    assert "corrupt or cut-off compressed data" in recording.notes[0]


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


def test_compressed_data_without_a_beginning(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(gzip.compress(CONTENT)[:12])
    assert "compressed data" in refusal(tmp_path / "a")


def test_content_decides_not_the_name(tmp_path: Path) -> None:
    frame = udp_frame(b"x")[0]
    (tmp_path / "a.pcap").write_bytes(section_bytes(Section([Packet(frame)])))
    (tmp_path / "b.pcapng").write_bytes(pcap_bytes([(0, frame)]))
    names = ("a.pcap", "b.pcapng")
    opened = [open_recording(tmp_path / name, StreamTable()) for name in names]
    assert [recording.container for recording in opened] == ["pcapng", "pcap"]


def test_files_that_are_no_recordings(tmp_path: Path) -> None:
    assert "no such file" in refusal(tmp_path / "missing.pcap")
    assert "folder" in refusal(tmp_path)
    (tmp_path / "empty").write_bytes(b"")
    assert "0 bytes" in refusal(tmp_path / "empty")
    (tmp_path / "text").write_bytes(b"hello, world")
    message = refusal(tmp_path / "text")
    assert "68 65 6c 6c 6f 2c 20 77" in message
    assert "pcap, pcapng" in message
    (tmp_path / "short").write_bytes(CONTENT[:10])
    assert "found 10" in refusal(tmp_path / "short")
    os.mkfifo(tmp_path / "pipe")
    assert "regular file" in refusal(tmp_path / "pipe")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_no_permission(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(CONTENT)
    (tmp_path / "a").chmod(0)
    assert "no permission" in refusal(tmp_path / "a")


def test_permission_errors_say_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a").write_bytes(CONTENT)

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)
    assert "no permission" in refusal(tmp_path / "a")


def test_a_bomb_is_read_in_bounded_pieces(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(zstd(bytes(50_000_000)))
    piece = memoryview(bytearray(1000))
    with Source(tmp_path / "a") as source:
        assert source.fill(piece) == 1000
        assert source.size_bytes < 10_000


def _bags(folder: Path, count: int) -> list[Path]:
    messages = fixture_messages("cdr")
    step = len(messages) // count
    return [
        write_rosbag2(folder / f"{number}.db3", messages[number * step : (number + 1) * step])
        for number in range(count)
    ]


@pytest.fixture
def elsewhere() -> Callable[[Callable[[], object]], object]:
    """What a function gives in a thread of its own."""

    def run(what: Callable[[], object]) -> object:
        with ThreadPoolExecutor(1) as pool:
            return pool.submit(what).result()

    return run


@pytest.mark.parametrize("bags", [1, 3])
def test_another_thread_goes_on(
    bags: int,
    tmp_path: Path,
    elsewhere: Callable[[Callable[[], object]], object],
) -> None:
    paths = _bags(tmp_path, bags)

    def opened() -> list[Recording]:
        # Several batches a file.
        return [
            rosbag2.open_folder(path, [path], StreamTable(), buffer_bytes=1 << 16) for path in paths
        ]

    whole = [len(batch) for batch in merge(opened())]
    batches = merge(opened())
    counts = [len(next(batches))]
    rest = elsewhere(lambda: [len(batch) for batch in batches])
    assert isinstance(rest, list)
    assert counts + rest == whole
    assert len(whole) > 1 or bags == 1


@pytest.mark.parametrize("bags", [1, 3])
def test_another_thread_ends(
    bags: int, tmp_path: Path, elsewhere: Callable[[Callable[[], object]], object]
) -> None:
    """Errors at the end of objects are failures of tests (see pyproject.toml)."""
    streams = StreamTable()
    batches = merge([open_recording(path, streams) for path in _bags(tmp_path, bags)])
    next(batches)
    elsewhere(batches.close)
    assert next(batches, None) is None
    with closing(merge([open_recording(tmp_path / "0.db3", streams)])) as again:
        assert len(next(again))


def test_a_wrapped_recording_reports_what_its_inner_one_does(tmp_path: Path) -> None:
    path = tmp_path / "a.pcap"
    path.write_bytes(CONTENT)
    inner = open_capture(path)
    outer = WrappedRecording(inner)
    read(inner)
    assert (outer.path, outer.container, outer.notes) == (inner.path, "pcap", [])
    assert outer.counts is inner.counts
    assert outer.position_bytes == inner.size_bytes > 0
    outer.keep = frozenset({"/own"})
    assert inner.keep == frozenset()
