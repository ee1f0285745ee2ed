"""Models that can be simulated: those of the module `lidar` in each vendor's folder."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Mapping
from functools import lru_cache
from typing import cast

import mlbatch.simulate
from mlbatch.simulate.interface import LidarModel, LidarSettings, SimulatedLidar, Simulator


@lru_cache(maxsize=1)
def _simulators() -> Mapping[str, tuple[LidarModel, Simulator]]:
    """Return all models by name, with the module of each."""
    found = {}
    for vendor in pkgutil.iter_modules(mlbatch.simulate.__path__):
        if not vendor.ispkg:
            continue
        name = f"{mlbatch.simulate.__name__}.{vendor.name}.lidar"
        simulator = cast(Simulator, importlib.import_module(name))
        found.update({model.name: (model, simulator) for model in simulator.MODELS})
    return found


def lidar_models() -> Mapping[str, LidarModel]:
    """Return all models by name."""
    return {name: model for name, (model, _) in _simulators().items()}


def simulated_lidar(settings: LidarSettings) -> SimulatedLidar:
    """Return a lidar of one of the models."""
    return _simulators()[settings.model][1].simulated(settings)
