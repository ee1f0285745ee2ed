"""Draw a merged scan as PNG: a top view and an oblique view, one colour per lidar.

    python docs/picture.py SCANS_DIR_OR_NPZ OUT.png [--below METRES]

Needs matplotlib (extra `dev`).
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from zipfile import BadZipFile

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FloatArray = npt.NDArray[np.float64]

BACKGROUND = "#0e131e"
GRID = "#2c364a"
TEXT = "#dbe2ec"
FAINT = "#8b96a8"
LIDARS = ("#ffa640", "#40beff", "#82dc6e", "#f06ea0", "#be96ff", "#f5e15a")
AXES = (("x", "#ff6b6b"), ("y", "#6fe07a"), ("z", "#7d9bff"))
AXIS_LENGTH_M = 1.5
# Points at the lowest height are drawn at this share of their brightness.
DIMMEST = 0.6


@dataclass(frozen=True, slots=True)
class Cloud:
    """Points of one scan: xyz (p, 3) in metres, body frame; lidar (p,) indexes `names`."""

    xyz: FloatArray
    lidar: npt.NDArray[np.int64]
    names: tuple[str, ...]
    title: str


def main() -> int:
    """Read the arguments, draw, write."""
    parser = argparse.ArgumentParser(description="Draw a merged scan as PNG.")
    parser.add_argument("scans", type=Path, help="folder of npz scans, or one npz file")
    parser.add_argument("out", type=Path, help="PNG to write")
    parser.add_argument(
        "--below", type=float, default=4.0, help="omit points above this height, m (roofs)"
    )
    arguments = parser.parse_args()
    try:
        cloud = load(pick(arguments.scans), arguments.below)
        draw(cloud, arguments.out)
    except ImportError:
        print(
            "picture: expected matplotlib, found none; do: pip install matplotlib", file=sys.stderr
        )
        return 1
    except (OSError, ValueError, KeyError, BadZipFile) as error:
        print(f"picture: {error}", file=sys.stderr)
        return 1
    print(f"{arguments.out}: {cloud.title}")
    return 0


def pick(scans: Path) -> Path:
    """Return the scan to draw: the file itself, or the middle whole scan of a folder."""
    if scans.is_file():
        return scans
    found = sorted(scans.glob("[0-9]*.npz"))
    if not found:
        raise FileNotFoundError(f"{scans}: expected a folder of npz scans, found none; convert")
    return found[len(found) // 2]


def load(path: Path, below_m: float) -> Cloud:
    """Load the points of a dense scan below `below_m` (metres, body frame)."""
    with np.load(path) as scan:
        xyz = scan["xyz"].astype(np.float64)
        lidar = scan["lidar_id"].astype(np.int64)
        names = tuple(str(name) for name in scan["sensors"])
        span_ms = (int(scan["end_ns"]) - int(scan["start_ns"])) / 1e6
        index = int(scan["index"])
    if xyz.ndim != 2 or not (xyz[:, 2] < below_m).any():
        raise ValueError(f"{path}: expected a dense scan with points below {below_m} m, found none")
    keep = xyz[:, 2] < below_m
    title = f"Scan {index}: {len(xyz):,} points from {len(names)} lidars in {span_ms:.1f} ms"
    return Cloud(xyz[keep], lidar[keep], names, title)


def draw(cloud: Cloud, out: Path) -> None:
    """Write the picture: top view at the left, oblique view at the right."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.lines import Line2D
    from matplotlib.ticker import MultipleLocator

    mpl.rcParams.update({"font.family": "DejaVu Sans", "font.size": 13, "text.color": TEXT})
    figure = plt.figure(figsize=(16, 6.7), dpi=100, facecolor=BACKGROUND)
    above = figure.add_axes((0.05, 0.105, 0.445, 0.78))
    oblique = figure.add_axes((0.515, 0.03, 0.475, 0.86))
    draw_view(above, cloud, view_axes(0.0, 90.0), dot=3.0)
    draw_view(oblique, cloud, view_axes(-35.0, 32.0), dot=3.2)
    for axis in (above.xaxis, above.yaxis):
        axis.set_major_locator(MultipleLocator(tick_step(cloud)))
    above.grid(color=GRID, linewidth=0.8)
    above.set_axisbelow(True)
    above.tick_params(colors=FAINT, length=0)
    above.set_xlabel("x forward, m", color=FAINT)
    above.set_ylabel("y left, m", color=FAINT)
    oblique.axis("off")
    figure.text(0.05, 0.925, cloud.title, fontsize=20)
    handles = [
        Line2D([], [], marker="o", linestyle="", color=colour, markersize=11, label=name)
        for name, colour in zip(cloud.names, LIDARS * len(cloud.names), strict=False)
    ]
    figure.legend(
        handles=handles,
        loc="upper right",
        bbox_to_anchor=(0.99, 1.0),
        ncols=len(handles),
        frameon=False,
        fontsize=18,
        labelcolor=TEXT,
        handletextpad=0.2,
    )
    # Without the version of matplotlib: equal pixels give equal bytes.
    figure.savefig(
        out,
        format="png",
        facecolor=BACKGROUND,
        metadata={"Software": None},
        pil_kwargs={"optimize": True},
    )
    plt.close(figure)


