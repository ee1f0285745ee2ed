"""Comparisons of clocks: verdicts, corrections and their texts, worked by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from mlbatch.clocks.compare import (
    CORRECTABLE,
    SYNCHRONISED,
    UNSYNCHRONISED,
    Comparison,
    compare,
    refuse_incomparable,
)
from mlbatch.clocks.watch import ClockWatch, Jump
from mlbatch.errors import ClockError
from tests.builders.clocks import (
    BEGIN_NS,
    GPS_NS,
    HOUR_NS,
    NS_PER_MS,
    NS_PER_S,
    TAI_NS,
    TRUE,
    Clock,
    Way,
    hear,
)

WAY = Way(least_us=100, mean_us=50)
UPTIME = Clock(1000 * NS_PER_S - BEGIN_NS)
NAMES = ("a", "b", "c")


def compared(
    *clocks: Clock,
    seconds: float = 30,
    host: Clock = TRUE,
    ways: Sequence[Way] = (WAY, WAY, WAY),
    begins_s: Sequence[float] = (0, 0, 0),
    rate_hz: float = 200,
) -> Comparison:
    estimates = []
    for number, clock in enumerate(clocks):
        one = hear(
            np.random.default_rng(number),
            clock,
            seconds=seconds,
            rate_hz=rate_hz,
            way=ways[number],
            host=host,
            begin_s=begins_s[number],
        )
        watch = ClockWatch(period_ns=HOUR_NS if clock.past_hour else 0)
        watch.add(one.stamp_ns, one.host_ns)
        estimate = watch.estimate()
        assert estimate is not None
        estimates.append((NAMES[number], estimate))
    return compare(estimates)


def test_synchronised_sensors() -> None:
    comparison = compared(TRUE, Clock(2 * NS_PER_MS), TRUE)
    assert comparison.verdict == SYNCHRONISED
    # 2 ms, and for both 1 ms of the way and 20 ms of a burst, 1500 times less.
    assert comparison.bound_ns == pytest.approx(4.03 * NS_PER_MS, rel=0.02)
    assert comparison.corrections == ()
    pairs = [(pair.one, pair.two) for pair in comparison.pairs]
    assert pairs == [("a", "b"), ("a", "c"), ("b", "c")]
    assert comparison.describe()[0].startswith("clocks: synchronised within 4.0")


@pytest.mark.parametrize(
    ("clocks", "text", "whole"),
    [
        ((TRUE, Clock(TAI_NS)), "clock: {epoch: tai}", "37 s: TAI - UTC"),
        ((TRUE, Clock(GPS_NS)), "clock: {epoch: gps}", "18 s: GPS - UTC"),
        ((Clock(TAI_NS), Clock(GPS_NS)), "clock: {offset_s: 19}", "19 s: TAI - GPS"),
        ((TRUE, Clock(8 * HOUR_NS)), "clock: {offset_s: -28800}", "8 whole hour(s)"),
        ((TRUE, Clock(-3 * 24 * HOUR_NS)), "clock: {offset_s: 259200}", "3 whole day(s)"),
        ((TRUE, Clock(-5 * NS_PER_S)), "clock: {offset_s: 5}", "5 whole second(s)"),
    ],
)
def test_whole_differences_are_named(clocks: tuple[Clock, Clock], text: str, whole: str) -> None:
    comparison = compared(*clocks)
    assert comparison.verdict == CORRECTABLE
    (correction,) = comparison.corrections
    assert (correction.sensor, correction.reference) == ("b", "a")
    assert correction.rig_text() == text
    (pair,) = comparison.pairs
    assert pair.whole.startswith(whole)
    assert f"b: correctable: {whole}" in comparison.describe()[-1]
    assert comparison.bound_ns is not None
    assert comparison.bound_ns < 5 * NS_PER_MS


def test_corrections_refer_to_the_sensor_on_utc() -> None:
    comparison = compared(Clock(TAI_NS), TRUE, Clock(-368 * NS_PER_MS))
    assert comparison.reference == "b"
    texts = {one.sensor: one.rig_text() for one in comparison.corrections}
    assert texts["a"] == "clock: {epoch: tai}"
    assert float(texts["c"].removeprefix("clock: {offset_s: ").removesuffix("}")) == (
        pytest.approx(0.368, abs=50e-6)
    )


def test_a_constant_offset_is_measured() -> None:
    """Two sensors that count from power-on: 4923.19 s apart, as in ouster/two-sensors."""
    comparison = compared(UPTIME, replace(UPTIME, offset_ns=UPTIME.offset_ns + 4_923_190_253_000))
    assert comparison.verdict == CORRECTABLE
    (correction,) = comparison.corrections
    assert correction.offset_ns == pytest.approx(-4_923_190_253_000, abs=50_000)
    assert correction.epoch == ""


def test_clocks_that_run_apart_are_never_synchronised() -> None:
    """20 ppm: 0.6 ms in 30 s, which an offset may correct; 200 ppm over 120 s: 24 ms, not."""
    slowly = compared(TRUE, Clock(drift_ppm=20))
    assert slowly.verdict == CORRECTABLE
    apart_ppm = float(slowly.pairs[0].why.removesuffix(" ppm").split()[-1])
    assert apart_ppm == pytest.approx(20, abs=0.1)
    fast = compared(TRUE, Clock(drift_ppm=200), seconds=120, rate_hz=100)
    assert (fast.verdict, fast.bound_ns, fast.corrections) == (UNSYNCHRONISED, None, ())
    apart_ms = float(fast.pairs[0].why.removesuffix(" ms").split()[-1])
    assert fast.pairs[0].why.startswith("they run apart by ")
    assert apart_ms == pytest.approx(24, abs=0.05)


def test_clocks_that_jump_are_unsynchronised() -> None:
    comparison = compared(TRUE, Clock(steps=((12, 37 * NS_PER_S),)))
    assert comparison.verdict == UNSYNCHRONISED
    assert comparison.pairs[0].why == "b jumps"
    alone = compared(Clock(steps=((12, 37 * NS_PER_S),)))
    assert (alone.verdict, alone.pairs) == (UNSYNCHRONISED, ())


def test_one_sensor_has_nothing_to_be_compared_with() -> None:
    comparison = compared(UPTIME)
    assert (comparison.verdict, comparison.pairs, comparison.bound_ns) == (SYNCHRONISED, (), 0)
    assert len(comparison.describe()) == 1
    assert compare([]).describe() == []


def _host_steps(comparison: Comparison) -> list[Jump]:
    return [jump for jump in comparison.estimates[0][1].jumps if jump.kind == "host"]


@pytest.mark.parametrize("by_ms", [-1500, -40, 40, 1500])
def test_a_host_step_changes_no_verdict(by_ms: int) -> None:
    comparison = compared(TRUE, TRUE, host=Clock(steps=((14.2, by_ms * NS_PER_MS),)))
    assert comparison.verdict == SYNCHRONISED
    (step,) = _host_steps(comparison)
    assert step.size_ns == pytest.approx(-by_ms * NS_PER_MS, abs=20_000)
    assert comparison.bound_ns is not None
    assert comparison.bound_ns < 3 * NS_PER_MS


def test_a_time_master_that_steps_is_no_host_step() -> None:
    """All sensors jump together, but it is their stamps that do."""
    clock = Clock(steps=((14.2, 50 * NS_PER_MS),))
    comparison = compared(clock, clock)
    assert _host_steps(comparison) == []
    assert comparison.verdict == UNSYNCHRONISED


def test_a_longer_transport_delay_of_one_sensor_is_no_host_step() -> None:
    """Nor is their delay before known."""
    late = replace(WAY, pauses=())
    one = hear(np.random.default_rng(1), TRUE, seconds=30, rate_hz=200, way=late)
    delayed_ns = one.host_ns + np.where(one.true_ns > BEGIN_NS + 15 * NS_PER_S, 60 * NS_PER_MS, 0)
    estimates = []
    for name, host_ns in (("a", one.host_ns), ("b", delayed_ns)):
        watch = ClockWatch()
        watch.add(one.stamp_ns, host_ns)
        estimate = watch.estimate()
        assert estimate is not None
        estimates.append((name, estimate))
    comparison = compare(estimates)
    assert _host_steps(comparison) == []
    (jump,) = comparison.estimates[1][1].jumps
    assert jump.kind == "delay"
    assert jump.describe().startswith("the transport delay became 60.000 ms longer at 1714566911.0")
    assert comparison.verdict == UNSYNCHRONISED
    assert comparison.pairs[0].why == "their difference changes by +60.000 ms"


def test_too_few_packets_give_no_verdict() -> None:
    """A packet each: either may have been held back by 20 ms."""
    near = compared(TRUE, TRUE, seconds=0.005)
    assert near.verdict == UNSYNCHRONISED
    assert near.pairs[0].why.startswith("too few packets")
    far = compared(UPTIME, replace(UPTIME, offset_ns=0), seconds=0.005)
    assert far.pairs[0].why.startswith("apart, and too few packets")


def test_sensors_that_were_never_seen_together() -> None:
    """The bound includes the drift of the capture host's clock in the 30 s between them."""
    comparison = compared(TRUE, TRUE, begins_s=(0, 60))
    assert comparison.verdict == SYNCHRONISED
    # 30 s at 100 ppm.
    assert comparison.pairs[0].uncertainty_ns > 3 * NS_PER_MS


@pytest.mark.parametrize(
    ("apart_s", "shown"),
    [(37, "37.000 s (37 s: TAI - UTC): "), (40, "40.000 s: "), (7.3, "7.300 s: ")],
)
def test_a_known_difference_is_named_in_the_refusal(apart_s: float, shown: str) -> None:
    offsets_ns = [("a", 5), ("b", None), ("c", round(apart_s * NS_PER_S) + 5)]
    with pytest.raises(ClockError) as caught:
        refuse_incomparable(offsets_ns, 0)
    assert f"found {shown}stamp minus" in str(caught.value)
    refuse_incomparable([*offsets_ns[:2], ("c", NS_PER_S + 5)], 0)
