"""Clock estimates and maps of 600 simulated recordings whose truth is known.

Each has one to three sensors; domains, drift, jumps, transport delays and the capture host's clock
are drawn with a fixed seed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from mlbatch.clocks.align import ClockMap, fit
from mlbatch.clocks.compare import CORRECTABLE, SYNCHRONISED, Comparison, compare
from mlbatch.clocks.watch import ClockEstimate, ClockWatch
from tests.builders.clocks import (
    BEGIN_NS,
    GPS_1980_NS,
    GPS_NS,
    HOUR_NS,
    NS_PER_MS,
    NS_PER_S,
    NS_PER_US,
    TAI_NS,
    Clock,
    Heard,
    Way,
    hear,
)

RECORDINGS = 600
MINUTE_S = 60
DAY_NS = 24 * HOUR_NS


@dataclass(frozen=True, slots=True)
class Sensor:
    """A simulated sensor: its clock, what it counts by the truth, what was heard of it."""

    clock: Clock
    domain: str
    heard: Heard
    watch: ClockWatch
    estimate: ClockEstimate
    map: ClockMap


@dataclass(frozen=True, slots=True)
class Simulated:
    """A simulated recording; host: the capture host's clock."""

    seconds: float
    host: Clock
    sensors: tuple[Sensor, ...]
    comparison: Comparison

    @property
    def is_long(self) -> bool:
        """True if there must be a drift."""
        return self.seconds >= MINUTE_S

    def error_ns(self, sensor: Sensor) -> int:
        """Offset found, minus the true one at that time (modulo the hour that was left out)."""
        estimate = sensor.estimate
        heard = sensor.heard
        near = int(np.abs(heard.host_ns - estimate.at_host_ns).argmin())
        true_ns = heard.true_ns[near : near + 1]
        truth_ns = int((sensor.clock.error_ns(true_ns) - self.host.error_ns(true_ns))[0])
        error_ns = estimate.offset_ns - truth_ns
        if sensor.clock.past_hour:
            error_ns = (error_ns + HOUR_NS // 2) % HOUR_NS - HOUR_NS // 2
        return error_ns


def _clock(rng: np.random.Generator, domain: str) -> Clock:
    drift_ppm = float(rng.uniform(-50, 50))
    small_ns = int(rng.integers(-NS_PER_MS, NS_PER_MS))
    uptime_ns = int(rng.integers(30 * NS_PER_S, 30 * DAY_NS)) - BEGIN_NS
    away_ns = int(rng.integers(5 * NS_PER_S, HOUR_NS // 2 - 5 * NS_PER_S))
    offsets_ns = {
        "utc": small_ns,
        "tai": TAI_NS + small_ns,
        "gps": small_ns + (GPS_NS, GPS_1980_NS)[int(rng.integers(2))],
        "uptime": uptime_ns,
        "top_of_hour": away_ns * (1, -1)[int(rng.integers(2))],
        "wrong_year": -int(rng.integers(200, 4000)) * DAY_NS + int(rng.integers(DAY_NS)),
        "unknown": int(rng.integers(100, 10_000)) * NS_PER_S + small_ns,
    }
    # Clocks that follow a source drift with it: what is left is the capture host's own drift.
    follows = domain in ("utc", "tai", "gps")
    return Clock(
        offsets_ns[domain],
        0.0 if follows else drift_ppm,
        quantum_ns=int(rng.choice([1, 10, 1000])),
        past_hour=domain == "top_of_hour",
    )


DOMAINS = ("utc", "utc", "tai", "gps", "uptime", "uptime", "top_of_hour", "wrong_year", "unknown")


def _jumps(rng: np.random.Generator, clock: Clock, domain: str, seconds: float) -> Clock:
    """One clock in eight steps once, well before the capture host's."""
    if seconds < 10 or rng.random() > 0.125 or domain == "top_of_hour":
        return clock
    after_s = float(rng.uniform(0.25, 0.45) * seconds)
    sizes_ns = [5 * NS_PER_MS, -5 * NS_PER_MS, 37 * NS_PER_S, -37 * NS_PER_S, 123_456_789]
    by_ns = int(rng.choice(sizes_ns))
    return replace(clock, steps=((after_s, by_ns),))


def _simulate(seed: int) -> Simulated:
    rng = np.random.default_rng([20_240_501, seed])
    seconds = float(rng.choice([0.5, 2, 10, 30, 60, 60, 90]))
    number = int(rng.integers(1, 4))
    steps: tuple[tuple[float, int], ...] = ()
    if seconds >= 10 and rng.random() < 0.2:
        size_ns = int(rng.choice([-500, -40, -5, 5, 40, 500, 1500])) * NS_PER_MS
        steps = ((float(rng.uniform(0.55, 0.75) * seconds), size_ns),)
    host = Clock(int(rng.integers(-800, 800)) * NS_PER_MS, float(rng.uniform(-20, 20)), steps)
    same = rng.random() < 0.3
    domain = str(rng.choice(DOMAINS))
    shared = _clock(rng, domain)
    sensors = []
    watches = []
    heards = []
    for _ in range(number):
        clock = shared if same else _clock(rng, domain := str(rng.choice(DOMAINS)))
        clock = _jumps(rng, clock, domain, seconds)
        way = Way(
            least_us=float(rng.uniform(20, 200)),
            mean_us=float(rng.uniform(20, 200)),
            bursts_hz=float(rng.uniform(0, 2)),
            lost=float(rng.choice([0, 0, 0.01])),
        )
        heard = hear(
            rng, clock, seconds=seconds, rate_hz=float(rng.uniform(150, 250)), way=way, host=host
        )
        watch = ClockWatch(period_ns=HOUR_NS if clock.past_hour else 0)
        for piece in np.array_split(np.arange(len(heard.stamp_ns)), int(rng.integers(1, 5))):
            watch.add(heard.stamp_ns[piece], heard.host_ns[piece])
        sensors.append((clock, domain))
        watches.append(watch)
        heards.append(heard)
    estimates = [watch.estimate() for watch in watches]
    maps = fit(watches)
    known = [estimate for estimate in estimates if estimate is not None]
    comparison = compare([(f"s{at}", estimate) for at, estimate in enumerate(known)])
    return Simulated(
        seconds,
        host,
        tuple(
            Sensor(*sensor, heard, watch, estimate, one)
            for sensor, heard, watch, estimate, one in zip(
                sensors, heards, watches, known, maps, strict=True
            )
            if one is not None
        ),
        comparison,
    )


@pytest.fixture(scope="module")
def recordings() -> list[Simulated]:
    return [_simulate(seed) for seed in range(RECORDINGS)]


def _sensors(recordings: list[Simulated]) -> list[tuple[Simulated, Sensor]]:
    return [(one, sensor) for one in recordings for sensor in one.sensors]


def test_the_domain_is_right(recordings: list[Simulated]) -> None:
    """Of the longest segment; with a jump of 37 s (from UTC to TAI), that of any segment."""
    right = [
        sensor.domain in {segment.domain for segment in sensor.estimate.segments}
        if sensor.clock.steps
        else sensor.domain == sensor.estimate.domain
        for _, sensor in _sensors(recordings)
    ]
    assert len(right) > 1000
    assert np.mean(right) >= 0.99


def test_offsets_are_exact_to_the_second_and_within_a_millisecond(
    recordings: list[Simulated],
) -> None:
    for one, sensor in _sensors(recordings):
        error_ns = abs(one.error_ns(sensor))
        assert error_ns < NS_PER_MS
        assert error_ns < sensor.estimate.uncertainty_ns


def test_drift_is_within_one_ppm(recordings: list[Simulated]) -> None:
    pairs = [
        (sensor.estimate, sensor.clock.drift_ppm - one.host.drift_ppm)
        for one, sensor in _sensors(recordings)
        if one.is_long
    ]
    assert len(pairs) > 400
    missed = 0
    for estimate, truth_ppm in pairs:
        assert estimate.drift_ppm is not None
        assert estimate.drift_uncertainty_ppm is not None
        error_ppm = abs(estimate.drift_ppm - truth_ppm)
        assert error_ppm < 1
        missed += error_ppm > estimate.drift_uncertainty_ppm
    # The uncertainty is three standard errors.
    assert missed < 0.02 * len(pairs)


def test_never_synchronised_beyond_the_bound(recordings: list[Simulated]) -> None:
    """And clocks within the bound are."""
    verdicts: dict[tuple[bool, bool, str], int] = {}
    for one in recordings:
        comparison = one.comparison
        true_ns = np.unique(np.concatenate([sensor.heard.true_ns for sensor in one.sensors]))
        errors = np.stack([sensor.clock.error_ns(true_ns) for sensor in one.sensors])
        apart_ns = int((errors.max(axis=0) - errors.min(axis=0)).max())
        if comparison.verdict == SYNCHRONISED:
            assert comparison.bound_ns is not None
            assert apart_ns <= comparison.bound_ns
        agree = apart_ns <= 2 * NS_PER_MS and not any(s.clock.steps for s in one.sensors)
        key = len(one.sensors) > 1, agree, comparison.verdict
        verdicts[key] = verdicts.get(key, 0) + 1
    assert not verdicts.get((True, False, SYNCHRONISED))
    assert verdicts[True, True, SYNCHRONISED] > 50
    assert {key[2] for key in verdicts if key[0] and key[1]} == {SYNCHRONISED}


def test_corrections_bring_clocks_together(recordings: list[Simulated]) -> None:
    """The correction for the rig leaves at most the stated error."""
    checked = 0
    for one in recordings:
        comparison = one.comparison
        if comparison.verdict != CORRECTABLE:
            continue
        names = [name for name, _ in comparison.estimates]
        by_name = dict(zip(names, one.sensors, strict=True))
        reference = by_name[comparison.reference]
        for correction in comparison.corrections:
            sensor = by_name[correction.sensor]
            for at in (0, -1):
                true_ns = sensor.heard.true_ns[at : (at + 1) or None]
                stamp_ns = int(sensor.clock.error_ns(true_ns)[0]) + correction.offset_ns
                left_ns = stamp_ns - int(reference.clock.error_ns(true_ns)[0])
                if sensor.clock.past_hour or reference.clock.past_hour:
                    left_ns = (left_ns + HOUR_NS // 2) % HOUR_NS - HOUR_NS // 2
                assert abs(left_ns) <= correction.error_ns
                checked += 1
    assert checked > 400


def test_jumps_are_found_and_separated_from_host_steps(recordings: list[Simulated]) -> None:
    """Where a packet was lost right at a step, only the other sensors show whose step it was."""
    wrong = 0
    steps = 0
    for one in recordings:
        for (_, estimate), sensor in zip(one.comparison.estimates, one.sensors, strict=True):
            truth = sorted(by_ns for _, by_ns in (*sensor.clock.steps, *_seen(one.host)))
            sizes = sorted(jump.size_ns for jump in estimate.jumps)
            assert len(sizes) == len(truth)
            assert np.abs(np.subtract(sizes, truth)).max(initial=0) < NS_PER_MS // 4
            steps += len(truth)
            wrong += len(estimate.sensor_jumps) != len(sensor.clock.steps)
            for jump in estimate.jumps:
                since_s = (jump.host_ns - BEGIN_NS) / NS_PER_S
                after_s = [after_s for after_s, _ in (*sensor.clock.steps, *one.host.steps)]
                assert np.abs(np.subtract(after_s, since_s)).min() < 4
    assert steps > 150
    assert wrong <= 0.01 * steps


def _seen(host: Clock) -> list[tuple[float, int]]:
    """Steps of the capture host's clock as those of the sensors' clocks against it."""
    return [(after_s, -by_ns) for after_s, by_ns in host.steps]


def test_aligned_stamps_are_right_within_half_a_millisecond(recordings: list[Simulated]) -> None:
    """By the capture host's clock as it was at first: its steps are not in the stamps."""
    errors_ns = []
    for one, sensor in _sensors(recordings):
        heard = sensor.heard
        aligned_ns = sensor.map.apply(heard.stamp_ns, heard.host_ns)
        assert (np.diff(aligned_ns) >= 0).all()
        steady = Clock(one.host.offset_ns, one.host.drift_ppm)
        errors_ns.append(int(np.abs(aligned_ns - steady.read(heard.true_ns)).max()))
    assert np.mean(np.array(errors_ns) < NS_PER_MS // 2) > 0.998
    assert np.quantile(errors_ns, 0.99) < 250 * NS_PER_US
