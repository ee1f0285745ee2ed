"""The mode that Ouster packets were sent in, against the `lidar_mode` of the metadata.

Source: docs/sources/ouster.md sections 1 and 5. Metadata that were saved before a change of mode
give every column a wrong azimuth, while sizes and serial number fit. Measurement ids count the
columns of a revolution and timestamps their times, so that packets show both numbers of a mode.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mlbatch.arrays import F64Array, I64Array, U8Array, median
from mlbatch.errors import RigError
from mlbatch.sensors.ouster.metadata import REMEDY, Metadata
from mlbatch.sensors.ouster.packets import Headers
from mlbatch.sensors.ouster.profiles import ENCODER_TICKS
from mlbatch.types import ColumnHeaders
from mlbatch.units import NS_PER_S, NS_PER_US

# Columns of a revolution, and revolutions per second (Firmware User Manual, `lidar_mode`).
MODES = ((512, 10), (512, 20), (1024, 10), (1024, 20), (2048, 10), (4096, 5))
# Modes differ by a factor of two; a rotor in motion deviates by up to 1 % from its mean speed.
_TOLERANCE = 0.15
# Packets with ids beyond the mode, of all: fewer are damaged, or of a mode that came later.
_BEYOND = 0.25
# Frames between two packets whose columns are counted.
_MOST_FRAMES = 16
_FEWEST_PAIRS = 2
# Share of the pairs that must agree.
_AGREE = 0.75


class Seen(NamedTuple):
    """Mode by the packets: 0 where too few were seen.

    columns: of a revolution; step_ns: from column to column; highest_id: of their columns;
    beyond: share of the packets with ids beyond the mode of the metadata.
    """

    columns: float
    step_ns: float
    highest_id: int
    beyond: float

    def modes(self) -> list[tuple[int, int]]:
        """Modes that fit."""
        return [
            (columns, hz)
            for columns, hz in MODES
            if columns > self.highest_id
            and (not self.columns or _is_near(self.columns, columns))
            and (not self.step_ns or _is_near(NS_PER_S / (self.step_ns * columns), hz))
        ]


def as_sent(described: Metadata, seen: Seen) -> Metadata:
    """The metadata, with another `lidar_mode` and a note if only its revolutions are wrong.

    Raises RigError for another number of columns per revolution.
    """
    columns = described.columns_per_frame
    known = [mode for mode in seen.modes() if mode[0] == columns]
    others = [mode for mode in seen.modes() if mode[0] != columns]
    stated_hz = described.revolutions_per_s
    is_other = bool(seen.columns and not _is_near(seen.columns, columns))
    # A whole revolution was not seen, and the time between columns is that of another mode.
    is_doubtful = bool(
        not seen.columns
        and others
        and stated_hz
        and seen.step_ns
        and not _is_near(NS_PER_S / (seen.step_ns * columns), stated_hz)
    )
    if seen.beyond > _BEYOND or is_other or is_doubtful:
        _refuse(described, seen, [*known, *others] if is_doubtful else others)
    if not stated_hz or not seen.step_ns or stated_hz in (hz for _, hz in known) or not known:
        return described
    sent = f"{columns}x{known[0][1]}"
    note = (
        f"{described.path}: Ouster metadata, lidar_mode: expected packets of "
        f"{described.lidar_mode}, found those of {sent} by their timestamps, which is used (points "
        f"are the same); {REMEDY}"
    )
    return described._replace(lidar_mode=sent, notes=(*described.notes, note))


def seen_in(described: Metadata, headers: Headers, packets: U8Array, found: ColumnHeaders) -> Seen:
    """Mode by intact packets (P, size) of the unit; found: their columns, of any id."""
    valid = found.valid
    mid = found.encoder
    if not valid.any():
        return Seen(0.0, 0.0, -1, 0.0)
    beyond = np.count_nonzero(valid & (mid >= described.columns_per_frame), axis=1) > 0
    is_next = valid[:, 1:] & valid[:, :-1] & (np.diff(mid, axis=1) == 1)
    step_ns = np.diff(found.stamp_ns, axis=1)[is_next]
    step_ns = step_ns[step_ns > 0]
    each_ns = median(step_ns) if len(step_ns) else 0.0
    has = valid.any(axis=1)
    first = valid.argmax(axis=1)
    rows = np.flatnonzero(has)
    stamp_ns = found.stamp_ns[rows, first[rows]]
    first_id = mid[rows, first[rows]]
    if headers.layout.legacy:
        counted = _columns_by_encoder(headers.encoders(packets)[valid], mid[valid])
    else:
        frame = headers.read(packets, "frame_id")[rows]
        counted = _columns_by_frames(frame, stamp_ns, first_id, each_ns)
    return Seen(counted, each_ns, int(mid[valid].max()), float(beyond[has].mean()))


def _columns_by_encoder(encoder: I64Array, mid: I64Array) -> float:
    """Columns of a revolution by the rotor positions that LEGACY columns state."""
    is_stated = (encoder > 0) & (mid > 0)
    return (
        float(median(mid[is_stated] * ENCODER_TICKS / encoder[is_stated]))
        if is_stated.any()
        else 0.0
    )


def _columns_by_frames(
    frame: I64Array, stamp_ns: I64Array, first_id: I64Array, step_ns: float
) -> float:
    """Columns of a revolution by the columns that passed between packets of different frames."""
    if not step_ns:
        return 0.0
    order = np.argsort(stamp_ns, kind="stable")
    frames = np.diff(frame[order])
    passed = np.diff(stamp_ns[order]) / step_ns - np.diff(first_id[order])
    used = (frames >= 1) & (frames <= _MOST_FRAMES)
    counts: F64Array = passed[used] / frames[used]
    if len(counts) < _FEWEST_PAIRS:
        return 0.0
    count = float(median(counts))
    agree = np.abs(counts - count) <= _TOLERANCE * abs(count)
    # A clock that was set between two packets, or a second lidar, gives any number.
    is_sure = agree.mean() >= _AGREE and any(_is_near(count, columns) for columns, _ in MODES)
    return count if is_sure else 0.0


def _is_near(value: float, nominal: float) -> bool:
    return abs(value - nominal) <= _TOLERANCE * nominal


def _refuse(described: Metadata, seen: Seen, modes: list[tuple[int, int]]) -> None:
    columns = described.columns_per_frame
    names = " or ".join(f"{one}x{hz}" for one, hz in modes)
    step = f", columns {seen.step_ns / NS_PER_US:.1f} us apart" if seen.step_ns else ""
    shown = f"measurement ids up to {seen.highest_id}{step}"
    if seen.columns:
        shown = f"{seen.columns:.0f} columns per revolution, {shown}"
    found = f"those of {names} ({shown})" if names else shown
    raise RigError(
        f"{described.path}: Ouster metadata, lidar_mode: expected packets of "
        f"{described.lidar_mode or f'{columns} columns per revolution'}, found {found}: the mode "
        f"changed after the metadata were saved, all azimuths would be wrong; {REMEDY}, or give "
        "those that were saved with this recording"
    )
