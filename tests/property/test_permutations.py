"""The result depends on stamps alone: whole conversions over 400 random receive times, and delays.

docs/batching.md: scans, scans.csv without `ready_host_ns` and all ledgers are the same
for every interleaving between sensors in which none lags by more than `--max-wait` in stamps.
`test_batching.py` tests the batching alone with thousands of other feeds; here packets of five
vendors are converted, with random receive times and batches.
"""

from __future__ import annotations

import random
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from mlbatch import readers
from mlbatch.discovery import discover
from mlbatch.discovery.discover import SensorSelection
from mlbatch.faults import Fault, parse_fault
from mlbatch.pipeline.conversion import Conversion
from mlbatch.pipeline.job import Job
from mlbatch.rig.rig import read_rig
from mlbatch.types import CaptureCounts, PacketBatch, Recording, Stream, StreamTable
from tests.builders import livox
from tests.builders.run import Values, csv_without_arrival, print_of
from tests.matrix.cells import NOON_NS
from tests.matrix.containers import rig_text
from tests.matrix.lidars import NS_PER_MS, VENDORS, Sent, Spell, write_metadata

BLOCKS = range(8)
PERMUTATIONS_A_BLOCK = 50
LENGTH_NS = 80 * NS_PER_MS
# Shorter than the session, so that receive times could break the law.
WAIT_NS = 40 * NS_PER_MS
RATE = Fraction(50)
LIVOX_IP = "10.0.0.5"
LIVOX_PORT = 57000

# The same rig in all conversions: to read it again would be a fifth of the time.
_READ_RIG = lru_cache(maxsize=1)(read_rig)

# Scans, scans.csv, ledgers, and what is the same for all scans.
Print = tuple[list[Values], str, list[str], str]


class Memory(Recording):
    """A recording of packets in memory; cuts: where its batches end."""

    def __init__(self, batch: PacketBatch, cuts: Sequence[int]) -> None:
        super().__init__(Path("memory.pcap"), "pcap", 0)
        self.batch = batch
        self.cuts = cuts

    def packets(self) -> Generator[PacketBatch, None, None]:
        """All batches, again from the start."""
        self.counts = CaptureCounts()
        ends = [*self.cuts, len(self.batch)]
        for begin, end in zip([0, *self.cuts], ends, strict=True):
            self.counts.frames += end - begin
            self.counts.datagrams += end - begin
            yield self.batch.take(slice(begin, end))


@dataclass(frozen=True, slots=True)
class Session:
    """Packets of all sensors, sensor by sensor; rows: which are whose, in their order.

    low_ns, high_ns: (P,) smallest and largest stamp of each packet; sent_ns: (P,) as they came.
    """

    data: PacketBatch
    rows: tuple[range, ...]
    low_ns: list[int]
    high_ns: list[int]
    streams: tuple[Stream, ...]
    rig: Path

    def recording(
        self, order: Sequence[int], rng: random.Random, streams: StreamTable, *, is_timely: bool
    ) -> Memory:
        """The packets in another order, in batches cut anywhere.

        is_timely: they arrive as they were sent; else at other times that go with the order.
        """
        index = np.array(order, np.int64)
        batch = self.data.take(index)
        numbers = np.array([streams.number(stream) for stream in self.streams])
        batch.stream = numbers[batch.stream]
        steps_ns = np.array(rng.choices([0, 10, 1_000, 100_000], k=len(order)))
        if not is_timely:
            batch.host_ns = NOON_NS + np.cumsum(steps_ns)
        cuts = sorted(rng.sample(range(1, len(order)), rng.choice([0, 1, 5, 40])))
        return Memory(batch, cuts)

    def prints(
        self, order: Sequence[int], rng: random.Random, faults: tuple[Fault, ...] = ()
    ) -> Print:
        """All that identity covers, and the ledgers."""

        def opened(path: Path, streams: StreamTable) -> Recording:
            return self.recording(order, rng, streams, is_timely=bool(faults))

        with (
            patch.object(readers, "open_recording", opened),
            patch.object(discover, "read_rig", _READ_RIG),
        ):
            return printed(replace(self.job, faults=faults))

    @property
    def job(self) -> Job:
        """A conversion of it."""
        selection = SensorSelection(rig=self.rig)
        return Job((Path("memory.pcap"),), selection, RATE, keep_partial=True, max_wait_ns=WAIT_NS)


def printed(job: Job) -> Print:
    """All that identity covers, and the ledgers of a run."""
    run = Conversion(job)
    scans = [print_of(scan) for scan, _ in run.scans()]
    assert len(scans) > LENGTH_NS * RATE / 10**9 - 1
    assert run.table is not None
    table = csv_without_arrival(run.table.text())
    ledgers = [repr(sensor.ledger) for sensor in run.sensors]
    return scans, table, ledgers, repr(run.info)


