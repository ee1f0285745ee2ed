"""Lost and reordered packets, by sequence numbers and by gaps in the stamps.

Numbers are worked by hand. Gaps are those of a rotor with a column every so many ns, none in dark
sectors, rounded to whole us and 0.01 degrees as by vendors: packets taken out are the lost ones.
"""

from __future__ import annotations

import tracemalloc
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest

from mlbatch.arrays import BoolArray, I64Array
from mlbatch.batching.loss import GapLoss, SequenceLoss
from mlbatch.types import ColumnHeaders
from tests.builders.decoded import rotor_words

# -- by sequence numbers --------------------------------------------------------------------------

# Frame ids of 16 bits, 64 packets a frame.
WRAP = 65536 * 64


def numbered(*batches: list[int], modulus: int = WRAP) -> tuple[int, int]:
    loss = SequenceLoss(modulus)
    for batch in batches:
        loss.add(np.array(batch, np.int64))
    return loss.lost, loss.reordered


LAST = WRAP - 1


@pytest.mark.parametrize(
    ("numbers", "lost", "reordered"),
    [
        ([], 0, 0),
        ([7], 0, 0),
        ([0, 1, 2, 3], 0, 0),
        # 3 and 4 are missing.
        ([0, 1, 2, 5, 6], 2, 0),
        # A packet that comes after a later one was not lost.
        ([0, 1, 3, 2, 4], 0, 1),
        ([0, 1, 4, 2, 3, 5], 0, 2),
        # 1 never comes, 2 comes late.
        ([0, 3, 2, 4], 1, 1),
        # Before the first of all nothing was known to be missing.
        ([5, 4, 6], 0, 1),
        # Every second packet of ten.
        (list(range(0, 20, 2)), 9, 0),
        # The frame id wraps; then LAST and 0 are missing; then LAST comes after 0.
        ([LAST - 1, LAST, 0, 1], 0, 0),
        ([LAST - 1, 1], 2, 0),
        ([LAST - 1, 0, LAST, 1], 0, 1),
        # One flipped frame id is a packet missing at its place, also the first of all.
        *(
            ([*range(100, 107), 107 ^ (1 << bit), *range(108, 120)], 1, 0)
            for bit in (16, 17, 19, 21)
        ),
        ([500_000 ^ (1 << 18), 500_001, 500_002, 500_004], 1, 0),
        # A long gap is counted once the next packet confirms it: 11 to 4999 never came.
        ([9, 10, 5000, 5001, 5002], 4989, 0),
        # Frame ids begin at 0 after a power cycle; loss across it is unknown.
        ([300_000, 300_001, 0, 1, 2], 0, 0),
        ([300_000, 300_001, 0, 1, 3], 1, 0),
        # Negative numbers are none.
        ([0, -5, 1, -900_000, 2], 0, 0),
        ([-1, -2], 0, 0),
    ],
)
def test_numbers_worked_by_hand(numbers: list[int], lost: int, reordered: int) -> None:
    assert numbered(numbers) == (lost, reordered)
    # Without a modulus no loss is known.
    assert numbered(numbers, modulus=0) == (0, 0)


# -- by gaps in the stamps ------------------------------------------------------------------------

MS = 10**6
S = 10**9
START_NS = 1_700_000_000 * S


@dataclass(frozen=True)
class Rotor:
    """A lidar: dark are sectors [from, to) in degrees; turns_per_s below 0: the other way."""

    columns: int = 12
    column_ns: float = 55_296.0
    turns_per_s: float = 10.0
    dark: tuple[tuple[float, float], ...] = ()

    @property
    def packet_ns(self) -> float:
        """Where no sector is dark."""
        return self.columns * self.column_ns


@dataclass(frozen=True)
class Sent:
    """Packets: stamps and angles of their columns (P, C), receive times (P,)."""

    stamp_ns: I64Array
    words: I64Array
    host_ns: I64Array

    def __len__(self) -> int:
        return len(self.host_ns)

    def take(self, index: I64Array | BoolArray | slice) -> Sent:
        """The packets at `index`."""
        return Sent(self.stamp_ns[index], self.words[index], self.host_ns[index])

    def shifted(self, first: int, by_ns: int) -> Sent:
        """From packet `first` on the sensor's clock is off."""
        late = np.arange(len(self)) >= first
        return replace(self, stamp_ns=self.stamp_ns + by_ns * late[:, None])


