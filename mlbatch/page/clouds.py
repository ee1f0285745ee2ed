"""Chosen scans of an output, read by their place in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mlbatch.outputs.read import IndexedScans, open_scans
from mlbatch.page.points import CloudPoints, PageCloud, Place, joined_cloud
from mlbatch.page.windows import Windows

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
