"""Estimates of single clocks, with values worked by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mlbatch.clocks.watch import ClockEstimate, ClockWatch, segment_of
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

# Every packet arrives exactly 0.1 ms after its stamp.
EXACT = Way(least_us=100, mean_us=0, bursts_hz=0)
DAY_NS = 24 * HOUR_NS
TRUE = Clock()
UPTIME = Clock(1000 * NS_PER_S - BEGIN_NS)


def heard(
    clock: Clock = TRUE,
    way: Way = EXACT,
    *,
    seconds: float = 20,
    host: Clock = TRUE,
    silent: tuple[tuple[float, float], ...] = (),
) -> Heard:
    return hear(
        np.random.default_rng(7),
        clock,
        seconds=seconds,
        rate_hz=200,
        way=way,
        host=host,
        silent=silent,
    )


def found(one: Heard, period_ns: int = 0) -> ClockEstimate:
    watch = ClockWatch(period_ns=period_ns)
    watch.add(one.stamp_ns, one.host_ns)
    estimate = watch.estimate()
    assert estimate is not None
    return estimate


def test_an_exact_clock() -> None:
    estimate = found(heard())
    assert (estimate.domain, estimate.packets, estimate.damaged) == ("utc", 4000, 0)
    assert estimate.offset_ns == -100 * NS_PER_US
    # 1 ms for the way; 20 ms of a burst, less for the 1000 times as long that was seen.
    assert estimate.uncertainty_ns == pytest.approx(1_020_000, abs=100)
    assert estimate.drift_ppm == pytest.approx(0, abs=1e-6)
    assert estimate.jumps == ()
    assert estimate.describe() == (
        "clock: UTC, -0.100 ms to the capture host (+-1.020 ms), drift +0.00 +-0.00 ppm"
    )


@pytest.mark.parametrize(
    ("clock", "domain"),
    [
        (Clock(900 * NS_PER_MS), "utc"),
        (Clock(TAI_NS), "tai"),
        (Clock(GPS_NS), "gps"),
        (Clock(GPS_1980_NS), "gps"),
        (UPTIME, "uptime"),
        # Three years without a break are none of a lidar: 1980 and 1999.
        (Clock(10 * 365 * DAY_NS - BEGIN_NS), "wrong_year"),
        (Clock(29 * 365 * DAY_NS - BEGIN_NS), "wrong_year"),
        (Clock(-5 * 365 * DAY_NS), "wrong_year"),
        (Clock(200 * DAY_NS), "wrong_year"),
        # A time master that is off, as in ouster/os2-128_duplicate-ip-id; a clock on local time.
        (Clock(540_790 * NS_PER_MS), "unknown"),
        (Clock(8 * HOUR_NS), "unknown"),
    ],
)
def test_domains_follow_from_values(clock: Clock, domain: str) -> None:
    assert found(heard(clock, seconds=2)).domain == domain


def test_a_counter_past_the_hour() -> None:
    """The decoder completes stamps from receive times: only a small offset means UTC."""
    away = found(heard(Clock(-1531 * NS_PER_S, past_hour=True)), HOUR_NS)
    assert (away.domain, away.offset_ns) == ("top_of_hour", -1531 * NS_PER_S - 100 * NS_PER_US)
    near = found(heard(Clock(-300 * NS_PER_MS, past_hour=True)), HOUR_NS)
    assert (near.domain, near.offset_ns) == ("utc", -300_100_000)


def test_local_time_is_named() -> None:
    assert "about 8 whole hour(s): a time zone" in found(heard(Clock(8 * HOUR_NS))).describe()
    assert "about 37 s" not in found(heard(Clock(36 * NS_PER_S))).describe()


def test_tai_before_2017_had_another_offset() -> None:
    """In 2016 TAI - UTC was 36 s, and 37 s ahead is no TAI."""
    one = heard(seconds=2)
    back_ns = 8 * 365 * DAY_NS
    for ahead_s, domain in ((36, "tai"), (39, "unknown")):
        stamp_ns = one.stamp_ns - back_ns + ahead_s * NS_PER_S
        assert found(Heard(one.true_ns, stamp_ns, one.host_ns - back_ns)).domain == domain


def test_drift_with_bursts_and_lost_packets() -> None:
    way = Way(60, 150, bursts_hz=2, lost=0.05)
    estimate = found(heard(Clock(drift_ppm=-37.5), way, seconds=60))
    assert estimate.drift_ppm == pytest.approx(-37.5, abs=0.3)
    assert estimate.drift_uncertainty_ppm is not None
    assert estimate.drift_uncertainty_ppm < 1


def test_a_short_recording_gives_no_drift() -> None:
    estimate = found(heard(seconds=0.5))
    assert estimate.drift_ppm is None
    assert estimate.drift_uncertainty_ppm is None
    # 0.02 s of 0.495 s.
    assert estimate.uncertainty_ns == pytest.approx(1_000_000 + 20_000_000 * 0.02 / 0.495, rel=0.01)


def test_one_packet() -> None:
    one = heard(UPTIME, seconds=0.005)
    estimate = found(one)
    assert (estimate.packets, estimate.domain, estimate.damaged) == (1, "uptime", 0)
    assert estimate.uncertainty_ns == 21 * NS_PER_MS


def test_no_packet() -> None:
    assert ClockWatch().estimate() is None


def test_the_uncertainty_has_the_step_of_stamps() -> None:
    """Packets each 5 ms, stamps in whole us that differ by 4.999, 5.000 or 5.001 ms."""
    exact = found(heard(Clock(drift_ppm=30), seconds=60))
    coarse = found(heard(Clock(quantum_ns=NS_PER_US, drift_ppm=30), seconds=60))
    assert coarse.uncertainty_ns - exact.uncertainty_ns >= NS_PER_US


# -- jumps ----------------------------------------------------------------------------------------


def jumps(one: Heard, period_ns: int = 0) -> list[tuple[str, float]]:
    """Kinds and sizes in s."""
    estimate = found(one, period_ns)
    return [(jump.kind, round(jump.size_ns / NS_PER_S, 6)) for jump in estimate.jumps]


def test_ptp_lock_gained() -> None:
    """From power-on to TAI after 5 s: both domains, and the packets around the jump."""
    by_ns = TAI_NS - UPTIME.offset_ns
    estimate = found(heard(replace(UPTIME, steps=((5, by_ns),))))
    assert [one.domain for one in estimate.segments] == ["uptime", "tai"]
    assert estimate.domain == "tai"
    (jump,) = estimate.jumps
    assert (jump.kind, jump.size_ns) == ("forward", by_ns)
    # Packets each 5 ms; the first after the jump was sent at 5 s.
    assert jump.stamp_before_ns == 1004_995 * NS_PER_MS
    assert jump.stamp_after_ns == BEGIN_NS + 5 * NS_PER_S + TAI_NS
    assert jump.host_ns == BEGIN_NS + 5 * NS_PER_S + 100 * NS_PER_US
    assert "forward by +1714565933.000000 s: from 1004.995000 s to" in estimate.describe()


@pytest.mark.parametrize("by_ms", [37_000, -37_000, 1500, -1500, 250, -250, 5, -5, 2, -2])
def test_steps_forward_and_backward(by_ms: int) -> None:
    kind = "forward" if by_ms > 0 else "backward"
    assert jumps(heard(Clock(steps=((10, by_ms * NS_PER_MS),)))) == [(kind, by_ms / 1000)]


def test_a_restart() -> None:
    """After 1010 s of uptime it counts from 20 s, and was silent for 30 s."""
    clock = replace(UPTIME, steps=((10, -1020 * NS_PER_S),))
    assert jumps(heard(clock, silent=((10, 40),), seconds=60)) == [("restart", -1020.0)]


@pytest.mark.parametrize("wrap_s", [2**32 / 1e6, 3600])
def test_a_counter_wraps(wrap_s: float) -> None:
    wrap_ns = round(wrap_s * NS_PER_S)
    clock = Clock(wrap_ns - 10 * NS_PER_S - BEGIN_NS, wrap_ns=wrap_ns)
    assert jumps(heard(clock)) == [("wrap", -wrap_s)]


def test_an_hour_that_is_found_anew_is_a_wrap() -> None:
    clock = Clock(-100 * NS_PER_S, steps=((10, HOUR_NS),))
    assert jumps(heard(clock), HOUR_NS) == [("wrap", 3600.0)]


@pytest.mark.parametrize("by_ms", [1500, -1500, 40, -40, 3, -3])
def test_the_capture_host_steps(by_ms: int) -> None:
    """Receive times step, stamps do not: no jump of the sensor."""
    estimate = found(heard(host=Clock(steps=((10, by_ms * NS_PER_MS),))))
    assert [(jump.kind, jump.size_ns) for jump in estimate.jumps] == [("host", -by_ms * NS_PER_MS)]
    assert estimate.sensor_jumps == ()


def test_host_steps_as_text() -> None:
    estimate = found(heard(host=Clock(steps=((10, -40 * NS_PER_MS),))))
    # 1714566896 s, 10 s later, 0.1 ms on the way, set back by 40 ms.
    words = "; the capture host's clock stepped by -40.000 ms at 1714566905.960 s"
    assert estimate.describe().endswith(words)


def test_silence_is_no_jump() -> None:
    assert jumps(heard(silent=((3, 9), (12, 12.5)))) == []


def test_a_capture_host_that_pauses_is_no_jump() -> None:
    """All packets of 3 s come at once, then of 0.8 s."""
    one = heard(way=replace(EXACT, pauses=((4, 3), (12, 0.8))))
    assert jumps(one) == []
    assert [segment.packets for segment in found(one).segments] == [len(one.stamp_ns)]


def test_a_fast_change_of_rate_is_no_jump() -> None:
    """A servo that slews by 500 ppm for 10 s moves the clock by 5 ms."""
    one = heard(seconds=30)
    since_ns = one.true_ns - BEGIN_NS
    slewed_ns = np.clip(since_ns - 10 * NS_PER_S, 0, 10 * NS_PER_S) // 2000
    assert jumps(replace(one, stamp_ns=one.stamp_ns + slewed_ns)) == []


def test_damaged_stamps_are_no_jumps() -> None:
    """Flipped bits: far away, not far, and no time at all."""
    one = heard()
    stamp_ns = one.stamp_ns.copy()
    damage = {500: 1 << 40, 1001: 1 << 29, 1500: 1 << 62, 2222: 1 << 35, 3999: 1 << 45}
    for at, bit in damage.items():
        stamp_ns[at] ^= bit
    estimate = found(replace(one, stamp_ns=stamp_ns))
    assert estimate.jumps == ()
    assert estimate.offset_ns == -100 * NS_PER_US
    # 2^29 ns is half a second, as for a delayed packet.
    assert (estimate.packets, estimate.damaged) == (3996, 4)


def test_a_clock_that_jumps_without_end() -> None:
    """Stretches are kept up to a number; what comes then is only known to be bad."""
    at = np.arange(3000)
    stamp_ns = BEGIN_NS + at * NS_PER_MS + at // 10 % 2 * 100 * NS_PER_S
    estimate = found(Heard(at, stamp_ns, BEGIN_NS + at * NS_PER_MS))
    assert estimate.unsteady
    assert len(estimate.segments) == 64
    assert "more than 63 jumps" in estimate.describe()


# -- laws -----------------------------------------------------------------------------------------


CASES = {
    "restart": (replace(UPTIME, steps=((10, -1020 * NS_PER_S),)), Way(lost=0.02), Clock()),
    "small": (Clock(drift_ppm=20, steps=((10, 4 * NS_PER_MS),)), Way(), Clock()),
    "host": (Clock(), Way(pauses=((3, 2),)), Clock(steps=((10, -40 * NS_PER_MS),))),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("size", [1, 7, 1000])
def test_pieces_do_not_matter(case: str, size: int) -> None:
    clock, way, host = CASES[case]
    one = heard(clock, way, host=host)
    stamp_ns = one.stamp_ns.copy()
    stamp_ns[[700, 701, 1400]] += [10**12, 10**13, 10**12]
    whole = found(replace(one, stamp_ns=stamp_ns))
    watch = ClockWatch()
    for at in range(0, len(stamp_ns), size):
        watch.add(stamp_ns[at : at + size], one.host_ns[at : at + size])
    pieces = watch.estimate()
    assert pieces is not None
    assert _plain(pieces) == _plain(whole)


def _plain(estimate: ClockEstimate) -> str:
    """A estimate with all its digits."""
    with np.printoptions(floatmode="unique", threshold=10**6):
        return repr(estimate)


def test_an_estimate_changes_nothing() -> None:
    one = heard(CASES["small"][0], Way())
    watch = ClockWatch()
    for at in range(0, len(one.stamp_ns), 100):
        watch.add(one.stamp_ns[at : at + 100], one.host_ns[at : at + 100])
        watch.estimate()
    estimate = watch.estimate()
    assert estimate is not None
    assert _plain(estimate) == _plain(found(one))


def test_memory_does_not_grow_with_the_recording() -> None:
    """An hour at 500 packets a second: a tenth and the whole of it."""
    watch = ClockWatch()
    sizes = []
    step = np.arange(180_000) * 2 * NS_PER_MS
    for tenth in range(10):
        true_ns = BEGIN_NS + tenth * 360 * NS_PER_S + step
        watch.add(true_ns, true_ns + 70 * NS_PER_US)
        sizes.append(_rows(watch))
    assert max(sizes) <= 4096
    estimate = watch.estimate()
    assert estimate is not None
    assert (estimate.packets, estimate.offset_ns) == (1_800_000, -70 * NS_PER_US)


def _rows(watch: ClockWatch) -> int:
    track = watch.track()
    assert track is not None
    return sum(len(part.table.rows) for part in track.parts)


def test_which_stretch_a_packet_is_of() -> None:
    """Stamps of a clock that was set back 5 s repeat: receive times separate them."""
    one = heard(Clock(steps=((10, -5 * NS_PER_S),)))
    estimate = found(one)
    truth = (one.true_ns - BEGIN_NS >= 10 * NS_PER_S).astype(np.int64)
    np.testing.assert_array_equal(segment_of(estimate.segments, one.stamp_ns, one.host_ns), truth)
    early = heard(Clock(steps=((10, 5 * NS_PER_S),)))
    alone = segment_of(found(early).segments, early.stamp_ns)
    np.testing.assert_array_equal(alone, truth)
    columns = np.repeat(early.stamp_ns[:, None], 3, axis=1)
    both = segment_of(found(early).segments, columns, early.host_ns[:, None])
    np.testing.assert_array_equal(both, np.repeat(truth[:, None], 3, axis=1))