def sent(rotor: Rotor, packets: int) -> Sent:
    """The first packets of a lidar; each is received 0.3 ms after its last column."""
    needed = packets * rotor.columns
    # No test has more than four fifths of a revolution dark.
    number = np.arange(6 * needed if rotor.dark else needed)
    degrees = number * rotor.column_ns * (rotor.turns_per_s * 360e-9)
    lit = np.ones(len(number), bool)
    for begin, end in rotor.dark:
        lit &= (degrees - begin) % 360 >= (end - begin) % 360
    number = number[lit][:needed]
    degrees = degrees[lit][:needed]
    shape = packets, rotor.columns
    time_ns = np.rint(number * rotor.column_ns).astype(np.int64).reshape(shape)
    stamp_ns = START_NS + time_ns - time_ns[:, :1] % 1000
    words = rotor_words(np.rint(degrees * 100) / 36000, np.zeros(needed)).reshape(shape)
    return Sent(stamp_ns, words, stamp_ns[:, -1] + 300_000)


def counted(rotor: Rotor, came: Sent, cuts: tuple[int, ...] = ()) -> tuple[int, int]:
    """Lost and reordered packets, added in batches that end at `cuts`."""
    loss = GapLoss(rotor.packet_ns)
    for part in np.split(np.arange(len(came)), sorted(cuts)):
        one = came.take(part)
        loss.add(
            ColumnHeaders(one.stamp_ns, one.words, np.ones(one.words.shape, bool)), one.host_ns
        )
    return loss.lost, loss.reordered


def without(packets: int, share: float, seed: int) -> BoolArray:
    """Mask of packets received; always the first and the last, between which loss is counted."""
    came = np.random.default_rng(seed).random(packets) >= share
    came[[0, -1]] = True
    return came


def missing(came: BoolArray) -> int:
    """How many do not come."""
    return int(np.count_nonzero(~came))


FULL = Rotor()
HALF = Rotor(dark=((90.0, 270.0),))


@pytest.mark.parametrize(
    ("gone", "lost"),
    [
        *(((), 0), ((3,), 1), ((3, 4, 5), 3), ((3, 5, 7), 3), ((0, 1), 0), ((18, 19), 0)),
        # Two packets, one, none: by the nominal period.
        *(((1, *range(3, 20)), 1), (range(1, 20), 0), (range(20), 0)),
    ],
)
def test_twenty_packets_by_hand(gone: Sequence[int], lost: int) -> None:
    """Loss before the first and after the last packet cannot be known."""
    came = ~np.isin(np.arange(20), gone)
    assert counted(FULL, sent(FULL, 20).take(came)) == (lost, 0)


@pytest.mark.parametrize("times", [1, 2])
def test_a_loss_that_hits_the_same_sector_twice_is_no_dark_sector(times: int) -> None:
    """Twice in eighteen revolutions the same tenth of the revolution is lost."""
    packets = sent(FULL, 18 * 151)
    came = np.ones(len(packets), bool)
    for turn in (4, 11)[:times]:
        came[turn * 151 : turn * 151 + 15] = False
    assert counted(FULL, packets.take(came)) == (15 * times, 0)


def test_a_dark_sector_of_few_turns_is_found_by_gaps_within_packets() -> None:
    """A packet continues behind the sector: two revolutions are enough."""
    assert counted(HALF, sent(HALF, 150)) == (0, 0)