def tick_step(cloud: Cloud) -> float:
    """Return the distance of grid lines, metres: at most 12 along the longer side."""
    low, high = np.percentile(cloud.xyz[:, :2], [0.1, 99.9], axis=0)
    longest = float((high - low).max())
    return next((step for step in (2.0, 5.0, 10.0, 20.0, 50.0) if longest / step <= 12), 100.0)


def view_axes(heading_deg: float, elevation_deg: float) -> FloatArray:
    """Rows (3, 3) of a parallel projection: right, up, towards the eye, in the body frame."""
    h = np.radians(heading_deg)
    e = np.radians(elevation_deg)
    right = (np.cos(h), np.sin(h), 0.0)
    up = (-np.sin(h) * np.sin(e), np.cos(h) * np.sin(e), np.cos(e))
    return np.array([right, up, np.cross(right, up)])


def draw_view(axes: Axes, cloud: Cloud, view: FloatArray, dot: float) -> None:
    """Draw points far to near in a parallel projection; low points are darker."""
    order = np.argsort(cloud.xyz @ view[2], kind="stable")
    flat = cloud.xyz[order] @ view[:2].T
    axes.set_facecolor(BACKGROUND)
    axes.set_aspect("equal")
    axes.scatter(
        flat[:, 0], flat[:, 1], s=dot, c=colours(cloud)[order], linewidths=0, rasterized=True
    )
    for (name, colour), tip in zip(AXES, AXIS_LENGTH_M * np.eye(3) @ view[:2].T, strict=True):
        # Seen from above z points at the eye.
        if np.hypot(*tip) < 0.1:
            continue
        axes.plot((0.0, tip[0]), (0.0, tip[1]), color=colour, linewidth=2.5)
        axes.annotate(name, tip * 1.25, color=colour, ha="center", va="center")
    low, high = np.percentile(flat, [0.05, 99.95], axis=0)
    border = 0.02 * (high - low).max()
    axes.set_xlim(low[0] - border, high[0] + border)
    axes.set_ylim(low[1] - border, high[1] + border)
    for spine in axes.spines.values():
        spine.set_visible(False)


def colours(cloud: Cloud) -> FloatArray:
    """RGB (p, 3) in [0, 1]: the lidar's colour, scaled by height."""
    from matplotlib.colors import to_rgb

    palette = np.array([to_rgb(colour) for colour in LIDARS])
    low, high = np.percentile(cloud.xyz[:, 2], [2.0, 98.0])
    height = np.clip((cloud.xyz[:, 2] - low) / max(high - low, 1e-6), 0.0, 1.0)
    brightness = DIMMEST + (1.0 - DIMMEST) * height
    return np.asarray(palette[cloud.lidar % len(LIDARS)] * brightness[:, None])


if __name__ == "__main__":
    sys.exit(main())
