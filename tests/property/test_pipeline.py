"""Laws of whole conversions: scans depend only on the packets (docs/batching.md).

Any order of arrival: test_permutations.py; containers: tests/golden and tests/matrix.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from mcap.reader import make_reader

from mlbatch.pipeline.job import Job
from tests.builders.captures import pcap_bytes
from tests.builders.run import BY_HOST, FIXTURE, Values, buffers_of, in_memory, prints, to_file
from tests.builders.traffic import Records, datagrams, frames, source
from tests.builders.two_lidars import LEFT, RIGHT, START_NS

# Head, two whole windows and a tail.
LENGTH_NS = 350_000_000
BUFFERS = (1 << 12, 10_000, 1 << 16, 300_000)
LARGE = 4 << 20
# The smallest int64.
LEAST = bytes(7) + b"\x80"


Message = tuple[str, int, int, int, bytes]


def messages(job: Job, target: Path) -> list[Message]:
    """All messages of an MCAP output by topic and time."""
    to_file(job, target, "mcap")
    with target.open("rb") as file:
        return sorted(
            (channel.topic, found.log_time, found.publish_time, found.sequence, found.data)
            for _, channel, found in make_reader(file, validate_crcs=True).iter_messages()
        )


@dataclass(frozen=True, slots=True)
class Wanted:
    """What the shortened fixture gives, with and without its head and tail."""

    scans: list[Values]
    messages: list[Message]
    whole_messages: list[Message]

    def check(self, paths: Sequence[Path], folder: Path, buffer_bytes: int = LARGE) -> None:
        """Convert recordings of the same packets, and compare."""
        job = replace(FIXTURE, recordings=tuple(paths))
        whole = replace(job, keep_partial=False)
        with buffers_of(buffer_bytes):
            assert prints(in_memory(job)) == self.scans
            assert messages(job, folder / "all.mcap") == self.messages
            assert messages(whole, folder / "whole.mcap") == self.whole_messages


@pytest.fixture(scope="module")
def wanted(tmp_path_factory: pytest.TempPathFactory) -> Wanted:
    """The outputs of the frames as they are."""
    folder = tmp_path_factory.mktemp("wanted")
    path = folder / "plain.pcap"
    path.write_bytes(pcap_bytes(frames(LENGTH_NS), ns=False))
    job = replace(FIXTURE, recordings=(path,))
    result = in_memory(job)
    assert [scan.index for scan in result.scans] == [-1, 0, 1, 2]
    return Wanted(
        prints(result),
        messages(job, folder / "all.mcap"),
        messages(replace(job, keep_partial=False), folder / "whole.mcap"),
    )


# -- several files and other orders ---------------------------------------------------------------


def by_sensor() -> tuple[Records, Records]:
    """The frames of `right`, and all others."""
    mine = [record for record in frames(LENGTH_NS) if source(record[1]) == RIGHT.ip]
    return mine, [record for record in frames(LENGTH_NS) if source(record[1]) != RIGHT.ip]


def by_turns() -> tuple[Records, Records]:
    """Datagrams divided by time, as by a capture tool that begins a new file."""
    records = [one.frame() for one in datagrams(LENGTH_NS)]
    return records[: len(records) // 2], records[len(records) // 2 :]


@pytest.mark.parametrize("parts", [by_sensor, by_turns])
@pytest.mark.parametrize("step", [1, -1])
@pytest.mark.parametrize("size", [10_000, LARGE])
def test_several_files_in_any_order_are_one_session(
    parts: Callable[[], tuple[Records, Records]],
    step: int,
    size: int,
    wanted: Wanted,
    tmp_path: Path,
) -> None:
    paths = [tmp_path / "z.pcap", tmp_path / "a.pcap"]
    for path, records in zip(paths, parts(), strict=True):
        path.write_bytes(pcap_bytes(records))
    wanted.check(paths[::step], tmp_path, size)


@pytest.mark.parametrize("size", [*BUFFERS, LARGE])
def test_a_pause_of_the_capture_host_does_not_matter(
    size: int, wanted: Wanted, tmp_path: Path
) -> None:
    """Sensors are looked for in the first 10 s; a buffer may end exactly there."""
    records = [one.frame() for one in datagrams(LENGTH_NS)]
    late = [(host_ns + 11 * 10**9, frame) for host_ns, frame in records[100:]]
    path = tmp_path / "recording.pcap"
    path.write_bytes(pcap_bytes(records[:100] + late))
    wanted.check([path], tmp_path, size)


@pytest.mark.parametrize("size", [9_000, LARGE])
def test_a_damaged_first_packet_does_not_silence_a_late_lidar(size: int, tmp_path: Path) -> None:
    """A lidar that is switched on after the 10 s in which sensors are looked for."""
    sent = list(datagrams(LENGTH_NS))
    early = next(one for one in sent if one.source == LEFT.ip and one.port == 7502)
    late = [number for number, one in enumerate(sent) if (one.source, one.port) == (RIGHT.ip, 7502)]
    payload = bytearray(sent[late[0]].payload)
    payload[7] ^= 1  # in the serial number, docs/sources/ouster.md section 2
    sent[late[0]] = replace(sent[late[0]], payload=bytes(payload))
    records = [replace(early, host_ns=START_NS - 15 * 10**9).frame()]
    path = tmp_path / "recording.pcap"
    path.write_bytes(pcap_bytes([*records, *(one.frame() for one in sent)]))
    with buffers_of(size):
        report = in_memory(replace(BY_HOST, recordings=(path,))).report
    assert report.sensors[1].ledger.packets.read == len(late) - 1


@pytest.mark.parametrize("step", [1, -1])
def test_the_report_names_streams_in_one_order(step: int, tmp_path: Path) -> None:
    """Two files, each with packets of a stranger."""
    first = datagrams(LENGTH_NS)[0]
    paths = [tmp_path / "one.pcap", tmp_path / "two.pcap"]
    strangers = ("10.5.5.31", "10.5.5.30")
    for path, records, ip in zip(paths, by_sensor(), strangers, strict=True):
        stranger = replace(first, source=ip, port=1900, payload=b"hello").frame()
        path.write_bytes(pcap_bytes([stranger, *records]))
    report = in_memory(replace(FIXTURE, recordings=tuple(paths[::step]))).report
    streams = [row.stream.split(" ")[0] for row in report.unassigned]
    assert streams == ["10.5.5.20", *sorted(strangers)]


def test_imu_on_the_host_clock_has_receive_times_as_stamps(tmp_path: Path) -> None:
    """Also samples whose own stamps are damaged beyond all arithmetic."""
    sent = [
        replace(one, payload=one.payload[:16] + LEAST + one.payload[24:])
        if one.port == 7503 and number % 3
        else one
        for number, one in enumerate(datagrams(LENGTH_NS))
    ]
    path = tmp_path / "recording.pcap"
    path.write_bytes(pcap_bytes([one.frame() for one in sent]))
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        memory = in_memory(replace(BY_HOST, recordings=(path,))).memory
    assert memory is not None
    stamps = sorted(stamp for samples in memory.imu for stamp in samples.stamp_ns.tolist())
    assert stamps == [one.host_ns for one in sent if one.port == 7503]


def test_datagrams_are_those_of_the_lidars() -> None:
    sizes = {(one.source, one.port, len(one.payload)) for one in datagrams(LENGTH_NS)}
    assert {row for row in sizes if row[1] != 5353} == {
        (LEFT.ip, 7502, 6400),
        (LEFT.ip, 7503, 48),
        (RIGHT.ip, 7502, 2304),
        (RIGHT.ip, 7503, 48),
    }
