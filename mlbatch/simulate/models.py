"""Models that can be simulated: those of the modules `simulate` in the folders of the vendors."""

from __future__ import annotations

import importlib
import importlib.util
import pkgutil
from collections.abc import Mapping
from functools import lru_cache
from typing import cast

import mlbatch.sensors
from mlbatch.lidar.simulated import LidarModel, LidarSettings, SimulatedLidar, Simulator


@lru_cache(maxsize=1)
def _simulators() -> Mapping[str, tuple[LidarModel, Simulator]]:
    """Return all models by name, with the module of each."""
    found = {}
    for vendor in pkgutil.iter_modules(mlbatch.sensors.__path__):
        name = f"{mlbatch.sensors.__name__}.{vendor.name}.simulate"
        if not vendor.ispkg or importlib.util.find_spec(name) is None:
            continue
        simulator = cast(Simulator, importlib.import_module(name))
        found.update({model.name: (model, simulator) for model in simulator.MODELS})
    return found


def lidar_models() -> Mapping[str, LidarModel]:
    """Return all models by name."""
    return {name: model for name, (model, _) in _simulators().items()}


def simulated_lidar(settings: LidarSettings) -> SimulatedLidar:
    """Return a lidar of one of the models."""
    return _simulators()[settings.model][1].simulated(settings)
