"""The page of a calibration: the same walls before and after, as static HTML and SVG."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import BoolArray, F32Array, F64Array
from mlbatch.page.templates import Verdict, render
from mlbatch.poses.calibration import Calibration, View
from mlbatch.poses.surfaces import Planes, planes, shared_cells

_SIZE = 440
# Points of a lidar in a picture.
_MOST_POINTS = 4000
# Half of the thickness of what a picture shows, m.
_SLAB_M = 0.25
_MOST_HALF_M = 25.0
_LEAST_HALF_M = 3.0
# Half of what the picture of one wall shows, m.
_WALL_M = 1.5
_EDGE_M = 1.0
_UPRIGHT = 0.3
_AXES = "xyz"

Clouds = Sequence[F32Array]


@dataclass(frozen=True, slots=True)
class _Cut:
    """A picture of a slab: its axes across, up and through the slab; centre (3,), m."""

    title: str
    axes: tuple[int, int, int]
    centre_m: F64Array
    half_m: float


def calibration_page(title: str, found: Calibration, command: str) -> str:
    """The whole page."""
    return render(
        "calibration.html",
        title=title,
        verdict=_verdict(found),
        size=_SIZE,
        names=[lidar.name for lidar in found.lidars],
        cuts=[]
        if found.view is None
        else [_pictures(found.view, cut) for cut in _cuts(found.view.after)],
        lidars=found.rows(),
        pairs=found.pair_rows(),
        imus=found.imu_rows(),
        notes=found.notes()[bool(found.level) :],
        command=command,
    )


def _verdict(found: Calibration) -> Verdict:
    if not found.pairs:
        return Verdict(
            "note",
            "Calibration",
            "Poses by motion alone",
            "The lidars share no surfaces that determine their poses, nor any to measure them on.",
            found.title(),
        )
    worst = max(found.pairs, key=lambda pair: pair.after.apart_mm)
    heading = (
        f"Surfaces of {worst.first} and {worst.second} are {worst.after.apart_mm:.1f} mm apart, "
        f"{worst.before.apart_mm:.1f} mm before"
    )
    others = (
        f"{100 * worst.after.share:.0f} % of the surfaces in common agree within 10 cm, "
        f"{100 * worst.before.share:.0f} % did before. All six directions of every pose are "
        "determined."
    )
    if found.level:
        others += f" {found.level}."
    return Verdict("note" if found.level else "good", "Calibration", heading, others, found.title())


# -- pictures -------------------------------------------------------------------------------------


def _cuts(clouds: Clouds) -> list[_Cut]:
    """A slab from above, one wall of it, and a slab from the side, by what lidars share."""
    cells = _shared(clouds)
    normal, mean_m = np.abs(cells.normal), cells.mean_m
    upright = normal[:, 2] < _UPRIGHT
    height_m = _middle(mean_m[:, 2], upright)
    across_m = _middle(mean_m[:, 1], normal[:, 1] < _UPRIGHT)
    above = np.array([0.0, 0.0, height_m])
    aside = np.array([0.0, across_m, 0.0])
    cuts = [
        _Cut(f"From above, {height_m:.1f} m high", (0, 1, 2), above, _half_m(clouds, above, 2)),
        _Cut(f"From the side, y {across_m:.1f} m", (0, 2, 1), aside, _half_m(clouds, aside, 1)),
    ]
    near = upright & (np.abs(mean_m[:, 2] - height_m) < _EDGE_M)
    if near.any():
        walls_m = mean_m[near]
        wall_m = walls_m[np.argmin((walls_m**2).sum(axis=1))]
        cuts.insert(1, _Cut("The nearest wall of it", (0, 1, 2), wall_m, _WALL_M))
    return cuts


def _shared(clouds: Clouds) -> Planes:
    """Planes of a lidar in cells in which another one has a plane, too."""
    found = [planes(cloud.astype(np.float64), np.zeros(len(cloud)), _EDGE_M) for cloud in clouds]
    best = found[0].take(np.zeros(0, np.int64))
    for number, first in enumerate(found):
        for second in found[number + 1 :]:
            rows, _ = shared_cells(first, second)
            if len(rows) > len(best.key):
                best = first.take(rows)
    return best


def _middle(values: F64Array, chosen: BoolArray) -> float:
    """Median of chosen values, else of all."""
    some = values[chosen] if chosen.any() else values
    return float(np.median(some)) if len(some) else 0.0


def _half_m(clouds: Clouds, centre_m: F64Array, axis: int) -> float:
    """Half of the edge of a picture that shows most of a slab."""
    inside = np.concatenate(
        [cloud[np.abs(cloud[:, axis] - centre_m[axis]) < _SLAB_M] for cloud in clouds]
    )
    flat = np.delete(np.abs(inside), axis, axis=1)
    reach = float(np.quantile(flat.max(axis=1), 0.9)) if len(flat) else _LEAST_HALF_M
    return min(_MOST_HALF_M, max(_LEAST_HALF_M, reach))


def _pictures(view: View, cut: _Cut) -> dict[str, object]:
    """Pictures of a cut, before and after, as paths of dots."""
    across, up, _ = (_AXES[axis] for axis in cut.axes)
    return {
        "title": cut.title,
        "about": f"{across} to the right, {up} up; {2 * cut.half_m:.1f} m wide",
        "pictures": [
            ("before", [_dots(cloud, cut) for cloud in view.before]),
            ("calibrated", [_dots(cloud, cut) for cloud in view.after]),
        ],
    }


def _dots(cloud: F32Array, cut: _Cut) -> str:
    """Points of a slab as the path of an SVG."""
    off_m = cloud.astype(np.float64) - cut.centre_m
    across, up, depth = (off_m[:, axis] for axis in cut.axes)
    inside = (np.abs(depth) < _SLAB_M) & (np.maximum(np.abs(across), np.abs(up)) < cut.half_m)
    rows = np.flatnonzero(inside)
    rows = rows[:: max(1, -(-len(rows) // _MOST_POINTS))]
    scale = _SIZE / (2 * cut.half_m)
    x, y = _SIZE / 2 + across[rows] * scale, _SIZE / 2 - up[rows] * scale
    dots = dict.fromkeys(f"M{a:.1f} {b:.1f}h0" for a, b in zip(x.tolist(), y.tolist(), strict=True))
    return "".join(dots)
