"""Simulated clocks of sensors and capture hosts: timestamps and receive times of known errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import F64Array, I64Array

NS_PER_S = 10**9
NS_PER_MS = 10**6
NS_PER_US = 10**3
HOUR_NS = 3600 * NS_PER_S
# 2024-05-01 12:34:56 UTC; TAI - UTC was 37 s, GPS - UTC 18 s.
BEGIN_NS = 1_714_566_896 * NS_PER_S
TAI_NS = 37 * NS_PER_S
GPS_NS = 18 * NS_PER_S
GPS_1980_NS = (18 - 315_964_800) * NS_PER_S


@dataclass(frozen=True, slots=True)
class Clock:
    """A clock: true time (UTC) + offset + drift since the begin + steps (after s, by ns).

    wander: (ppm, period s) of a drift that comes and goes, with the temperature; quantum_ns: its
    stamps are multiples of that; wrap_ns: it counts on from 0 there, 0: never; past_hour: its
    stamps leave out the hour, which the decoder takes from the first receive time.
    """

    offset_ns: int = 0
    drift_ppm: float = 0.0
    steps: tuple[tuple[float, int], ...] = ()
    wander: tuple[float, float] = (0.0, 1.0)
    quantum_ns: int = 1
    wrap_ns: int = 0
    past_hour: bool = False

    def error_ns(self, true_ns: I64Array) -> I64Array:
        """What it shows more than the true time."""
        since_ns = true_ns - BEGIN_NS
        drifted_ns = since_ns * (self.drift_ppm * 1e-6)
        ppm, period_s = self.wander
        if ppm:
            angular_ns = period_s * NS_PER_S / (2 * np.pi)
            drifted_ns += ppm * 1e-6 * angular_ns * (1 - np.cos(since_ns / angular_ns))
        error: I64Array = np.rint(drifted_ns).astype(np.int64)
        error += self.offset_ns
        for after_s, by_ns in self.steps:
            error += np.where(since_ns >= after_s * NS_PER_S, by_ns, 0)
        return error

    def read(self, true_ns: I64Array) -> I64Array:
        """What it shows at true times."""
        shown = (true_ns + self.error_ns(true_ns)) // self.quantum_ns * self.quantum_ns
        return shown % self.wrap_ns if self.wrap_ns else shown


@dataclass(frozen=True, slots=True)
class Way:
    """From a sensor to the capture host: shortest delay, mean of the exponential rest, bursts.

    bursts_hz: how often a queue delays all packets by up to `burst_ms`; lost: share of packets;
    pauses: (after s, for s) in which the capture host receives nothing.
    """

    least_us: float = 60.0
    mean_us: float = 80.0
    bursts_hz: float = 1.0
    burst_ms: float = 20.0
    lost: float = 0.0
    pauses: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, slots=True)
class Heard:
    """Packets of one sensor in order of receive time: true, stamp and receive times; ns, (P,)."""

    true_ns: I64Array
    stamp_ns: I64Array
    host_ns: I64Array


TRUE = Clock()
USUAL = Way()


def hear(
    rng: np.random.Generator,
    clock: Clock,
    *,
    seconds: float,
    rate_hz: float,
    way: Way = USUAL,
    host: Clock = TRUE,
    begin_s: float = 0.0,
    silent: tuple[tuple[float, float], ...] = (),
) -> Heard:
    """A sensor that sends at a steady rate, and what a capture host hears of it.

    silent: (from s, to s) in which it sends nothing.
    """
    count = max(int(seconds * rate_hz), 1)
    period_ns = NS_PER_S / rate_hz
    true_ns = BEGIN_NS + np.rint(begin_s * NS_PER_S + np.arange(count) * period_ns).astype(np.int64)
    since_s = (true_ns - BEGIN_NS) / NS_PER_S
    kept = rng.random(count) >= way.lost
    for from_s, to_s in silent:
        kept &= (since_s < from_s) | (since_s >= to_s)
    true_ns = true_ns[kept]
    since_s = since_s[kept]
    true_receive_ns = true_ns + np.rint(_way_ns(rng, way, since_s)).astype(np.int64)
    host_ns = host.read(np.maximum.accumulate(true_receive_ns))
    stamp_ns = clock.read(true_ns)
    if clock.past_hour:
        stamp_ns = _hours_from_receive_time(stamp_ns % HOUR_NS, host_ns)
    return Heard(true_ns, stamp_ns, host_ns)


def _way_ns(rng: np.random.Generator, way: Way, since_s: F64Array) -> F64Array:
    """How long each packet takes; nothing overtakes, and what was held back comes at once."""
    delay_ns = way.least_us * NS_PER_US + rng.exponential(way.mean_us * NS_PER_US, len(since_s))
    first_s = float(since_s[0])
    last_s = float(since_s[-1])
    number = rng.poisson(way.bursts_hz * (last_s - first_s))
    delays = [
        (float(begin), float(length))
        for begin, length in zip(
            rng.uniform(first_s, last_s, number),
            rng.uniform(0, way.burst_ms / 1000, number),
            strict=True,
        )
    ]
    for begin_s, length_s in (*delays, *way.pauses):
        held = slice(*np.searchsorted(since_s, [begin_s, begin_s + length_s]).tolist())
        rest_ns = (begin_s + length_s - since_s[held]) * NS_PER_S
        delay_ns[held] = np.maximum(delay_ns[held], rest_ns + way.least_us * NS_PER_US)
    return delay_ns


def _hours_from_receive_time(past_hour_ns: I64Array, host_ns: I64Array) -> I64Array:
    """Stamps whose hour is guessed once, from the first receive time, and kept."""
    first_ns = int(past_hour_ns[0]) - int(host_ns[0])
    offset_ns = (first_ns + HOUR_NS // 2) % HOUR_NS - HOUR_NS // 2
    near_ns = host_ns + offset_ns
    return past_hour_ns + (near_ns - past_hour_ns + HOUR_NS // 2) // HOUR_NS * HOUR_NS
