"""A simulated ROBOSENSE: rays of its firing rounds, point and device packets.

Source: docs/sources/robosense.md sections 1 to 7, by way of the encoder.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.simulate.interface import (
    LidarModel,
    LidarSettings,
    PacketTopic,
    Sent,
    Shots,
    SpinningLidar,
    readings,
    shots_of,
)
from mlbatch.simulate.robosense.encode import (
    RobosenseSpec,
    advanced,
    difop,
    directions,
    fan,
    firing_times_ns,
    msop,
    origins,
)
from mlbatch.simulate.robosense.models import MODELS as ROWS
from mlbatch.units import NS_PER_S

MSOP_PORT = 6699
DIFOP_PORT = 7788
_DIFOP_NS = NS_PER_S // 10
_LARGEST = 65535
# Airy: two bits of a range are flags (section 4).
_AIRY_FLAG = 0x4000
_AIRY_LARGEST = 0x3FFF
_CHUNK_PACKETS = 60
_TYPE = "rslidar_msg/RslidarPacket"
# Rows for packets that name their model a byte earlier, and other kinds of one model.
_EARLY = ", early type"

MODELS = tuple(
    LidarModel(name, tuple(mode for mode in row.modes), (10, 5, 20))
    for name, row in ROWS.items()
    if not name.endswith(_EARLY)
)


class SimulatedRobosense(SpinningLidar):
    """Firing rounds follow each other without a gap."""

    def __init__(self, settings: LidarSettings) -> None:
        """Choose the encoder's specification of the unit, and its angles."""
        self._spec = RobosenseSpec(
            settings.model,
            settings.mode,
            rpm=settings.rate_hz * 60,
            start_deg=settings.phase_deg,
            start_ns=settings.start_ns,
            serial=f"{settings.serial:012d}"[-12:],
        )
        self._angles = fan(self._spec)
        self.topics = {
            MSOP_PORT: PacketTopic("rslidar_packets", _TYPE),
            DIFOP_PORT: PacketTopic("rslidar_packets", _TYPE, of_device=True),
        }
        self._columns = np.arange(round(_CHUNK_PACKETS * self._spec.columns_per_packet))
        self.chunk_s = len(self._columns) * self._spec.round_ns / NS_PER_S
        is_airy = settings.model.startswith("Airy")
        self._flag = _AIRY_FLAG if is_airy else 0
        self._largest = _AIRY_LARGEST if is_airy else _LARGEST

    def shots(self, chunk: int) -> Shots:
        """Rays of the columns of a chunk."""
        spec = advanced(self._spec, chunk * _CHUNK_PACKETS)
        time_ns = firing_times_ns(spec, self._columns)
        direction = directions(spec, self._angles, self._columns)
        return shots_of(time_ns, origins(spec, self._columns), direction)

    def packets(self, chunk: int, distance_m: F64Array, reflectivity: F64Array) -> list[Sent]:
        """Packets of a chunk, and device packets of the same time."""
        spec = advanced(self._spec, chunk * _CHUNK_PACKETS)
        # Receive times are those of the simulation.
        spec = replace(spec, latency_ns=0)
        counts, level = readings(
            distance_m, reflectivity, spec.range_unit_m, self._largest, spec.returns
        )
        data = [Sent(at, MSOP_PORT, one) for at, one in msop(spec, counts + self._flag, level)]
        return data + self._device_packets(chunk)

    def _device_packets(self, chunk: int) -> list[Sent]:
        chunk_ns = len(self._columns) * self._spec.round_ns
        begin_ns = chunk * chunk_ns
        first = -(-begin_ns // _DIFOP_NS) * _DIFOP_NS
        times = range(
            self._spec.start_ns + first, self._spec.start_ns + begin_ns + chunk_ns, _DIFOP_NS
        )
        return [Sent(at, DIFOP_PORT, difop(self._spec, self._angles, time_ns=at)) for at in times]


simulated = SimulatedRobosense
