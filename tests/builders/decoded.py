"""Packets of one lidar decoded to readings and points, without windows or files."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import F32Array, F64Array, I64Array, U8Array, U16Array
from mlbatch.decode.decoder import Decoder
from mlbatch.decode.groups import Source, slot_numbers
from mlbatch.lidar.geometry import BeamTable, Projection
from mlbatch.lidar.interface import BitField, ChannelRun, Lidar, PixelTable, Records, ReturnLayout
from mlbatch.native.arena import PacketArena
from mlbatch.pipeline.sensor import new_ring
from mlbatch.types import EXTRAS, ColumnHeaders, RunInfo, SensorInfo, Window, WindowColumns

_NO_BOXES = np.empty((0, 6))


@dataclass(frozen=True, slots=True)
class Readings:
    """All columns of some packets, beams in wire order: (n, channels, returns).

    range_m: 0 without a return, where the others are 0 or NaN; xyz: one more axis of 3.
    """

    headers: ColumnHeaders
    range_m: F32Array
    intensity: F32Array
    reflectivity: U16Array | None
    xyz: F32Array

    @property
    def stamp_ns(self) -> I64Array:
        return self.headers.stamp_ns.reshape(-1)

    @property
    def encoder(self) -> I64Array:
        return self.headers.encoder.reshape(-1)


def readings(
    lidar: Lidar,
    packets: U8Array,
    host_ns: I64Array | None = None,
    body_from_sensor: F64Array | None = None,
    encoder: I64Array | None = None,
) -> Readings:
    """Decode packets (P, size); encoder: (n,) of the columns, instead of what the packets say."""
    received_ns = np.zeros(len(packets), np.int64) if host_ns is None else host_ns
    headers = lidar.column_headers(packets, received_ns)
    ring = new_ring(lidar, PacketArena())
    start = np.arange(len(packets), dtype=np.int64) * lidar.packet_size
    first = ring.keep(packets.reshape(-1).copy(), start).ring_index
    place = first[:, None] + ring.column_offsets(lidar.columns_per_packet)
    pose = np.eye(4) if body_from_sensor is None else body_from_sensor
    source = Source(lidar, ring, pose, 0, keep_repeated=True)
    sensor = SensorInfo(
        "s", lidar.model, lidar.channels, lidar.returns, 0, pose, lidar.has_reflectivity
    )
    info = RunInfo((sensor,), "base_link", "10", "utc", layout="organized")
    count = place.size
    columns = WindowColumns(
        np.arange(count, dtype=np.int64),
        np.zeros(count, np.int64),
        place.reshape(-1),
        headers.encoder.reshape(-1) if encoder is None else encoder,
    )
    decoder = Decoder(info, [source], _NO_BOXES, EXTRAS)
    scan = decoder.scan(Window(0, 0, 0, 1_000_000_000, True, 0, columns))
    shape = (count, lidar.channels, lidar.returns)
    slots = slot_numbers(lidar)

    def wired(values: F32Array, without: float = math.nan) -> F32Array:
        own: F32Array = values[:count, slots].reshape(*shape, *values.shape[2:]).copy()
        own[np.isnan(own)] = without
        return own

    assert scan.range_m is not None
    reflectivity = None
    if scan.reflectivity is not None:
        reflectivity = scan.reflectivity[:count, slots].reshape(shape).copy()
    return Readings(
        headers, wired(scan.range_m, 0), wired(scan.intensity, 0), reflectivity, wired(scan.xyz)
    )


_UNITS_PER_M = 1 << 20


class Rotor(Lidar):
    """A lidar of beams alone: its packets are one column of ranges in 2**-20 m."""

    def __init__(
        self,
        firing_ns: I64Array,
        beams: BeamTable | None = None,
        project: Callable[[F64Array], Projection | None] = lambda pose: None,
    ) -> None:
        """firing_ns: (T, B); beams: in the sensor frame; project: instead of them."""
        count = firing_ns.shape[1]
        self.vendor = self.model = self.mode = "beams"
        self.calibration = ""
        self.channels = count
        self.returns = 1
        self.return_types = (0,)
        self.columns_per_packet = 1
        # Words of the last pixel reach beyond it.
        self.packet_size = 4 * count + 4
        self.records = Records(0, self.packet_size, self.packet_size)
        self.channel = np.arange(count)
        self.firing_ns = firing_ns
        nowhere = np.zeros((3, count, 3))
        self.beams = BeamTable(nowhere, nowhere[:, :1], np.zeros(1)) if beams is None else beams
        run = (ChannelRun(0, 0, count),)
        layout = ReturnLayout(run, BitField(0, "<u4", 0, 0x7FFFFFFF), BitField(0, "u1"))
        self.pixels = PixelTable(4, (layout,), _UNITS_PER_M)
        self._project = project

    def column_headers(self, packets: U8Array, host_ns: I64Array) -> ColumnHeaders:
        """Not used: rotor positions are given."""
        none = np.zeros((len(packets), 1), np.int64)
        return ColumnHeaders(none, none, np.ones(none.shape, np.bool_))

    def faults(self, packets: U8Array) -> U8Array:
        """None."""
        return np.zeros(len(packets), np.uint8)

    def projection(self, body_from_sensor: F64Array) -> Projection | None:
        """As given."""
        return self._project(body_from_sensor)


def projected(
    rotor: Rotor, encoder: I64Array, range_m: F32Array, body_from_sensor: F64Array | None = None
) -> F32Array:
    """Points (n, B, 3), m, of ranges (n, B) above 0, at rotor positions (n,)."""
    packets = np.zeros((len(encoder), rotor.packet_size), np.uint8)
    units = np.rint(range_m * _UNITS_PER_M).astype("<u4")
    packets[:, :-4] = np.ascontiguousarray(units).view(np.uint8).reshape(len(encoder), -1)
    found = readings(rotor, packets, None, body_from_sensor, encoder)
    return found.xyz[:, :, 0]


_MOST_SPEED = (1 << 23) - 1


def rotor_words(
    revolutions: F64Array, revolutions_per_s: F64Array | float = 0.0, table: I64Array | int = 0
) -> I64Array:
    """The `encoder` of columns of sensors without an angle table; arguments broadcast.

    revolutions: rotor angle at the stamp of the column; revolutions_per_s: its speed while the
    beams of the column fire; table: row of the column in `Lidar.firing_ns`.
    """
    ticks = (revolutions - np.floor(revolutions)) * 2.0**32
    angle = np.rint(ticks).astype(np.int64) % 2**32
    steps = np.rint(np.multiply(revolutions_per_s, 2.0**48 * 1e-9))
    speed = np.clip(steps, -_MOST_SPEED, _MOST_SPEED).astype(np.int64) % 2**24
    words: I64Array = angle | speed << 32 | np.asarray(table) << 56
    return words
