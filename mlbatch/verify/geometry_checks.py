"""Points of a scan against what their sensor measured: distance and direction."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import BoolArray, F64Array
from mlbatch.verify.scan import HeldScan, Points
from mlbatch.verify.verdict import Judge

Plane: TypeAlias = npt.NDArray[np.generic]

# Ranges count from where a beam leaves, a few cm from the origin of the sensor's frame; those of an
# HDL-64E lack the correction of their laser, 0.9 to 1.6 m. `FARTHEST_M`: what most points of a
# sensor may be off, `APART_M`: how much farther any of them may be.
FARTHEST_M, APART_M = 2.0, 1.0
# Of coordinates that were rounded to float32.
SHARE = 1e-5
# The direction of what lies this near to its sensor is rounding.
NEAR_M = 0.1


@dataclass(slots=True)
class Geometry:
    """Holds coordinates against ranges, distances and angles.

    poses: body from sensor, (s, 4, 4); None where no report tells them. off_m: what most points of
    a sensor's first scan are off.
    """

    judge: Judge
    poses: F64Array | None
    off_m: dict[int, float] = field(default_factory=dict)

    def check(self, scan: HeldScan, points: Points) -> None:
        """Judge one scan."""
        measured = (scan.range_m, scan.distance_m)
        if self.poses is None or not points.count or all(plane is None for plane in measured):
            return
        owner = points.lidar_id
        if owner is None and scan.sensor is None and len(self.poses) > 1:
            return
        pose = self.poses[scan.sensor or 0] if owner is None else self.poses[owner]
        apart_m: F64Array = points.xyz - pose[..., :3, 3]
        away_m: F64Array = np.sqrt((apart_m * apart_m).sum(axis=1))
        if scan.range_m is not None:
            self._ranges(scan, points, away_m, _picked(points, scan.range_m))
        # The largest coordinate was rounded, before the sensor's place was taken off.
        grain: F64Array = SHARE * (1 + np.abs(points.xyz).max(axis=1))
        if scan.distance_m is not None:
            said_m = _picked(points, scan.distance_m)
            wrong = ~(np.abs(away_m - said_m) <= grain)
            _blame(self.judge, scan, wrong, "distance from its sensor", away_m, said_m, "m")
        if scan.angles_rad is not None:
            own_m: F64Array = np.einsum("...ji,...j->...i", pose[..., :3, :3], apart_m)
            _check_angles(self.judge, scan, points, own_m, grain)

    def _ranges(self, scan: HeldScan, points: Points, away_m: F64Array, said_m: F64Array) -> None:
        off_m: F64Array = away_m - said_m
        owner = points.lidar_id
        sensors = [scan.sensor or 0] if owner is None else np.unique(owner).tolist()
        usual_m = np.zeros(len(self.poses) if self.poses is not None else 0)
        for sensor in sensors:
            if sensor not in self.off_m:
                own_m = off_m if owner is None else off_m[owner == sensor]
                middle_m = float(np.median(np.nan_to_num(own_m)))
                self.off_m[sensor] = middle_m if abs(middle_m) <= FARTHEST_M else 0.0
            usual_m[sensor] = self.off_m[sensor]
        away_from_usual = off_m - (usual_m[sensors[0]] if owner is None else usual_m[owner])
        wrong = ~(np.abs(away_from_usual) <= APART_M) | (said_m <= 0)
        _blame(self.judge, scan, wrong, "distance from its sensor", away_m, said_m, "m")


def _check_angles(
    judge: Judge, scan: HeldScan, points: Points, own_m: F64Array, grain: F64Array
) -> None:
    """Azimuth and elevation of points in the frames of their sensors."""
    if scan.angles_rad is None:
        return
    flat_m = np.hypot(own_m[:, 0], own_m[:, 1])
    wanted = np.arctan2(own_m[:, 1], own_m[:, 0]), np.arctan2(own_m[:, 2], flat_m)
    near: BoolArray = flat_m < NEAR_M
    for name, plane, angle in zip(("azimuth", "elevation"), scan.angles_rad, wanted, strict=True):
        said = _picked(points, plane)
        turned = np.abs(np.remainder(said - angle + np.pi, 2 * np.pi) - np.pi)
        wrong = ~(turned * flat_m <= grain * 2) & ~near
        _blame(judge, scan, wrong, name, angle, said, "rad")


def _picked(points: Points, plane: Plane) -> F64Array:
    picked: F64Array = (plane if points.valid is None else plane[points.valid]).astype(np.float64)
    return picked


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
