"""Maps of clocks: error against the truth, order, exactness, targets that are refused."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from mlbatch.arrays import I64Array
from mlbatch.clocks.align import TO_FIRST, ClockMap, fit
from mlbatch.clocks.watch import ClockWatch
from mlbatch.errors import ClockError
from tests.builders.clocks import (
    BEGIN_NS,
    NS_PER_MS,
    NS_PER_S,
    NS_PER_US,
    TAI_NS,
    TRUE,
    USUAL,
    Clock,
    Heard,
    Way,
    hear,
)

UPTIME = Clock(1000 * NS_PER_S - BEGIN_NS)
ETHERNET = Way(least_us=60, mean_us=150, bursts_hz=2)
EXACT = Way(least_us=100, mean_us=0, bursts_hz=0)


def heard(
    clock: Clock, way: Way = ETHERNET, host: Clock = TRUE, seconds: float = 60, seed: int = 5
) -> Heard:
    rng = np.random.default_rng(seed)
    return hear(rng, clock, seconds=seconds, rate_hz=300, way=way, host=host)


def watched(one: Heard) -> ClockWatch:
    watch = ClockWatch()
    watch.add(one.stamp_ns, one.host_ns)
    return watch


def fitted(one: Heard) -> ClockMap:
    (made,) = fit([watched(one)])
    assert made is not None
    return made


def error_ns(one: Heard, host: Clock = TRUE) -> I64Array:
    """Aligned stamps minus true times by the capture host's clock, as if that had never stepped."""
    aligned_ns = fitted(one).apply(one.stamp_ns, one.host_ns)
    assert (np.diff(aligned_ns) >= 0).all()
    return aligned_ns - replace(host, steps=()).read(one.true_ns)


@pytest.mark.parametrize("drift_ppm", [0, 1, -10, 50, -50])
@pytest.mark.parametrize("mean_us", [20, 200])
def test_drift_jitter_and_bursts(drift_ppm: float, mean_us: float) -> None:
    clock = replace(UPTIME, drift_ppm=drift_ppm)
    errors = error_ns(heard(clock, Way(60, mean_us, bursts_hz=4)))
    # The shortest way, 60 us, stays in; all else is found within some us.
    assert np.abs(errors - 60 * NS_PER_US).max() < 30 * NS_PER_US


@pytest.mark.parametrize("by_ms", [-500, -20, -3, 3, 20, 128, 2000])
def test_host_steps_are_removed(by_ms: int) -> None:
    host = Clock(drift_ppm=15, steps=((25, by_ms * NS_PER_MS), (40, -by_ms * NS_PER_MS)))
    errors = error_ns(heard(replace(UPTIME, drift_ppm=-30), host=host), host)
    assert np.abs(errors).max() < 150 * NS_PER_US


def test_drift_that_comes_and_goes() -> None:
    """3 ppm up and down in ten minutes, on top of 20 ppm."""
    clock = replace(UPTIME, drift_ppm=20, wander=(3, 600))
    one = hear(np.random.default_rng(2), clock, seconds=1200, rate_hz=100, way=ETHERNET)
    assert np.abs(error_ns(one)).max() < 150 * NS_PER_US
    made = fitted(one)
    assert made.knots == 119
    assert "119 knot(s)" in made.describe()


def test_stamps_are_mapped_exactly() -> None:
    """Days of ns since 1970 do not fit into a float64; an exact clock is recovered to the ns."""
    one = heard(Clock(TAI_NS + 123), EXACT)
    aligned_ns = fitted(one).apply(one.stamp_ns)
    np.testing.assert_array_equal(aligned_ns, one.true_ns + 100 * NS_PER_US)
    # Steps of 1 ns stay steps of 1 ns.
    fine_ns = one.stamp_ns[0] + np.arange(1000)
    assert (np.diff(fitted(one).apply(fine_ns)) == 1).all()


def test_stamps_between_and_beyond_those_seen_keep_their_order() -> None:
    rng = np.random.default_rng(0)
    one = heard(replace(UPTIME, drift_ppm=-45, steps=((20, 3 * NS_PER_S),)))
    low = int(one.stamp_ns.min())
    high = int(one.stamp_ns.max())
    stamp_ns = np.sort(rng.integers(low - 10 * NS_PER_S, high + 10 * NS_PER_S, 100_000))
    assert (np.diff(fitted(one).apply(stamp_ns)) >= 0).all()


