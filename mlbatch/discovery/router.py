"""Assignment of packets to sensors: by stream, payload size and what the packets contain.

A *kind* is a stream together with a payload size. Discovery matches the kinds of the first seconds
with calibrations or the rig; a kind that appears later joins a sensor only if its packets identify
the sensor.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from enum import Enum

from mlbatch.arrays import U8Array
from mlbatch.discovery.sampler import Found, Kind, is_beside
from mlbatch.rig.rig import StreamSelector
from mlbatch.types import Stream, StreamTable


class Role(Enum):
    """What the packets of a kind are."""

    LIDAR = "lidar"
    IMU = "imu"
    BAD_SIZE = "bad_size"
    UNASSIGNED = "unassigned"


@dataclass(frozen=True, slots=True)
class Route:
    """Where the packets of a kind go: numbers of sensors that may own them."""

    role: Role
    sensors: tuple[int, ...] = ()
    what: str = ""


class Router:
    """Tells for every kind which sensors it may come from; remembers the answer.

    early: the kinds from which the sensors were found.
    """

    def __init__(self, table: StreamTable, found: Sequence[Found], early: Collection[Kind]) -> None:
        self._table = table
        self._found = list(found)
        self._early = frozenset(early)
        self._routes: dict[Kind, Route] = {}

    def route(self, kind: Kind, payload: U8Array) -> Route:
        """Route of a kind; payload is one of its packets, looked at only the first time."""
        known = self._routes.get(kind)
        if known is None:
            known = self._routes[kind] = self._decide(kind, payload)
        return known

    def _decide(self, kind: Kind, payload: U8Array) -> Route:
        stream, size = self._table.streams[kind[0]], kind[1]
        owners = tuple(
            number
            for number, sensor in enumerate(self._found)
            if size in (sensor.lidar.packet_size, sensor.lidar.packet_size + 1)
            and self._may_own(sensor, kind, stream, payload)
        )
        if owners:
            self._join(kind, owners)
            return Route(Role.LIDAR, owners)
        imu = self._imu_owner(stream, size)
        if imu is not None:
            return Route(Role.IMU, (imu,))
        for number, sensor in enumerate(self._found):
            if any(stream_number == kind[0] for stream_number, _ in sensor.kinds):
                return Route(Role.BAD_SIZE, (number,))
        return Route(Role.UNASSIGNED)

    def _join(self, kind: Kind, owners: Sequence[int]) -> None:
        """A sensor is known to send a kind: what comes beside it may be its IMU."""
        for number in owners:
            if kind not in self._found[number].kinds:
                self._found[number].kinds.add(kind)
                self._routes = {
                    other: route
                    for other, route in self._routes.items()
                    if route.role is not Role.UNASSIGNED
                }

    def _may_own(self, sensor: Found, kind: Kind, stream: Stream, payload: U8Array) -> bool:
        if kind in sensor.kinds:
            return True
        if not sensor.selector.selects(stream):
            return False
        # A stream that was not there at the start joins only by the serial number it carries,
        # or because the rig says where the sensor sends from.
        if sensor.selector == StreamSelector() and not sensor.lidar.carries_serial:
            return False
        # One packet, which may be damaged, must not speak for all of a stream that begins late:
        # each of its packets is looked at.
        size = sensor.lidar.packet_size
        return kind not in self._early or bool(sensor.lidar.owns(payload[None, :size])[0])

    def _imu_owner(self, stream: Stream, size: int) -> int | None:
        """The sensor whose IMU this is: same source, and, among twins, the port it announces."""
        near = [
            number
            for number, sensor in enumerate(self._found)
            if sensor.lidar.is_imu(size)
            and any(is_beside(self._table.streams[other], stream) for other, _ in sensor.kinds)
        ]
        if len(near) > 1 and not stream.topic:
            near = [n for n in near if self._found[n].lidar.imu_port == stream.port]
        return near[0] if len(near) == 1 else None
