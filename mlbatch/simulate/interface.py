"""The interface of a simulated lidar: rays of its shots, and packets of measured distances.

The module `encode` in the folder of a vendor offers it. Columns are sent in chunks of constant
length, so that recordings of any length need constant memory; the number of a chunk determines its
columns.
"""

from __future__ import annotations

import importlib
import pkgutil
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol, cast

import numpy as np

import mlbatch.simulate
from mlbatch.arrays import BoolArray, F64Array, I64Array


@dataclass(frozen=True, slots=True)
class LidarModel:
    """A model that can be simulated, and its options; the first of each is the default.

    modes: of returns; profiles, columns: of Ouster packets, () for others; rates_hz: of the rotor.
    """

    name: str
    modes: tuple[str, ...]
    rates_hz: tuple[int, ...] = (10, 5, 15, 20)
    profiles: tuple[str, ...] = ()
    columns: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class LidarSettings:
    """A lidar to simulate; values are among those of its `LidarModel`.

    phase_deg: rotation of the rotor at the start; start_ns: sensor clock of the first column;
    serial: number of the unit, decimal digits; imu: whether it sends IMU packets.
    """

    model: str
    mode: str
    rate_hz: int
    profile: str
    columns: int
    phase_deg: float
    start_ns: int
    serial: int
    imu: bool


@dataclass(frozen=True, slots=True, eq=False)
class Shots:
    """Rays of n columns of c channels, sensor frame.

    time_ns: (n,) first firing of each column, sensor clock; delay_s: (1 or n, c) later firing of
    each channel; origin_m, direction: (n, c, 3), m and unit vectors; fires: (n, c) channels that
    fire, None for all.
    """

    time_ns: I64Array
    delay_s: F64Array
    origin_m: F64Array
    direction: F64Array
    fires: BoolArray | None = None


@dataclass(frozen=True, slots=True)
class Sent:
    """A packet; time_ns: sensor clock when it is complete."""

    time_ns: int
    port: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class PacketTopic:
    """Topic and message type of the packets of a port in bags; of_device: as `PacketMessages`."""

    name: str
    message: str
    of_device: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class ImuUnit:
    """The IMU within a lidar; sensor_from_imu: (4, 4), m."""

    rate_hz: int
    sensor_from_imu: F64Array


@dataclass(frozen=True, slots=True)
class LidarFiles:
    """Calibration of a unit: a file next to the recording, or a latched message in bags.

    name: suffix of the file, "" for none; topic: of a std_msgs/String with the same text, "": none.
    """

    name: str = ""
    content: bytes = b""
    topic: str = ""


class SimulatedLidar(ABC):
    """A lidar that sends packets; its rotor has constant speed by its own clock."""

    # Name of the model as in a rig, "" if packets identify it.
    rig_model: str = ""
    # Destination ports, and their topics; ports without a topic are left out of bags.
    topics: Mapping[int, PacketTopic]
    files: LidarFiles = LidarFiles()
    # Seconds by the sensor clock from chunk to chunk.
    chunk_s: float
    imu: ImuUnit | None = None

    @abstractmethod
    def shots(self, chunk: int) -> Shots:
        """Rays of the columns of a chunk."""

    @abstractmethod
    def packets(self, chunk: int, distance_m: F64Array, reflectivity: F64Array) -> list[Sent]:
        """Packets of a chunk, and others of the same time, in any order.

        distance_m: (n, c) from the origins of the rays, inf for no return; reflectivity: (n, c), 0
        to 255.
        """

    def imu_packets(
        self, time_ns: I64Array, acceleration: F64Array, angular_velocity: F64Array
    ) -> list[Sent]:
        """Packets of IMU samples: (n,) sensor clock, (n, 3) m/s2 and rad/s, frame of the IMU."""
        return []


class Simulator(Protocol):
    """Interface of the module `encode` of a vendor."""

    LIDARS: tuple[LidarModel, ...]

    def simulated(self, settings: LidarSettings) -> SimulatedLidar:
        """Return the lidar."""
        ...


def whole_counts(distance_m: F64Array, unit_m: float, largest: int) -> I64Array:
    """Return distances in whole units of a packet; 0 where none comes back or it does not fit."""
    counts = distance_m * (1.0 / unit_m)
    fits = (counts >= 0.5) & (counts < largest + 0.5)
    return np.rint(np.where(fits, counts, 0.0)).astype(np.int64)


@lru_cache(maxsize=1)
def _simulators() -> Mapping[str, tuple[LidarModel, Simulator]]:
    """Return all models by name, with the module of each."""
    found = {}
    for vendor in pkgutil.iter_modules(mlbatch.simulate.__path__):
        if not vendor.ispkg:
            continue
        name = f"{mlbatch.simulate.__name__}.{vendor.name}.encode"
        simulator = cast(Simulator, importlib.import_module(name))
        found.update({model.name: (model, simulator) for model in simulator.LIDARS})
    return found


def lidar_models() -> Mapping[str, LidarModel]:
    """Return all models by name."""
    return {name: model for name, (model, _) in _simulators().items()}


def simulated_lidar(settings: LidarSettings) -> SimulatedLidar:
    """Return a lidar of one of the models."""
    return _simulators()[settings.model][1].simulated(settings)
