"""Several lidars at one address: two sequences of packets that are interleaved and each continue.

The packets of one lidar do not overlap in time, and each begins where the one before ends. Loss,
duplicates, delay and reordering change neither; a timestamp that is wrong does not continue a
sequence. Two lidars send packets that overlap, or are of two clocks, while both sequences continue.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array, median
from mlbatch.discovery.sampler import Sampler
from mlbatch.discovery.types import DetectedSensor, PacketKind
from mlbatch.lidar.geometry import rotor_ticks
from mlbatch.lidar.headers import content_keys
from mlbatch.lidar.interface import Lidar
from mlbatch.units import NS_PER_MS, NS_PER_S

# Of the time from the first to the last column of a packet: steps to the next packet that overlap
# (with a margin for rounded timestamps), and steps between neighbours in time.
_OVERLAP = 0.95
_NEIGHBOUR = 2.5
# Deviation of a packet that continues another: share of a packet, and rounding.
_TIME_SHARE = 0.06
_TIME_ROUNDING_NS = 2000
_ROTOR_SHARE = 0.25
_ROTOR_ROUNDING = 1e-3  # revolutions
_REVOLUTION_TICKS = 2.0**32
# Timestamps of neighbours further apart are of two clocks.
_CLOCKS_NS = NS_PER_S
# Packets that may be lost between two of a sequence.
_MOST_LOST = 2
# Steps between neighbours: least number, and least share between two lidars.
_MIN_STEPS = 8
_SEVERAL = 0.15
# Of each of two clocks: least number and share of packets that are continued; and least number of
# changes between the clocks.
_MIN_CONTINUED = 6
_CONTINUED = 0.6
_MIN_CHANGES = 4

# Indices of two packets of different sequences.
Pair = tuple[int, int]


def shared_address(sampler: Sampler, sensor: DetectedSensor) -> str:
    """Error text if several lidars send on a stream of a sensor, else ""."""
    lidar = sensor.lidar
    for kind in sorted(sensor.kinds & sampler.kinds.keys()):
        packets = _packets(sampler, kind, lidar)
        pair = _overlapping(packets) or _of_two_clocks(packets)
        if pair is not None:
            one, other = (packets.described(number) for number in pair)
            return (
                f"sensor {sensor.name}: {sampler.table.streams[kind.stream]}: expected packets of "
                f"one {lidar.model}, found two sequences of packets of "
                f"{packets.span_ns / NS_PER_MS:.3f} ms that each continue, one with {one}, the "
                f"other with {other}: several lidars share the address, or recordings of two "
                "drives were joined; give each an address or a port of its own and record again, "
                "or convert each recording alone"
            )
    return ""


class _Packets(NamedTuple):
    """Sampled packets of one kind, in receive order; (n,) each.

    position: among all packets of the kind; stamp_ns: of the first column; rotor: revolutions,
    modulo 1; number: of the sequence, or none (< 0); content: equal in copies.

    Of a packet: span_ns, time from the first to the last column; step_ns and turn, time and
    revolutions from packet to packet (turn 0: no rotor).
    """

    position: I64Array
    host_ns: I64Array
    stamp_ns: I64Array
    rotor: F64Array
    number: I64Array
    content: I64Array
    span_ns: float
    step_ns: float
    turn: float

    def described(self, row: int) -> str:
        """A packet by its timestamp and receive time."""
        stamp_s = int(self.stamp_ns[row]) / NS_PER_S
        host_s = int(self.host_ns[row]) / NS_PER_S
        return f"the timestamp {stamp_s:.6f} s (received at {host_s:.6f} s)"

    def runs(self) -> Iterator[I64Array]:
        """Rows that were received one after the other."""
        edges = np.flatnonzero(np.diff(self.position) != 1) + 1
        yield from np.split(np.arange(len(self.position)), edges)

    def first_ns_of(self, older: I64Array, newer: I64Array) -> int:
        """First timestamp of the newer of two clocks, that of packets `newer`."""
        offset_ns = self.stamp_ns - self.host_ns
        between_ns = (median(offset_ns[older]) + median(offset_ns[newer])) / 2
        return int(self.stamp_ns[offset_ns > between_ns].min())

    def in_order(self, run: I64Array) -> I64Array:
        """Rows of a run by timestamp, one of each packet."""
        _, first = np.unique(self.content[run], return_index=True)
        rows = run[first]
        return rows[self.stamp_ns[rows].argsort(kind="stable")]

    def continued(self, rows: I64Array, most_lost: int = 0) -> BoolArray:
        """(n, n) True where the second of two rows begins where the first one ends.

        most_lost: up to this number of packets may be missing between them.
        """
        stamp_ns = self.stamp_ns[rows]
        result = np.zeros((len(rows), len(rows)), np.bool_)
        for steps in range(1, most_lost + 2):
            off_ns = np.abs(stamp_ns[None, :] - stamp_ns[:, None] - steps * self.step_ns)
            is_next = off_ns <= _TIME_SHARE * self.step_ns + _TIME_ROUNDING_NS
            if self.turn:
                is_next &= self._turns_on(rows[:, None], rows[None, :], steps)
            result |= is_next
        return result

    def follows(self, one: I64Array, other: I64Array) -> BoolArray:
        """(n,) True where one of two packets is the other's next, whatever their timestamps."""
        are_numbered = (self.number[one] >= 0) & (self.number[other] >= 0)
        apart = np.abs(self.number[other] - self.number[one])
        result = np.where(are_numbered, apart == 1, bool(self.turn))
        if self.turn:
            result &= self._turns_on(one, other) | self._turns_on(other, one)
        return np.asarray(result, np.bool_)

    def _turns_on(self, one: I64Array, other: I64Array, steps: int = 1) -> BoolArray:
        """True where the rotor turns by so many packets from the first to the second."""
        off = self.rotor[other] - self.rotor[one] - steps * self.turn
        off = np.abs(off - np.rint(off))
        return np.asarray(off <= max(_ROTOR_SHARE * abs(self.turn), _ROTOR_ROUNDING), np.bool_)


