"""Reads trajectories of the TUM format: `time x y z qx qy qz qw` a line, s and m.

Source: the TUM RGB-D benchmark, "File formats". Times are read as decimal text, to the ns.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.bounded import read_text
from mlbatch.errors import RigError
from mlbatch.motion.se3 import rotations_of
from mlbatch.motion.track import PoseTrack
from mlbatch.units import NS_PER_S

# Further from 1, the numbers are no quaternion.
_NORM_TOLERANCE = 1e-2
_TIME = re.compile(r"(\d{1,12})(?:\.(\d*))?", re.ASCII)
_EXPONENT = re.compile(r"\d(?:\.\d+)?[eE][+]?\d{1,2}", re.ASCII)
_VALUES = 8
_DIGITS = 9
# Tilt of the body's z axis: of a vehicle, and of one that lies on its side or its roof.
_LEVEL_DEG = 20.0
_LYING_DEG = 45.0
_LEVEL_SHARE = 0.95
# Of the fastest trains twice.
_MOST_SPEED = 200.0
# Of stamps: 2038; a count of ms, us or ns is beyond.
_LATEST_NS = 2**31 * NS_PER_S


def read_tum(path: Path) -> PoseTrack:
    """Read a trajectory; RigError with file and line for the first mistake."""
    try:
        text = read_text(path, encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as err:
        reason = getattr(err, "strerror", None) or "bytes that are not UTF-8"
        raise RigError(
            f"{path}: expected a trajectory (TUM), found {reason}; check the path"
        ) from err
    stamps: list[int] = []
    rows: list[list[float]] = []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        stamp_ns, row = _values(f"{path}:{number}", words)
        if stamps and stamp_ns <= stamps[-1]:
            raise RigError(
                f"{path}:{number}: expected a time after that of the line before, found "
                f"{words[0]}; sort the lines by time"
            )
        stamps.append(stamp_ns)
        rows.append(row)
    if len(stamps) < 2:
        raise RigError(
            f"{path}: expected at least 2 poses, found {len(stamps)}; give a trajectory of the "
            "recording"
        )
    table = np.array(rows)
    norm = np.sqrt((table[:, 3:] ** 2).sum(axis=1))
    quaternions = table[:, 3:] / norm[:, None]
    _refuse_speed(path, np.array(stamps, np.int64), table[:, :3])
    rotations = rotations_of(quaternions)
    _refuse_w_first(path, rotations, rotations_of(np.roll(quaternions, -1, axis=1)))
    return PoseTrack(np.array(stamps, np.int64), rotations, table[:, :3], path.name)


def _refuse_speed(path: Path, stamp_ns: I64Array, position_m: F64Array) -> None:
    """RigError for a vehicle that is faster than any: positions in mm, or times of another unit."""
    step_m = np.sqrt((np.diff(position_m, axis=0) ** 2).sum(axis=1))
    speed = float(np.median(step_m / (np.diff(stamp_ns) / NS_PER_S)))
    if speed > _MOST_SPEED:
        raise RigError(
            f"{path}: expected positions in m of a vehicle below {_MOST_SPEED:g} m/s, found a "
            f"median of {speed:.4g} m/s; convert millimetres to metres, and times to s"
        )


def _refuse_w_first(path: Path, rotations: F64Array, others: F64Array) -> None:
    """RigError if the body lies, but is level where quaternions are read as w, x, y, z.

    rotations, others: (n, 3, 3), of both readings.
    """
    lying = float(np.mean(rotations[:, 2, 2] < math.cos(math.radians(_LYING_DEG))))
    level = float(np.mean(others[:, 2, 2] > math.cos(math.radians(_LEVEL_DEG))))
    if lying > 0.5 and level > _LEVEL_SHARE:
        raise RigError(
            f"{path}: expected quaternions as qx qy qz qw, found {100 * lying:.0f} % of the poses "
            f"tilted by more than {_LYING_DEG:.0f} degrees, all level if w is first; write w last"
        )


def _values(place: str, words: list[str]) -> tuple[int, list[float]]:
    if len(words) != _VALUES:
        raise RigError(
            f"{place}: expected 8 numbers (time x y z qx qy qz qw), found {len(words)}; export the "
            "trajectory in TUM format"
        )
    try:
        row = [float(word) for word in words[1:]]
    except ValueError:
        row = [float("nan")]
    stamp_ns = _stamp_ns(words[0])
    if stamp_ns is None or not all(map(math.isfinite, row)):
        raise RigError(
            f"{place}: expected 8 finite numbers, the first a time in s since 1970, found "
            f"{' '.join(words)[:60]!r}; correct the line"
        )
    norm = math.hypot(*row[3:])
    if abs(norm - 1.0) > _NORM_TOLERANCE:
        raise RigError(
            f"{place}: expected a unit quaternion x, y, z, w, found norm {norm:.4g}; check the "
            "order of the columns"
        )
    return stamp_ns, row


def _stamp_ns(text: str) -> int | None:
    """Return a time in ns, None for no time; numpy writes exponents, which have fewer digits."""
    match = _TIME.fullmatch(text)
    if _EXPONENT.fullmatch(text):
        stamp_ns = round(float(text) * NS_PER_S)
    elif match is not None:
        fraction = (match[2] or "")[:_DIGITS].ljust(_DIGITS, "0")
        stamp_ns = int(match[1]) * NS_PER_S + int(fraction)
    else:
        return None
    return stamp_ns if stamp_ns < _LATEST_NS else None
