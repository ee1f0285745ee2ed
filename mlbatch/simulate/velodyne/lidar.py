"""A simulated Velodyne: rays of its firing sequences, data and position packets.

Source: docs/sources/velodyne.md sections 1, 2, 5 to 8, by way of the encoder.
"""

from __future__ import annotations

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.simulate.interface import (
    LidarFiles,
    LidarModel,
    LidarSettings,
    PacketTopic,
    Sent,
    Shots,
    SpinningLidar,
    readings,
    shots_of,
)
from mlbatch.simulate.velodyne.encode import (
    VelodyneSpec,
    advanced,
    directions,
    encode,
    firing_times_ns,
    origins,
    position_packets,
)
from mlbatch.simulate.velodyne.models import MODELS as TABLES
from mlbatch.simulate.velodyne.models import calibration_yaml
from mlbatch.units import NS_PER_S, NS_PER_US

DATA_PORT = 2368
POSITION_PORT = 8308
_HOUR_NS = 3600 * NS_PER_S
_DEVICE_NS = NS_PER_S // 2
_LARGEST = 65535
# The status bytes of an HDL-64E repeat after 16 packets.
_CHUNK_PACKETS = 48

MODELS = tuple(LidarModel(name, ("strongest", "last", "dual")) for name in TABLES)


class SimulatedVelodyne(SpinningLidar):
    """Firing sequences follow each other without a gap."""

    def __init__(self, settings: LidarSettings) -> None:
        """Choose the encoder's specification of the unit."""
        hour, past_ns = divmod(settings.start_ns, _HOUR_NS)
        self._spec = VelodyneSpec(
            settings.model,
            settings.mode,
            rpm=settings.rate_hz * 60.0,
            start_azimuth_deg=settings.phase_deg,
            start_us=past_ns / NS_PER_US,
            hour=hour,
        )
        needs_file = settings.model.startswith("HDL-64E")
        self.rig_model = settings.model if needs_file else ""
        text = calibration_yaml(settings.model) if needs_file else ""
        self.files = LidarFiles("yaml" if needs_file else "", text.encode())
        self.topics = {DATA_PORT: PacketTopic("velodyne_packets", "velodyne_msgs/VelodyneScan")}
        packet_us = self._spec.rows_per_packet * self._spec.row_us
        self.chunk_s = _CHUNK_PACKETS * packet_us * 1e-6
        self._packet_us = packet_us
        self._columns = np.arange(_CHUNK_PACKETS * self._spec.columns_per_packet)
        self._start_ns = settings.start_ns
        # The HDL-64E has no position packets (section 8).
        self._has_positions = not needs_file

    def shots(self, chunk: int) -> Shots:
        """Rays of the columns of a chunk."""
        spec = advanced(self._spec, chunk * _CHUNK_PACKETS)
        time_ns = firing_times_ns(spec, self._columns)
        return shots_of(time_ns, origins(spec, self._columns), directions(spec, self._columns))

    def packets(self, chunk: int, distance_m: F64Array, reflectivity: F64Array) -> list[Sent]:
        """Packets of a chunk, and position packets of the same time."""
        spec = advanced(self._spec, chunk * _CHUNK_PACKETS)
        table = spec.table
        past_m = distance_m - np.array(table.dist_m)
        sent = encode(spec, *readings(past_m, reflectivity, table.unit_m, _LARGEST, spec.returns))
        first_us = (chunk * _CHUNK_PACKETS + 1 + np.arange(_CHUNK_PACKETS)) * self._packet_us
        end_ns = self._start_ns + np.rint(first_us * NS_PER_US).astype(np.int64)
        data = [
            Sent(at, DATA_PORT, payload.tobytes())
            for at, payload in zip(end_ns.tolist(), sent.payloads, strict=True)
        ]
        return data + self._positions(chunk) if self._has_positions else data

    def _positions(self, chunk: int) -> list[Sent]:
        """Return position packets with the time of the GPS, two per second."""
        begin_ns = round(chunk * self.chunk_s * NS_PER_S)
        end_ns = round((chunk + 1) * self.chunk_s * NS_PER_S)
        after = range(-(-begin_ns // _DEVICE_NS) * _DEVICE_NS, end_ns, _DEVICE_NS)
        times_us = np.array([one / NS_PER_US for one in after], np.float64)
        sent = position_packets(self._spec, times_us)
        return [
            Sent(self._start_ns + at, POSITION_PORT, payload.tobytes())
            for at, payload in zip(after, sent.payloads, strict=True)
        ]


simulated = SimulatedVelodyne
