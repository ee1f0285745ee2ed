"""One instant of a comparison: the fused sets and the window of it, as clouds and figures."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.page.clouds import MOST_CHARS, CloudPoints, PageCloud, Place, joined_cloud
from mlbatch.page.document import cloud_data
from mlbatch.page.policies import offset_m
from mlbatch.units import NS_PER_MS

# Ages are drawn by direction, deg; nearer points have none that lidars share, m.
_SECTOR_DEG = 5
_NEAREST_M = 2.0
# Of the circle around a spot, and from the camera to it, m.
RADIUS_M = 2.5
_CAMERA_M = 12.5


@dataclass(frozen=True, slots=True)
class Spot:
    """The place where a fused set differs most from the window; centre_m: body frame.

    gain_ns: time between the lidars in the fused set, beyond that in the window; unmatched: points
    of the fused set, of `points` above the ground, without a point of the window near them; 0: only
    the times differ.
    """

    centre_m: tuple[float, float, float]
    gain_ns: float
    unmatched: int
    points: int

    @property
    def score(self) -> tuple[bool, float]:
        """What differs in place precedes what differs in time."""
        return self.unmatched > 0, self.gain_ns * max(1, self.unmatched)


@dataclass(frozen=True, slots=True, eq=False)
class InstantSet:
    """A fused set, or the window; ages in ms before the instant, by lidar; None: no column.

    ages_ms: oldest and newest column; points: None: no poses; spot_ms: time between the lidars at
    the spot, None if fewer than two see it; apart_ms: at all places that two see, median and
    largest.
    """

    name: str
    ages_ms: tuple[tuple[float, float] | None, ...]
    points: CloudPoints | None = None
    spot_ms: float | None = None
    apart_ms: tuple[float, float] | None = None

    @property
    def range_ms(self) -> tuple[float, float]:
        """Age of its oldest and newest column."""
        oldest, newest = zip(*(ages for ages in self.ages_ms if ages is not None), strict=True)
        return max(oldest), min(newest)

    def row(self, speed_mps: float) -> list[str]:
        """Cells of the table."""
        oldest, newest = self.range_ms
        apart = ["-"] * 5
        if self.spot_ms is not None:
            apart[:2] = f"{self.spot_ms:.1f}", f"{offset_m(speed_mps, self.spot_ms):.2f}"
        if self.apart_ms is not None:
            largest = offset_m(speed_mps, self.apart_ms[1])
            apart[2:] = *(f"{one:.1f}" for one in self.apart_ms), f"{largest:.2f}"
        return [self.name, f"{oldest:.1f} to {newest:.1f}", *apart]

    def ages_by_direction(self, lidar: int) -> list[tuple[float, float]]:
        """Azimuth in the body frame, deg, and median age, ms, of sectors with points of a lidar."""
        if self.points is None:
            return []
        x, y = self.points.xyz[:, 0], self.points.xyz[:, 1]
        own = np.flatnonzero((np.hypot(x, y) > _NEAREST_M) & (self.points.lidar == lidar))
        azimuth_deg = np.degrees(np.arctan2(y[own], x[own]))
        sector = np.floor(azimuth_deg / _SECTOR_DEG).astype(np.int64)
        age_ms = -self.points.time_ns[own] / NS_PER_MS
        return [
            ((number + 0.5) * _SECTOR_DEG, float(np.median(age_ms[sector == number])))
            for number in np.unique(sector).tolist()
        ]


@dataclass(frozen=True, slots=True, eq=False)
class SharedInstant:
    """The end of a window, and what each way to batch gives for it; sets: window last.

    at_s: after the first column; looked: number of instants compared; shown: index of the set that
    differs most; columns: (s,) of the window; why: reason why there are no clouds.
    """

    at_s: float
    looked: int
    sensors: tuple[str, ...]
    poses: tuple[F64Array, ...]
    period_ns: int
    columns: I64Array
    sets: tuple[InstantSet, ...]
    shown: int
    spot: Spot | None
    why: str = ""

    @property
    def range_ms(self) -> tuple[float, float]:
        """Age of the oldest and newest column of all sets."""
        oldest, newest = zip(*(one.range_ms for one in self.sets), strict=True)
        return max(oldest), min(newest)

    def clouds(self) -> list[PageCloud]:
        """The sets as a page stores them; every nth column where they would be too large."""
        stride = 1
        while True:
            clouds = [
                self._cloud(one.name, one.points, stride)
                for one in self.sets
                if one.points is not None
            ]
            share = sum(one.chars for one in clouds) / MOST_CHARS
            if share <= 1:
                return clouds
            stride = math.ceil(stride * share)

    def _cloud(self, name: str, points: CloudPoints, stride: int) -> PageCloud:
        first_ns, last_ns = (round(-age * NS_PER_MS) for age in self.range_ms)
        place = Place(name, 0, 0, 0, 0)
        times_ns = first_ns, last_ns
        return joined_cloud(
            place, [points], self.period_ns, self.columns, stride, times_ns=times_ns
        )

    def toggle(self, clouds: Sequence[PageCloud]) -> dict[str, object]:
        """The data of the player."""
        spot = self.spot and {
            "target": self.spot.centre_m,
            "radius": RADIUS_M,
            "distance": _CAMERA_M,
            # As the body looks at it.
            "yaw": math.atan2(self.spot.centre_m[1], self.spot.centre_m[0]),
        }
        return {
            "sensors": self.sensors,
            "poses": [pose[:3].ravel().tolist() for pose in self.poses],
            "begin": self.shown,
            "pair": [self.shown, len(clouds) - 1],
            "colour": "time",
            "spot": spot,
            "windows": None,
            "clouds": [
                # The caption begins with the title.
                cloud_data(replace(one, place=replace(one.place, title="")), 0.0)
                | {"title": one.place.title, "ages": True}
                | {"data": base64.b64encode(one.packed).decode()}
                for one in clouds
            ],
        }
