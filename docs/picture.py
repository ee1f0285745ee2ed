"""Draw a merged scan as PNG: from above and at a slant, a colour for each lidar.

    python docs/picture.py SCANS_DIR_OR_NPZ OUT.png [--below METRES]

Needs numpy alone: points are painted far to near into a double-sized image, which is halved to
smooth it, lettered and written by zlib (PNG, W3C recommendation: IHDR, IDAT, IEND).
"""

from __future__ import annotations

import argparse
import struct
import sys
import zlib
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import numpy.typing as npt
from glyphs import GLYPH_WIDTH, dots

F64 = npt.NDArray[np.float64]
U8 = npt.NDArray[np.uint8]
Colour = tuple[int, int, int]

BACKGROUND: Colour = (14, 19, 30)
GRID: Colour = (44, 54, 74)
TEXT: Colour = (200, 208, 220)
FAINT: Colour = (125, 136, 154)
LIDARS: tuple[Colour, ...] = (
    (255, 166, 64),
    (64, 190, 255),
    (130, 220, 110),
    (240, 110, 160),
    (190, 150, 255),
    (245, 225, 90),
)
AXES: tuple[tuple[str, Colour], ...] = (
    ("x", (240, 80, 80)),
    ("y", (90, 210, 100)),
    ("z", (90, 140, 255)),
)
WIDTH, HEIGHT, MARGIN, HEADER = 1600, 760, 40, 96
LETTER = 3  # pixels a dot of a letter
# The lowest points keep this share of their colour.
DIM = 0.45


@dataclass(frozen=True, slots=True)
class Cloud:
    """What the picture needs of a scan; xyz (p, 3) in metres, body frame."""

    xyz: F64
    lidar: npt.NDArray[np.int64]
    names: tuple[str, ...]
    title: str


@dataclass(frozen=True, slots=True)
class View:
    """A parallel projection: rows of `axes` (3, 3) are right, up and towards the eye."""

    axes: F64
    scale: float  # double-sized pixels a metre
    centre: F64  # of the panel, double-sized pixels
    middle: F64  # what is drawn there, metres along right and up

    def pixels(self, xyz: F64) -> F64:
        """Points (n, 3) in metres to (n, 2) double-sized pixels, x right and y down."""
        flat = xyz @ self.axes[:2].T - self.middle
        return np.asarray(self.centre + flat * (self.scale, -self.scale))


def main() -> int:
    """Read the arguments, draw, write."""
    parser = argparse.ArgumentParser(description="Draw a merged scan as PNG.")
    parser.add_argument("scans", type=Path, help="a folder of npz scans, or one of them")
    parser.add_argument("out", type=Path, help="the PNG to write")
    parser.add_argument(
        "--below", type=float, default=4.0, help="leave out what is higher, m; roofs hide the rest"
    )
    arguments = parser.parse_args()
    try:
        cloud = load(pick(arguments.scans), arguments.below)
        arguments.out.write_bytes(png(draw(cloud)))
    except (OSError, ValueError, KeyError, BadZipFile) as error:
        print(f"picture: {error}", file=sys.stderr)
        return 1
    print(f"{arguments.out}: {cloud.title}")
    return 0


