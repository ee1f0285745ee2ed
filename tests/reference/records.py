"""Point records, literally: one point at a time, field by field, in exact numbers.

Fields and types as docs/formats.md and docs/sources/outputs.md have them, typed again.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from fractions import Fraction
from typing import Any, TypeAlias

import numpy as np

from mlbatch.types import Scan

# Of a point in the arrays of a scan: (p,), or (column, slot) when organized.
At: TypeAlias = tuple[int, ...]
_NS = 10**9
# Of UTC since 1970: to GPS time of 1980 with 18 leap seconds, minus 10^9 s (LAS: adjusted).
_GPS_S = 18 - 315_964_800 - 10**9


def copied(scan: Scan, at: At, *names: str) -> bytes:
    """Values as they are."""
    return b"".join(np.asarray(getattr(scan, name)[at]).tobytes() for name in names)


def time_f4(scan: Scan, at: At) -> bytes:
    """Seconds, the largest float32 that is not above the time."""
    exact = Fraction(int(scan.time_ns[at]), _NS)
    value = np.float32(float(exact))
    if Fraction(float(value)) > exact:
        value = np.nextafter(value, np.float32(0))
    return struct.pack("<f", value)


def stamp(scan: Scan, at: At, shift_s: int = 0) -> bytes:
    """Seconds since the epoch, the nearest float64."""
    whole_ns = scan.start_ns + shift_s * _NS + int(scan.time_ns[at])
    return struct.pack("<d", float(Fraction(whole_ns, _NS)))


def range_mm(scan: Scan, at: At) -> bytes:
    """Millimetres, half to even; 0 without a range."""
    assert scan.range_m is not None
    value_m = float(scan.range_m[at])
    return struct.pack("<I", 0 if value_m != value_m else round(Fraction(value_m) * 1000))


def reflectivity(scan: Scan, at: At) -> bytes:
    """0 where no sensor has it."""
    return bytes(2) if scan.reflectivity is None else copied(scan, at, "reflectivity")


def number(form: str, value: Any) -> bytes:
    """A number of another type than in the scan."""
    return struct.pack(form, int(value))


def las(scan: Scan, at: At) -> bytes:
    """Point data record format 6 and the extra bytes, of a scan on UTC after 2017."""
    steps = [round(Fraction(float(value_m)) * 10_000) for value_m in scan.xyz[at]]
    level = min(max(round(Fraction(float(scan.intensity[at]))), 0), 65535)
    kind = int(scan.return_type[at])
    # Types 3 and 4, 5 and 6 are the nearer and the farther one of two returns.
    returns = {3: (1, 2), 4: (2, 2), 5: (1, 2), 6: (2, 2)}.get(kind, (1, 1))
    source = int(scan.lidar_id[at]) + 1
    bits = returns[0] | returns[1] << 4
    extra = b"" if scan.reflectivity is None else reflectivity(scan, at)
    return (
        struct.pack("<iiiHBBBBhH", *steps, level, bits, 0, 0, 0, 0, source)
        + stamp(scan, at, _GPS_S)
        + copied(scan, at, "time_ns", "ring", "return_type", "intensity")
        + extra
    )


RECORDS: dict[str, Callable[[Scan, At], bytes]] = {
    "standard": lambda scan, at: (
        copied(scan, at, "xyz", "intensity")
        + time_f4(scan, at)
        + copied(scan, at, "ring", "return_type", "lidar_id")
    ),
    "velodyne": lambda scan, at: copied(scan, at, "xyz", "intensity", "ring") + time_f4(scan, at),
    "ouster": lambda scan, at: (
        copied(scan, at, "xyz")
        + bytes(4)
        + copied(scan, at, "intensity", "time_ns")
        + reflectivity(scan, at)
        + copied(scan, at, "ring")
        + bytes(4)
        + range_mm(scan, at)
        + bytes(12)
    ),
    "hesai": lambda scan, at: copied(scan, at, "xyz", "intensity", "ring") + stamp(scan, at),
    "kiss-icp": lambda scan, at: copied(scan, at, "xyz") + time_f4(scan, at),
    "minimal": lambda scan, at: copied(scan, at, "xyz"),
    "ply": lambda scan, at: (
        copied(scan, at, "xyz", "intensity")
        + struct.pack("<d", int(scan.time_ns[at]) / _NS)
        + number("<i", scan.ring[at])
        + copied(scan, at, "return_type", "lidar_id")
    ),
    "ply-float": lambda scan, at: copied(scan, at, "xyz") + time_f4(scan, at),
    "kitti": lambda scan, at: copied(scan, at, "xyz", "intensity"),
    "nuscenes": lambda scan, at: (
        copied(scan, at, "xyz", "intensity") + struct.pack("<f", int(scan.ring[at]))
    ),
    "time": lambda scan, at: time_f4(scan, at) + struct.pack("<f", int(scan.lidar_id[at])),
    "las": las,
}
RECORDS["ply-cloudcompare"] = RECORDS["ply"]


def check_records(found: bytes, scan: Scan, name: str, seed: int, most: int = 60) -> None:
    """Compare records in the order of the file with some of the points of a scan."""
    shape = scan.time_ns.shape
    count = scan.time_ns.size
    if not count:
        assert not found
        return
    step = len(found) // count
    assert step * count == len(found)
    for place in np.random.default_rng(seed).permutation(count)[:most].tolist():
        # Organized: rows of slots.
        at = tuple(reversed(np.unravel_index(place, shape[::-1])))
        record = found[place * step : (place + 1) * step]
        assert record == RECORDS[name](scan, at), (name, place, at)
