"""The result depends on stamps alone: whole conversions over random receive times, and delays.

docs/batching.md: scans, scans.csv without `ready_host_ns` and all ledgers are the same
for every interleaving between sensors in which none lags by more than `--max-wait` in stamps.
`test_batching.py` tests the batching alone with thousands of other feeds; here packets of four
vendors are converted, with random receive times and buffers.
"""

from __future__ import annotations

import random
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from mlbatch.discovery.discover import SensorSelection
from mlbatch.faults import parse_fault
from mlbatch.pipeline.job import Job
from tests.builders.captures import udp_frame, write_pcap
from tests.builders.run import Values, buffers_of, in_memory, prints
from tests.matrix.containers import rig_text
from tests.matrix.lidars import NOON_NS, NS_PER_MS, VENDORS, Sent, Spell, write_metadata

LENGTH_NS = 80 * NS_PER_MS
# Shorter than the session, so that receive times could break the law.
WAIT_NS = 40 * NS_PER_MS
SESSION = tuple(row.send(Spell(NOON_NS + row.begin_ns, LENGTH_NS)) for row in VENDORS.values())
# Sensor and number of a packet.
Order = list[tuple[int, int]]


def permutation(rng: random.Random) -> Order:
    """Packets of each sensor in their order, between sensors in any order that the law allows.

    Bursts of one sensor alternate with steps of all; nobody falls behind the newest stamp by more
    than the wait, and who has none yet, behind the first stamp of the session.
    """
    taken = [0] * len(SESSION)
    newest = [min(int(sent.stamp_ns.min()) for sent in SESSION)] * len(SESSION)
    order: Order = []
    stays = rng.choice([0.0, 0.5, 0.9, 0.99])
    current = 0
    left = list(range(len(SESSION)))

    def may_continue(sensor: int) -> bool:
        others = [stamp for other, stamp in enumerate(newest) if other != sensor]
        return int(SESSION[sensor].stamp_ns[taken[sensor]].max()) - min(others) <= WAIT_NS

    while left:
        tries = rng.sample(left, len(left))
        if current in left and rng.random() < stays:
            tries.insert(0, current)
        # The slowest may always continue, so that one is found.
        current = next(filter(may_continue, tries))
        stamps = SESSION[current].stamp_ns[taken[current]]
        newest[current] = max(newest[current], int(stamps.max()))
        order.append((current, taken[current]))
        taken[current] += 1
        if taken[current] == len(SESSION[current].payloads):
            left.remove(current)
    return order


def job_of(folder: Path, order: Order, host_ns: list[int], *faults: str) -> Job:
    """A conversion of the packets in an order, received at these times."""
    write_metadata(folder)
    (folder / "rig.yaml").write_text(rig_text(SESSION, "pcap"), encoding="utf-8")
    frames = [_frame(SESSION[sensor], number) for sensor, number in order]
    path = write_pcap(folder / "drive.pcap", zip(host_ns, frames, strict=True))
    return Job(
        (path,),
        SensorSelection(rig=folder / "rig.yaml"),
        Fraction(50),
        keep_partial=True,
        max_wait_ns=WAIT_NS,
        faults=tuple(map(parse_fault, faults)),
    )


def _frame(sent: Sent, number: int) -> bytes:
    row = VENDORS[sent.vendor]
    return udp_frame(sent.payloads[number], row.ip, dport=row.port)[0]


def printed(job: Job) -> tuple[list[Values], list[str]]:
    """All that identity covers, and the ledgers."""
    result = in_memory(job)
    return prints(result), [repr(sensor.ledger) for sensor in result.report.sensors]


def as_sent() -> tuple[Order, list[int]]:
    """The packets by receive time."""
    rows = [
        (host_ns, (sensor, number))
        for sensor, sent in enumerate(SESSION)
        for number, host_ns in enumerate(sent.host_ns.tolist())
    ]
    rows.sort()
    return [place for _, place in rows], [host_ns for host_ns, _ in rows]


@pytest.fixture(scope="module")
def wanted(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Values], list[str]]:
    """What the packets give in the order in which they were sent."""
    found = printed(job_of(tmp_path_factory.mktemp("sent"), *as_sent()))
    assert len(found[0]) > 4
    return found


@pytest.mark.parametrize("seed", range(60))
def test_arrival_does_not_matter(
    seed: int, wanted: tuple[list[Values], list[str]], tmp_path: Path
) -> None:
    rng = random.Random(seed)
    order = permutation(rng)
    assert len(set(order)) == len(order) == sum(len(sent.payloads) for sent in SESSION)
    steps_ns = rng.choices([0, 10, 1_000, 100_000], k=len(order))
    times_ns = (NOON_NS + np.cumsum(steps_ns)).tolist()
    with buffers_of(rng.choice([1 << 12, 1 << 14, 4 << 20])):
        assert printed(job_of(tmp_path, order, times_ns)) == wanted


# Packets of the Ouster last 3 ms, so that it is behind by that before any delay.
@pytest.mark.parametrize(
    "faults",
    [
        ["delay:ouster:30ms"],
        ["delay:velodyne:35ms", "delay:hesai:12ms"],
        ["delay:*:400ms"],
        ["delay:robosense:25ms", "reorder:*:20%", "dup:*:20%"],
        ["reorder:ouster:50%", "reorder:hesai:50%"],
    ],
)
def test_delays_within_the_wait_change_no_scan(
    faults: list[str], wanted: tuple[list[Values], list[str]], tmp_path: Path
) -> None:
    assert printed(job_of(tmp_path, *as_sent(), *faults))[0] == wanted[0]