def pick(scans: Path) -> Path:
    """The scan to draw: the file itself, or the middle one of a folder's whole scans."""
    if scans.is_file():
        return scans
    found = sorted(scans.glob("[0-9]*.npz"))
    if not found:
        raise FileNotFoundError(
            f"{scans}: wanted a folder with npz scans, found none; convert first"
        )
    return found[len(found) // 2]


def load(path: Path, below_m: float) -> Cloud:
    """The points of a dense scan that lie below `below_m`, metres."""
    with np.load(path) as scan:
        xyz = scan["xyz"].astype(np.float64)
        lidar = scan["lidar_id"].astype(np.int64)
        names = tuple(str(name) for name in scan["sensors"])
        span_ms = (int(scan["end_ns"]) - int(scan["start_ns"])) / 1e6
        title = f"scan {int(scan['index'])}: {len(xyz)} points of {len(names)} lidars"
    keep = xyz[:, 2] < below_m
    if xyz.ndim != 2 or not keep.any():
        raise ValueError(f"{path}: wanted a dense scan with points below {below_m} m, found none")
    return Cloud(xyz[keep], lidar[keep], names, f"{title} in {span_ms:.1f} ms")


def draw(cloud: Cloud) -> U8:
    """The picture (HEIGHT, WIDTH, 3)."""
    image = np.empty((2 * HEIGHT, 2 * WIDTH, 3), np.uint8)
    image[:] = BACKGROUND
    split = WIDTH // 2
    bottom = HEIGHT - MARGIN
    above = fitted(cloud, turned(0.0, 90.0), (MARGIN + 50, HEADER, split - 10, bottom - 60))
    aslant = fitted(cloud, turned(-35.0, 32.0), (split + 30, HEADER, WIDTH - MARGIN, bottom - 60))
    for view in (above, aslant):
        paint_grid(image, view, cloud)
        paint_points(image, view, cloud)
        paint_axes(image, view)
    small = np.asarray(image.reshape(HEIGHT, 2, WIDTH, 2, 3).mean(axis=(1, 3)), np.uint8)
    write(small, MARGIN, 26, cloud.title, TEXT)
    write_legend(small, cloud.names)
    write_scale(small, above, cloud)
    return small


def turned(heading_deg: float, elevation_deg: float) -> F64:
    """Axes of a view: seen from `elevation_deg` above the ground, forward turned by the heading."""
    h, e = np.radians(heading_deg), np.radians(elevation_deg)
    right = (np.cos(h), np.sin(h), 0.0)
    up = (-np.sin(h) * np.sin(e), np.cos(h) * np.sin(e), np.cos(e))
    return np.array([right, up, np.cross(right, up)])


def fitted(cloud: Cloud, axes: F64, panel: tuple[int, int, int, int]) -> View:
    """The view that fills a panel (left, top, right, bottom; pixels) with the cloud."""
    flat = cloud.xyz @ axes[:2].T
    low, high = np.percentile(flat, 0.1, axis=0), np.percentile(flat, 99.9, axis=0)
    left, top, right, bottom = (2 * edge for edge in panel)
    extent_m = np.maximum(high - low, 0.1)
    scale = min((right - left) / extent_m[0], (bottom - top) / extent_m[1])
    centre = np.array([(left + right) / 2, (top + bottom) / 2])
    return View(axes, float(scale), centre, (low + high) / 2)


def paint_points(image: U8, view: View, cloud: Cloud) -> None:
    """Points far to near, so that the nearest is seen; low ones are darker."""
    order = np.argsort(cloud.xyz @ view.axes[2], kind="stable")
    height = cloud.xyz[order, 2]
    low, high = np.percentile(height, [2.0, 98.0])
    share = DIM + (1.0 - DIM) * np.clip((height - low) / max(high - low, 1e-6), 0.0, 1.0)
    palette = np.array(LIDARS)[cloud.lidar[order] % len(LIDARS)]
    put(image, view.pixels(cloud.xyz[order]), (palette * share[:, None]).astype(np.uint8), 4)


def paint_grid(image: U8, view: View, cloud: Cloud) -> None:
    """Lines on the ground, z = 0, at round metres."""
    (x0, y0), (x1, y1) = corners(cloud)
    x_lines, y_lines = grid(cloud)
    for x in x_lines:
        line(image, view, (x, y0, 0.0), (x, y1, 0.0), GRID)
    for y in y_lines:
        line(image, view, (x0, y, 0.0), (x1, y, 0.0), GRID)


def corners(cloud: Cloud) -> F64:
    """Lower and upper corner (2, 2) of the ground that the cloud covers, metres."""
    return np.asarray(np.percentile(cloud.xyz[:, :2], [0.1, 99.9], axis=0))


def grid(cloud: Cloud) -> tuple[F64, F64]:
    """Where lines cross the x and the y axis: every 5 m, less often where that gave over 12."""
    low, high = corners(cloud)
    longest = float((high - low).max())
    step = next((s for s in (5.0, 10.0, 20.0, 50.0, 100.0) if longest / s <= 12), 200.0)
    first, last = np.ceil(low / step), np.floor(high / step)
    return (
        step * np.arange(first[0], last[0] + 1),
        step * np.arange(first[1], last[1] + 1),
    )


def paint_axes(image: U8, view: View) -> None:
    """The body frame: a metre and a half along x, y and z from its origin."""
    for row, (_, colour) in zip(1.5 * np.eye(3), AXES, strict=True):
        line(image, view, (0.0, 0.0, 0.0), tuple(row), colour, 5)


def line(
    image: U8,
    view: View,
    start: tuple[float, ...],
    end: tuple[float, ...],
    colour: Colour,
    size: int = 2,
) -> None:
    """A straight line between two points in metres."""
    ends = view.pixels(np.array([start, end]))
    steps = int(np.abs(ends[1] - ends[0]).max()) + 1
    share = np.linspace(0.0, 1.0, steps)[:, None]
    put(image, ends[0] + share * (ends[1] - ends[0]), np.array(colour, np.uint8), size)


def put(image: U8, pixels: F64, colours: U8, size: int) -> None:
    """Squares of `size` double-sized pixels at (n, 2) places; later ones cover earlier ones."""
    corner = np.round(pixels - size / 2).astype(np.int64)
    inside = ((corner >= 0) & (corner < (2 * WIDTH - size, 2 * HEIGHT - size))).all(axis=1)
    x, y = corner[inside].T
    if colours.ndim == 2:
        colours = colours[inside]
    step = np.arange(size)
    for down in step:
        for right in step:
            image[y + down, x + right] = colours


def write(image: U8, x: int, y: int, text: str, colour: Colour) -> None:
    """A line of text with its upper left corner at (x, y)."""
    for column, row in dots(text):
        left, top = x + column * LETTER, y + row * LETTER
        image[top : top + LETTER, left : left + LETTER] = colour


def text_width(text: str) -> int:
    """Pixels that a line of text takes."""
    return len(text) * (GLYPH_WIDTH + 1) * LETTER


def write_legend(image: U8, names: tuple[str, ...]) -> None:
    """Names of the lidars in their colours, at the upper right."""
    x = WIDTH - MARGIN - sum(text_width(name) + 60 for name in names)
    for number, name in enumerate(names):
        colour = LIDARS[number % len(LIDARS)]
        image[26 : 26 + 7 * LETTER, x + 20 : x + 20 + 7 * LETTER] = colour
        write(image, x + 52, 26, name, TEXT)
        x += text_width(name) + 60


def write_scale(image: U8, view: View, cloud: Cloud) -> None:
    """Metres along the edges of the top view."""
    low = corners(cloud)[0]
    x_lines, y_lines = grid(cloud)
    for x in x_lines:
        place = view.pixels(np.array([[x, low[1], 0.0]]))[0] / 2
        text = f"{x:.0f}"
        write(image, int(place[0]) - text_width(text) // 2, int(place[1]) + 12, text, FAINT)
    for y in y_lines:
        place = view.pixels(np.array([[low[0], y, 0.0]]))[0] / 2
        text = f"{y:.0f}"
        write(image, int(place[0]) - text_width(text) - 10, int(place[1]) - 10, text, FAINT)
    write(image, MARGIN, HEIGHT - 40, "x forward, y left, z up (metres, body frame)", FAINT)


def png(image: U8) -> bytes:
    """The bytes of a PNG file of an image (height, width, 3)."""
    height, width, _ = image.shape
    rows = np.zeros((height, 1 + 3 * width), np.uint8)  # a filter byte (0: none) before each row
    rows[:, 1:] = image.reshape(height, -1)
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = ((b"IHDR", head), (b"IDAT", zlib.compress(rows.tobytes(), 9)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in chunks
    )


if __name__ == "__main__":
    sys.exit(main())
