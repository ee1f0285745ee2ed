"""The decoder literally: the formulas of `docs/sources`, column by column, in float64.

It takes from a lidar what its data sheet says (places of readings, directions, firing times) and
computes every point anew: no tables of angles, no series, no float32 but for the ranges, whose
rounding is part of their definition (`lidar/interface.py`). Positions of the compiled decoder may
differ by 0.05 mm + 3e-7 of the range; all else has to be equal.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from mlbatch.arrays import F64Array, I64Array, U8Array
from mlbatch.decode.groups import Source
from mlbatch.decode.packet_ring import PacketRing
from mlbatch.lidar.geometry import (
    BeamTable,
    Coordinates,
    CorrectedRanges,
    Mirrors,
    OffAxis,
    PlacedPoints,
)
from mlbatch.lidar.interface import BitField, Lidar
from mlbatch.types import Scan, WindowColumns

Reals: TypeAlias = np.ndarray[tuple[int, ...], np.dtype[np.float32]]
# Ranges, levels and reflectivities by beam.
Readings: TypeAlias = tuple[Reals, F64Array, I64Array]
TURN = 2 * math.pi
BOUND_M = 5e-5
BOUND_OF_RANGE = 3e-7
SINGLE = 7


@dataclass(slots=True)
class Column:
    """Slots of one column in order of output: channels times returns, those without a return too.

    outcome: `no_return`, `repeated`, `range`, `box` or `written`; unsure: whether a bound of a box
    is too near to say.
    """

    outcome: list[str] = field(default_factory=list)
    unsure: list[bool] = field(default_factory=list)
    slot: list[int] = field(default_factory=list)
    xyz: list[F64Array] = field(default_factory=list)
    range_m: list[float] = field(default_factory=list)
    level: list[float] = field(default_factory=list)
    reflectivity: list[int] = field(default_factory=list)
    time_ns: list[int] = field(default_factory=list)
    ring: list[int] = field(default_factory=list)
    kind: list[int] = field(default_factory=list)


class LiteralDecoder:
    """Decodes windows of columns of some sensors."""

    def __init__(self, sources: Sequence[Source], boxes_m: F64Array, first_sensor: int = 0) -> None:
        self.sources = sources
        self.boxes_m = boxes_m
        self.first_sensor = first_sensor
        # By sensor.
        self.counts = [Counter[str]() for _ in sources]

    def count(self, sensor: int, outcome: str) -> None:
        """Count a slot of a sensor."""
        self.counts[sensor][outcome] += 1
        self.counts[sensor]["slots"] += 1

    def column(self, columns: WindowColumns, number: int, start_ns: int) -> Column:
        """Decode one column of a window that starts at `start_ns`."""
        source = self.sources[int(columns.sensor[number])]
        lidar = source.lidar
        word = int(columns.encoder[number])
        record = record_of(source.ring, int(columns.ring_index[number]))
        table = min(word >> 56, len(lidar.firing_ns) - 1)
        if lidar.beams.angle_rad is not None:
            table = 0
        firing_ns = np.maximum(lidar.firing_ns[table], 0)
        channel = lidar.channel if lidar.channel.ndim == 1 else lidar.channel[table]
        slots = lidar.channel if lidar.channel.ndim == 1 else np.arange(lidar.channels)
        readings = [readings_of(lidar, record, which) for which in range(lidar.returns)]
        places = [
            places_of(source, record, which, ranges, word, firing_ns)
            for which, (ranges, _, _) in enumerate(readings)
        ]
        kinds = kinds_of(lidar, readings)
        offset_ns = int(columns.stamp_ns[number]) - start_ns
        found = Column()
        # Beams as they fire, those that fire together by channel.
        for beam in sorted(range(lidar.channels), key=lambda one: (firing_ns[one], channel[one])):
            for which in range(lidar.returns):
                range_m = float(readings[which][0][beam])
                point = places[which][beam]
                earlier = [readings[other][0][beam] for other in range(which)]
                low, high = np.float32(source.min_range_m), np.float32(source.max_range_m)
                inside, unsure = self._in_boxes(point)
                outcome = "box" if inside else "written"
                if not low <= readings[which][0][beam] <= high:
                    outcome = "range"
                if lidar.sends_twice and not source.keep_repeated and range_m in earlier:
                    outcome = "repeated"
                if not range_m > 0:
                    outcome = "no_return"
                if columns.moves is not None:
                    move = columns.moves[number].astype(np.float64)
                    point = move[:, :3] @ point + move[:, 3]
                found.outcome.append(outcome)
                found.unsure.append(unsure and outcome in ("box", "written"))
                found.slot.append(int(slots[beam]) * lidar.returns + which)
                found.xyz.append(point)
                found.range_m.append(range_m)
                found.level.append(float(readings[which][1][beam]))
                found.reflectivity.append(int(readings[which][2][beam]))
                found.time_ns.append(offset_ns + int(firing_ns[beam]))
                found.ring.append(source.ring_base + int(channel[beam]))
                found.kind.append(kinds[which][beam])
        return found

    def _in_boxes(self, point: F64Array) -> tuple[bool, bool]:
        """Whether a point is in a box, and whether it is too near to a bound to say."""
        inside = unsure = False
        for box in self.boxes_m:
            depth = min(*(point - box[:3]), *(box[3:] - point))
            inside = inside or depth >= 0
            unsure = unsure or abs(depth) < 2 * BOUND_M + 1e-6 * float(np.abs(point).max())
        return inside, unsure


def record_of(ring: PacketRing, ring_index: int) -> U8Array:
    """Bytes of a column."""
    view, origin = ring.view
    rows, per_row = view.shape
    row, place = divmod(ring_index - origin, per_row)
    record: U8Array = np.frombuffer(view[row % rows, place].tobytes(), np.uint8)
    return record


def readings_of(lidar: Lidar, record: U8Array, which: int) -> Readings:
    """Ranges in m (0: none), levels and reflectivities of one return, by beam."""
    table = lidar.pixels
    shape = lidar.channels
    ranges = np.zeros(shape, np.float32)
    levels = np.zeros(shape)
    reflectivities = np.zeros(shape, np.int64)
    if table is None:
        return _recorded(lidar, record, which)
    layout = table.returns[which]
    for run in layout.runs:
        for pixel in range(run.channels):
            beam = run.channel + pixel
            at = run.first_byte + pixel * table.step
            distance = field_of(record, at, layout.distance)
            if distance > table.silent and beam not in table.dark:
                product = np.float32(distance) * np.float32(table.factor)
                ranges[beam] = product / np.float32(table.divisor)
            levels[beam] = field_of(record, at, layout.intensity)
            if layout.reflectivity is not None and lidar.has_reflectivity:
                reflectivities[beam] = field_of(record, at, layout.reflectivity)
    return ranges, levels, reflectivities


def field_of(record: U8Array, at: int, bits: BitField) -> int:
    """An unsigned number in a pixel that begins at byte `at`."""
    size = int(bits.word[-1])
    data = record[at + bits.first : at + bits.first + size].tobytes()
    word = int.from_bytes(data, "big" if bits.word[0] == ">" else "little")
    return word >> bits.shift & bits.mask


def _recorded(lidar: Lidar, record: U8Array, which: int) -> Readings:
    """Ranges and levels of points that are recorded with coordinates."""
    own = lidar.projection(np.eye(4))
    none = np.zeros(lidar.channels, np.int64)
    if isinstance(own, PlacedPoints):
        planes = _planes(own, record, lidar.channels)
        x, y, z = planes[:3]
        ranges = np.sqrt(x * x + y * y + z * z)
        return ranges, planes[3].astype(np.float64), none
    assert isinstance(own, Coordinates)
    point = coordinates_of(own, record, which)
    level = record[which * own.return_bytes + own.intensity_at]
    return (np.array([np.linalg.norm(point)], np.float32), np.array([float(level)]), none)


def _planes(own: PlacedPoints, record: U8Array, slots: int) -> Reals:
    end = own.first_byte + 16 * slots
    return np.frombuffer(record[own.first_byte : end].tobytes(), "<f4").reshape(4, slots)


def coordinates_of(own: Coordinates, record: U8Array, which: int) -> F64Array:
    """The point of a return, m, in the sensor frame: docs/sources/others.md."""
    data = record[which * own.return_bytes :].tobytes()
    if own.form == 0:
        return np.frombuffer(data[:12], "<i4") / 1000
    if own.form == 1:
        return np.frombuffer(data[:6], "<i2") / 100
    depth = int.from_bytes(data[:4], "little") / 1000
    zenith = math.radians(int.from_bytes(data[4:6], "little") / 100)
    azimuth = math.radians(int.from_bytes(data[6:8], "little") / 100)
    flat = depth * math.sin(zenith)
    return np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), depth * math.cos(zenith)])


def places_of(
    source: Source, record: U8Array, which: int, ranges: Reals, word: int, firing_ns: I64Array
) -> list[F64Array]:
    """Points of one return in the body frame, m, by beam."""
    lidar = source.lidar
    pose = source.body_from_sensor
    own = lidar.projection(pose)
    if isinstance(own, PlacedPoints):
        points = _planes(own, record, lidar.channels)[:3].T.astype(np.float64)
        return [pose[:3, :3] @ point + pose[:3, 3] for point in points]
    if isinstance(own, Coordinates):
        return [pose[:3, :3] @ coordinates_of(own, record, which) + pose[:3, 3]]
    fixed = lidar.beams.angle_rad
    angle = (word & 0xFFFFFFFF) / 2**32 * TURN
    steps = (word >> 32) & 0xFFFFFF
    speed = (steps - (1 << 24 if steps >> 23 else 0)) / 2**48 * TURN
    found = []
    for beam, distance in enumerate(ranges.astype(np.float64).tolist()):
        rotor = float(fixed[word]) if fixed is not None else angle + speed * float(firing_ns[beam])
        if isinstance(own, Mirrors):
            # All beams of a column belong to one mirror.
            found.append(_mirrored(own, beam, distance, rotor, angle))
        elif isinstance(own, CorrectedRanges):
            found.append(_corrected(own, beam, distance, rotor))
        elif isinstance(own, OffAxis):
            near = 0 < np.float32(distance) <= np.float32(0.09)
            behind = math.sqrt(max(distance**2 - float(own.miss_m2[beam]), 0.0))
            direction, origin, reach = _beam(own.beams, beam, rotor)
            if near:
                found.append(distance * direction + own.axis_m)
            else:
                found.append((behind + reach) * direction + origin)
        else:
            direction, origin, reach = _beam(lidar.beams, beam, rotor)
            point = (distance + reach) * direction + origin
            found.append(pose[:3, :3] @ point + pose[:3, 3])
    return found


def _beam(beams: BeamTable, beam: int, rotor: float) -> tuple[F64Array, F64Array, float]:
    """Direction and origin of a beam, and what is added to its range."""
    cosine, sine = math.cos(rotor), math.sin(rotor)
    first, second, third = beams.direction[:, beam]
    at = min(beam, beams.origin.shape[1] - 1)
    begin, across, up = beams.origin[:, at]
    reach = float(beams.reach_m[min(beam, len(beams.reach_m) - 1)])
    return cosine * first + sine * second + third, cosine * begin + sine * across + up, reach


def _corrected(own: CorrectedRanges, beam: int, distance: float, rotor: float) -> F64Array:
    """The HDL-64E: docs/sources/velodyne.md section 10."""
    values = own.planes[:, beam].astype(np.float64)
    azimuth = rotor - math.atan2(values[1], values[0])
    elevation = math.atan2(values[3], values[2])
    aside, above, far, right_m, right_slope, forward_m, forward_slope = values[4:]
    cosine, sine = math.cos(azimuth), math.sin(azimuth)
    level = math.cos(elevation)
    to_right = to_forward = to_up = distance + far
    if np.float32(distance) < np.float32(25.04):
        flat = (distance + far) * level
        by_right = right_m + right_slope * abs(flat * sine)
        by_forward = forward_m + forward_slope * abs(flat * cosine)
        to_right, to_forward = distance + by_right, distance + by_forward
        to_up = distance + (by_right + by_forward) / 2
    right = to_right * level * sine - aside * cosine
    forward = to_forward * level * cosine + aside * sine
    up = to_up * math.sin(elevation) + above
    pose: F64Array = own.pose.astype(np.float64)
    point: F64Array = pose[:, :3] @ np.array([forward, -right, up]) + pose[:, 3]
    return point


def _mirrored(own: Mirrors, beam: int, distance: float, rotor: float, column: float) -> F64Array:
    """The AT128: docs/sources/hesai.md section 6."""
    past = min((column - float(start)) % TURN for start in own.start_rad) + rotor - column
    cosine, sine, flat, up = own.planes[:, beam].astype(np.float64)
    azimuth = 2 * past + math.atan2(sine, cosine) + _adjusted(own.azimuth, beam, rotor)
    elevation = math.atan2(up, flat) + _adjusted(own.elevation, beam, rotor)
    level = math.cos(elevation)
    towards = [level * math.sin(azimuth), level * math.cos(azimuth), math.sin(elevation)]
    pose: F64Array = own.pose.astype(np.float64)
    point: F64Array = distance * (pose[:, :3] @ np.array(towards)) + pose[:, 3]
    return point


def _adjusted(table: Reals, beam: int, rotor: float) -> float:
    """A correction over the rotor angle, interpolated between its steps."""
    steps = table.shape[1]
    at = rotor / TURN * steps
    cell = math.floor(at)
    value, change = (float(one) for one in table[:, cell % steps, beam])
    return value + change * (at - cell)


def kinds_of(lidar: Lidar, readings: Sequence[Readings]) -> list[list[int]]:
    """Return types by return and beam: docs/sources/outputs.md section 3."""
    kinds = [[kind] * lidar.channels for kind in lidar.return_types]
    if lidar.returns != 2 or not lidar.typed_by:
        return kinds
    for beam in range(lidar.channels):
        first, second = (float(ranges[beam]) for ranges, _, _ in readings)
        weaker = readings[0][1][beam] < readings[1][1][beam]
        if first == 0 or second == 0 or (lidar.sends_twice and first == second):
            kinds[0][beam] = kinds[1][beam] = SINGLE
            continue
        is_last = first > second
        is_weak = lidar.typed_by == "level" and weaker
        # 3, 4: strongest, first and last; 5, 6: weak, first and last.
        kinds[0][beam] = 3 + is_last + 2 * is_weak
        kinds[1][beam] = 3 + (not is_last) + 2 * (not is_weak)
    return kinds


def check_scan(decoder: LiteralDecoder, columns: WindowColumns, scan: Scan, start_ns: int) -> None:
    """Compare a scan with what its columns say; AssertionError where they differ."""
    row = 0
    for number in range(len(columns)):
        one = decoder.column(columns, number, start_ns)
        sensor = decoder.first_sensor + int(columns.sensor[number])
        for place, outcome in enumerate(one.outcome):
            at: tuple[int, ...] = (number, one.slot[place])
            if scan.info.layout == "organized":
                assert int(scan.lidar_id[at]) == sensor
                is_here = not bool(np.isnan(scan.xyz[at][0]))
            else:
                at = (row,)
                is_here = row < scan.points and _is_labelled(one, place, sensor, scan, at)
            is_point = is_here if one.unsure[place] else outcome == "written"
            assert is_point <= is_here, f"column {number}, slot {one.slot[place]}: missing"
            row += is_point
            if scan.info.layout == "organized":
                assert is_point == is_here, f"column {number}, slot {one.slot[place]}: too many"
            if not is_point:
                decoder.count(int(columns.sensor[number]), "box" if one.unsure[place] else outcome)
                continue
            decoder.count(int(columns.sensor[number]), "written")
            assert _is_labelled(one, place, sensor, scan, at)
            _check_point(one, place, scan, at)
            if scan.column is not None:
                assert int(scan.column[at]) == number
    assert row == scan.points


def _is_labelled(one: Column, place: int, sensor: int, scan: Scan, at: tuple[int, ...]) -> bool:
    return (
        int(scan.time_ns[at]) == one.time_ns[place]
        and int(scan.ring[at]) == one.ring[place]
        and int(scan.lidar_id[at]) == sensor
        and int(scan.return_type[at]) == one.kind[place]
    )


def _check_point(one: Column, place: int, scan: Scan, at: tuple[int, ...]) -> None:
    range_m = one.range_m[place]
    away_m = float(np.abs(scan.xyz[at].astype(np.float64) - one.xyz[place]).max())
    reach_m = max(range_m, float(np.abs(one.xyz[place]).max()))
    assert away_m <= BOUND_M + BOUND_OF_RANGE * reach_m, (away_m, range_m)
    assert float(scan.intensity[at]) == one.level[place]
    if scan.range_m is not None:
        assert abs(float(scan.range_m[at]) - range_m) <= BOUND_OF_RANGE * range_m
    if scan.reflectivity is not None:
        assert int(scan.reflectivity[at]) == one.reflectivity[place]
