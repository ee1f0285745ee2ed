"""Packets lost on the way, of sensors whose packets bear no count: told by the pace of stamps.

Packets follow each other at a steady pace, so a step of k paces is one of k - 1 lost packets (issue
5: "azimuth continuity and the known packet period"). A sensor that leaves out a part of its turn is
silent through the same angles every turn: these take their time, and no packet. They are known by
where columns never lie, though the rotor passed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mlbatch.geometry import rotor_ticks
from mlbatch.types import BoolArray, F64Array, Heads, I64Array, U16Array
from mlbatch.units import NS_PER_S

# `intake.py` lets no packet in that lies further behind its sensor's newest stamp than 1 s: what is
# older than this is in its final order. A longer step back is a clock that was reset.
_SETTLED_NS = 3 * NS_PER_S // 2
# Packets that are judged together: a dozen turns of the sensors that send the most.
_CHUNK = 16384
# Longer silences must have passed at the recorder too, up to this (as in `jumps.py`).
_STEP_NS = NS_PER_S
# Rows of the angles at which columns were seen, of a turn: 0.09 degrees each.
_BIN_BITS = 12
_BINS = 1 << _BIN_BITS
_TURNS_PER_TICK = 2.0**-32
# Columns leave holes between them; a dark sector is wider than so many of their steps.
_HOLE_STEPS = 2.5
# So many turns without one column of a sector are no chance, if not half of all packets are lost.
_PASSES = 12
# The rotor of a sensor goes on while packets are lost: turns that it may be off by.
_ROTOR_OFF = 0.1
# Steps from which the pace is taken, and how far they may lie from each other.
_FEWEST_STEPS, _NEAR = 16, 0.1
_BACK_TURNS = 1 / 360
# Packets over which the speed of the rotor is taken.
_SPEED_OVER = 64


@dataclass(slots=True)
class _Packets:
    """Packets of one sensor, (n,) each; places: (n, C) uint16, rows of the angles of its columns.

    stamp_ns: of the first column; first, last: angles of the first and last column, in turns.
    """

    stamp_ns: I64Array
    host_ns: I64Array
    first: F64Array
    last: F64Array
    places: U16Array

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def take(self, index: I64Array | BoolArray | slice) -> _Packets:
        return _Packets(
            self.stamp_ns[index],
            self.host_ns[index],
            self.first[index],
            self.last[index],
            self.places[index],
        )


class PaceLoss:
    """Counts packets that are missing between those that came, and those that came out of order.

    The answer is the same however packets are cut into batches: they are judged in the order of
    their stamps, in chunks that depend on nothing else.
    """

    def __init__(self, packet_ns: float) -> None:
        """packet_ns: nominal time of a packet, used where packets are too few to tell their own."""
        self.reordered = 0
        self._packet_ns = packet_ns
        self._judged = 0
        self._parts: list[_Packets] = []
        self._waiting = 0
        self._newest_ns: int | None = None
        self._crowd = 3 * _CHUNK

    @property
    def lost(self) -> int:
        """Packets missing so far; those that wait are judged as if no other came."""
        if not self._parts:
            return self._judged
        self._settle()
        return self._judged + _missing(self._parts[0], self._packet_ns)

    def add(self, heads: Heads, host_ns: I64Array) -> None:
        """Take in accepted packets (P,), in order of arrival, by the sensor's own clock."""
        measured = np.flatnonzero(heads.valid.any(axis=1))
        ticks = rotor_ticks(heads.encoder)
        packets = _Packets(
            heads.stamp_ns[:, 0],
            host_ns,
            ticks[:, 0].astype(np.float64) * _TURNS_PER_TICK,
            ticks[:, -1].astype(np.float64) * _TURNS_PER_TICK,
            (ticks >> (32 - _BIN_BITS)).astype(np.uint16),
        )
        if len(measured) < len(packets):
            packets = packets.take(measured)
        while len(packets):
            packets = self._until_reset(packets)

    def _until_reset(self, packets: _Packets) -> _Packets:
        """Take in packets up to where the clock was reset; gives the others."""
        stamp_ns = packets.stamp_ns
        begin = int(stamp_ns[0]) if self._newest_ns is None else self._newest_ns
        newest = np.maximum.accumulate(np.concatenate([[begin], stamp_ns]))
        back = newest[:-1] - stamp_ns
        count = len(packets)
        if int(back.max()) > _SETTLED_NS:
            count = int(np.argmax(back > _SETTLED_NS))
        self.reordered += int(np.count_nonzero(back[:count] > 0))
        self._newest_ns = int(newest[count])
        if count == len(packets):
            self._wait(packets)
            return packets.take(slice(count, None))
        self._wait(packets.take(slice(count)))
        # What was missed meanwhile, nobody knows.
        self._judged, self._parts, self._waiting = self.lost, [], 0
        self._newest_ns = None
        return packets.take(slice(count, None))

    def _wait(self, packets: _Packets) -> None:
        if not len(packets):
            return
        self._parts.append(packets)
        self._waiting += len(packets)
        if self._waiting >= self._crowd:
            self._settle()
            self._crowd = max(3 * _CHUNK, 2 * self._waiting)

    def _settle(self) -> None:
        """Judge the oldest of the packets that are in their final order, chunk by chunk.

        As many are left as are judged at once, so that the last chunk of all is no short one.
        """
        rows = _in_order(self._parts)
        final_ns = rows.stamp_ns[-1] - _SETTLED_NS
        settled = int(np.searchsorted(rows.stamp_ns, final_ns))
        while settled >= 2 * _CHUNK:
            # The last packet is the next chunk's first: the step between them counts once.
            self._judged += _missing(rows.take(slice(_CHUNK + 1)), self._packet_ns)
            rows = rows.take(slice(_CHUNK, None))
            settled -= _CHUNK
        self._parts, self._waiting = [rows], len(rows)


