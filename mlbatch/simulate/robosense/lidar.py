"""A simulated ROBOSENSE: point and device packets, by the encoder."""

from __future__ import annotations

from mlbatch.simulate.interface import LidarModel, LidarSettings
from mlbatch.simulate.robosense.encode import RobosenseSpec
from mlbatch.simulate.robosense.models import EARLY
from mlbatch.simulate.robosense.models import MODELS as ROWS
from mlbatch.simulate.spinning import simulator

MODELS = tuple(
    LidarModel(name, tuple(row.modes), (10, 5, 20))
    for name, row in ROWS.items()
    if not name.endswith(EARLY)
)


def _unit(settings: LidarSettings) -> RobosenseSpec:
    return RobosenseSpec(
        settings.model,
        settings.mode,
        rpm=settings.rate_hz * 60,
        start_deg=settings.phase_deg,
        start_ns=settings.start_ns,
        serial=f"{settings.serial:012d}"[-12:],
    )


simulated = simulator(_unit)
