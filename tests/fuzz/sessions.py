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

import numpy as np

from mlbatch.discovery.discover import SensorSelection
from mlbatch.errors import MlbatchError
from mlbatch.pipeline.job import Job
from mlbatch.reports.report import RunReport
from mlbatch.types import Scan
from mlbatch.verification import verify
from tests.builders.captures import udp_frame, write_pcap
from tests.builders.run import (
    BY_HOST,
    FIXTURE,
    TWO_LIDARS,
    Result,
    buffers_of,
    command,
    in_memory,
    prints,
)
from tests.builders.traffic import frames as fixture_frames
from tests.fuzz.framing import Part, joined, mutated_parts, parts_of
from tests.fuzz.harness import BrokenLaw, Target
from tests.fuzz.mutation import Seeds, mutated
from tests.fuzz.packets import CALIBRATION, DEVICE_PORT, NAMES, seeds_of

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


def _checked(job: Job) -> Result:
    """Convert; ledgers balance, and the output has what they count."""
    result = in_memory(job)
    check_ledgers(result.report)
    check_output(result)
    return result


def _convert(data: bytes, folder: Path) -> None:
    _checked(_job(data, folder))


def check_ledgers(report: RunReport) -> None:
    """Ledgers balance (docs/report.md), and every datagram is counted."""
    capture = report.capture
    unassigned = sum(row.packets for row in report.unassigned)
    assert capture.frames == capture.datagrams + sum(capture.skipped.values())
    ledgers = [sensor.ledger for sensor in report.sensors]
    own = sum(ledger.packets.read + ledger.imu_packets for ledger in ledgers)
    assert capture.datagrams == own + unassigned
    for ledger in ledgers:
        packets = ledger.packets
        columns = ledger.columns
        points = ledger.points
        assert packets.read == packets.accepted + sum(packets.rejected.values())
        assert columns.decoded == columns.written + sum(columns.dropped.values())
        kept_out = points.no_return + points.range + points.box + points.repeated
        assert points.slots == kept_out + points.written
        samples = ledger.imu_samples
        assert samples.decoded == samples.written + sum(samples.dropped.values())
        counts = (*packets.rejected.values(), *columns.dropped.values(), kept_out)
        assert min(counts) >= 0


def check_output(result: Result) -> None:
    """What the ledgers count as written is in the output, and valid."""
    assert result.memory is not None
    assert not result.memory.abandoned
    ledgers = [sensor.ledger for sensor in result.report.sensors]
    columns = np.zeros(len(ledgers), np.int64)
    points = np.zeros(len(ledgers), np.int64)
    for scan in result.scans:
        check_scan(scan)
        columns += np.bincount(scan.column_lidar_id, minlength=len(ledgers))
        owner = scan.lidar_id[np.isfinite(scan.range_m)] if scan.range_m is not None else None
        assert owner is not None
        points += np.bincount(owner, minlength=len(ledgers))
    assert columns.tolist() == [ledger.columns.written for ledger in ledgers]
    assert points.tolist() == [ledger.points.written for ledger in ledgers]
    assert result.report.scans.points == points.sum()
    assert result.report.scans.written == len({(s.index, s.slice) for s in result.scans})
    for number, ledger in enumerate(ledgers):
        own = [len(s.stamp_ns) for s in result.memory.imu if s.sensor == number]
        assert sum(own) == ledger.imu_samples.written


def check_scan(scan: Scan) -> None:
    """Stamps in order within the window, points finite, indices in range."""
    stamps = scan.column_stamp_ns
    assert len(stamps)
    assert (np.diff(stamps) >= 0).all()
    assert scan.start_ns <= stamps[0]
    assert stamps[-1] < scan.end_ns
    assert scan.range_m is not None
    valid = np.isfinite(scan.range_m)
    assert valid.sum() == scan.points
    assert (scan.range_m[valid] > 0).all()
    assert (np.isfinite(scan.xyz).all(axis=-1) == valid).all()
    if scan.column is not None:
        assert (np.diff(scan.column.astype(np.int64)) >= 0).all()
        assert scan.column.max(initial=0) < len(stamps)


# -- frames ---------------------------------------------------------------------------------------

