"""The two lidars of `fixtures/two_lidars`, as its SOURCE.md describes them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mlbatch.arrays import F64Array

FOLDER = Path(__file__).resolve().parents[2] / "fixtures" / "two_lidars"
BEAMS = 32
# 2026-05-04T08:00:00 UTC; the recording begins 20 ms later.
SECOND_NS = 1_777_881_600_000_000_000
START_NS = SECOND_NS + 20_000_000


@dataclass(frozen=True, slots=True)
class FixtureLidar:
    """One lidar; translation_m, rpy_deg: body_from_sensor."""

    name: str
    serial: str
    ip: str
    translation_m: tuple[float, float, float]
    rpy_deg: tuple[float, float, float]

    @property
    def metadata(self) -> dict[str, Any]:
        """Its metadata document."""
        text = (FOLDER / f"{self.name}.json").read_text(encoding="utf-8")
        found: dict[str, Any] = json.loads(text)
        return found


LEFT = FixtureLidar("left", "122647000123", "10.5.5.87", (0.3, 0.95, 2.45), (0.4, 22.0, 80.0))
RIGHT = FixtureLidar("right", "122648000456", "10.5.5.88", (0.28, -0.9, 2.4), (-0.6, 20.5, -78.0))


def pose(translation_m: Sequence[float], rpy_deg: Sequence[float]) -> F64Array:
    """(4, 4) by rotations about the fixed axes x, y, z; metres (docs/rig.md)."""
    (cr, cp, cy), (sr, sp, sy) = (f(np.radians(rpy_deg)) for f in (np.cos, np.sin))
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    matrix[:3, 3] = translation_m
    return matrix


def body_from_sensor(lidar: FixtureLidar) -> F64Array:
    """Extrinsics."""
    return pose(lidar.translation_m, lidar.rpy_deg)
