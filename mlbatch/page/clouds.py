"""Scans as a page stores them: rounded, by ring, differences deflated; and which are chosen."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from isal import isal_zlib

from mlbatch.arrays import BoolArray, F32Array, F64Array, I64Array, U8Array, U16Array
from mlbatch.outputs.read import IndexedScans, open_scans
from mlbatch.outputs.scan import Scan
from mlbatch.page.windows import Windows
from mlbatch.units import NS_PER_MS

# Finest step of coordinates, below the noise of lidars.
_STEP_M = 0.005
_BYTE = 255
_WORD = 65535
# Shares of the points that the range of a colour covers: single bright points are no scale.
_LOW, _HIGH = 0.02, 0.98
# Share of the points of a lidar inside the first view.
_IN_VIEW = 0.97


@dataclass(frozen=True, slots=True)
class Place:
    """A window to show; title: what it is in the run, "" for most."""

    title: str
    row: int  # of the table
    index: int
    slice: int
    start_ns: int


@dataclass(frozen=True, slots=True)
class PageCloud:
    """A scan as the page stores it.

    packed: deflated planes of its `shown` points, in this order: x, y, z in steps from the lowest,
    time in 1/65535 of `times_ms`, ring, as differences in 16 bits (see `_differences`), then lidar
    and intensity, in 8 bits.
    """

    place: Place
    total: int  # points of the scan
    stride: int  # every nth column is shown
    shown: int
    packed: bytes
    low_m: tuple[float, float, float]
    step_m: float
    times_ms: tuple[float, float]  # the window, and what fused sweeps have beyond
    height_m: tuple[float, float]  # range of the colours
    centre_m: tuple[float, float, float]  # of the first view
    view_m: float  # radius around the centre that contains most points of every lidar
    absent: frozenset[str]  # as of `Scan`

    @property
    def chars(self) -> int:
        """Length of its base64."""
        return -(-len(self.packed) // 3) * 4


class CloudPoints(NamedTuple):
    """Points of a scan or set, (p, 3) m, body frame, and (p,); time_ns: after its start."""

    xyz: F32Array
    lidar: U8Array
    time_ns: I64Array
    ring: U16Array
    intensity: F32Array

    @classmethod
    def of(cls, scan: Scan) -> CloudPoints:
        """The points of a scan, without empty slots; zeros for what its output does not store."""
        valid = scan.is_valid
        count = int(np.count_nonzero(valid))
        # Of dense scans all are.
        rows = slice(None) if valid.ndim == 1 and count == len(valid) else valid

        def of(name: str) -> Any:
            return np.zeros(count, np.uint8) if name in scan.absent else getattr(scan, name)[rows]

        return cls(scan.xyz[rows], of("lidar_id"), of("time_ns"), of("ring"), of("intensity"))

    def take(self, rows: BoolArray | I64Array) -> CloudPoints:
        """Some of the points."""
        xyz, lidar, time_ns, ring, intensity = self
        return CloudPoints(xyz[rows], lidar[rows], time_ns[rows], ring[rows], intensity[rows])


def joined_cloud(
    place: Place,
    parts: Sequence[CloudPoints],
    window_ns: int,
    expected: I64Array,
    stride: int = 1,
    absent: frozenset[str] = frozenset(),
    is_fast: bool = False,
    times_ns: tuple[int, int] | None = None,
) -> PageCloud:
    """Join the scans of a window.

    expected: columns of a whole window by lidar; stride: keep every nth column of each; absent: as
    of `Scan`; is_fast: a seventh of the time to deflate, for a few percent more bytes; times_ns:
    range of times to store, where it is not that of the points.
    """
    points, lidar, times, ring, intensity = map(np.concatenate, zip(*parts, strict=True))
    time_ns: I64Array = times.astype(np.int64)
    first_ns, last_ns = times_ns or (0, window_ns)
    first_ns = min(first_ns, int(time_ns.min(initial=first_ns)))
    last_ns = max(last_ns, int(time_ns.max(initial=last_ns)))
    # By lidar and ring; those of one are in the order of their columns already.
    order = np.argsort(ring, kind="stable")
    order = order[np.argsort(lidar[order], kind="stable")]
    if stride > 1:
        # Points without times are in the order of their columns.
        has_times, total = "time_ns" not in absent, len(points)
        share = time_ns / window_ns if has_times else np.arange(total) / max(1, total)
        order = order[_columns(share, lidar, expected)[order] % stride == 0]
    # By axis: numpy is slow in loops over three values.
    xyz: F64Array = points[order].T.astype(np.float64, order="C")
    low_m: F64Array = xyz.min(axis=1) if len(order) else np.zeros(3)
    high_m: F64Array = xyz.max(axis=1) if len(order) else np.zeros(3)
    step_m = max(float((high_m - low_m).max()) / _WORD, _STEP_M)
    centre_m, view_m = _view(xyz, lidar[order])
    return PageCloud(
        place=place,
        total=len(points),
        stride=stride,
        shown=len(order),
        packed=_packed(
            np.rint((xyz - low_m[:, None]) / step_m).astype(np.uint16),
            np.rint((time_ns[order] - first_ns) / (last_ns - first_ns) * _WORD),
            ring[order],
            lidar[order],
            _bytes_of(intensity[order]),
            is_fast,
        ),
        low_m=(float(low_m[0]), float(low_m[1]), float(low_m[2])),
        step_m=step_m,
        times_ms=(first_ns / NS_PER_MS, last_ns / NS_PER_MS),
        height_m=_span(xyz[2]),
        centre_m=(float(centre_m[0]), float(centre_m[1]), float(centre_m[2])),
        view_m=view_m,
        absent=absent,
    )


def _columns(share: F64Array, lidar: U8Array, expected: I64Array) -> I64Array:
    """Number of the column of each point in its window, (p,).

    share: time in the window, 0 to 1; expected: columns of a whole window by lidar. A time, since
    the firings of one column of some lidars have times of their own.
    """
    count: I64Array = np.maximum(1, expected[np.minimum(lidar, len(expected) - 1)])
    return np.floor(share * count).astype(np.int64)


def _packed(
    xyz: U16Array,
    time: F64Array,
    ring: I64Array,
    lidar: U8Array,
    intensity: U8Array,
    is_fast: bool,
) -> bytes:
    words = (*xyz, time, ring)
    planes = [_differences(np.asarray(plane).astype(np.uint16)) for plane in words]
    # Of level 6, level 9 takes 3 to 6 times as long for 1.6 % less.
    coder = isal_zlib.compressobj(1, wbits=-15) if is_fast else zlib.compressobj(6, wbits=-15)
    data = b"".join([*planes, lidar.tobytes(), intensity.tobytes()])
    return coder.compress(data) + coder.flush()


def _differences(words: U16Array) -> bytes:
    """Differences of neighbours modulo 65536, small ones of either sign as small numbers.

    0, -1, 1, -2 become 0, 1, 2, 3; first all low bytes, then all high ones.
    """
    steps = np.diff(words, prepend=np.uint16(0)).view(np.int16)
    coded = ((steps << 1) ^ (steps >> 15)).view(np.uint16)
    return (coded & _BYTE).astype(np.uint8).tobytes() + (coded >> 8).astype(np.uint8).tobytes()


def _view(xyz: F64Array, lidar: U8Array) -> tuple[F64Array, float]:
    """Centre (3,) and radius of a view, m, that has most points of every lidar.

    The centre is the body; where the cloud is farther away than it is large, it is that of the
    cloud. xyz: (3, p).
    """
    parts = [xyz[:, lidar == number] for number in np.unique(lidar)]
    if not parts:
        return np.zeros(3), 1.0
    boxes = np.array([[_span(part[axis]) for axis in range(3)] for part in parts])
    low_m = boxes[:, :, 0].min(axis=0)
    high_m = boxes[:, :, 1].max(axis=0)
    centre_m: F64Array = (low_m + high_m) / 2
    if np.linalg.norm(centre_m) <= np.linalg.norm(high_m - low_m):
        centre_m = np.zeros(3)
    away_m = [np.hypot(part[0] - centre_m[0], part[1] - centre_m[1]) for part in parts]
    return centre_m, max(1.0, *(_quantile(away, _IN_VIEW) for away in away_m))


def _quantile(values: F64Array | F32Array, share: float) -> float:
    """A value of the array by nearest rank; 0 without one."""
    if not len(values):
        return 0.0
    rank = int(share * (len(values) - 1))
    return float(np.partition(values, rank)[rank])


def _span(values: F64Array | F32Array) -> tuple[float, float]:
    return _quantile(values, _LOW), _quantile(values, _HIGH)


def _bytes_of(values: F32Array) -> U8Array:
    """Values in 256 steps between the ends of their range of colours."""
    low, high = _span(values)
    width = high - low if high > low else 1.0
    found: U8Array = np.rint(np.clip((values - low) / width, 0.0, 1.0) * _BYTE).astype(np.uint8)
    return found


# Characters of the scans of a page; of scans that were asked for, what browsers open.
MOST_CHARS = 3_000_000
_MOST_CHARS_ASKED = 160_000_000
# Of a point, where many are asked for.
_CHARS_PER_POINT = 4
# First, middle and worst.
_LEAST_SCANS = 3


def chosen_clouds(
    output: Path, windows: Windows, scans: int | None, report: Path | None = None
) -> list[PageCloud]:
    """The scans of an output to show, in order; every nth column of all where a limit demands it.

    scans: number, 0 for all; None: as many as the page has room for, three at least; report: as of
    `open_scans`. Raises RecordingError if the output cannot be read.
    """
    stored = open_scans(output, report)
    places = choose_places(windows, _LEAST_SCANS if scans is None else scans)
    if scans is None:
        places = [place for place in places if place.title]
    most = MOST_CHARS if scans is None else _MOST_CHARS_ASKED
    stride = 1
    if scans is not None:
        points = int(windows.points[[one.row for one in places]].sum())
        stride = max(1, -(-points * _CHARS_PER_POINT // most))
    clouds = read_clouds(stored, places, windows, stride)
    chars = [one.chars for one in clouds]
    if sum(chars) > most:
        return read_clouds(stored, places, windows, -(-stride * sum(chars) // most))
    # Other scans may have more points than these, which may be empty.
    per_point = max((one.chars / max(1, one.total) for one in clouds), default=1.0)
    room = int((most - sum(chars)) / (per_point * max(1, int(windows.points.max()))))
    if scans is None and room:
        more = choose_places(windows, len(places) + room)
        clouds += read_clouds(stored, [one for one in more if one not in places], windows)
    return sorted(clouds, key=lambda one: one.place.row)


def choose_places(windows: Windows, scans: int) -> list[Place]:
    """The worst, first and middle window, and others at equal distances, in order.

    scans: number, 0 for all.
    """
    worst_row = windows.worst()
    is_whole = windows.fill[worst_row].min() >= 1.0
    first_row = int(windows.has_head and len(windows) > 1)
    named = (
        ("fewest points" if is_whole else "worst", worst_row),
        ("first", first_row),
        ("middle", len(windows) // 2),
    )
    rows = list(range(len(windows)))
    titles: dict[int, list[str]] = {row: [] for row in rows}
    for title, row in named[1:] + named[:1]:
        titles[row].append(title)
    if scans and scans < len(rows):
        kept = list(dict.fromkeys(row for _, row in named))[:scans]
        others = [row for row in rows[first_row:] if row not in kept]
        spread = np.linspace(0, len(others) - 1, min(len(others), scans - len(kept)))
        rows = sorted(kept + [others[i] for i in np.rint(spread).astype(int).tolist()])
    return [
        Place(
            " and ".join(titles[row]),
            row,
            int(windows.index[row]),
            int(windows.slice[row]),
            int(windows.start_ns[row]),
        )
        for row in rows
    ]


def read_clouds(
    scans: IndexedScans, places: list[Place], windows: Windows, stride: int = 1
) -> list[PageCloud]:
    """The scans of an output at some places; stride: every nth column of them.

    Raises RecordingError for a damaged scan.
    """
    numbers: dict[tuple[int, int], list[int]] = {}
    for number, one in enumerate(scans.places):
        numbers.setdefault((one.window, one.slice), []).append(number)
    clouds = []
    for place in places:
        parts = [scans.scan(one) for one in numbers.get((place.index, place.slice), ())]
        if parts:
            window_ns = int(windows.end_ns[place.row] - windows.start_ns[place.row])
            expected, points = windows.expected[place.row], list(map(CloudPoints.of, parts))
            clouds.append(joined_cloud(place, points, window_ns, expected, stride, parts[0].absent))
    return clouds
