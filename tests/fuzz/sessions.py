"""Target: whole conversions of mutated packets in sound frames, with every law of a run checked."""

from __future__ import annotations

import random
import zlib
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from functools import lru_cache
from pathlib import Path

from mlbatch.discover import Wishes
from mlbatch.job import Job
from tests.builders.captures import udp_frame, write_pcap
from tests.builders.run import in_memory
from tests.fuzz.framing import mutated_parts, parts_of
from tests.fuzz.harness import Target
from tests.fuzz.mutation import Seeds
from tests.fuzz.packets import CALIBRATION, NAMES, seeds_of
from tests.property.test_damage import check_ledgers, check_output

_SOURCE, _HOST = "192.168.1.201", "192.168.1.10"
_EVERY = 5
_JOBS = (
    Job((), keep_partial=True),
    Job((), keep_partial=True, keep_repeated=True, layout="organized"),
    Job((), keep_partial=True, slices=3, min_range_m=1.0),
    Job((), split=True, rate=Fraction(1000)),
    Job((), Wishes(decode={"firing_azimuth": "off"}), keep_partial=True),
)


@lru_cache(maxsize=1)
def _seeds() -> Seeds:
    """Some of each maker's."""
    makers = ("velodyne", "hesai", "robosense", "livox", "ouster")
    return tuple(seed for maker in makers for seed in seeds_of(maker)[::_EVERY])


def _convert(data: bytes, folder: Path) -> None:
    records, metadata = [], list[Path]()
    for part in parts_of(data):
        if part.kind == CALIBRATION:
            path = folder / f"unit{NAMES[part.host_ns % len(NAMES)]}"
            path.write_bytes(part.data)
            metadata = [path]
        else:
            frames = udp_frame(part.data, _SOURCE, _HOST, part.kind, part.kind)
            records += [(min(part.host_ns, _LAST_NS), frame) for frame in frames]
    capture = write_pcap(folder / "lidar.pcap", records)
    rng = random.Random(zlib.crc32(data))
    job = rng.choice(_JOBS)
    wishes = replace(job.wishes, metadata=tuple(metadata))
    result = in_memory(replace(job, recordings=(capture,), wishes=wishes))
    check_ledgers(result.report)
    check_output(result)


# A pcap counts seconds in 32 bits.
_LAST_NS = ((1 << 32) - 1) * 10**9

TARGETS: Sequence[Target] = (Target("sessions", _seeds, _convert, mutated_parts, 2),)
