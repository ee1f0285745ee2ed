"""Share of the bytes that some packets of a recording have; numbers worked by hand."""

from __future__ import annotations

import pytest

from mlbatch.discovery.sampler import KindSamples, Sampler
from mlbatch.discovery.types import PacketKind
from mlbatch.types import StreamTable


def _sampler(*counts: tuple[int, int]) -> tuple[Sampler, list[PacketKind]]:
    """Packets and bytes of a packet, by stream."""
    sampler = Sampler(StreamTable())
    kinds = [PacketKind(number, size) for number, (_, size) in enumerate(counts)]
    for kind, (packets, _) in zip(kinds, counts, strict=True):
        sampler.kinds[kind] = KindSamples([], [], [], packets, 0, 0, set())
    return sampler, kinds


def test_share_of_bytes() -> None:
    sampler, (lidar, camera) = _sampler((10, 300), (9, 1000))
    assert sampler.share_of({lidar}) == pytest.approx(3000 / 12000)
    assert sampler.share_of({camera}) == pytest.approx(9000 / 12000)
    assert sampler.share_of({lidar, camera}) == 1.0
    # 12000 bytes of 19 packets: 19 more have as many.
    sampler.crowd.packets = 19
    assert sampler.share_of({lidar}) == pytest.approx(3000 / 24000)


def test_share_of_nothing() -> None:
    assert _sampler()[0].share_of(set()) == 0.0
