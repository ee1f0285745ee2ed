"""Scenarios of the study: an agile two-lidar rig in a yard, another one for each seed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml

# Part of the settings by which results are kept: change it with anything below.
WORLD = "yard-1"
STANDSTILL_S = 1.0
_STEP_DEG = 30.0
_SWAY = (  # coordinate, amplitude (deg or m), frequency (Hz)
    ("yaw", 8.0, 0.35),
    ("roll", 1.5, 0.6),
    ("pitch", 1.5, 0.7),
    ("z", 0.02, 0.9),
)


def write_scenario(path: Path, seed: int, duration_s: float) -> None:
    """Write a scenario for `mlbatch simulate`: scene, way and phases of the sway by the seed."""
    random = np.random.default_rng((2, seed))
    scenario = {
        "schema": "mlbatch.scenario/1",
        "seed": seed,
        "duration_s": duration_s,
        "motion": {
            "standstill_s": STANDSTILL_S,
            "above_ground": True,
            "waypoints": _way(random, duration_s),
            "sway": [
                {
                    "coordinate": name,
                    "amplitude": amplitude,
                    "frequency_hz": round(frequency * random.uniform(0.8, 1.2), 3),
                    "phase_deg": round(random.uniform(0.0, 360.0), 1),
                }
                for name, amplitude, frequency in _SWAY
            ],
        },
        "scene": {
            # Walls around the yard, from inside.
            "rectangles": _walls(),
            "terrain": {"half_size_m": 40, "relief_m": 0.3, "wavelength_m": 25},
            "boxes": _boxes(random),
            "forest": [
                {
                    "area_m": [-30, -24, 30, 24],
                    "per_hectare": 60,
                    "radius_m": [0.1, 0.3],
                    "height_m": [4, 10],
                    "taper": 0.5,
                    "clearance_m": 2.0,
                }
            ],
        },
        "sensors": [_lidar("left", 1.0, 0.0), _lidar("right", -1.0, 133.0)],
        "truth": {"rate_hz": 200},
    }
    path.write_text(yaml.safe_dump(scenario, sort_keys=False), encoding="utf-8")


def _way(random: np.random.Generator, duration_s: float) -> list[list[float]]:
    """Waypoints around the centre, 1.5 to 2.5 m/s; radii that vary make the rig turn."""
    begin = random.uniform(0.0, 360.0)
    sense = random.choice([-1.0, 1.0])
    rows: list[list[float]] = []
    time_s, last = 0.0, np.zeros(2)
    while time_s < duration_s + 5.0:
        angle = np.radians(begin + sense * _STEP_DEG * len(rows))
        place = random.uniform(9.0, 14.0) * np.array([np.cos(angle), np.sin(angle)])
        if rows:
            time_s += float(np.hypot(*(place - last)) / random.uniform(1.5, 2.5))
        rows.append([round(time_s, 3), *np.round(place, 3).tolist(), 0.1])
        last = place
    return rows


def _walls() -> list[dict[str, object]]:
    """Four walls of 6 m height, 64 x 52 m."""
    corners = np.array([[-32, -26], [32, -26], [32, 26], [-32, 26]])
    return [
        {
            "corner_m": [*corner.tolist(), -2],
            "along_m": [*(following - corner).tolist(), 0],
            "across_m": [0, 0, 8],
        }
        for corner, following in zip(corners, np.roll(corners, -1, axis=0), strict=True)
    ]


def _boxes(random: np.random.Generator) -> list[dict[str, object]]:
    """Boxes inside and outside of the way: containers, walls, stacks."""
    places = [(random.uniform(0.0, 3.5), 1.5) for _ in range(3)]
    places += [(random.uniform(18.0, 26.0), 3.0) for _ in range(18)]
    rows: list[dict[str, object]] = []
    for away, half in places:
        angle = random.uniform(0.0, 2 * np.pi)
        size = random.uniform((0.6 * half, 0.3 * half, 1.5), (1.5 * half, half, 4.0))
        centre = [away * np.cos(angle), away * np.sin(angle), 0.4 * size[2]]
        rows.append(
            {
                "centre_m": np.round(centre, 3).tolist(),
                "size_m": np.round(size, 3).tolist(),
                "yaw_deg": round(random.uniform(0.0, 180.0), 1),
            }
        )
    return rows


def _lidar(name: str, side: float, phase_deg: float) -> dict[str, object]:
    """An OS1-32 on one side; 133 degrees at 10 Hz are 37 ms."""
    return {
        "name": name,
        "model": "OS1-32",
        "profile": "RNG15_RFL8_NIR8",
        "phase_deg": phase_deg,
        "max_range_m": 60,
        "dropout": 0.02,
        "extrinsics": {
            "translation_m": [0.3, 0.5 * side, 1.6],
            "rotation_rpy_deg": [0, 15, 80 * side],
        },
    }
