"""A simulated HESAI: rays of its firing groups, packets and the angle file of the unit.

Source: docs/sources/hesai.md sections 2 to 8, by way of the encoder.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.simulate.hesai.angles import Angles, Beams, MirrorAngles, angles_csv, fan
from mlbatch.simulate.hesai.encode import (
    HesaiSpec,
    advanced,
    directions,
    encode_packets,
    fires,
    firing_times_ns,
    packet_times_ns,
)
from mlbatch.simulate.hesai.models import MODELS as ROWS
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
from mlbatch.units import NS_PER_S, RAD_PER_DEG

DATA_PORT = 2368
_MODES = {"strongest": 0x37, "last": 0x38, "dual": 0x39}
_LARGEST = 65535
# A multiple of the packets after which times are whole ns (3) and firing tables repeat (4).
_CHUNK_PACKETS = 60
_MIRROR_STARTS_DEG = (20.0, 140.0, 260.0)
# Azimuths in which an AT128 measures, from the middle of a mirror's field.
_HALF_VIEW_DEG = 60.0
_TYPE = "hesai_ros_driver/UdpFrame"


def _modes(name: str) -> tuple[str, ...]:
    """Return the return modes; JT16 has one, and seven blocks cannot have pairs of returns."""
    modes = tuple(_MODES)
    if name == "JT16":
        return modes[:1]
    return modes[:2] if ROWS[name].blocks % 2 else modes


MODELS = tuple(
    LidarModel(name, _modes(name), (10,) if name == "AT128" else (10, 5, 20)) for name in ROWS
)


class SimulatedHesai(SpinningLidar):
    """Firing groups follow each other without a gap."""

    def __init__(self, settings: LidarSettings) -> None:
        """Choose the encoder's specification of the unit, and its angles."""
        rpm = settings.rate_hz * 60
        self._spec = HesaiSpec(
            settings.model,
            _MODES[settings.mode],
            rpm=rpm,
            start_deg=settings.phase_deg,
            start_ns=settings.start_ns,
        )
        row = self._spec.row
        elevation, azimuth = fan(settings.model, row.channels)
        self._beams: Beams = Angles(elevation, azimuth)
        self.files = LidarFiles("csv", angles_csv(elevation, azimuth))
        self._has_mirrors = settings.model == "AT128"
        if self._has_mirrors:
            mirrors = MirrorAngles(_MIRROR_STARTS_DEG, elevation, azimuth)
            self._beams = mirrors
            self.files = LidarFiles("dat", mirrors.dat())
        self.topics = {DATA_PORT: PacketTopic("hesai_packets", _TYPE)}
        self._columns = _CHUNK_PACKETS * self._spec.groups
        self.chunk_s = float(row.step_ns * self._columns) / NS_PER_S

    def shots(self, chunk: int) -> Shots:
        """Rays of the columns of a chunk."""
        spec = advanced(self._spec, chunk * _CHUNK_PACKETS)
        time_ns = firing_times_ns(spec, self._columns)
        fired = fires(spec, self._columns)
        direction = directions(spec, self._beams, self._columns)
        shots = shots_of(time_ns, np.zeros((1, 1, 3)), direction, fired)
        if self._has_mirrors:
            # The middle of the field is at twice 60 degrees of the mirror.
            azimuth = np.arctan2(direction[..., 0], direction[..., 1]) / RAD_PER_DEG % 360.0
            return replace(shots, fires=fired & (np.abs(azimuth - 120.0) <= _HALF_VIEW_DEG))
        return shots

    def packets(self, chunk: int, distance_m: F64Array, reflectivity: F64Array) -> list[Sent]:
        """Packets of a chunk."""
        spec = advanced(self._spec, chunk * _CHUNK_PACKETS)
        unit_m = spec.row.unit_mm / 1000.0
        values = readings(distance_m, reflectivity, unit_m, _LARGEST, spec.returns)
        payloads = encode_packets(spec, *values)
        last_ns = firing_times_ns(spec, self._columns).reshape(_CHUNK_PACKETS, -1).max(axis=1)
        ready_ns = np.maximum(last_ns, packet_times_ns(spec, _CHUNK_PACKETS)).tolist()
        return [Sent(at, DATA_PORT, one) for at, one in zip(ready_ns, payloads, strict=True)]


simulated = SimulatedHesai
