"""One instant of a comparison: the fused sets and the window of it, as clouds and figures."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.outputs.stored_scan import StoredScan
from mlbatch.page.clouds import MOST_CHARS
from mlbatch.page.document import cloud_data, kept_words
from mlbatch.page.points import PageCloud, Place, joined_cloud
from mlbatch.page.policies import offset_m
from mlbatch.units import NS_PER_MS

# Ages are drawn by direction, deg; nearer points have none that lidars share, m.
_SECTOR_DEG = 5
_NEAREST_M = 2.0
# From the camera to the place, in radii of it.
_CAMERA = 5.0
# Of the plots, in pixels.
_LEFT, _WIDTH, _HEIGHT, _LANE = 56, 900, 200, 14
HEAD = (
    *("set", "age, ms", "lidars apart at the place, ms", "offset there, m"),
    *("apart at all places: median, ms", "largest, ms", "largest offset, m"),
)


@dataclass(frozen=True, slots=True)
class Spot:
    """The place where a fused set differs most from the window; centre_m: body frame.

    unmatched: points of the fused set, of `points` above the ground, without a point of the window
    near them; 0: only the times differ.
    """

    centre_m: tuple[float, float, float]
    radius_m: float
    unmatched: int
    points: int


@dataclass(frozen=True, slots=True, eq=False)
class InstantSet:
    """A fused set, or the window; ages in ms before the instant, by lidar; None: no column.

    ages_ms: oldest and newest column; cloud: its `time_ns` after the instant, None: no poses;
    spot_ms: mean of the points at the spot; apart_ms: between the lidars at places that two see,
    median and largest.
    """

    name: str
    ages_ms: tuple[tuple[float, float] | None, ...]
    cloud: StoredScan | None = None
    spot_ms: tuple[float | None, ...] = ()
    apart_ms: tuple[float, float] | None = None

    @property
    def range_ms(self) -> tuple[float, float]:
        """Age of its oldest and newest column."""
        known = [ages for ages in self.ages_ms if ages is not None]
        return max(oldest for oldest, _ in known), min(newest for _, newest in known)

    @property
    def spot_apart_ms(self) -> float | None:
        """Time between the lidars at the spot; None if fewer than two see it."""
        known = [age for age in self.spot_ms if age is not None]
        return max(known) - min(known) if len(known) > 1 else None


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
        stored = [one.cloud for one in self.sets if one.cloud is not None]
        stride = 1
        while True:
            clouds = [self._cloud(number, one, stride) for number, one in enumerate(stored)]
            share = sum(one.chars for one in clouds) / MOST_CHARS
            if share <= 1:
                return clouds
            stride = math.ceil(stride * share)

    def _cloud(self, number: int, cloud: StoredScan, stride: int) -> PageCloud:
        place = Place(self.sets[number].name, number, number, 0, 0)
        first_ns, last_ns = (round(-age * NS_PER_MS) for age in self.range_ms)
        return joined_cloud(
            place, [cloud], self.period_ns, self.columns, stride, times_ns=(first_ns, last_ns)
        )


def toggle(instant: SharedInstant, clouds: Sequence[PageCloud]) -> dict[str, object]:
    """The data of the player."""
    spot = instant.spot
    return {
        "sensors": instant.sensors,
        "poses": [pose[:3].ravel().tolist() for pose in instant.poses],
        "begin": instant.shown,
        "pair": [instant.shown, len(clouds) - 1],
        "colour": "time",
        "spot": None
        if spot is None
        else {
            "target": spot.centre_m,
            "radius": spot.radius_m,
            "distance": _CAMERA * spot.radius_m,
            # As the body looks at it.
            "yaw": math.atan2(spot.centre_m[1], spot.centre_m[0]),
        },
        "clouds": [
            # The caption begins with the title.
            cloud_data(replace(one, place=Place("", 0, 0, 0, 0)), 0.0)
            | {"title": one.place.title, "ages": True}
            | {"data": base64.b64encode(one.packed).decode()}
            for one in clouds
        ],
    }


def about(instant: SharedInstant, clouds: Sequence[PageCloud]) -> str:
    """What the clouds are, in words."""
    kilobytes = sum(one.chars for one in clouds) / len(clouds) / 1000
    return (
        f"The end of a window, {instant.at_s:.1f} s after the first column: the one of "
        f"{instant.looked} instants at which a fused set differs most from the window. Of each "
        f"policy the set whose last column is nearest, with {kept_words(clouds[0])}; "
        f"{kilobytes:,.0f} kB per cloud. Age: time before the instant, negative after it."
    )


def place_words(instant: SharedInstant, speed_mps: float) -> str:
    """What differs at the place, and how far apart an object stands there."""
    fused, window = instant.sets[instant.shown], instant.sets[-1]
    spot = instant.spot
    if spot is None:
        return (
            "At no place are the lidars of a fused set farther apart in time than those of the "
            "window by 5 ms or more."
        )
    text = "In the circle the times of the lidars differ most."
    if spot.unmatched:
        text = (
            f"In the circle the clouds differ most: {spot.unmatched:,} of {spot.points:,} points "
            "of the fused set above the ground have no point of the window near them, since "
            "something moves there, or the body itself."
        )
    apart_ms = fused.spot_apart_ms
    if apart_ms is None:
        return text
    offset = f"{offset_m(speed_mps, apart_ms):.2f} m"
    window_ms = window.spot_apart_ms
    other = "one lidar alone sees it" if window_ms is None else _offset(speed_mps, window_ms)
    return (
        f"{text} There an object at {speed_mps:g} m/s stands at two places {offset} apart "
        f"({fused.name}: {apart_ms:.0f} ms between the lidars); in the window: {other}."
    )


def _offset(speed_mps: float, time_ms: float) -> str:
    return f"{offset_m(speed_mps, time_ms):.2f} m ({time_ms:.0f} ms)"


def rows(instant: SharedInstant, speed_mps: float) -> list[list[str]]:
    """Cells of the table, as HEAD."""
    found = []
    for one in instant.sets:
        oldest, newest = one.range_ms
        spot_ms = one.spot_apart_ms
        cells = [one.name, f"{oldest:.1f} to {newest:.1f}", "-", "-", "-", "-", "-"]
        if spot_ms is not None:
            cells[2:4] = f"{spot_ms:.1f}", f"{offset_m(speed_mps, spot_ms):.2f}"
        if one.apart_ms is not None:
            median_ms, most_ms = one.apart_ms
            offset = f"{offset_m(speed_mps, most_ms):.2f}"
            cells[4:] = f"{median_ms:.1f}", f"{most_ms:.1f}", offset
        found.append(cells)
    return found


# -- plots ------------------------------------------------------------------------------------


def ages_plot(instant: SharedInstant, ticks: Sequence[float]) -> dict[str, object]:
    """Bars from the oldest to the newest column of each lidar; ticks: ages, ms."""
    oldest, newest = instant.range_ms
    scale = (_WIDTH - 2 * _LEFT) / (oldest - newest)

    def x(age_ms: float) -> float:
        return _LEFT + (oldest - age_ms) * scale

    sets = []
    y = 4
    for one in instant.sets:
        bars = []
        for number, ages in enumerate(one.ages_ms):
            if ages is not None:
                name = instant.sensors[number]
                text = f"{one.name}, {name}: {ages[0]:.1f} to {ages[1]:.1f} ms before the instant"
                bar_y = y + 18 + number * _LANE
                bars.append(
                    (f"k{number % 4}", x(ages[0]), (ages[0] - ages[1]) * scale, bar_y, text)
                )
        first, last = one.range_ms
        sets.append((y + 13, f"{one.name}: {first - last:.0f} ms", bars))
        y += 28 + _LANE * len(instant.sensors)
    return {
        "height": y + 20,
        "sets": sets,
        "lane": _LANE - 3,
        "ticks": [(x(tick), f"{tick:g} ms") for tick in ticks if newest <= tick <= oldest],
    }


def direction_plots(instant: SharedInstant, ticks: Sequence[float]) -> list[dict[str, object]]:
    """Ages by direction, one plot per set; ticks: ages, ms."""
    oldest, newest = instant.range_ms
    inner = _WIDTH - _LEFT - 12

    def y(age_ms: float) -> float:
        return 14 + (oldest - age_ms) / (oldest - newest) * (_HEIGHT - 48)

    return [
        {
            "name": one.name,
            "height": _HEIGHT,
            "axis": {"unit": "ms", "ticks": [(y(tick), f"{tick:g}") for tick in ticks]},
            "directions": [
                (
                    _LEFT + (degrees + 180) / 360 * inner,
                    "end" if degrees == 180 else "middle",
                    f"{degrees} deg",
                )
                for degrees in range(-180, 181, 60)
            ],
            "paths": [
                (
                    f"k{number % 4}",
                    instant.sensors[number],
                    "".join(
                        f"M{_LEFT + (at + 180 - 2) / 360 * inner:.1f} {y(age):.1f}h{inner / 90:.1f}"
                        for at, age in ages
                    ),
                )
                for number, ages in enumerate(ages_by_direction(one.cloud, len(instant.sensors)))
            ],
        }
        for one in instant.sets
        if one.cloud is not None
    ]


def ages_by_direction(cloud: StoredScan, sensors: int) -> list[list[tuple[float, float]]]:
    """Azimuth in the body frame, deg, and median age, ms, of sectors with points, by lidar."""
    if cloud.time_ns is None or cloud.lidar_id is None:
        return []
    x, y = cloud.xyz[:, 0], cloud.xyz[:, 1]
    far = np.hypot(x, y) > _NEAREST_M
    sector = np.floor(np.degrees(np.arctan2(y, x)) / _SECTOR_DEG).astype(np.int64)
    found = []
    for number in range(sensors):
        own = np.flatnonzero(far & (cloud.lidar_id == number))
        order = own[np.argsort(sector[own], kind="stable")]
        edges = np.flatnonzero(np.diff(sector[order]))
        found.append(
            [
                (
                    (float(sector[some[0]]) + 0.5) * _SECTOR_DEG,
                    -float(np.median(cloud.time_ns[some])) / NS_PER_MS,
                )
                for some in np.split(order, edges + 1)
                if len(some)
            ]
        )
    return found