def test_the_period_is_estimated_from_the_packets() -> None:
    """A clock that runs 3 % fast, and an oscillator that drifts by 1 % in 13 s."""
    fast = replace(sent(HALF, 3000), host_ns=np.zeros(3000, np.int64))
    fast = replace(fast, stamp_ns=START_NS + (fast.stamp_ns - START_NS) * 103 // 100)
    came = without(3000, 0.1, 5)
    assert counted(HALF, fast.take(came)) == (missing(came), 0)
    packets = sent(FULL, 20_000)
    since_ns = packets.stamp_ns - START_NS
    gained_ns = since_ns * (since_ns // 1000) // (2 * 1_300_000_000)
    packets = replace(packets, stamp_ns=packets.stamp_ns + gained_ns)
    came = without(20_000, 0.1, 6)
    assert counted(FULL, packets.take(came)) == (missing(came), 0)


def test_steps_that_alternate_with_two_returns() -> None:
    """Three columns a packet, of two equal stamps each: steps of one and two rounds."""
    number = np.arange(3 * 4000) // 2
    stamp_ns = (START_NS + number * 55_550).reshape(-1, 3)
    turns = np.multiply(number, 55_550e-8, dtype=np.float64)
    words = rotor_words(turns, np.zeros(len(number))).reshape(-1, 3)
    packets = Sent(stamp_ns, words, stamp_ns[:, -1])
    rotor = Rotor(columns=3, column_ns=55_550.0)
    assert counted(rotor, packets) == (0, 0)
    came = without(4000, 0.1, 7)
    assert counted(rotor, packets.take(came)) == (missing(came), 0)


def test_packets_of_equal_stamps_are_one_step() -> None:
    """A sensor that sends each return in a packet of its own."""
    twice = sent(FULL, 500).take(np.arange(1000) // 2)
    assert counted(FULL, twice) == (0, 0)


def test_stamps_that_jitter() -> None:
    packets = sent(HALF, 3000)
    jitter_ns = np.random.default_rng(8).integers(-30_000, 30_000, (3000, 1))
    packets = replace(packets, stamp_ns=packets.stamp_ns + jitter_ns)
    assert counted(HALF, packets) == (0, 0)
    came = without(3000, 0.05, 9)
    assert counted(HALF, packets.take(came))[0] == missing(came)


def test_packets_that_come_out_of_order_are_not_lost() -> None:
    packets = sent(FULL, 8)
    assert counted(FULL, packets.take(np.array([0, 2, 1, 3, 6, 4, 5, 7]))) == (0, 3)
    # 4 never comes.
    assert counted(FULL, packets.take(np.array([0, 2, 1, 3, 6, 5, 7]))) == (1, 2)


def test_a_packet_may_come_one_and_a_half_seconds_late() -> None:
    """Later ones show a clock that was set."""
    half_ms = Rotor(columns=10, column_ns=50_000.0)
    packets = sent(half_ms, 3010)
    order = np.array([0, *range(2, 3002), 1, *range(3002, 3010)])
    assert counted(half_ms, packets.take(order)) == (0, 1)


# -- clocks ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("length_s", [0.3, 0.95, 1.05, 4.0])
def test_a_silence_is_loss_however_long(length_s: float) -> None:
    """As sequence numbers would count it, if the capture host's clock shows it too."""
    packets = sent(FULL, 12_000)
    silent = round(length_s * S / FULL.packet_ns)
    came = (np.arange(12_000) < 2000) | (np.arange(12_000) >= 2000 + silent)
    assert counted(FULL, packets.take(came)) == (silent, 0)


def test_a_clock_that_is_set_is_no_loss() -> None:
    """By more than a second at the sensor alone, or without a move of the rotor."""
    packets = sent(FULL, 3000)
    assert counted(FULL, packets.shifted(1500, 37 * S)) == (0, 0)
    assert counted(FULL, packets.shifted(1500, 350 * MS)) == (0, 0)


def test_a_clock_that_is_set_back_begins_anew() -> None:
    """With --clock host that is no error; loss across it is unknown."""
    packets = sent(FULL, 3000)
    came = np.ones(3000, bool)
    came[[100, 101, 2000]] = False
    back = packets.shifted(1500, -20 * S).take(came)
    assert counted(FULL, back) == (3, 0)
    assert counted(FULL, back, cuts=(1497, 1498, 1499)) == (3, 0)


# -- batches --------------------------------------------------------------------------------------


def test_chunks_of_long_recordings_do_not_depend_on_batches() -> None:
    rotor = Rotor(columns=5, column_ns=55_560.0, dark=((90.0, 200.0),))
    packets = sent(rotor, 160_000)
    came = np.flatnonzero(without(len(packets), 0.03, 11))
    swapped = came.copy()
    swapped[10::20], swapped[11::20] = came[11::20], came[10::20]
    lost = len(packets) - len(came), len(swapped[11::20])
    for size in (997, 40_000, len(packets)):
        cuts = tuple(range(size, len(came), size))
        assert counted(rotor, packets.take(swapped), cuts) == lost


def test_kept_packets_are_few_and_small() -> None:
    """At most three chunks of 16384 and a batch: stamps of 8 bytes, angles of 4, bins of 2."""
    packets = sent(FULL, 200_000)
    batch = 1000
    most = (3 * 16384 + 2 * batch) * (2 * 8 + 2 * 4 + 2 * FULL.columns)
    objects = 200_000
    # numpy imports modules at first use.
    assert counted(FULL, packets.take(np.arange(batch))) == (0, 0)
    loss = GapLoss(FULL.packet_ns)
    tracemalloc.start()
    try:
        for begin in range(0, len(packets), batch):
            one = packets.take(np.arange(begin, begin + batch))
            valid = np.ones(one.words.shape, bool)
            loss.add(ColumnHeaders(one.stamp_ns, one.words, valid), one.host_ns)
            del one, valid
            kept, _ = tracemalloc.get_traced_memory()
            assert kept <= most + objects
    finally:
        tracemalloc.stop()
    assert loss.lost == 0


def test_a_packet_without_a_column_is_ignored() -> None:
    packets = sent(FULL, 100)
    valid = np.ones(packets.words.shape, bool)
    valid[40] = False
    stamps = packets.stamp_ns.copy()
    stamps[40] = -(2**62)
    loss = GapLoss(FULL.packet_ns)
    loss.add(ColumnHeaders(stamps, packets.words, valid), packets.host_ns)
    assert (loss.lost, loss.reordered) == (1, 0)
