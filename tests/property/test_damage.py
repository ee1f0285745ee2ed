"""Damaged packets: every run balances its ledgers or ends in one clear line, and soon.

Damaged payloads, files, rigs and metadata: tests/fuzz.
"""

from __future__ import annotations

import contextlib
import json
import random
import re
import signal
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import FrameType
from typing import TypeAlias

import numpy as np
import pytest

from mlbatch.discovery.discover import SensorSelection
from mlbatch.errors import MlbatchError
from mlbatch.pipeline.job import Job
from mlbatch.reports.report import RunReport, build_report
from mlbatch.types import Scan
from tests.builders.captures import pcap_bytes
from tests.builders.run import (
    BY_HOST,
    FIXTURE,
    TWO_LIDARS,
    Result,
    Values,
    buffers_of,
    in_memory,
    prints,
)
from tests.builders.traffic import Datagram, Records, datagrams, frames
from tests.builders.two_lidars import COLUMNS_PER_PACKET, LEFT, RIGHT

# Damaged data must cause no numpy warnings.
pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

LENGTH_NS = 220_000_000
LONGEST_S = 300
BUFFERS = (9_000, 50_000)
# Source IP in an Ethernet frame.
SENDER = slice(26, 30)
LIDARS = ("left.json", "right.json")

# -- damage ---------------------------------------------------------------------------------------

SHARE = 0.1
# How far a network or a capture host may swap packets.
REACH = 20

Kind: TypeAlias = Callable[[random.Random, bytes], Sequence[bytes]]


def flipped(rng: random.Random, data: bytes) -> bytes:
    """One to four bits flipped, anywhere or among the first bytes, where headers are."""
    changed = bytearray(data)
    reach = rng.choice([len(data), len(data), 64])
    for _ in range(rng.randint(1, 4) if data else 0):
        changed[rng.randrange(min(reach, len(data)))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def cut(rng: random.Random, data: bytes) -> bytes:
    """A part from the start on."""
    return data[: rng.choice([0, rng.randrange(len(data) + 1), max(len(data) - 1, 0)])]


KINDS: dict[str, Kind] = {
    "removed": lambda rng, data: [],
    "duplicated": lambda rng, data: [data] * rng.choice([2, 2, 3]),
    "truncated": lambda rng, data: [cut(rng, data)],
    "flipped": lambda rng, data: [flipped(rng, data)],
}
NAMES = (*KINDS, "reordered", "all")


def damaged(rng: random.Random, parts: Iterable[bytes], name: str) -> list[list[bytes]]:
    """What takes the place of each part: usually itself."""
    kinds = list(KINDS) if name == "all" else [name]
    out = []
    for part in parts:
        hit = name != "reordered" and rng.random() < SHARE
        out.append(list(KINDS[rng.choice(kinds)](rng, part)) if hit else [part])
    return _reordered(rng, out) if name in ("reordered", "all") else out


def _reordered(rng: random.Random, parts: list[list[bytes]]) -> list[list[bytes]]:
    keys = [
        place + (rng.uniform(-REACH, REACH) if rng.random() < SHARE else 0.0)
        for place in range(len(parts))
    ]
    return [parts[place] for place in sorted(range(len(parts)), key=keys.__getitem__)]


def damaged_frames(rng: random.Random, records: Sequence[tuple[int, bytes]], name: str) -> Records:
    """Frames on their way to the capture host; receive times stay in order."""
    parts = damaged(rng, [frame for _, frame in records], name)
    return [
        (host_ns, frame)
        for (host_ns, _), frames in zip(records, parts, strict=True)
        for frame in frames
    ]


# Timestamps at the limits of accepted values, and of 8 bytes.
STAMPS_NS = (0, 1, (1 << 31) * 10**9 - 1, (1 << 31) * 10**9, (1 << 63) - 1, 1 << 63, (1 << 64) - 1)
STEPS_NS = (10**6, 15 * 10**6, 10**8, 999 * 10**6, 10**9, 2 * 10**9, 10**12)


def damaged_heads(rng: random.Random, sent: Sequence[Datagram]) -> Records:
    """Lidar packets with odd stamps, measurement ids and status words in some columns."""
    kind = rng.randrange(4)
    share = rng.choice([0.02, 0.1, 0.4])
    return [
        (_odd_columns(rng, one, kind) if one.port == 7502 and rng.random() < share else one).frame()
        for one in sent
    ]


def _odd_columns(rng: random.Random, one: Datagram, kind: int) -> Datagram:
    """Column headers (docs/sources/ouster.md): stamp u64, measurement id u16, status u16."""
    data = bytearray(one.payload)
    record = (len(data) - 64) // COLUMNS_PER_PACKET
    for _ in range(rng.choice([1, 1, COLUMNS_PER_PACKET])):
        at = 32 + rng.randrange(COLUMNS_PER_PACKET) * record
        stamp_ns = int.from_bytes(data[at : at + 8], "little")
        stepped_ns = stamp_ns + rng.choice([-1, 1]) * rng.choice(STEPS_NS)
        new_ns = (stamp_ns, rng.choice(STAMPS_NS), stepped_ns, stamp_ns)[kind]
        data[at : at + 8] = (new_ns % (1 << 64)).to_bytes(8, "little")
        if kind in (0, 3):
            first = 0 if kind == 0 else 8
            data[at + rng.randrange(first, 12)] ^= 1 << rng.randrange(8)
    return replace(one, payload=bytes(data))


def with_jumps(rng: random.Random, records: Records) -> Records:
    """The same frames with a clock step of the capture host, for one frame or all later ones."""
    seconds = (0.001, 0.5, 2, 40, 10**6)
    out = []
    shift_ns = 0
    for host_ns, frame in records:
        jump_ns = int(rng.choice([-1, 1]) * rng.choice(seconds) * 10**9)
        chance = rng.random()
        once_ns = jump_ns if chance < 0.02 else 0
        shift_ns += jump_ns if chance > 0.995 else 0
        out.append((host_ns + shift_ns + once_ns, frame))
    return out


# -- laws -----------------------------------------------------------------------------------------

JOBS = (
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
            metadata=tuple(TWO_LIDARS / name for name in LIDARS),
            identity_extrinsics=True,
            decode={"crc": "check"},
        ),
        min_range_m=3.0,
    ),
)


