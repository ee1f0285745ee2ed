"""A simulated HESAI, by the encoder."""

from __future__ import annotations

from mlbatch.simulate.hesai.encode import HesaiSpec
from mlbatch.simulate.hesai.models import MODELS as ROWS
from mlbatch.simulate.interface import LidarModel, LidarSettings
from mlbatch.simulate.spinning import simulator


def _modes(name: str) -> tuple[str, ...]:
    """Return the return modes; JT16 has one, and seven blocks cannot have pairs of returns."""
    if name == "JT16":
        return ("strongest",)
    return ("strongest", "last") if ROWS[name].blocks % 2 else ("strongest", "last", "dual")


MODELS = tuple(
    LidarModel(name, _modes(name), (10,) if name == "AT128" else (10, 5, 20)) for name in ROWS
)


def _unit(settings: LidarSettings) -> HesaiSpec:
    return HesaiSpec(
        settings.model,
        settings.mode,
        rpm=settings.rate_hz * 60,
        start_deg=settings.phase_deg,
        start_ns=settings.start_ns,
    )


simulated = simulator(_unit)
