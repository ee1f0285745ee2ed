"""Packets of lidars of all vendors in a scene, and the expected points of their conversion.

The encoders (`velodyne.py`, `hesai.py`, `robosense.py`, `two_lidars.py`) lay out bytes; here their
rays meet the scene, and times are those of their packets. Nothing of a decoder is used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.simulate.hesai import encode as hesai
from mlbatch.simulate.hesai.angles import Beams
from mlbatch.simulate.robosense import encode as robosense
from mlbatch.simulate.velodyne import encode as velodyne
from tests.builders import two_lidars
from tests.builders.lidar_packets import Payloads, encoded, firing_ns
from tests.builders.scene import Scene

# Behind a near surface every third column sees another one, as a beam does that an edge cuts.
_EDGE_EVERY = 3
_EDGE_M = 7.0
_PAST_M = 1e-6
# Packets count the azimuth in 0.01 degrees. Half of that is its own rounding; as much again may be
# the error of the rotor speed that the few azimuths of a packet give.
ASIDE_PER_M = 1.75e-4
_AIRY_FLAG = 0x4000


@dataclass(frozen=True, slots=True)
class Seen:
    """What one lidar sent, and what it means.

    stamp_ns: (n,) of its columns, in their order; firing_ns: (n, channels), as `stamp_ns` by the
    sensor's clock; counts, level: (n, channels, returns), counts of `unit_m`, 0 where nothing came
    back; xyz_m: (n, channels, returns, 3), those counts on the rays, body frame. Channels
    are in the order of the output.
    """

    stamp_ns: I64Array
    firing_ns: I64Array
    counts: I64Array
    level: I64Array
    xyz_m: F64Array
    unit_m: float
    payloads: Payloads
    columns_per_packet: int

    @property
    def channels(self) -> int:
        """Of a column."""
        return int(self.counts.shape[1])

    @property
    def returns(self) -> int:
        """Of a shot."""
        return int(self.counts.shape[2])

    @property
    def packet_stamps(self) -> I64Array:
        """(P, columns of a packet)."""
        return self.stamp_ns.reshape(-1, self.columns_per_packet)


@dataclass(frozen=True, slots=True)
class Eye:
    """A scene as seen from a pose, body_from_sensor (4, 4), metres."""

    scene: Scene
    pose: F64Array

    def look(
        self, origin: F64Array, direction: F64Array, returns: int = 1
    ) -> tuple[F64Array, F64Array]:
        """Distances in m (inf: none) and levels, (n, channels, returns), of rays (n, channels, 3).

        Of several returns the first is the last on the way, the second the strongest.
        """
        shape = direction.shape[:2]
        start: F64Array = np.broadcast_to(origin, direction.shape).reshape(-1, 3)
        start = start @ self.pose[:3, :3].T + self.pose[:3, 3]
        ray = direction.reshape(-1, 3) @ self.pose[:3, :3].T
        first_m, level = self._cast(start, ray)
        if returns == 1:
            return first_m.reshape(*shape, 1), level.reshape(*shape, 1)
        last_m = first_m.copy()
        last_level = level.copy()
        column = np.arange(len(ray)) // shape[1]
        cut = np.flatnonzero((column % _EDGE_EVERY == 0) & (first_m < _EDGE_M))
        reached_m = first_m[cut] + _PAST_M
        behind_m, behind_level = self._cast(start[cut] + reached_m[:, None] * ray[cut], ray[cut])
        further = np.isfinite(behind_m)
        last_m[cut[further]] = (reached_m + behind_m)[further]
        last_level[cut[further]] = behind_level[further]
        pairs = [(last_m, last_level), (first_m, level), (last_m, last_level)][:returns]
        distance_m, levels = (
            np.stack([pair[part].reshape(shape) for pair in pairs], axis=-1) for part in (0, 1)
        )
        return distance_m, levels

    def points(self, origin: F64Array, direction: F64Array, distance_m: F64Array) -> F64Array:
        """(n, channels, returns, 3), m, of distances (n, channels, returns) along the rays."""
        reached = origin[..., None, :] + distance_m[..., None] * direction[..., None, :]
        moved: F64Array = reached @ self.pose[:3, :3].T + self.pose[:3, 3]
        return moved

    def _cast(self, start: F64Array, ray: F64Array) -> tuple[F64Array, F64Array]:
        brightness = [surface.reflectivity for surface in self.scene.surfaces] + [0]
        surface = self.scene.surface_hit(start, ray)
        return self.scene.cast(start, ray), np.array(brightness, np.float64)[surface]


def velodyne_sees(spec: velodyne.VelodyneSpec, eye: Eye, packets: int) -> Seen:
    """A Velodyne's stamps are whole us, each of the first firing of a packet (sheet, section 2)."""
    table = spec.table
    columns = np.arange(packets * spec.columns_per_packet)
    origin = velodyne.origins(spec, columns)
    direction = velodyne.directions(spec, columns)
    distance_m, bright = eye.look(origin, direction, spec.returns)
    reach_m = np.array(table.dist_m)[:, None]
    counts, level = _counted(distance_m - reach_m, bright, table.unit_m)
    payloads = encoded(spec, counts, level)
    fires_ns = firing_ns(spec, payloads)
    # Channel 0 is the lowest beam (docs/formats.md).
    order = np.argsort(np.array(table.elevation_deg), kind="stable")
    xyz_m = eye.points(origin, direction, np.asarray(counts * table.unit_m + reach_m))
    return Seen(
        fires_ns.min(axis=1),
        fires_ns[:, order],
        counts[:, order],
        level[:, order],
        xyz_m[:, order],
        table.unit_m,
        payloads,
        spec.columns_per_packet,
    )