def test_any_shape() -> None:
    one = heard(replace(UPTIME, steps=((20, -5 * NS_PER_S),)), seconds=40)
    made = fitted(one)
    columns = one.stamp_ns[:, None] + np.arange(4) * 100 * NS_PER_US
    aligned_ns = made.apply(columns, one.host_ns[:, None])
    np.testing.assert_array_equal(aligned_ns[:, 0], made.apply(one.stamp_ns, one.host_ns))
    assert aligned_ns.shape == columns.shape
    assert made.apply(columns[:0], one.host_ns[:0, None]).shape == (0, 4)


def test_damaged_stamps_stay_damaged() -> None:
    """High bits flipped, or u64 beyond int64: never mapped into the range of good stamps."""
    made = fitted(heard(Clock(TAI_NS)))
    stamp_ns = np.array([-1, -(2**63), 2**63 - 1, 2**62, 2**31 * NS_PER_S], np.int64)
    np.testing.assert_array_equal(made.apply(stamp_ns), stamp_ns)
    good_ns = np.append(stamp_ns, BEGIN_NS + TAI_NS)
    assert abs(int(made.apply(good_ns)[-1]) - BEGIN_NS) < NS_PER_MS


# -- onto the first sensor's clock ----------------------------------------------------------------


def test_onto_the_first_sensor() -> None:
    """Drift and steps of the capture host cancel; transport delays remain."""
    host = Clock(drift_ppm=18, steps=((22, 70 * NS_PER_MS), (41, -1200 * NS_PER_MS)))
    target = Clock(TAI_NS, drift_ppm=3)
    other = replace(UPTIME, drift_ppm=-40)
    first = heard(target, USUAL, host)
    second = heard(other, ETHERNET, host, seed=9)
    one, two = fit([watched(first), watched(second)], TO_FIRST)
    assert one is not None
    assert two is not None
    np.testing.assert_array_equal(one.apply(first.stamp_ns), first.stamp_ns)
    aligned_ns = two.apply(second.stamp_ns, second.host_ns)
    assert (np.diff(aligned_ns) >= 0).all()
    assert np.abs(aligned_ns - target.read(second.true_ns)).max() < 100 * NS_PER_US
    assert two.describe().startswith("aligned to the first sensor's clock: ")


def test_a_sensor_that_lasts_longer_than_the_first() -> None:
    first = heard(UPTIME, EXACT, seconds=10)
    second = heard(Clock(drift_ppm=20), EXACT)
    _, two = fit([watched(first), watched(second)], TO_FIRST)
    assert two is not None
    errors = two.apply(second.stamp_ns) - UPTIME.read(second.true_ns)
    assert np.abs(errors).max() < 100 * NS_PER_US


def test_a_target_must_run_without_jumps() -> None:
    jumping = watched(heard(replace(UPTIME, steps=((20, -5 * NS_PER_S),))))
    good = watched(heard(TRUE))
    with pytest.raises(ClockError, match=r"does not jump, found 1 jump\(s\); use --align-cl"):
        fit([jumping, good], TO_FIRST)
    with pytest.raises(ClockError, match="expected packets of the first sensor, found none"):
        fit([ClockWatch(), good], TO_FIRST)
    maps = fit([good, ClockWatch(), jumping], TO_FIRST)
    assert [one is None for one in maps] == [False, True, False]


def _measured(packets: int) -> tuple[int, ClockMap | None]:
    """Peak memory of a watch and its map, with a hundredth of the timestamps damaged; the map."""
    rng = np.random.default_rng(1)
    watch = ClockWatch()
    tracemalloc.start()
    try:
        for begin in range(0, packets, 1000):
            true_ns = BEGIN_NS + (begin + np.arange(1000)) * 400 * NS_PER_US
            stamp_ns = np.where(rng.random(1000) < 0.01, rng.integers(0, 2**62, 1000), true_ns)
            watch.add(stamp_ns, true_ns + rng.integers(NS_PER_US, NS_PER_MS, 1000))
        [found] = fit([watch])
        return tracemalloc.get_traced_memory()[1], found
    finally:
        tracemalloc.stop()


def test_memory_of_a_map_does_not_grow_with_the_packets() -> None:
    few_bytes, few = _measured(60_000)
    many_bytes, many = _measured(1_010_000)
    assert many_bytes - few_bytes < 3_000_000
    assert few is not None
    assert many is not None
    # One knot every 10 s of 24 and 404 s.
    assert (few.knots, many.knots) == (2, 40)