def _in_order(parts: list[_Packets]) -> _Packets:
    """All packets in the order of their stamps; of equal stamps the first that came."""
    rows = _Packets(
        np.concatenate([part.stamp_ns for part in parts]),
        np.concatenate([part.host_ns for part in parts]),
        np.concatenate([part.first for part in parts]),
        np.concatenate([part.last for part in parts]),
        np.concatenate([part.places for part in parts]),
    )
    if bool((rows.stamp_ns[1:] >= rows.stamp_ns[:-1]).all()):
        return rows
    return rows.take(np.argsort(rows.stamp_ns, kind="stable"))


def _missing(packets: _Packets, packet_ns: float) -> int:
    """How many packets are missing between these, which are in the order of their stamps."""
    # Packets that share a stamp (a return each) are missed together.
    packets = packets.take(np.diff(packets.stamp_ns, prepend=packets.stamp_ns[:1] - 1) > 0)
    step_ns = np.diff(packets.stamp_ns).astype(np.float64)
    pace_ns = _pace_ns(step_ns, packet_ns)
    gap = np.flatnonzero(step_ns > 1.5 * pace_ns)
    if not len(gap):
        return 0
    speed = _speed(packets, step_ns, pace_ns)[gap]
    usual = float(np.median(speed))
    step_ns, angle = step_ns[gap], packets.first[gap]
    turned = packets.first[gap + 1] - angle
    whole = np.rint(speed * step_ns - turned)
    turned += whole
    passed_ns = packets.host_ns[gap + 1] - packets.host_ns[gap]
    is_silence = np.where(
        step_ns > _STEP_NS,
        passed_ns >= step_ns - _STEP_NS,
        np.abs(speed * step_ns - turned) < _ROTOR_OFF,
    )
    dark = _dark_turns(packets, angle, turned, usual * pace_ns)
    with np.errstate(divide="ignore", invalid="ignore"):
        dark_ns = np.where(dark > 0, dark / np.abs(speed), 0.0)
    missing = np.rint((step_ns - dark_ns) / pace_ns) - 1
    return int(missing[is_silence & (missing > 0)].sum())