def hesai_sees(spec: hesai.HesaiSpec, beams: Beams, eye: Eye, packets: int) -> Seen:
    """A HESAI's beams leave from the axis unless the optical centre is asked for."""
    columns = packets * spec.groups
    unit_m = spec.row.unit_mm / 1000
    direction = hesai.directions(spec, beams, columns)
    origin = np.zeros_like(direction)
    counts, level = _counted(*eye.look(origin, direction, spec.returns), unit_m)
    fires = hesai.fires(spec, columns)
    counts *= fires[:, :, None]
    level *= fires[:, :, None]
    payloads = encoded(spec, counts, level)
    fires_ns = firing_ns(spec, payloads)
    never = np.iinfo(np.int64).max
    return Seen(
        np.where(fires, fires_ns, never).min(axis=1),
        fires_ns,
        counts,
        level,
        eye.points(origin, direction, np.multiply(counts, unit_m, dtype=np.float64)),
        unit_m,
        payloads,
        spec.groups,
    )


def robosense_sees(
    spec: robosense.RobosenseSpec, angles: robosense.Angles, eye: Eye, packets: int
) -> Seen:
    """Ranges count from the lens (sheet, section 8)."""
    count = round(packets * spec.columns_per_packet)
    columns = np.arange(count)
    origin = robosense.origins(spec, columns)
    direction = robosense.directions(spec, angles, columns)
    distance_m, bright = eye.look(origin, direction, spec.returns)
    counts, level = _counted(distance_m, bright, spec.range_unit_m)
    flag = _AIRY_FLAG if spec.model.startswith("Airy") else 0
    seen = Seen(
        np.empty(0, np.int64),
        robosense.firing_times_ns(spec, columns),
        counts,
        level,
        eye.points(origin, direction, np.asarray(counts * spec.range_unit_m, np.float64)),
        spec.range_unit_m,
        robosense.msop(spec, counts + flag, level),
        int(spec.columns_per_packet),
    )
    if spec.columns_per_packet % 1:
        seen = _split(spec, seen)
    return replace(seen, stamp_ns=seen.firing_ns.min(axis=1))


def ouster_sees(lidar: two_lidars.FixtureLidar, eye: Eye, first_ns: int, turns: int) -> Seen:
    """An Ouster: its encoder casts the rays itself, from its own pose."""
    fields = two_lidars.turn_fields(lidar, eye.scene)
    stamps = two_lidars.column_stamps(lidar, first_ns, turns)
    raw = two_lidars.packets(lidar, fields, stamps)
    column = np.arange(len(stamps)) % two_lidars.COLUMNS_PER_TURN
    last_ns = stamps.reshape(-1, two_lidars.COLUMNS_PER_PACKET)[:, -1]
    counts = fields["RANGE"] // lidar.range_step_mm
    unit_m = lidar.range_step_mm / 1000
    # Ranges count from the rotor's axis, along the beam.
    origin, direction = two_lidars.rays(lidar)
    reached_m = counts.reshape(-1, 1) * unit_m - lidar.offset_mm / 1000
    xyz_m = (origin + reached_m * direction).reshape(*counts.shape, 1, 3)
    return Seen(
        stamps,
        np.repeat(stamps[:, None], two_lidars.BEAMS, axis=1),
        counts[column][:, :, None],
        fields["REFLECTIVITY"][column][:, :, None],
        xyz_m[column],
        unit_m,
        list(zip(last_ns.tolist(), raw, strict=True)),
        two_lidars.COLUMNS_PER_PACKET,
    )


def _counted(distance_m: F64Array, level: F64Array, unit_m: float) -> tuple[I64Array, I64Array]:
    """Whole counts of 16 bits, and levels; 0 where nothing comes back."""
    with np.errstate(invalid="ignore"):
        counts = distance_m / unit_m
        fits = (counts >= 0.5) & (counts < 65535.5)
    whole = np.rint(np.where(fits, counts, 0)).astype(np.int64)
    return whole, np.where(whole > 0, np.rint(level), 0).astype(np.int64)


def _split(spec: robosense.RobosenseSpec, seen: Seen) -> Seen:
    """Three blocks do not divide by two: each return is a column of its own.

    The second may be in the next packet; there it has that packet's time, cut to whole us anew.
    """
    blocks = np.arange(seen.counts.shape[0] * spec.returns)
    rounds = robosense.rounds(spec, blocks // spec.returns)
    first = rounds[blocks // spec.row.blocks * spec.row.blocks]
    said_ns = (spec.start_ns + first * spec.round_ns) // 1000 * 1000
    begin_ns = said_ns + (rounds - first) * spec.round_ns
    shape = (len(blocks), seen.channels, 1)
    return replace(
        seen,
        firing_ns=begin_ns[:, None] + spec.firing_ns,
        counts=seen.counts.transpose(0, 2, 1).reshape(shape),
        level=seen.level.transpose(0, 2, 1).reshape(shape),
        xyz_m=seen.xyz_m.transpose(0, 2, 1, 3).reshape(*shape, 3),
        columns_per_packet=spec.row.blocks,
    )
