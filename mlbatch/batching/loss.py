"""Lost and reordered packets: by sequence numbers, otherwise by gaps in the stamps.

`SequenceLoss` serves sensors whose packets have a sequence number. `GapLoss` serves the others: it
compares the step between two packets with the packet period, without the time in which the sensor
sends nothing because its rotor passes a dark sector.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array, U16Array, U32Array, median
from mlbatch.native.library import Numbers, library
from mlbatch.types import ColumnHeaders
from mlbatch.units import NS_PER_S


class PacketLoss:
    """Lost and reordered packets of one sensor.

    Zero for a sensor that has neither sequence numbers nor a known packet period. numbers, gaps:
    the counters in use; the intake counts numbers itself.
    """

    def __init__(self, modulus: int, packet_ns: float = 0.0) -> None:
        """modulus: of sequence numbers, 0: none; packet_ns: nominal packet period, 0: unknown."""
        self.numbers = SequenceLoss(modulus)
        self.gaps = GapLoss(packet_ns) if packet_ns and not modulus else None

    @property
    def lost(self) -> int:
        """Packets missing between those received."""
        return self.numbers.lost if self.gaps is None else self.gaps.lost

    @property
    def reordered(self) -> int:
        """Packets received after a later one."""
        return self.numbers.reordered if self.gaps is None else self.gaps.reordered

    def add(self, sequence: I64Array, headers: ColumnHeaders, host_ns: I64Array) -> None:
        """Add accepted packets (P,) in order of receive time; stamps on the sensor's clock."""
        self.numbers.add(sequence)
        if self.gaps is not None:
            self.gaps.add(headers, host_ns)


class SequenceLoss:
    """Counts gaps and backward steps in sequence numbers that wrap at `modulus` (0: none).

    The rules: `native/intake.c`.
    """

    def __init__(self, modulus: int) -> None:
        self.struct = Numbers(modulus=modulus, newest=-1, doubtful=-1)

    @property
    def lost(self) -> int:
        """Packets missing between those received."""
        return int(self.struct.lost)

    @property
    def reordered(self) -> int:
        """Packets received after a later one."""
        return int(self.struct.reordered)

    def add(self, sequence: I64Array) -> None:
        """Add accepted packets (n,) in order of receive time; negative numbers are ignored."""
        numbers = np.ascontiguousarray(sequence, np.int64)
        library().mlbatch_numbers(self.struct, len(numbers), numbers)


# -- by gaps in the stamps ------------------------------------------------------------------------

# `Intake` accepts no packet further behind the newest stamp of its sensor than 1 s, so the order of
# packets older than this is final. A longer step back is a clock reset.
_FINAL_NS = 3 * NS_PER_S // 2
# Packets that are evaluated together: a dozen revolutions of the sensors that send the most.
_CHUNK = 16384
# A gap longer than this must have passed at the capture host too, up to this tolerance; it is the
# step that `Intake` accepts.
_STEP_NS = NS_PER_S
# Bins of a revolution for the angles of columns: about 0.0055 degrees, half of the finest encoder.
_BIN_BITS = 16
_BINS = 1 << _BIN_BITS
_REVOLUTIONS_PER_TICK = 2.0**-32
# Packets whose columns are looked up together.
_PART = 1024
# A dark sector is wider than so many steps between columns.
_MIN_WIDTH = 2.5
# A sector without columns is dark if the rotor passed it so often during gaps: random loss would
# have spared it at least once.
_MIN_PASSES = 12
# Largest error of a predicted rotor angle, in revolutions, after a gap.
_ROTOR_ERROR = 0.1
# The period is estimated from at least so many steps, from those within 10 % of the 5 % quantile,
# if these are 8 % of all or more.
_MIN_STEPS = 16
_QUANTILE = 0.05
_TOLERANCE = 0.1
_MIN_SHARE = 0.08
# Share of columns at the angle of the one before, if each return is a column: half of them are.
_MIN_DUAL_SHARE = 0.25
# A backward move of the rotor within a packet that is jitter, in revolutions.
_JITTER = 1 / 360


@dataclass(slots=True)
class _Packets:
    """Packets of one sensor, (n,) each."""

    stamp_ns: I64Array  # of the first column
    host_ns: I64Array
    first: U32Array  # angle of the first column, 2**-32 revolutions
    last: U32Array  # angle of the last column, 2**-32 revolutions
    bins: U16Array  # (n, C) angle bins of all columns

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def take(self, index: I64Array | BoolArray | slice) -> _Packets:
        return _Packets(
            self.stamp_ns[index],
            self.host_ns[index],
            self.first[index],
            self.last[index],
            self.bins[index],
        )

    def mirrored(self) -> _Packets:
        """The same packets with the rotor direction reversed."""
        return _Packets(self.stamp_ns, self.host_ns, -self.first, -self.last, ~self.bins)


