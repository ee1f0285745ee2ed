"""A simulated Velodyne: data and position packets, by the encoder."""

from __future__ import annotations

from mlbatch.simulate.interface import LidarModel, LidarSettings
from mlbatch.simulate.spinning import simulator
from mlbatch.simulate.velodyne.encode import VelodyneSpec
from mlbatch.simulate.velodyne.models import MODELS as TABLES
from mlbatch.units import NS_PER_S, NS_PER_US

_HOUR_NS = 3600 * NS_PER_S
MODELS = tuple(LidarModel(name, ("strongest", "last", "dual")) for name in TABLES)


def _unit(settings: LidarSettings) -> VelodyneSpec:
    hour, past_ns = divmod(settings.start_ns, _HOUR_NS)
    return VelodyneSpec(
        settings.model,
        settings.mode,
        rpm=settings.rate_hz * 60.0,
        start_azimuth_deg=settings.phase_deg,
        start_us=past_ns / NS_PER_US,
        hour=hour,
    )


simulated = simulator(_unit)
