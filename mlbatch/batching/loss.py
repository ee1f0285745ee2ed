"""Packets lost and reordered on the way: by the sensor's own count, else by the pace of stamps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array, U16Array, median
from mlbatch.lidar.geometry import rotor_ticks
from mlbatch.types import Heads
from mlbatch.units import NS_PER_S

# A longer step is believed only if the next packet goes on from there: one flipped bit in a frame
# number must not count as a million lost packets.
BELIEVED_STEP = 1024


class PacketLoss:
    """What one sensor's packets tell of others that did not come, or came late.

    By their numbers where they bear a count, else by the pace of their stamps; a sensor of which
    neither is known loses nothing that we know of.
    """

    def __init__(self, modulus: int, packet_ns: float = 0.0) -> None:
        """modulus: where the count wraps, 0 none; packet_ns: time of a packet, 0 unknown."""
        self._numbers = Loss(modulus)
        self._pace = PaceLoss(packet_ns) if packet_ns and not modulus else None

    @property
    def lost(self) -> int:
        """Packets missing between those that came."""
        return self._numbers.lost if self._pace is None else self._pace.lost

    @property
    def reordered(self) -> int:
        """Packets that came after a later one."""
        return self._numbers.reordered if self._pace is None else self._pace.reordered

    def add(self, sequence: I64Array, heads: Heads, host_ns: I64Array) -> None:
        """Count accepted packets (P,), in order of arrival, by the sensor's own clock."""
        if self._pace is None:
            self._numbers.add(sequence)
        elif len(host_ns):
            self._pace.add(heads, host_ns)


class Loss:
    """Counts gaps and backward steps in sequence numbers that wrap at `modulus` (0: none)."""

    def __init__(self, modulus: int) -> None:
        self.lost = 0
        self.reordered = 0
        self._modulus = modulus
        self._newest: int | None = None
        self._doubtful: int | None = None
        # One packet alone proves nothing: the first of all may be the damaged one.
        self._is_sure = False

    def add(self, sequence: I64Array) -> None:
        """Count accepted packets (n,), in order of arrival; negative: outside the count."""
        if not self._modulus or not len(sequence):
            return
        if self._is_sure and self._doubtful is None and self._goes_on(sequence):
            self._newest = int(sequence[-1])
            return
        for number in sequence[sequence >= 0].tolist():
            if self._newest is None:
                self._newest = number
            else:
                self._step(number)

    def _goes_on(self, sequence: I64Array) -> bool:
        """Whether every number is one more than that before, as nearly always."""
        if self._newest is None or int(sequence[0]) != (self._newest + 1) % self._modulus:
            return False
        return len(sequence) == 1 or bool(
            (sequence[1:] == (sequence[:-1] + 1) % self._modulus).all()
        )

    def _step(self, number: int) -> None:
        step = self._signed(number - (self._newest or 0))
        if abs(step) > BELIEVED_STEP:
            if self._doubtful is None or abs(self._signed(number - self._doubtful)) > BELIEVED_STEP:
                self._doubtful = number
                return
            # A restart counts anew; a long gap is a gap.
            if step > 0 and self._is_sure:
                self.lost += step - 2
            self._newest, self._doubtful, self._is_sure = number, None, True
            return
        self._doubtful, self._is_sure = None, True
        if step > 0:
            self.lost += step - 1
            self._newest = number
        elif step < 0:
            self.reordered += 1
            self.lost = max(0, self.lost - 1)

    def _signed(self, step: int) -> int:
        half = self._modulus // 2
        return (step + half) % self._modulus - half


# Packets lost on the way, of sensors whose packets bear no count: told by the pace of stamps.
#
# Packets follow each other at a steady pace, so a step of k paces is one of k - 1 lost packets
# (issue 5: "azimuth continuity and the known packet period"). A sensor that leaves out a part of
# its turn is silent through the same angles every turn: these take their time, and no packet.
# They are known by where columns never lie, though the rotor passed.

