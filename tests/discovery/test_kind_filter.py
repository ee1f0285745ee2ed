"""Very many packet kinds: which are followed, and whether a lidar among them is found."""

from __future__ import annotations

import itertools
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.discovery import sampler
from mlbatch.discovery.sampler import EXAMINED_AT, MOST_KINDS, KindFilter, split_by_kind
from mlbatch.discovery.types import PacketKind
from mlbatch.types import MOST_STREAMS, OTHER_STREAMS, PacketBatch, Stream, StreamTable
from tests.builders.captures import udp_frame, write_pcap
from tests.builders.reading import open_capture
from tests.builders.sessions import NS_PER_MS, Shell, Unit, write_session


def _batch(streams: list[int]) -> PacketBatch:
    """Packets of 9 bytes on these streams."""
    count = len(streams)
    start = np.arange(count) * 9
    size = np.full(count, 9)
    number = np.arange(count)
    return PacketBatch(np.zeros(9 * count, np.uint8), start, size, np.array(streams), number)


@given(
    streams=st.lists(st.integers(0, 30), max_size=300),
    cuts=st.lists(st.integers(0, 300), max_size=8),
    recognised=st.sets(st.integers(0, 30)),
    most=st.integers(0, 12),
)
def test_what_is_followed_does_not_depend_on_batches(
    streams: list[int], cuts: list[int], recognised: set[int], most: int
) -> None:
    def is_recognised(_: PacketBatch, kind: PacketKind, __: int) -> bool:
        return kind.stream in recognised

    # One packet after the other: the first kinds, and later ones from their 16th packet on.
    expected: set[int] = set()
    seen: dict[int, int] = {}
    first: list[int] = []
    for at, stream in enumerate(streams):
        if stream not in first and len(first) < most:
            first.append(stream)
        seen[stream] = seen.get(stream, 0) + 1
        later = stream in recognised and seen[stream] >= EXAMINED_AT
        # A kind that is recognised takes one of the first places as long as there are any.
        if stream in first or later:
            expected.add(at)
    found: set[int] = set()
    tested = KindFilter()
    with (
        patch.object(sampler, "MOST_KINDS", most),
        patch.object(sampler, "_is_recognised", is_recognised),
    ):
        bounds = sorted({0, len(streams), *(cut for cut in cuts if cut < len(streams))})
        for begin, end in itertools.pairwise(bounds):
            batch = _batch(streams[begin:end])
            for _, index in tested.followed(batch, split_by_kind(batch)):
                found |= {begin + row for row in index.tolist()}
    assert found == expected
    assert tested.packets == len(streams) - len(expected)


def _scan(count: int, unit: Unit, before_ns: int = 0) -> list[tuple[int, bytes]]:
    """Two packets to each of so many ports, in the 100 ms up to `before_ns` before a lidar."""
    begin_ns = unit.begin_ns - before_ns - 100 * NS_PER_MS
    return [
        (
            begin_ns + number * 100 * NS_PER_MS // (2 * count),
            udp_frame(bytes(40), "10.9.9.9", dport=1000 + number // 2)[0],
        )
        for number in range(2 * count)
    ]


def test_a_lidar_that_starts_after_a_port_scan_is_found(tmp_path: Path, shell: Shell) -> None:
    unit = Unit(turns=4)
    write_session(tmp_path, unit, more=_scan(2 * MOST_KINDS, unit))
    outcome = shell("convert drive.pcap -o out.mcap --identity-extrinsics --report report.json")
    assert outcome.code == 0, outcome.err
    text = (tmp_path / "report.json").read_text()
    assert '"read": 128' in text
    assert f"at least {MOST_KINDS} streams or sizes after the first {MOST_KINDS}" in text


def test_inspect_lists_no_more_than_the_first_streams(tmp_path: Path, shell: Shell) -> None:
    unit = Unit(turns=4)
    write_session(tmp_path, unit, more=_scan(3 * MOST_KINDS, unit))
    outcome = shell("inspect drive.pcap")
    assert outcome.code == 0, outcome.err
    assert outcome.out.count("10.9.9.9 > port") == MOST_KINDS
    # 2 packets of each port, and those of the lidar before it was recognised.
    packets = 2 * 2 * MOST_KINDS + EXAMINED_AT - 1
    assert f"{packets} packets of at least {2 * MOST_KINDS + 1} other streams" in outcome.out
    assert "10.0.0.1 > port 7502" in outcome.out


def test_streams_beyond_the_table_are_one(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("mlbatch.types.MOST_STREAMS", 5)
    monkeypatch.setattr("mlbatch.readers.capture.dissector.MOST_STREAMS", 5)
    sent = [(7, 1), (7, 2), (8, 1), (8, 2), (9, 1), (7, 3), (8, 3), (9, 1), (99, 1), (7, 1)]
    frames = [udp_frame(b"x", f"10.0.0.{low}", dport=port)[0] for low, port in sent]
    path = write_pcap(tmp_path / "a", list(enumerate(frames)))
    table = StreamTable()
    # Of two frames each: all of the table is known to the second pass.
    recording = open_capture(path, streams=table, buffer_bytes=130)
    for _ in range(2):
        numbers = np.concatenate([batch.stream for batch in recording.packets()])
        assert numbers.tolist() == [0, 1, 2, 3, 4, 5, 5, 4, 5, 0]
    assert table.streams[5] == OTHER_STREAMS
    assert table.number(Stream("10.0.0.1", 1)) == 5
    assert len(table.streams) == 6
    assert MOST_STREAMS == 65_536