_LENGTH_NS = 220_000_000
_BUFFERS = (9_000, 50_000)
# How far a network or a capture host may swap packets.
_REACH = 20
# Source IP in an Ethernet frame.
_SENDER = slice(26, 30)
_STEPS_NS = (10**6, 5 * 10**8, 2 * 10**9, 40 * 10**9, 10**15)
_FIXTURE_JOBS = (
    FIXTURE,
    replace(FIXTURE, slices=3),
    replace(FIXTURE, split=True),
    replace(FIXTURE, layout="organized"),
    BY_HOST,
    replace(FIXTURE, keep_partial=False, max_wait_ns=20_000_000),
    replace(FIXTURE, rate=Fraction(100, 3), max_wait_ns=None),
    replace(
        FIXTURE,
        selection=SensorSelection(
            metadata=tuple(TWO_LIDARS / name for name in ("left.json", "right.json")),
            identity_extrinsics=True,
            decode={"crc": "check"},
        ),
        min_range_m=3.0,
    ),
)


def _frame_seeds() -> Seeds:
    """The fixture's first frames, most of them fragments."""
    return (joined(Part(0, host_ns, frame) for host_ns, frame in fixture_frames(_LENGTH_NS)),)


def _mutated_frames(rng: random.Random, seeds: Seeds) -> bytes:
    """Some frames are lost, repeated, damaged or swapped; the capture host's clock may step."""
    parts = parts_of(seeds[0])
    share = rng.choice((0.02, 0.1, 0.1, 0.4))
    changed: list[tuple[float, bytes]] = []
    for place, part in enumerate(parts):
        kind = rng.randrange(5) if rng.random() < share else 5
        if kind < 2:
            changed += [(place, part.data)] * (kind * rng.choice((2, 2, 3)))
        elif kind == 2:
            changed.append((place + rng.uniform(-_REACH, _REACH), part.data))
        else:
            data = part.data if kind == 5 else mutated(rng, (part.data,))
            changed.append((place, data))
    changed.sort(key=lambda row: row[0])
    step_ns = rng.choice((-1, 1)) * rng.choice(_STEPS_NS) * (rng.random() < 0.2)
    first, last = rng.randrange(len(parts)), rng.choice((1, len(parts)))
    return joined(
        Part(0, max(0, parts[at].host_ns + step_ns * (first <= at < first + last)), data)
        for at, data in ((min(max(0, round(place)), len(parts) - 1), one) for place, one in changed)
    )


def _convert_frames(data: bytes, folder: Path) -> None:
    """Frames in one file, or in one for each sender: any buffer gives the same."""
    rng = random.Random(zlib.crc32(data))
    count = rng.choice((1, 1, 2, 3))
    files: list[list[tuple[int, bytes]]] = [[] for _ in range(count)]
    for part in parts_of(data):
        # Fragments of a datagram stay together.
        files[sum(part.data[_SENDER]) % count].append((part.host_ns, part.data))
    paths = [write_pcap(folder / f"{number}.pcap", file) for number, file in enumerate(files)]
    job = replace(rng.choice(_FIXTURE_JOBS), recordings=tuple(paths))
    found = _outcome_of_frames(job, sum(map(len, files)))
    with buffers_of(rng.choice(_BUFFERS)):
        if _outcome_of_frames(job, sum(map(len, files))) != found:
            raise BrokenLaw("another size of buffers gives other scans")


def _outcome_of_frames(job: Job, count: int) -> object:
    """Scans, or the words of the error: one about two sensors may name either first."""
    try:
        result = _checked(job)
    except MlbatchError as err:
        return sorted(re.findall(r"[^\s,;:()]+", str(err)))
    if result.report.capture.frames != count:
        raise BrokenLaw("frames are forgotten or invented")
    report = result.report
    return prints(result), [sensor.ledger for sensor in report.sensors], report.unassigned


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
    Target("sessions of frames", _frame_seeds, _convert_frames, _mutated_frames, 4),
    Target("sessions, verified", _described_seeds, _verified, _mutated_geometry, 2),
    Target("sessions of two jobs", _seeds, _share, mutated_parts, 2),
)
