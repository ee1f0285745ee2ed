"""Points of a scan against what their sensor measured: distance and direction."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.types import BoolArray, F64Array
from mlbatch.verify.scan import HeldScan, Points
from mlbatch.verify.verdict import Judge

Plane: TypeAlias = npt.NDArray[np.generic]

# Beams leave a few cm from where a sensor's frame has its origin, and ranges count from there.
OFF_CENTRE_M = 0.5
# Of coordinates that were rounded to float32.
SHARE = 1e-5
# The direction of what lies this near to its sensor is rounding.
NEAR_M = 0.1


def check_geometry(judge: Judge, scan: HeldScan, points: Points, poses: F64Array | None) -> None:
    """Hold coordinates against ranges, distances and angles; poses: body from sensor, (s, 4, 4)."""
    measured = (scan.range_m, scan.distance_m)
    if poses is None or not points.count or all(plane is None for plane in measured):
        return
    owner = points.lidar_id
    if owner is None and scan.sensor is None and len(poses) > 1:
        return
    pose = poses[scan.sensor or 0] if owner is None else poses[owner]
    apart_m: F64Array = points.xyz - pose[..., :3, 3]
    away_m: F64Array = np.sqrt((apart_m * apart_m).sum(axis=1))
    if scan.range_m is not None:
        room_m: F64Array = np.full(points.count, OFF_CENTRE_M)
        _check_lengths(judge, scan, away_m, _picked(points, scan.range_m), room_m)
    # The largest coordinate was rounded, before the sensor's place was taken off.
    grain: F64Array = SHARE * (1 + np.abs(points.xyz).max(axis=1))
    if scan.distance_m is not None:
        _check_lengths(judge, scan, away_m, _picked(points, scan.distance_m), grain)
    if scan.angles_rad is not None:
        own_m: F64Array = np.einsum("...ji,...j->...i", pose[..., :3, :3], apart_m)
        flat_m = np.hypot(own_m[:, 0], own_m[:, 1])
        azimuth = np.arctan2(own_m[:, 1], own_m[:, 0])
        elevation = np.arctan2(own_m[:, 2], flat_m)
        near: BoolArray = flat_m < NEAR_M
        for name, plane, wanted in zip(
            ("azimuth", "elevation"), scan.angles_rad, (azimuth, elevation), strict=True
        ):
            said = _picked(points, plane)
            turned = np.abs(np.remainder(said - wanted + np.pi, 2 * np.pi) - np.pi)
            wrong = ~(turned * flat_m <= grain * 2) & ~near
            _blame(judge, scan, wrong, name, wanted, said, "rad")


def _picked(points: Points, plane: Plane) -> F64Array:
    picked: F64Array = (plane if points.valid is None else plane[points.valid]).astype(np.float64)
    return picked


def _check_lengths(
    judge: Judge, scan: HeldScan, away_m: F64Array, said_m: F64Array, room_m: F64Array
) -> None:
    wrong = ~(np.abs(away_m - said_m) <= room_m) | (said_m <= 0)
    _blame(judge, scan, wrong, "distance from its sensor", away_m, said_m, "m")


def _blame(
    judge: Judge,
    scan: HeldScan,
    wrong: BoolArray,
    name: str,
    wanted: F64Array,
    said: F64Array,
    unit: str,
) -> None:
    if wrong.any():
        first = int(wrong.argmax())
        text = f"{name} {wanted[first]:.6g} {unit} of its coordinates"
        judge.none(
            "geometry", scan.point, wrong, text, lambda at: f"{said[at]:.6g} {unit} in the output"
        )
    else:
        judge.passed("geometry", wrong.size)