@contextlib.contextmanager
def within(seconds: int) -> Iterator[None]:
    """Fail instead of hanging."""

    def late(_signal: int, _frame: FrameType | None) -> None:
        raise AssertionError(f"still running after {seconds} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


Outcome = tuple[str, list[Values]]


def outcome(job: Job, frames_given: int | None = None) -> Outcome:
    """Convert and check; ledgers and scans in comparable form, or the line of the error."""
    try:
        with within(LONGEST_S):
            result = in_memory(job)
    except MlbatchError as err:
        line = str(err)
        assert line.strip()
        assert "\n" not in line
        assert "please report" not in line
        return line, []
    report = result.report
    if frames_given is not None:
        assert report.capture.frames == frames_given
    check_ledgers(report)
    check_output(result)
    said = build_report(report)
    ledgers = {key: said[key] for key in ("capture", "sensors", "scans", "unassigned")}
    return json.dumps(ledgers), prints(result)


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


def both_buffers(job: Job, frames_given: int | None, size: int) -> Outcome:
    """The outcome, which must not depend on the size of the buffers."""
    line, values = outcome(job, frames_given)
    with buffers_of(size):
        other, other_values = outcome(job, frames_given)
    assert other_values == values
    # An error about two sensors may name either first.
    assert _words(other) == _words(line) if not values else other == line
    return line, values


def _words(line: str) -> list[str]:
    return sorted(re.findall(r"[^\s,;:()]+", line))


def recorded(rng: random.Random, records: Records, folder: Path) -> tuple[Path, ...]:
    """One file, or one for each sender; sometimes by a clock that jumps."""
    if rng.random() < 0.2:
        records = with_jumps(rng, records)
    count = rng.choice([1, 1, 2, 3])
    parts: list[Records] = [[] for _ in range(count)]
    for record in records:
        # Fragments of a datagram stay together.
        parts[sum(record[1][SENDER]) % count].append(record)
    paths = tuple(folder / f"{number}.pcap" for number in range(count))
    for path, part in zip(paths, parts, strict=True):
        path.write_bytes(pcap_bytes(part))
    return paths


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("name", NAMES)
def test_damaged_frames(name: str, seed: int, tmp_path: Path) -> None:
    rng = random.Random(f"frames {name} {seed}")
    records = damaged_frames(rng, frames(LENGTH_NS), name)
    job = replace(rng.choice(JOBS), recordings=recorded(rng, records, tmp_path))
    both_buffers(job, len(records), rng.choice(BUFFERS))


@pytest.mark.parametrize("seed", range(30))
def test_damaged_columns(seed: int, tmp_path: Path) -> None:
    rng = random.Random(f"columns {seed}")
    records = damaged_heads(rng, datagrams(LENGTH_NS))
    job = replace(rng.choice(JOBS), recordings=recorded(rng, records, tmp_path))
    both_buffers(job, len(records), rng.choice(BUFFERS))


@pytest.mark.parametrize("name", ["removed", "duplicated", "truncated"])
def test_counts_are_exactly_the_damage(name: str, tmp_path: Path) -> None:
    rng = random.Random(f"exact {name}")
    sent = datagrams(LENGTH_NS)
    parts = damaged(rng, [one.payload for one in sent], name)
    records = [
        replace(one, payload=payload).frame()
        for one, payloads in zip(sent, parts, strict=True)
        for payload in payloads
    ]
    path = tmp_path / "damaged.pcap"
    path.write_bytes(pcap_bytes(records))
    report = in_memory(replace(FIXTURE, recordings=(path,))).report
    for lidar, sensor in zip((LEFT, RIGHT), report.sensors, strict=True):
        own = [
            (len(one.payload), [len(payload) for payload in payloads])
            for one, payloads in zip(sent, parts, strict=True)
            if (one.source, one.port) == (lidar.ip, 7502)
        ]
        whole = [sizes.count(size) for size, sizes in own]
        packets = sensor.ledger.packets
        there = np.flatnonzero(whole)
        assert packets.read == sum(len(sizes) for _, sizes in own)
        assert packets.accepted == len(there)
        rejected = {
            "bad_size": packets.read - sum(whole),
            "duplicate": sum(whole) - len(there),
        }
        assert packets.rejected == {reason: n for reason, n in rejected.items() if n}
        # Loss at the ends cannot be known.
        assert packets.lost == there[-1] - there[0] + 1 - len(there)
        assert len(there) < len(own) or rejected["duplicate"]
