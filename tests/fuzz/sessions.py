"""Targets: whole conversions of mutated packets in sound frames, with every law of a run checked.

Threads and compiled loops read and write at places from arrays: they must give the same bytes.
"""

from __future__ import annotations

import random
import re
import shutil
import zlib
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from functools import lru_cache
from pathlib import Path

from mlbatch.discovery.discover import SensorSelection
from mlbatch.errors import MlbatchError
from mlbatch.pipeline.job import Job
from mlbatch.verification import verify
from tests.builders.captures import udp_frame, write_pcap
from tests.builders.run import command, in_memory, prints
from tests.fuzz.framing import joined, mutated_parts, parts_of
from tests.fuzz.harness import BrokenLaw, Target
from tests.fuzz.mutation import Seeds
from tests.fuzz.packets import CALIBRATION, DEVICE_PORT, NAMES, seeds_of
from tests.property.test_damage import check_ledgers, check_output

_SOURCE, _HOST = "192.168.1.201", "192.168.1.10"
_EVERY = 5
_JOBS = (
    Job((), keep_partial=True),
    Job((), keep_partial=True, keep_repeated=True, layout="organized"),
    Job((), keep_partial=True, slices=3, min_range_m=1.0),
    Job((), split=True, rate=Fraction(1000)),
    Job((), SensorSelection(decode={"firing_azimuth": "off"}), keep_partial=True),
)


@lru_cache(maxsize=1)
def _seeds() -> Seeds:
    """Some of each vendor's."""
    vendors = ("velodyne", "hesai", "robosense", "livox", "ouster")
    return tuple(seed for vendor in vendors for seed in seeds_of(vendor)[::_EVERY])


def _job(data: bytes, folder: Path) -> Job:
    """A conversion of the packets of an input, which are written into the folder."""
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
    job = random.Random(zlib.crc32(data)).choice(_JOBS)
    selection = replace(job.selection, metadata=tuple(metadata))
    return replace(job, recordings=(capture,), selection=selection)


def _convert(data: bytes, folder: Path) -> None:
    result = in_memory(_job(data, folder))
    check_ledgers(result.report)
    check_output(result)


# -- verified -------------------------------------------------------------------------------------

# From what a lidar can be to what none is.
_SIZES = (
    *("0", "0.05", "0.4", "0.6", "0.99", "1.01", "1.6", "2", "5", "15", "45", "89", "91", "180"),
    *("361", "500", "999", "1001", "1e4", "99999", "1e6", "6e15", "1e19", "1e100", "1e308", "nan"),
)
_WRITTEN = re.compile(rb"(?<![\w.])-?\d+(\.\d+)?([eE][-+]?\d+)?(?![\w.])")


@lru_cache(maxsize=1)
def _described_seeds() -> Seeds:
    """Those with a calibration file, or with device packets that contain angles."""
    kinds = {CALIBRATION, DEVICE_PORT}
    return tuple(seed for seed in _seeds() if kinds & {part.kind for part in parts_of(seed)})


def _mutated_geometry(rng: random.Random, seeds: Seeds) -> bytes:
    """Change numbers of a calibration file, or bytes of all device packets; no points."""
    parts = parts_of(rng.choice(seeds))
    change = rng.random()
    for at, part in enumerate(parts):
        if part.kind == CALIBRATION:
            parts[at] = replace(part, data=_with_numbers(random.Random(change), part.data))
        elif part.kind == DEVICE_PORT:
            parts[at] = replace(part, data=_with_bytes(random.Random(change), part.data))
    return joined(parts)


def _with_numbers(rng: random.Random, data: bytes) -> bytes:
    for _ in range(rng.choice((1, 1, 2, 5))):
        found = list(_WRITTEN.finditer(data))
        if not found:
            return _with_bytes(rng, data)
        # Long tables have most numbers: those at the ends of a file are chosen as often.
        one = rng.choice(found if rng.random() < 0.5 else [*found[:20], *found[-60:]])
        number = rng.choice(("", "-")) + rng.choice(_SIZES)
        data = data[: one.start()] + number.encode() + data[one.end() :]
    return data


def _with_bytes(rng: random.Random, data: bytes) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 3, 20))):
        changed[rng.randrange(len(changed))] = rng.choice((0, 1, 0x7F, 0xFF, rng.randrange(256)))
    return bytes(changed)


def _verified(data: bytes, folder: Path) -> None:
    """What `convert` writes without an error is without fault for `verify`."""
    job = _job(data, folder)
    output = folder / "out"
    shutil.rmtree(output, ignore_errors=True)
    words: list[str | Path] = ["convert", *job.recordings, "-o", output, "--keep-partial"]
    for path in job.selection.metadata:
        words += ["--metadata", path]
    run = command(*words, "--no-fsync", "--quiet")
    if run.code:
        raise MlbatchError(run.err.splitlines()[-1])
    verdict = verify(output)
    if not verdict.ok:
        shown = "; ".join(map(str, verdict.violations[:3]))
        raise BrokenLaw(f"a run without an error, but not for verify: {shown}")


# -- others that must do the same -----------------------------------------------------------------


def _outcome(job: Job) -> object:
    """All that a run gives, or why it gives nothing."""
    try:
        return prints(in_memory(job))
    except MlbatchError as err:
        return str(err)


def _compare(job: Job, other: Job) -> None:
    if _outcome(job) != _outcome(other):
        raise BrokenLaw(f"{other.jobs} jobs: other scans than in one")


def _share(data: bytes, folder: Path) -> None:
    job = _job(data, folder)
    _compare(job, replace(job, jobs=2))


# A pcap counts seconds in 32 bits.
_LAST_NS = ((1 << 32) - 1) * 10**9

TARGETS: Sequence[Target] = (
    Target("sessions", _seeds, _convert, mutated_parts, 2),
    Target("sessions, verified", _described_seeds, _verified, _mutated_geometry, 2),
    Target("sessions of two jobs", _seeds, _share, mutated_parts, 2),
)
