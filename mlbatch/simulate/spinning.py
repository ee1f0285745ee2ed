"""Spinning lidars: what the encoder of a vendor offers, and the simulation made of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import ClassVar

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array
from mlbatch.simulate.interface import (
    LidarFiles,
    LidarSettings,
    PacketTopic,
    Sent,
    Shots,
    SimulatedLidar,
    whole_counts,
)
from mlbatch.units import NS_PER_S


class SpinningSpec(ABC):
    """A unit to imitate: the shots of its columns, and packets of what they measured.

    A column is a firing of all channels (HESAI: of a group of blocks); column k is the k-th that is
    sent. Places of fields, angles and firing times come from the model's row in `mlbatch/sensors`,
    which tests compare with the documents and with bytes laid out by hand. The angles of a unit,
    where models have none, are made up.
    """

    # Where packets of the device go.
    device_port: ClassVar[int] = 0
    # Packets after which firing tables and status bytes repeat, and columns and ns are whole.
    chunk_packets: ClassVar[int] = 60
    topics: ClassVar[Mapping[int, PacketTopic]]
    model: str  # a row of the encoder's table
    mode: str  # of returns

    # What follows from the fields of a vendor's specification, which it sets in `__post_init__`.
    reported_model: str  # in `mlbatch sensors`
    rig_model: str = ""  # as in a rig, "" if packets identify it
    channels: int  # shots of a column
    returns: int  # of a shot
    columns_per_packet: float  # not whole where packets share one
    column_ns: float  # from column to column
    range_unit_m: float  # of a count of range
    largest: int = 65535  # count of range
    # (channels,) or (1,) what ranges are short of the distance from the beam's origin.
    range_offset_m: F64Array = np.zeros(1)
    device_period_ns: int = 0  # from packet to packet of the device; 0: it sends none
    begin_ns: int  # of the start, by the sensor's clock

    @property
    def files(self) -> LidarFiles:
        """Calibration of the unit."""
        return LidarFiles()

    def shape(self, packets: int) -> tuple[int, int, int]:
        """Columns, channels and returns of so many packets."""
        return round(packets * self.columns_per_packet), self.channels, self.returns

    @abstractmethod
    def advanced(self, packets: int) -> SpinningSpec:
        """The unit as it is so many packets later; a multiple of `chunk_packets`."""

    @abstractmethod
    def firing_times_ns(self, columns: int) -> I64Array:
        """(n, channels) when the beams fire, by the sensor's clock."""

    def said_times_ns(self, columns: int) -> I64Array:
        """(n, channels) the same by the timestamps of the packets, if they are rounded further."""
        return self.firing_times_ns(columns)

    def fires(self, columns: int) -> BoolArray:
        """(n, channels) which beams fire in a column."""
        return np.ones((columns, self.channels), np.bool_)

    @abstractmethod
    def directions(self, columns: int) -> F64Array:
        """(n, channels, 3) unit vectors at each beam's firing, sensor frame."""

    def origins(self, columns: int) -> F64Array:
        """(n, channels, 3) where the beams begin, m, sensor frame; or (1, 1, 3)."""
        return np.zeros((1, 1, 3))

    def in_view(self, directions: F64Array) -> BoolArray:
        """(n, channels) whether it measures in these directions."""
        return np.ones(directions.shape[:2], np.bool_)

    @abstractmethod
    def encode(self, counts: I64Array, levels: I64Array) -> list[Sent]:
        """Packets of these columns, which fill whole ones.

        counts, levels: (columns, channels, returns), range (0: no return) and intensity as on the
        wire. Raises ValueError for parts of packets.
        """

    def device_packet(self, after_ns: int) -> bytes:
        """A packet of the device, so long after the start."""
        raise NotImplementedError


class SimulatedSpinner(SimulatedLidar):
    """Columns of a spinning lidar follow each other without a gap."""

    def __init__(self, spec: SpinningSpec) -> None:
        self._spec = spec
        self.rig_model = spec.rig_model
        self.topics = spec.topics
        self.files = spec.files
        self._columns = spec.shape(spec.chunk_packets)[0]
        self.chunk_s = self._columns * spec.column_ns / NS_PER_S

    def shots(self, chunk: int) -> Shots:
        """Rays of the columns of a chunk."""
        spec = self._spec.advanced(chunk * self._spec.chunk_packets)
        time_ns = spec.firing_times_ns(self._columns)
        fires = spec.fires(self._columns)
        first_ns = np.where(fires, time_ns, time_ns.max()).min(axis=1)
        delay_s: F64Array = (time_ns - first_ns[:, None]) / NS_PER_S
        direction = spec.directions(self._columns)
        is_measured = fires & spec.in_view(direction)
        return Shots(first_ns, delay_s, spec.origins(self._columns), direction, is_measured)

    def packets(self, chunk: int, distance_m: F64Array, reflectivity: F64Array) -> list[Sent]:
        """Packets of a chunk, and the device's own packets of the same time."""
        spec = self._spec.advanced(chunk * self._spec.chunk_packets)
        range_m = distance_m - spec.range_offset_m
        counts = whole_counts(range_m, spec.range_unit_m, spec.largest)
        level = np.where(counts > 0, np.rint(reflectivity), 0.0).astype(np.int64)
        # All returns of a shot are equal.
        shape = (*counts.shape, spec.returns)
        readings = (np.broadcast_to(one[..., None], shape) for one in (counts, level))
        return spec.encode(*readings) + self._device_packets(chunk)

    def _device_packets(self, chunk: int) -> list[Sent]:
        period_ns = self._spec.device_period_ns
        if not period_ns:
            return []
        begin_ns, end_ns = (round(one * self.chunk_s * NS_PER_S) for one in (chunk, chunk + 1))
        return [
            Sent(
                self._spec.begin_ns + after_ns,
                self._spec.device_port,
                self._spec.device_packet(after_ns),
            )
            for after_ns in range(-(-begin_ns // period_ns) * period_ns, end_ns, period_ns)
        ]


def simulator(unit: Callable[[LidarSettings], SpinningSpec]) -> Callable[..., SimulatedLidar]:
    """Return `Simulator.simulated` of a vendor; unit: the specification of a unit."""
    return lambda settings: SimulatedSpinner(unit(settings))