# `intake.py` lets no packet in that lies further behind its sensor's newest stamp than 1 s: what is
# older than this is in its final order. A longer step back is a clock that was reset.
_SETTLED_NS = 3 * NS_PER_S // 2
# Packets that are judged together: a dozen turns of the sensors that send the most.
_CHUNK = 16384
# Longer silences must have passed at the recorder too, up to this (as in `jumps.py`).
_STEP_NS = NS_PER_S
# Places on a turn at which columns were seen: half of what packets count, 0.01 degrees.
_PLACE_BITS = 16
_PLACES = 1 << _PLACE_BITS
_TURNS_PER_TICK = 2.0**-32
# Columns leave holes between them; a dark sector is wider than so many of their steps.
_HOLE_STEPS = 2.5
# So many turns without one column of a sector are no chance, if not half of all packets are lost.
_PASSES = 12
# Angles are rounded: a column may seem to lie as much behind an edge, in turns.
_GRID_OFF = 1 / _PLACES
# The rotor of a sensor goes on while packets are lost: turns that it may be off by.
_ROTOR_OFF = 0.1
# Steps from which the pace is taken, and how far they may lie from each other.
_FEWEST_STEPS, _LOW, _NEAR, _SHARE = 16, 0.05, 0.1, 0.08
_BACK_TURNS = 1 / 360
# Share of columns that lie where those before them do, if each return is one: half of them do.
_TWICE = 0.25
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

    def mirrored(self) -> _Packets:
        """Those of a rotor that turns the other way."""
        first, last = -self.first % 1.0, -self.last % 1.0
        return _Packets(self.stamp_ns, self.host_ns, first, last, ~self.places)


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
            # A copy: else the stamps of all columns would be kept.
            heads.stamp_ns[:, 0].copy(),
            host_ns,
            ticks[:, 0].astype(np.float64) * _TURNS_PER_TICK,
            ticks[:, -1].astype(np.float64) * _TURNS_PER_TICK,
            (ticks >> (32 - _PLACE_BITS)).astype(np.uint16),
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
    if median(speed) < 0:
        packets, speed = packets.mirrored(), -speed
    step_ns, begin, end = step_ns[gap], packets.first[gap], packets.first[gap + 1]
    turned = end - begin + np.rint(speed * step_ns - (end - begin))
    passed_ns = packets.host_ns[gap + 1] - packets.host_ns[gap]
    is_silence = np.where(
        step_ns > _STEP_NS,
        passed_ns >= step_ns - _STEP_NS,
        np.abs(speed * step_ns - turned) < _ROTOR_OFF,
    )
    due = step_ns / pace_ns
    columns = packets.places.shape[1]
    column_turns = np.maximum(speed * (pace_ns / columns), 0.0)
    dark = _dark_sectors(packets, begin, turned, median(column_turns))
    across = np.flatnonzero(dark.passes(begin, turned).any(axis=1) & (column_turns > 0))
    if len(across):
        together = _together(packets.places)
        pitch = together * column_turns[across]
        seen = together * dark.angles(begin[across], turned[across], pitch)
        if together > 1:
            # Packets may begin with the second column of an angle.
            second = (packets.places[:, 0] != packets.places[:, 1]).astype(np.float64)
            seen += second[gap[across] + 1] - second[gap[across]]
        due[across] = seen / columns
    missing = np.rint(due) - 1
    return int(missing[is_silence & (missing > 0)].sum())


def _together(places: U16Array) -> int:
    """Columns at one angle: 2 where each return is a column of its own, else 1."""
    if places.shape[1] == 1:
        return 1
    return 2 if float(np.mean(places[:, 1:] == places[:, :-1])) > _TWICE else 1


