"""Assignment of packets to sensors: by stream, payload size and what the packets contain.

Discovery matches the packet kinds of the first seconds with calibrations or the rig; a kind that
appears later joins a sensor only if its packets identify the sensor.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from enum import Enum
from typing import NamedTuple

import numpy as np

from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.discovery.sampler import are_neighbours, split_by_kind
from mlbatch.discovery.types import DetectedSensor, PacketKind
from mlbatch.lidar.interface import Lidar
from mlbatch.rig.rig import StreamSelector
from mlbatch.types import PacketBatch, Stream, StreamTable


class Role(Enum):
    """Use of the packets of a kind."""

    LIDAR = "lidar"
    IMU = "imu"
    BAD_SIZE = "bad_size"
    UNASSIGNED = "unassigned"


class Route(NamedTuple):
    """Destination of the packets of a kind."""

    role: Role
    sensors: tuple[int, ...] = ()  # indices of sensors that may have sent them


_UNASSIGNED = Route(Role.UNASSIGNED)
# Kinds of no sensor are forgotten beyond this number: it may grow without end.
_MOST_ROUTES = 1 << 16


class Router:
    """Decides which sensors the packets of a kind may come from, once for each kind.

    early: kinds from which the sensors were detected.
    """

    def __init__(
        self, table: StreamTable, sensors: Sequence[DetectedSensor], early: Collection[PacketKind]
    ) -> None:
        self._table = table
        self._sensors = list(sensors)
        self._early = frozenset(early)
        self._routes: dict[PacketKind, Route] = {}

    def route(self, kind: PacketKind, payload: U8Array) -> Route:
        """Route of a kind; payload: one of its packets, read for the first of a kind only."""
        route = self._routes.get(kind)
        if route is None:
            route = self._decide(kind, payload)
            if route == _UNASSIGNED and len(self._routes) >= _MOST_ROUTES:
                self._forget_unassigned()
            self._routes[kind] = route
        return route

    def route_of(self, kind: PacketKind, batch: PacketBatch, row: int) -> Route:
        """Route of a kind; row: one of its packets in a batch."""
        begin = int(batch.start[row])
        return self.route(kind, batch.data[begin : begin + kind.size])

    def owners(self, batch: PacketBatch) -> I64Array:
        """Index of the sensor that sent each packet, IMU packets included; -1: no sensor."""
        owner = np.full(len(batch), -1, np.int64)
        for kind, index in split_by_kind(batch):
            route = self.route_of(kind, batch, int(index[0]))
            if route.role in (Role.IMU, Role.BAD_SIZE):
                owner[index] = route.sensors[0]
                continue
            for number in route.sensors:
                left = index[owner[index] < 0]
                owner[left[_is_sent_by(self._sensors[number].lidar, batch, left)]] = number
        return owner

    def _forget_unassigned(self) -> None:
        """Let kinds of no sensor be decided again, by their next packets."""
        self._routes = {
            kind: route for kind, route in self._routes.items() if route.role is not Role.UNASSIGNED
        }

    def _decide(self, kind: PacketKind, payload: U8Array) -> Route:
        stream = self._table.streams[kind.stream]
        owners = tuple(
            number
            for number, sensor in enumerate(self._sensors)
            if kind.size in (sensor.lidar.packet_size, sensor.lidar.packet_size + 1)
            and self._may_own(sensor, kind, stream, payload)
        )
        for number in owners:
            kinds = self._sensors[number].kinds
            if kind not in kinds:
                kinds.add(kind)
                # Its neighbours may be IMU packets.
                self._forget_unassigned()
        if owners:
            return Route(Role.LIDAR, owners)
        imu = self._imu_owner(stream, kind.size)
        if imu is not None:
            return Route(Role.IMU, (imu,))
        for number, sensor in enumerate(self._sensors):
            if kind.stream in sensor.streams:
                return Route(Role.BAD_SIZE, (number,))
        return _UNASSIGNED

    def _may_own(
        self, sensor: DetectedSensor, kind: PacketKind, stream: Stream, payload: U8Array
    ) -> bool:
        if kind in sensor.kinds:
            return True
        if not sensor.selector.selects(stream):
            return False
        # Of a topic that turns out to have clouds of several lidars, only what the rig names.
        if (sensor.selector.frame_id, sensor.selector.lidar_id) != (
            stream.frame_id,
            stream.lidar_id,
        ):
            return False
        # A later stream joins only by the serial number in its packets, or by the rig's selector.
        if sensor.selector == StreamSelector() and not sensor.lidar.carries_serial:
            return False
        # Of a later stream, each packet is checked as it is read: one of them may be damaged.
        size = sensor.lidar.packet_size
        return kind not in self._early or bool(sensor.lidar.sent_by_me(payload[None, :size])[0])

    def _imu_owner(self, stream: Stream, size: int) -> int | None:
        """The sensor whose IMU sends this: a neighbour; of several, by the IMU port of each."""
        near = [
            number
            for number, sensor in enumerate(self._sensors)
            if sensor.lidar.is_imu(size)
            and any(
                are_neighbours(self._table.streams[other.stream], stream) for other in sensor.kinds
            )
        ]
        if len(near) > 1 and not stream.topic:
            near = [n for n in near if self._sensors[n].lidar.imu_port == stream.port]
        return near[0] if len(near) == 1 else None


def _is_sent_by(lidar: Lidar, batch: PacketBatch, rows: I64Array) -> BoolArray:
    """Which packets (k,) may be a lidar's, by their serial numbers."""
    start = batch.start[rows]
    if lidar.reader is None:
        return lidar.sent_by_me(batch.data[start[:, None] + np.arange(lidar.packet_size)])
    # Keys that are given are not computed.
    keys = np.zeros(len(rows), np.int64)
    return lidar.reader.read(batch.data, start, batch.host_ns[rows], keys).is_mine
