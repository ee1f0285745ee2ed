"""The laws of batching: equal to the reference, for every grouping and order between sensors."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest

from mlbatch.errors import ClockError
from tests.builders.fast import run_fast
from tests.builders.feeds import groups, interleavings, random_feed
from tests.reference.batching import FeedPacket, Outcome, Settings, reference_scans

SEEDS_A_BLOCK = 250
BLOCKS = range(8)
INTERLEAVED_BLOCKS = range(100, 104)


def by_reference(feed: list[FeedPacket], options: Settings) -> Outcome | None:
    """Outcome of the reference; None for clocks that cannot be used."""
    try:
        return reference_scans(feed, options)
    except ClockError:
        return None


def by_fast(feed: list[FeedPacket], options: Settings, sizes: list[int]) -> Outcome | None:
    """Outcome of the fast batcher for batches of these sizes."""
    try:
        return run_fast(feed, options, sizes)
    except ClockError:
        return None


def differences(expected: Outcome | None, found: Outcome | None) -> list[str]:
    """Names and values of all fields in which two outcomes differ; for windows the first pair."""
    if expected is None or found is None:
        same = expected is found
        return [] if same else [f"clock error: expected {expected is None}, found {found is None}"]
    different = []
    for name in Outcome.__slots__:
        one = getattr(expected, name)
        two = getattr(found, name)
        if one == two:
            continue
        if name == "windows":
            pairs = [pair for pair in zip(one, two, strict=False) if pair[0] != pair[1]]
            one, two = pairs[0] if pairs else (len(one), len(two))
        different.append(f"{name}: expected {one}, found {two}")
    return different


def without_receive_times(outcome: Outcome | None) -> Outcome | None:
    """The outcome without fields that depend on the order between sensors."""
    if outcome is None:
        return None
    windows = [replace(window, ready_host_ns=0) for window in outcome.windows]
    return replace(outcome, windows=windows)


@pytest.mark.parametrize("block", BLOCKS)
def test_fast_batcher_equals_the_reference(block: int) -> None:
    for seed in range(block * SEEDS_A_BLOCK, (block + 1) * SEEDS_A_BLOCK):
        feed, options = random_feed(seed)
        sizes = groups(random.Random(seed), len(feed))
        expected = by_reference(feed, options)
        found = differences(expected, by_fast(feed, options, sizes))
        assert not found, f"random_feed({seed}), {options}, groups {sizes}: {found}"


@pytest.mark.parametrize("block", INTERLEAVED_BLOCKS)
def test_order_between_sensors_does_not_matter(block: int) -> None:
    compared = 0
    for seed in range(block * SEEDS_A_BLOCK, (block + 1) * SEEDS_A_BLOCK):
        case = random_feed(seed)
        options = case[1]
        rng = random.Random(seed)
        if options.sensors == 1:
            continue
        expected = without_receive_times(by_reference(*case))
        for feed in interleavings(case, rng, count=2):
            compared += 1
            for outcome in (
                by_reference(feed, options),
                by_fast(feed, options, groups(rng, len(feed))),
            ):
                found = differences(expected, without_receive_times(outcome))
                assert not found, f"random_feed({seed}), interleaved: {found}"
    # Too many stalls in the feeds would leave the law untested.
    assert compared > SEEDS_A_BLOCK // 4


def test_feeds_show_every_reason_and_every_kind_of_window() -> None:
    reasons: set[str] = set()
    kinds: set[tuple[bool, bool]] = set()
    for seed in range(150):
        outcome = by_reference(*random_feed(seed))
        if outcome is None:
            reasons.add("clock")
            continue
        for counts in [*outcome.rejected, *outcome.dropped]:
            reasons.update(counts)
        kinds.update((window.complete, window.index < 0) for window in outcome.windows)
        reasons.update(["empty"] if outcome.empty else [])
    assert reasons == {
        *("before_start", "late", "tail", "head", "invalid", "outside_time"),
        *("bad_stamp", "duplicate", "clock", "empty"),
    }
    assert kinds >= {(True, False), (False, False), (False, True)}