def _pace_ns(step_ns: F64Array, packet_ns: float) -> float:
    """Time of a packet, by the steps between them that are usual; else the nominal one.

    By two steps at once: where three columns of two returns make a packet, steps of one and two
    rounds take turns.
    """
    pair_ns = (step_ns[1:] + step_ns[:-1]) / 2
    if len(pair_ns) < _FEWEST_STEPS:
        return packet_ns
    low_ns = float(np.quantile(pair_ns, _LOW))
    near = pair_ns[np.abs(pair_ns - low_ns) <= _NEAR * low_ns]
    # Where most packets are lost, what is left does not tell.
    return float(near.mean()) if len(near) >= _SHARE * len(pair_ns) else packet_ns


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


@dataclass(slots=True)
class _Sectors:
    """Sectors of a turn, (k,) each: from where to where the rotor passes them, in turns."""

    begin: F64Array
    width: F64Array

    def take(self, index: BoolArray) -> _Sectors:
        return _Sectors(self.begin[index], self.width[index])

    def passes(self, begin: F64Array, turned: F64Array) -> F64Array:
        """(g, k) how often rotors pass them that turn from `begin` on by `turned`."""
        ahead = begin[:, None] - (self.begin + self.width / 2)
        count: F64Array = np.floor(ahead + turned[:, None]) - np.floor(ahead)
        return count

    def angles(self, begin: F64Array, turned: F64Array, pitch: F64Array) -> F64Array:
        """(g,) angles that a sensor measures at while it turns so, from `begin` on.

        They lie on a grid: at both edges the last one in the light is known.
        """
        lit = turned - self.passes(begin, turned) @ self.width
        before = self.begin - begin[:, None]
        after = (begin + turned)[:, None] - self.begin - self.width
        at_edges = 1 + _beyond_grid(before, pitch) + _beyond_grid(after, pitch)
        return np.asarray(lit / pitch + at_edges, np.float64)


def _beyond_grid(turns: F64Array, pitch: F64Array) -> F64Array:
    """(g,) down to a whole number of pitches, from the least of the ways (g, k) along a turn.

    Where rounding may hide an angle, half of it.
    """
    high = ((turns + _GRID_OFF) % 1.0).min(axis=1)
    low = np.maximum(high - 2 * _GRID_OFF, 0.0)
    whole = (np.floor(high / pitch) + np.floor(low / pitch)) / 2
    return np.asarray(whole - (high - _GRID_OFF) / pitch, np.float64)


def _dark_sectors(
    packets: _Packets, begin: F64Array, turned: F64Array, column_turns: float
) -> _Sectors:
    """Where no column ever lies, though the rotor passed: in steps (g,) from `begin` by `turned`.

    That is known where it passed often, or within a packet, where nothing can be lost.
    """
    holes = _holes(packets.places, column_turns)
    is_dark = np.count_nonzero(holes.passes(begin, turned), axis=0) >= _PASSES
    if not is_dark.all():
        span = (packets.last - packets.first) % 1.0
        # A rotor that jitters or rests may seem to step back.
        span[span > 1 - _BACK_TURNS] = 0.0
        wide = np.flatnonzero(span > 1.5 * median(span))
        is_dark |= holes.passes(packets.first[wide], span[wide]).any(axis=0)
    return holes.take(is_dark)


def _holes(places: U16Array, column_turns: float) -> _Sectors:
    """Sectors in which no column lies."""
    bare = np.bincount(places.ravel(), minlength=_PLACES) == 0
    # Turned so that none passes the end.
    first = int(np.argmin(bare))
    edge = np.diff(np.roll(bare, -first).astype(np.int8), append=np.int8(0))
    begin, end = np.flatnonzero(edge == 1) + 1, np.flatnonzero(edge == -1) + 1
    # On average half of the place at each edge is dark as well.
    width = (end - begin + 1) / _PLACES
    wide = width > _HOLE_STEPS * column_turns
    return _Sectors(((begin + first - 0.5) / _PLACES % 1.0)[wide], width[wide])
