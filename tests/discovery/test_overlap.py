"""Recordings of one session overlap in receive time, or continue one another."""

from __future__ import annotations

import gzip
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from mlbatch.readers import open_recording
from mlbatch.types import StreamTable
from tests.builders.captures import udp_frame, write_pcap
from tests.builders.reading import packets_in
from tests.builders.sessions import (
    NS_PER_MS,
    NS_PER_S,
    SMALL,
    Records,
    Shell,
    Unit,
    twin,
    write_metadata,
)
from tests.builders.transcripts import transcripts

CASES = {
    f"{name}{packed}": transcript
    for packed in ("", ".gz")
    for name, transcript in transcripts("overlap", Z=packed).items()
}
DAY_NS = 24 * 3600 * NS_PER_S
ONE = Unit()
# In its packets, 5 s later; both last 0.3 s.
LATER = replace(twin(ONE, 222), begin_ns=ONE.begin_ns + 5 * NS_PER_S)
NEXT = replace(ONE, begin_ns=ONE.begin_ns + 300 * NS_PER_MS, first_frame=8)
# Received a day after the last packet; stamps are those of a next part.
DAY = replace(NEXT, host_ns=NEXT.host_ns + DAY_NS - 3_125_000)
FILES: Mapping[str, Sequence[Unit]] = {
    "left": [ONE],
    "right": [LATER],
    "next": [NEXT],
    # The counter of the sensor begins anew, so that its first packets look like copies.
    "paused": [replace(LATER, spec=ONE.spec, ip=ONE.ip)],
    "moved": [replace(NEXT, ip="10.0.0.9")],
    "twin": [twin(ONE, 222)],
    "twin_next": [twin(NEXT, 222)],
    "both": [ONE, twin(ONE, 222)],
    "day": [DAY],
    "over": [replace(DAY, host_ns=DAY.host_ns + 1000)],
}


def _capture(path: Path, records: Records) -> Path:
    return write_pcap(path, sorted(records, key=lambda record: record[0]))


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all recordings, plain and packed."""
    folder = tmp_path_factory.mktemp("parts")
    for serial in (111, 222):
        write_metadata(folder / f"{serial}.json", replace(SMALL, serial=serial))
    for name, units in FILES.items():
        records = [record for unit in units for record in unit.records]
        path = _capture(folder / f"{name}.pcap", records)
        (folder / f"{name}.pcap.gz").write_bytes(gzip.compress(path.read_bytes()))
    return folder


@pytest.mark.parametrize("name", CASES)
def test_transcript(shell: Shell, place: Path, tmp_path: Path, name: str) -> None:
    CASES[name].check_with(place, shell, tmp_path)


def test_a_day_is_one_to_the_nanosecond() -> None:
    assert DAY.payloads[0][0] - ONE.payloads[-1][0] == DAY_NS


def test_the_end_of_a_capture_is_known_without_reading_it(shell: Shell, tmp_path: Path) -> None:
    unit = Unit(turns=60)
    path = _capture(tmp_path / "left.pcap", unit.records)
    table = StreamTable()
    last = open_recording(path, table).last_packets(table)
    assert last is not None
    assert str(table.streams[0]) == "10.0.0.1 > port 7502"
    assert path.stat().st_size > 1_500_000
    payloads = unit.payloads[-len(last) :]
    assert 700 < len(last) < len(unit.payloads)
    assert [one[1:] for one in packets_in(last)] == payloads
    # `inspect` reads 10 s, and shows what it knows.
    write_metadata(tmp_path / "111.json", unit.spec)
    right = _capture(tmp_path / "right.pcap", replace(LATER, turns=1).records)
    late = replace(LATER, begin_ns=ONE.begin_ns + 100 * NS_PER_S)
    late_path = _capture(tmp_path / "late.pcap", late.records)
    assert "no_overlap" not in shell("inspect", path, right).out
    assert "no_overlap" in shell("inspect", path, late_path).out


def test_the_end_of_a_capture_of_very_many_small_packets_is_known(tmp_path: Path) -> None:
    frames = [(number, udp_frame(b"x", dport=number % 7)[0]) for number in range(30_000)]
    path = write_pcap(tmp_path / "small.pcap", frames)
    last = open_recording(path, StreamTable()).last_packets(StreamTable())
    assert last is not None
    assert last.host_ns.tolist() == list(range(30_000 - len(last), 30_000))
    # In 1 MiB, of 16 + 42 + 1 bytes each; the first record is only looked for.
    assert (1 << 20) // 59 - 2 <= len(last) <= (1 << 20) // 59


def test_a_capture_that_is_cut_off_does_not_show_its_end(tmp_path: Path) -> None:
    path = _capture(tmp_path / "left.pcap", ONE.records)
    path.write_bytes(path.read_bytes()[:-100])
    assert open_recording(path, StreamTable()).last_packets(StreamTable()) is None