def _packets(sampler: Sampler, kind: PacketKind, lidar: Lidar) -> _Packets:
    """Return the intact samples of a kind in which all columns are valid."""
    payloads, host_ns, position = sampler.good_samples(kind, lidar)
    headers = lidar.column_headers(payloads, host_ns)
    whole = headers.valid.all(axis=1)
    stamp_ns = headers.stamp_ns[whole]
    encoder = headers.encoder[whole]
    positions = lidar.beams.angle_rad
    rotor = (
        rotor_ticks(encoder) / _REVOLUTION_TICKS
        if positions is None
        else encoder / max(len(positions), 1)
    )
    number = np.full(len(stamp_ns), -1, np.int64)
    if lidar.sequence_modulus:
        number = lidar.sequence(payloads[whole])
    span_ns = 0.0
    columns = 1
    turn = 0.0
    if len(stamp_ns):
        span_ns = median(stamp_ns[:, -1] - stamp_ns[:, 0])
        # Blocks of two returns have one timestamp.
        columns = len(set(stamp_ns[0].tolist()))
        swept = rotor[:, -1] - rotor[:, 0]
        turn = median(swept - np.rint(swept))
    # A packet ends one column after the begin of its last column.
    whole_packet = columns / max(columns - 1, 1)
    return _Packets(
        position=position[whole],
        host_ns=host_ns[whole],
        stamp_ns=stamp_ns[:, 0],
        rotor=rotor[:, 0],
        number=number,
        content=content_keys(payloads[whole]),
        span_ns=span_ns,
        step_ns=span_ns * whole_packet,
        turn=turn * whole_packet,
    )


def _overlapping(packets: _Packets) -> Pair | None:
    """Two packets that overlap, if enough do while their sequences continue."""
    steps = 0
    pairs: list[Pair] = []
    for run in packets.runs():
        rows = packets.in_order(run)
        step_ns = np.diff(packets.stamp_ns[rows])
        steps += int(np.count_nonzero(step_ns < _NEIGHBOUR * packets.span_ns))
        overlaps = step_ns < _OVERLAP * packets.span_ns
        if not overlaps.any():
            continue
        continued = packets.continued(rows, _MOST_LOST)
        continues: BoolArray = np.logical_or(continued.any(axis=0), continued.any(axis=1))
        foreign = overlaps & continues[1:] & continues[:-1]
        foreign &= ~packets.follows(rows[:-1], rows[1:])
        pairs += [(int(rows[at]), int(rows[at + 1])) for at in foreign.nonzero()[0].tolist()]
    if steps < _MIN_STEPS or len(pairs) < _SEVERAL * steps:
        return None
    return pairs[0]


def _of_two_clocks(packets: _Packets) -> Pair | None:
    """Two packets of clocks that alternate, if the packets of each clock continue.

    Late packets alternate with others, too. They are of times at which the lidar was recorded, and
    what is late of a sequence is missing in it.
    """
    changes = 0
    sequences: list[tuple[I64Array, I64Array]] = []
    pairs: list[Pair] = []
    for run in packets.runs():
        stamp_ns = packets.stamp_ns[run]
        changed = np.flatnonzero(np.abs(np.diff(stamp_ns)) > _CLOCKS_NS)
        if not len(changed):
            continue
        changes += len(changed)
        pairs.append((int(run[changed[0]]), int(run[changed[0] + 1])))
        rows = packets.in_order(run)
        gap = int(np.diff(packets.stamp_ns[rows]).argmax()) + 1
        sequences.append((rows[:gap], rows[gap:]))
    if changes < max(_MIN_CHANGES, _SEVERAL * (len(packets.stamp_ns) - 1)):
        return None
    newer = [rows for _, rows in sequences]
    older = [rows for rows, _ in sequences]
    first_ns = packets.first_ns_of(np.concatenate(older), np.concatenate(newer))
    older = [rows[packets.stamp_ns[rows] < first_ns] for rows in older]
    if not _is_continued(packets, older) or not _is_continued(packets, newer):
        return None
    return pairs[0]


def _is_continued(packets: _Packets, parts: Sequence[I64Array]) -> bool:
    """True if most packets have their successor in the same part; the last ones do not count."""
    expected = sum(max(len(rows) - 1, 0) for rows in parts)
    continued = sum(int(packets.continued(rows).any(axis=1).sum()) for rows in parts)
    return expected >= _MIN_CONTINUED and continued >= _CONTINUED * expected
