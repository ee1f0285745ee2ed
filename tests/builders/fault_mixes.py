"""Random mixes of the faults that packets of one lidar have on their way."""

from __future__ import annotations

import random

import numpy as np

from mlbatch.arrays import I64Array
from tests.matrix.lidars import NS_PER_MS, Sent

KINDS = ("duplicate", "late", "jitter", "loss", "burst")
SHARES = (0.02, 0.1, 0.3, 0.5, 0.7, 1.0)


def mixed(sent: Sent, rng: random.Random) -> Sent:
    """Packets of one lidar with one to four kinds of faults, in order of the new receive times."""
    host_ns = sent.host_ns.copy()
    rows = np.arange(len(host_ns))
    draws = np.random.default_rng(rng.randrange(2**32))
    gap_ns = int(np.median(np.diff(host_ns)))
    for kind in rng.sample(KINDS, rng.randint(1, 4)):
        share = rng.choice(SHARES)
        hit = np.flatnonzero(draws.random(len(host_ns)) < share)
        if kind == "duplicate":
            late_ns = _delays(rng, draws, len(hit), (0, gap_ns // 3, 3 * gap_ns, *_LONG_NS))
            rows = np.concatenate([rows, rows[hit]])
            host_ns = np.concatenate([host_ns, host_ns[hit] + late_ns])
        elif kind == "late":
            host_ns[hit] += _delays(rng, draws, len(hit), (gap_ns, 5 * gap_ns, *_LONG_NS))
        elif kind == "jitter":
            most_ns = rng.choice([gap_ns // 2, 3 * gap_ns, 20 * gap_ns, 100 * NS_PER_MS])
            host_ns = host_ns + draws.integers(0, most_ns + 1, len(host_ns))
        elif kind == "loss":
            stays = draws.random(len(host_ns)) >= min(share, 0.6)
            rows = rows[stays]
            host_ns = host_ns[stays]
        else:
            host_ns = _in_bursts(host_ns, rng.choice([20, 200, 1500]) * NS_PER_MS, share, draws)
    order = np.argsort(host_ns, kind="stable")
    faulty = sent.where(rows[order])
    faulty.host_ns[:] = host_ns[order]
    return faulty


_LONG_NS = tuple(ms * NS_PER_MS for ms in (20, 300, 900, 1100, 2500))


def _delays(
    rng: random.Random, draws: np.random.Generator, count: int, choices: tuple[int, ...]
) -> I64Array:
    """Delays of packets: all alike, or each its own up to the longest."""
    most_ns = rng.choice(choices)
    if rng.random() < 0.5:
        return np.full(count, most_ns)
    return draws.integers(0, most_ns + 1, count)


def _in_bursts(
    host_ns: I64Array, period_ns: int, share: float, draws: np.random.Generator
) -> I64Array:
    """Receive times where some periods are delivered whole, at their ends."""
    period = host_ns // period_ns
    number = period - period.min()
    is_burst = draws.random(int(number.max(initial=0)) + 1) < share
    return np.where(is_burst[number], (period + 1) * period_ns, host_ns)
