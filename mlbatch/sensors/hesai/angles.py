"""Angle files of HESAI lidars: csv of spinning models, dat of the AT128.

Source: docs/sources/hesai.md section 6. A csv has the columns channel (from 1), elevation and
azimuth in degrees, below a line of titles; it may begin with a byte-order mark, comments and a line
`EEFF,1,1`, and end with the SHA-256 of all text before, taken with CRLF line ends (recomputed for
the JT128 file of HesaiTechnology/ HesaiLidar_SDK_2.0 `correction/angle_correction`). A dat is
binary and ends with its SHA-256.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.errors import RigError
from mlbatch.units import RAD_PER_DEG

_CHANNEL_TITLES = ("laser id", "laserid", "laser", "channel", "channel id")
_ANGLE_TITLES = ("elevation", "azimuth")
# A file without titles in its first lines is another kind of file.
_FIRST_LINES = 16
# Channels of all models with such files; other numbers mean a truncated file.
_CHANNELS = (16, 20, 32, 40, 64, 90, 128)
_HIGHEST_DEG = {"elevation": 90.0, "azimuth": 360.0}
_SHA256 = re.compile(r"[0-9a-fA-F]{64}")
_SHOWN_CHARS = 60
_REMEDY = "read the correction file from the lidar again"

# Head of an AT128 file, and its expected values (docs/sources/hesai.md section 6).
AT128_CHANNELS = 128
AT128_STEPS = 180
_AT128_SIZE = 47176
_AT128_MAGIC = b"\xee\xff\x01"
_AT128_HEAD = np.dtype(
    [
        ("magic", "u1", 2),
        ("version", "u1", 2),
        ("channels", "u1"),
        ("mirrors", "u1"),
        ("frames", "u1"),
        ("config", "u1", 8),
        ("resolution", "u1"),
    ]
)
_AT128_BODY = np.dtype(
    [
        ("head", _AT128_HEAD),
        ("start", "<u4", 3),
        ("end", "<u4", 3),
        ("azimuth", "<i4", AT128_CHANNELS),
        ("elevation", "<i4", AT128_CHANNELS),
        ("azimuth_adjust", "i1", (AT128_CHANNELS, AT128_STEPS)),
        ("elevation_adjust", "i1", (AT128_CHANNELS, AT128_STEPS)),
    ]
)
_AT128_EXPECTED = {"version": [1, 5], "channels": [128], "mirrors": [3], "frames": [3]}
# Angles count in resolution / 25600 deg; the resolution of known files is 2.
_RESOLUTIONS = (1, 8)
_ANGLE_UNITS_PER_DEG = 25600
_ADJUST_UNITS_PER_DEG = 100


@dataclass(frozen=True, slots=True)
class HesaiAngles:
    """Beam angles at rotor angle zero, (channels,), azimuth clockwise."""

    path: Path
    azimuth_rad: F64Array
    elevation_rad: F64Array


@dataclass(frozen=True, slots=True)
class At128File:
    """Angles of an AT128, whose rotor carries mirrors.

    start_rad: (3,) rotor angles at which the mirrors begin.
    azimuth_rad, elevation_rad: (128,).
    adjust: (128, 180), added at rotor angles 0, 2, 4 .. 358 deg.
    """

    path: Path
    start_rad: F64Array
    azimuth_rad: F64Array
    elevation_rad: F64Array
    azimuth_adjust_rad: F64Array
    elevation_adjust_rad: F64Array


def read_angles(path: Path, content: bytes) -> HesaiAngles | None:
    """Parse a csv; None if it is no HESAI csv, RigError if it is damaged."""
    if b"\0" in content:
        return None
    text = content.decode("utf-8-sig", errors="replace")
    lines = _lines(text)
    first = next((at for at, cells in enumerate(lines[:_FIRST_LINES]) if _is_title(cells)), None)
    if first is None:
        return None
    titles = [cell.lower() for cell in lines[first]]
    order = [next(at for at, one in enumerate(titles) if name in one) for name in _ANGLE_TITLES]
    angles_deg: dict[int, tuple[float, float]] = {}
    for number, cells in enumerate(lines[first + 1 :], first + 2):
        if _SHA256.fullmatch(cells[0]):
            _check_digest(path, number, content, cells[0])
        elif cells != [""] and not cells[0].startswith("#"):
            channel = _channel(path, number, cells)
            if channel in angles_deg:
                _fail(path, number, "every channel once", f"channel {channel} again")
            elevation, azimuth = (
                _angle_deg(path, number, name, cells[at])
                for name, at in zip(_ANGLE_TITLES, order, strict=True)
            )
            angles_deg[channel] = (elevation, azimuth)
    _check_complete(path, len(lines), angles_deg)
    in_order = np.array([angles_deg[channel] for channel in sorted(angles_deg)]) * RAD_PER_DEG
    return HesaiAngles(path, in_order[:, 1].copy(), in_order[:, 0].copy())


def read_at128(path: Path, content: bytes) -> At128File | None:
    """Parse an AT128 file; None if it is none, RigError if it is damaged."""
    if not content.startswith(_AT128_MAGIC) or len(content) < _AT128_HEAD.itemsize:
        return None
    head = np.frombuffer(content, _AT128_HEAD, 1)[0]
    for name, expected in _AT128_EXPECTED.items():
        found = np.ravel(head[name]).tolist()
        if found != expected:
            _fail_at128(path, f"{name} {_dotted(expected)}", _dotted(found))
    low, high = _RESOLUTIONS
    resolution = int(head["resolution"])
    if not low <= resolution <= high:
        _fail_at128(path, f"a resolution from {low} to {high}", str(resolution))
    if len(content) != _AT128_SIZE:
        _fail_at128(path, f"{_AT128_SIZE} bytes", f"{len(content)} bytes")
    body = content[: _AT128_BODY.itemsize]
    if _sha256(body) != content[_AT128_BODY.itemsize :]:
        _fail_at128(path, "content that matches its SHA-256", "changed content")
    values = np.frombuffer(body, _AT128_BODY)[0]
    for name, limit in _HIGHEST_DEG.items():
        largest = float(np.abs(values[name].astype(np.float64)).max())
        largest_deg = largest * resolution / _ANGLE_UNITS_PER_DEG
        if largest_deg > limit:
            _fail_at128(path, f"{name} from -{limit:g} to {limit:g} deg", f"{largest_deg:g}")
    angle = resolution * RAD_PER_DEG / _ANGLE_UNITS_PER_DEG
    adjust = resolution * RAD_PER_DEG / _ADJUST_UNITS_PER_DEG
    return At128File(
        path,
        values["start"] * angle,
        values["azimuth"] * angle,
        values["elevation"] * angle,
        values["azimuth_adjust"] * adjust,
        values["elevation_adjust"] * adjust,
    )


def _lines(text: str) -> list[list[str]]:
    """Cells of all lines, without the empty ones that spreadsheets append."""

    def cells() -> Iterator[list[str]]:
        for line in text.splitlines():
            row = [cell.strip() for cell in line.split(",")]
            while len(row) > 1 and not row[-1]:
                row.pop()
            yield row

    return list(cells())


def _is_title(cells: list[str]) -> bool:
    names = [cell.lower() for cell in cells]
    has_angles = all(any(name.startswith(angle) for name in names[1:]) for angle in _ANGLE_TITLES)
    return len(names) == 3 and names[0] in _CHANNEL_TITLES and has_angles


def _sha256(content: bytes) -> bytes:
    # Imported late: hashlib loads slowly.
    import hashlib

    return hashlib.sha256(content).digest()


def _check_digest(path: Path, number: int, content: bytes, digest: str) -> None:
    """Check the digest of CRLF lines; transports may have changed line ends or added a mark."""
    before = content[: content.index(digest.encode())]
    unix = before.replace(b"\r\n", b"\n").removeprefix(b"\xef\xbb\xbf")
    variants = (before, unix, unix.replace(b"\n", b"\r\n"))
    if all(_sha256(one).hex() != digest.lower() for one in variants):
        _fail(path, number, "lines that match this SHA-256", "changed lines")


def _channel(path: Path, number: int, cells: list[str]) -> int:
    if len(cells) != 3:
        _fail(path, number, "channel, elevation, azimuth", ", ".join(cells))
    if not cells[0].isdecimal() or not 1 <= int(cells[0]) <= _CHANNELS[-1]:
        _fail(path, number, f"a channel from 1 to {_CHANNELS[-1]}", cells[0])
    return int(cells[0])


def _angle_deg(path: Path, number: int, name: str, cell: str) -> float:
    limit = _HIGHEST_DEG[name]
    try:
        angle_deg = float(cell)
    except ValueError:
        angle_deg = math.nan
    # Also true for NaN.
    if not abs(angle_deg) <= limit:
        _fail(path, number, f"{name} from -{limit:g} to {limit:g} deg", cell)
    return angle_deg


def _check_complete(path: Path, lines: int, angles_deg: dict[int, tuple[float, float]]) -> None:
    last = max(angles_deg, default=0)
    missing = next((one for one in range(1, last) if one not in angles_deg), None)
    if missing is not None:
        _fail(path, lines, f"channels 1 to {last}", f"no channel {missing}")
    if last not in _CHANNELS:
        counts = ", ".join(str(count) for count in _CHANNELS[:-1])
        _fail(path, lines, f"{counts} or {_CHANNELS[-1]} channels in all", str(last))


def _fail(path: Path, number: int, expected: str, found: str) -> NoReturn:
    shown = found if len(found) <= _SHOWN_CHARS else found[: _SHOWN_CHARS - 3] + "..."
    raise RigError(
        f"{path}: HESAI angles, line {number}: expected {expected}, "
        f"found {shown or 'nothing'}; {_REMEDY}"
    )


def _fail_at128(path: Path, expected: str, found: str) -> NoReturn:
    raise RigError(f"{path}: HESAI AT128 angles: expected {expected}, found {found}; {_REMEDY}")


def _dotted(numbers: list[int]) -> str:
    return ".".join(str(number) for number in numbers)