def livox_sent() -> Sent:
    """48 points every 2 ms, each a column of its own, evenly over the interval."""
    spec = livox.LivoxSpec(points=48, interval=20_000, start_ns=NOON_NS + 1_300_000)
    packets = LENGTH_NS // (spec.interval * 100)
    rng = np.random.default_rng(5)
    coordinates = rng.integers(1000, 9000, (packets * spec.points, 1, 3))
    sent = livox.point_packets(spec, coordinates, np.full(coordinates.shape[:2], 80))
    first_ns = spec.start_ns + np.arange(packets)[:, None] * spec.interval * 100
    stamps = first_ns + np.arange(spec.points) * spec.interval * 100 // spec.points
    hosts = np.array([host_ns for host_ns, _ in sent])
    return Sent("livox", tuple(payload for _, payload in sent), hosts, stamps, stamps * 0 + 1)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """Lidars of five vendors at the same time."""
    folder = tmp_path_factory.mktemp("permutations")
    write_metadata(folder)
    four = [row.send(Spell(NOON_NS + row.begin_ns, LENGTH_NS)) for row in VENDORS.values()]
    text = rig_text(four, "pcap")
    text += f"  - name: livox\n    stream: {{source_ip: {LIVOX_IP}, port: {LIVOX_PORT}}}\n"
    text += "    extrinsics: {translation_m: [0, 0, 5], rotation_rpy_deg: [0, 0, 0]}\n"
    (folder / "rig.yaml").write_text(text, encoding="utf-8")
    sents = [*four, livox_sent()]
    payloads = [payload for sent in sents for payload in sent.payloads]
    sizes = np.array([len(payload) for payload in payloads], np.int64)
    counts = [len(sent.payloads) for sent in sents]
    firsts = np.cumsum([0, *counts]).tolist()
    batch = PacketBatch(
        np.frombuffer(b"".join(payloads) + bytes(64), np.uint8).copy(),
        np.cumsum(sizes) - sizes,
        sizes,
        np.repeat(np.arange(len(sents)), counts),
        np.concatenate([sent.host_ns for sent in sents]),
    )
    streams = [Stream(row.ip, row.port) for row in VENDORS.values()]
    return Session(
        batch,
        tuple(range(a, a + n) for a, n in zip(firsts, counts, strict=False)),
        [low for sent in sents for low in sent.stamp_ns.min(axis=1).tolist()],
        [high for sent in sents for high in sent.stamp_ns.max(axis=1).tolist()],
        (*streams, Stream(LIVOX_IP, LIVOX_PORT)),
        folder / "rig.yaml",
    )


def permutation(session: Session, rng: random.Random) -> list[int]:
    """Packets of each sensor in their order, between sensors in any order that the law allows.

    Bursts of one sensor alternate with steps of all; nobody falls behind the newest stamp by more
    than the wait, and who has none yet, behind the first stamp of the session.
    """
    places = [rows.start for rows in session.rows]
    newest = [min(session.low_ns)] * len(places)
    order: list[int] = []
    stays = rng.choice([0.0, 0.5, 0.9, 0.99])
    current = 0
    left = list(range(len(places)))
    while left:
        tries = rng.sample(left, len(left))
        if current in left and rng.random() < stays:
            tries.insert(0, current)
        # The slowest may always continue, so that one is found.
        current = next(one for one in tries if _may_go_on(session, places, newest, one))
        order.append(places[current])
        newest[current] = max(newest[current], session.high_ns[places[current]])
        places[current] += 1
        if places[current] == session.rows[current].stop:
            left.remove(current)
    return order


def _may_go_on(session: Session, places: list[int], newest: list[int], current: int) -> bool:
    """Whether the next packet of a sensor leaves all others within the wait."""
    others = [stamp for sensor, stamp in enumerate(newest) if sensor != current]
    return session.high_ns[places[current]] - min(others) <= WAIT_NS


@pytest.fixture(scope="module")
def wanted(session: Session) -> Print:
    """What the packets give in the order in which they were sent."""
    order = np.argsort(session.data.host_ns, kind="stable").tolist()
    return session.prints(order, random.Random(0))


@pytest.mark.parametrize("block", BLOCKS)
def test_arrival_does_not_matter(block: int, session: Session, wanted: Print) -> None:
    first = block * PERMUTATIONS_A_BLOCK
    for seed in range(first, first + PERMUTATIONS_A_BLOCK):
        rng = random.Random(seed)
        order = permutation(session, rng)
        assert sorted(order) == list(range(len(session.data)))
        assert session.prints(order, rng) == wanted, f"seed {seed}"


# Packets of the Ouster last 3 ms, so that it is behind by that before any delay.
DELAYS = [
    ["delay:ouster:30ms"],
    ["delay:velodyne:35ms", "delay:hesai:12ms"],
    ["delay:*:400ms"],
    ["delay:robosense:25ms", "reorder:*:20%", "dup:*:20%"],
    ["reorder:ouster:50%", "reorder:livox:50%"],
]


@pytest.mark.parametrize("faults", DELAYS)
@pytest.mark.parametrize("seed", range(4))
def test_delays_within_the_wait_change_no_scan(
    faults: list[str], seed: int, session: Session, wanted: Print
) -> None:
    rng = random.Random(seed)
    order = np.argsort(session.data.host_ns, kind="stable").tolist()
    replayed = tuple(parse_fault(text) for text in faults)
    scans, table, _, info = session.prints(order, rng, replayed)
    assert (scans, table, info) == (wanted[0], wanted[1], wanted[3])
