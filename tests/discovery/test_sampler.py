"""Samples of packets: the split by kind, which packets are kept, rates and clocks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mlbatch.discovery.discover import SensorSelection, discover
from mlbatch.discovery.sampler import SAMPLES_PER_KIND, KindSamples, Sampler
from mlbatch.discovery.types import PacketKind
from mlbatch.readers import open_recording
from mlbatch.types import PacketBatch, Stream, StreamTable
from tests.builders.sessions import NS_PER_MS, NS_PER_S, Unit, write_session

SIZE = 8
BEGIN_NS = 1_700_000_000 * NS_PER_S


def _batch(host_ns: list[int], first_words: list[int]) -> PacketBatch:
    payloads = np.zeros((len(host_ns), SIZE), np.uint8)
    payloads[:, :4] = np.array(first_words, "<u4")[:, None].view(np.uint8)
    start = np.arange(len(host_ns)) * SIZE
    size = np.full(len(host_ns), SIZE)
    stream = np.zeros(len(host_ns), np.int64)
    return PacketBatch(payloads.reshape(-1), start, size, stream, np.array(host_ns, np.int64))


def _sampled(batches: list[PacketBatch]) -> Sampler:
    table = StreamTable()
    table.number(Stream("10.0.0.1", 2368))
    sampler = Sampler(table)
    for batch in batches:
        sampler.add(batch)
    return sampler


@pytest.mark.parametrize("batch_size", [1, 7, 26, 1000])
def test_the_first_packets_are_kept_and_six_of_every_quarter_of_a_second(batch_size: int) -> None:
    """Quarters of the clock of receive times, in whatever batches packets come."""
    host_ns = [BEGIN_NS + number * 10 * NS_PER_MS for number in range(100)]
    words = [0] * len(host_ns)
    sampler = _sampled(
        [
            _batch(host_ns[at : at + batch_size], words[at : at + batch_size])
            for at in range(0, len(host_ns), batch_size)
        ]
    )
    samples = sampler.kinds[PacketKind(0, SIZE)]
    kept = [(at - BEGIN_NS) // (10 * NS_PER_MS) for at in samples.host_ns]
    rows = [at + row for at in (25, 50, 75) for row in range(6)]
    assert kept == [*range(SAMPLES_PER_KIND), *rows]
    assert samples.numbers == kept
    assert samples.packets == 100
    assert (samples.first_host_ns, samples.last_host_ns) == (host_ns[0], host_ns[-1])


def test_packets_with_new_first_words_are_kept() -> None:
    """Rare device packets among others: up to eight different words."""
    words = [0] * 20 + [1] + [0] * 3 + list(range(2, 12))
    host_ns = [BEGIN_NS + number for number in range(len(words))]
    samples = _sampled([_batch(host_ns, words)]).kinds[PacketKind(0, SIZE)]
    later = [at - BEGIN_NS for at in samples.host_ns][SAMPLES_PER_KIND:]
    assert later == [20, 24, 25, 26, 27, 28, 29]


def test_rate_and_clock_of_a_sensor(tmp_path: Path) -> None:
    # 512 columns a revolution of 0.1 s, 16 a packet, which is received 4.125 ms after its first
    # column, hence 1.1953125 ms after its newest.
    unit = Unit(turns=30)
    late = replace(unit, host_ns=5 * NS_PER_S)
    for name, one, offset_s in (("same", unit, -0.0011953125), ("late", late, -5.0001953125)):
        table = StreamTable()
        recording = open_recording(write_session(tmp_path / name, one), table)
        found = discover([recording], table, SensorSelection())
        (sensor,) = found.sensors
        assert found.sampler.columns_per_s(sensor) == pytest.approx(5120, rel=1e-3)
        offset_ns = found.sampler.clock_offset_ns(sensor)
        assert offset_ns is not None
        assert offset_ns / NS_PER_S == pytest.approx(offset_s, abs=1e-9)
        assert found.sampler.has_receive_times(sensor)


# -- shares of the bytes, worked by hand ------------------------------------------------------


def _counted(*counts: tuple[int, int]) -> tuple[Sampler, list[PacketKind]]:
    """Packets and bytes of a packet, by stream."""
    sampler = Sampler(StreamTable())
    kinds = [PacketKind(number, size) for number, (_, size) in enumerate(counts)]
    for kind, (packets, _) in zip(kinds, counts, strict=True):
        sampler.kinds[kind] = KindSamples([], [], [], packets, 0, 0, set())
    return sampler, kinds


def test_share_of_bytes() -> None:
    sampler, (lidar, camera) = _counted((10, 300), (9, 1000))
    assert sampler.share_of({lidar}) == pytest.approx(3000 / 12000)
    assert sampler.share_of({camera}) == pytest.approx(9000 / 12000)
    assert sampler.share_of({lidar, camera}) == 1.0
    # 12000 bytes of 19 packets: 19 more have as many.
    sampler.kind_filter.packets = 19
    assert sampler.share_of({lidar}) == pytest.approx(3000 / 24000)


def test_share_of_nothing() -> None:
    assert _counted()[0].share_of(set()) == 0.0