def _pace_ns(step_ns: F64Array, packet_ns: float) -> float:
    """Time of a packet, by the steps between them that are usual; else the nominal one.

    By two steps at once: where three columns of two returns make a packet, steps of one and two
    rounds take turns.
    """
    pair_ns = (step_ns[1:] + step_ns[:-1]) / 2
    if len(pair_ns) < _FEWEST_STEPS:
        return packet_ns
    low_ns = float(np.quantile(pair_ns, 0.1))
    near = pair_ns[np.abs(pair_ns - low_ns) <= _NEAR * low_ns]
    # Where most packets are lost, what is left does not tell.
    return float(near.mean()) if 4 * len(near) >= len(pair_ns) else packet_ns


def _speed(packets: _Packets, step_ns: F64Array, pace_ns: float) -> F64Array:
    """Turns a ns of the rotor around each step, by the steps near it between which none is lost."""
    turned = np.diff(packets.first)
    turned -= np.rint(turned)
    clean = step_ns < 1.5 * pace_ns
    at = np.arange(len(step_ns) + 1)
    low = np.maximum(at[:-1] - _SPEED_OVER // 2, 0)
    high = np.minimum(at[:-1] + _SPEED_OVER // 2, len(step_ns))
    turns = np.concatenate([[0.0], np.cumsum(np.where(clean, turned, 0.0))])
    time_ns = np.concatenate([[0.0], np.cumsum(np.where(clean, step_ns, 0.0))])
    took_ns = time_ns[high] - time_ns[low]
    usual = turns[-1] / time_ns[-1] if time_ns[-1] else 0.0
    return np.where(took_ns > 0, (turns[high] - turns[low]) / np.maximum(took_ns, 1.0), usual)


def _dark_turns(
    packets: _Packets, angle: F64Array, turned: F64Array, packet_turns: float
) -> F64Array:
    """(g,) turns of dark sectors in steps that begin at `angle` and turn by `turned`, in turns.

    packet_turns: by which the rotor turns while a packet is filled, negative if backwards.
    """
    column_turns = abs(packet_turns) / packets.places.shape[1]
    middle, width = _holes(packets.places, column_turns)
    begin, end = angle[:, None] - middle, (angle + turned)[:, None] - middle
    passes = np.abs(np.floor(end) - np.floor(begin))
    is_dark = np.count_nonzero(passes, axis=0) >= _PASSES
    if not is_dark.all():
        is_dark |= _within_packets(packets, middle, np.sign(packet_turns))
    return np.asarray(passes[:, is_dark] @ width[is_dark], np.float64)


def _holes(places: U16Array, column_turns: float) -> tuple[F64Array, F64Array]:
    """Middle and width, in turns, of sectors in which no column lies."""
    bare = np.bincount(places.ravel(), minlength=_BINS) == 0
    # Turned so that none passes the end.
    first = int(np.argmin(bare))
    edge = np.diff(np.roll(bare, -first).astype(np.int8), append=np.int8(0))
    begin, end = np.flatnonzero(edge == 1) + 1, np.flatnonzero(edge == -1) + 1
    # On average half of the row at each edge is dark as well.
    width = (end - begin + 1) / _BINS
    wide = width > _HOLE_STEPS * column_turns
    return ((begin + end) / (2 * _BINS) + first / _BINS)[wide] % 1.0, width[wide]


def _within_packets(packets: _Packets, middle: F64Array, sense: float) -> BoolArray:
    """Which sectors lie between the columns of one packet, where nothing can be lost.

    sense: 1 or -1, by which the rotor turns.
    """
    span = sense * (packets.last - packets.first) % 1.0
    # A rotor that jitters or rests may seem to step back.
    span[span > 1 - _BACK_TURNS] = 0.0
    wide = np.flatnonzero(span > 1.5 * np.median(span))
    ahead = sense * (middle - packets.first[wide, None]) % 1.0
    return np.asarray((ahead < span[wide, None]).any(axis=0), np.bool_)