class GapLoss:
    """Counts lost and reordered packets by their stamps.

    The result does not depend on how packets are grouped: they are evaluated in the order of their
    stamps, in chunks of fixed size.
    """

    def __init__(self, packet_ns: float) -> None:
        """packet_ns: nominal packet period, used where packets are too few to estimate it."""
        self.reordered = 0
        self._packet_ns = packet_ns
        # Lost packets of the chunks that are evaluated.
        self._lost = 0
        self._parts: list[_Packets] = []
        self._waiting = 0
        self._newest_ns: int | None = None
        self._limit = 3 * _CHUNK

    @property
    def lost(self) -> int:
        """Packets missing so far, as if the input ended here."""
        if not self._parts:
            return self._lost
        self._evaluate()
        return self._lost + _missing(self._parts[0], self._packet_ns)

    def add(self, headers: ColumnHeaders, host_ns: I64Array) -> None:
        """Add accepted packets (P,) in order of receive time.

        Of the stamps, on the sensor's clock, only the first of each packet are read.
        """
        measured = np.flatnonzero(headers.valid.any(axis=1))
        encoder = np.ascontiguousarray(headers.encoder)
        packets = _Packets(
            # A copy, so that the stamps of all columns are not kept in memory.
            headers.stamp_ns[:, 0].copy(),
            host_ns,
            # The low 32 bits of the words, and the higher 16 of them: copies without the others.
            encoder.view("<u4")[:, 0].copy(),
            encoder.view("<u4")[:, -2].copy(),
            encoder.view("<u2")[:, 1::4].copy(),
        )
        if len(measured) < len(packets):
            packets = packets.take(measured)
        while len(packets):
            packets = self._until_reset(packets)

    def _until_reset(self, packets: _Packets) -> _Packets:
        """Add packets up to a clock reset; return those after it."""
        stamp_ns = packets.stamp_ns
        begin = int(stamp_ns[0]) if self._newest_ns is None else self._newest_ns
        newest = np.maximum.accumulate(np.concatenate([[begin], stamp_ns]))
        back = newest[:-1] - stamp_ns
        count = len(packets)
        if int(back.max()) > _FINAL_NS:
            count = int(np.argmax(back > _FINAL_NS))
        self.reordered += int(np.count_nonzero(back[:count] > 0))
        self._newest_ns = int(newest[count])
        self._enqueue(packets.take(slice(count)))
        if count < len(packets):
            # Loss across a reset cannot be known: begin anew.
            self._lost = self.lost
            self._parts = []
            self._waiting = 0
            self._newest_ns = None
        return packets.take(slice(count, None))

    def _enqueue(self, packets: _Packets) -> None:
        if not len(packets):
            return
        self._parts.append(packets)
        self._waiting += len(packets)
        if self._waiting >= self._limit:
            self._evaluate()
            # Grows with the waiting packets: a constant limit would take time by their square.
            self._limit = max(3 * _CHUNK, self._waiting + max(_CHUNK, self._waiting // 4))

    def _evaluate(self) -> None:
        """Evaluate the oldest packets whose order is final, chunk by chunk.

        A full chunk always remains, so that the last chunk of all is not a short one.
        """
        rows = _in_order(self._parts)
        final = int(np.searchsorted(rows.stamp_ns, rows.stamp_ns[-1] - _FINAL_NS))
        begin = 0
        while final - begin >= 2 * _CHUNK:
            # The last packet of a chunk is the first of the next, to count the step between them.
            self._lost += _missing(rows.take(slice(begin, begin + _CHUNK + 1)), self._packet_ns)
            begin += _CHUNK
        if begin:
            # A copy, so that packets that are evaluated are not kept in memory.
            rows = rows.take(np.arange(begin, len(rows)))
        self._parts = [rows]
        self._waiting = len(rows)


def _in_order(parts: list[_Packets]) -> _Packets:
    """All packets by stamp, then by receive time."""
    rows = _Packets(
        np.concatenate([part.stamp_ns for part in parts]),
        np.concatenate([part.host_ns for part in parts]),
        np.concatenate([part.first for part in parts]),
        np.concatenate([part.last for part in parts]),
        np.concatenate([part.bins for part in parts]),
    )
    if bool((rows.stamp_ns[1:] >= rows.stamp_ns[:-1]).all()):
        return rows
    return rows.take(np.argsort(rows.stamp_ns, kind="stable"))


def _missing(packets: _Packets, packet_ns: float) -> int:
    """Number of packets missing between these, which are sorted by stamp."""
    # Packets of equal stamps (one per return) count as one.
    is_next = np.diff(packets.stamp_ns, prepend=packets.stamp_ns[:1] - 1) > 0
    if not is_next.all():
        packets = packets.take(is_next)
    step_ns = np.diff(packets.stamp_ns).astype(np.float64)
    period_ns = _period_ns(step_ns, packet_ns)
    is_gap = step_ns > 1.5 * period_ns
    gap = np.flatnonzero(is_gap)
    if not len(gap):
        return 0
    speed = _speed(packets, step_ns, is_gap)
    if speed < 0:
        packets = packets.mirrored()
        speed = -speed
    gap_ns = step_ns[gap]
    begin = _revolutions(packets.first[gap])
    turned = _revolutions(packets.first[gap + 1]) - begin
    turned += np.rint(speed * gap_ns - turned)
    passed_ns = packets.host_ns[gap + 1] - packets.host_ns[gap]
    # A clock that was set also steps: then the rotor, or the capture host, did not move as long.
    is_silence = np.where(
        gap_ns > _STEP_NS,
        passed_ns >= gap_ns - _STEP_NS,
        np.abs(speed * gap_ns - turned) < _ROTOR_ERROR,
    )
    columns = packets.bins.shape[1]
    dark = _dark_sectors(packets, begin, turned, speed * period_ns / columns)
    dark_turned = dark.passes(begin, turned) @ dark.width
    share = np.divide(dark_turned, turned, out=np.zeros(len(gap)), where=turned > 0)
    sent = gap_ns * (1 - share) / period_ns
    sent[dark_turned > 0] -= _edge_excess(packets.bins)
    missing = np.rint(sent) - 1
    return int(missing[is_silence & (missing > 0)].sum())


def _edge_excess(bins: U16Array) -> float:
    """Packets by which the estimate across a dark sector may exceed what rounding corrects.

    One angle at an edge of the sector; and, if two returns are columns of one angle, the column
    with which a packet begins. Positive for packets of up to 3 columns only.
    """
    columns = int(bins.shape[1])
    is_dual = columns > 1 and float(np.mean(bins[:, 1:] == bins[:, :-1])) > _MIN_DUAL_SHARE
    return max((3 if is_dual else 1) / columns - 0.5, 0.0)


def _period_ns(step_ns: F64Array, packet_ns: float) -> float:
    """The packet period: mean of the usual steps, else the nominal one.

    Over two steps at a time, since three columns of two returns in a packet make steps of one and
    two rounds alternate.
    """
    pair_ns = (step_ns[1:] + step_ns[:-1]) / 2
    if len(pair_ns) < _MIN_STEPS:
        return packet_ns
    # By this method numpy does not import `numpy.ma`.
    low_ns = float(np.quantile(pair_ns, _QUANTILE, method="inverted_cdf"))
    near = pair_ns[np.abs(pair_ns - low_ns) <= _TOLERANCE * low_ns]
    # If most packets are lost, the remaining steps show no period.
    return float(near.mean()) if len(near) >= _MIN_SHARE * len(pair_ns) else packet_ns


def _speed(packets: _Packets, step_ns: F64Array, is_gap: BoolArray) -> float:
    """Speed of the rotor, revolutions per ns, over the steps that are no gaps."""
    turned = np.diff(_revolutions(packets.first))
    turned -= np.rint(turned)
    time_ns = float(step_ns[~is_gap].sum())
    return float(turned[~is_gap].sum()) / time_ns if time_ns else 0.0


def _revolutions(angle: U32Array) -> F64Array:
    """Return angles in 2**-32 revolutions as revolutions."""
    return angle.astype(np.float64) * _REVOLUTIONS_PER_TICK


class _Sectors(NamedTuple):
    """Sectors of a revolution, (k,) each, in revolutions, in the direction of the rotor."""

    begin: F64Array
    width: F64Array

    def passes(self, begin: F64Array, turned: F64Array) -> F64Array:
        """(g, k) how often a rotor passes each sector that turns by `turned` from `begin`."""
        ahead = begin[:, None] - (self.begin + self.width / 2)
        count: F64Array = np.floor(ahead + turned[:, None]) - np.floor(ahead)
        return count


def _dark_sectors(
    packets: _Packets, begin: F64Array, turned: F64Array, column_revolutions: float
) -> _Sectors:
    """Sectors in which the sensor measures nothing; begin, turned: (g,) gaps.

    These are sectors without a column that the rotor passed during many gaps, or within a packet,
    where nothing can be lost.
    """
    bare = _bare_sectors(packets.bins, column_revolutions)
    is_dark = np.count_nonzero(bare.passes(begin, turned), axis=0) >= _MIN_PASSES
    if not is_dark.all():
        span = _revolutions(packets.last - packets.first)
        span[span > 1 - _JITTER] = 0.0
        wide = np.flatnonzero(span > 1.5 * median(span))
        is_dark |= bare.passes(_revolutions(packets.first[wide]), span[wide]).any(axis=0)
    return _Sectors(bare.begin[is_dark], bare.width[is_dark])


def _bare_sectors(bins: U16Array, column_revolutions: float) -> _Sectors:
    """Sectors without a column; column_revolutions: step between columns, revolutions."""
    bare = np.ones(_BINS, np.bool_)
    # In parts, since numpy makes an index of 8 bytes for each bin.
    for some in np.array_split(bins, len(bins) // _PART + 1):
        bare[some] = False
    # Rotated so that no sector contains the end.
    first = int(np.argmin(bare))
    edge = np.diff(np.roll(bare, -first).astype(np.int8), append=np.int8(0))
    begin = np.flatnonzero(edge == 1) + 1
    end = np.flatnonzero(edge == -1) + 1
    # On average half of the bin at each edge is dark as well.
    width = (end - begin + 1) / _BINS
    wide = width > _MIN_WIDTH * column_revolutions
    return _Sectors(((begin + first - 0.5) / _BINS % 1.0)[wide], width[wide])
