"""Point records: presets by hand, times, and arrays of any form against literal records."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from mlbatch.decode.scan_buffer import ScanBuffer
from mlbatch.types import Scan
from mlbatch.writers.point_layouts import (
    CLOUD_LAYOUTS,
    PLY_LAYOUTS,
    ROWS_NUSCENES,
    ROWS_TIME,
    Records,
)
from tests.builders.scans import dense_scan, organized_scan, point_scan
from tests.reference.records import check_records

SCANS: dict[str, Callable[[], Scan]] = {"dense": dense_scan, "organized": organized_scan}
LAYOUTS = {
    layout.name: layout
    for layout in (*CLOUD_LAYOUTS.values(), *PLY_LAYOUTS.values(), ROWS_NUSCENES, ROWS_TIME)
}
SPARE = 7


def packed(scan: Scan, name: str) -> Records:
    """Return the records of a scan."""
    records = np.zeros(scan.time_ns.T.shape, LAYOUTS[name].dtype)
    LAYOUTS[name].pack(scan, records)
    return records


@pytest.mark.parametrize(
    ("name", "form", "values"),
    [
        ("velodyne", "<ffffHf", (1, 2, 3, 7, 258, 0.0625)),
        ("ouster", "<fff4xfIHHH2xI12x", (1, 2, 3, 7, 62_500_000, 300, 258, 0, 1500)),
        ("hesai", "<ffffHd", (1, 2, 3, 7, 258, 1_700_000_000.1625)),
        ("kiss-icp", "<ffff", (1, 2, 3, 0.0625)),
        ("minimal", "<fff", (1, 2, 3)),
    ],
)
def test_presets_by_hand(name: str, form: str, values: tuple[float, ...]) -> None:
    assert LAYOUTS[name].step == struct.calcsize(form)
    assert packed(point_scan(), name).tobytes() == struct.pack(form, *values)


def test_autoware_angles_are_in_the_sensor_frame() -> None:
    # The sensor is at (1, 0, 2) and its x axis is body y: the point (1, 3, 6) is 3 m ahead of it
    # and 4 m up.
    scan = replace(point_scan(), xyz=np.array([[1, 3, 6]], np.float32))
    scan = replace(scan, intensity=np.array([999], np.float32), ring=np.array([6], np.uint16))
    records = packed(scan, "autoware")
    x, y, z, intensity, kind, channel, azimuth, elevation, distance, time = struct.unpack(
        "<fffBBHfffI", records.tobytes()
    )
    assert (x, y, z, intensity, kind, channel, time) == (1, 3, 6, 255, 2, 2, 62_500_000)
    assert azimuth == pytest.approx(0, abs=1e-6)
    assert elevation == pytest.approx(math.atan2(4, 3))
    assert distance == pytest.approx(5)
    assert records.dtype.names == (
        *("x", "y", "z", "intensity", "return_type", "channel"),
        *("azimuth", "elevation", "distance", "time_stamp"),
    )


def test_float32_times_never_exceed_the_true_time() -> None:
    # The float32 nearest to 99 999 999 ns is 0.1 s, above the truth; the next below, 2^-27 s less,
    # is 0.0999999940395355224609375 s. Those of 500 000 000 ns and 0 are exact.
    time_ns = np.array([0, 1, 99_999_999, 500_000_000, 4_000_000_001], np.uint32)
    found = packed(replace(dense_scan(points=len(time_ns)), time_ns=time_ns), "standard")["time"]
    assert found[2] == 0.0999999940395355224609375
    assert found[[0, 3, 4]].tolist() == [0.0, 0.5, 4.0]
    for value, truth_ns in zip(found, time_ns.tolist(), strict=True):
        # Exact rationals: m / 2^k <= ns / 10^9 < next(m / 2^k).
        above = np.nextafter(value, np.float32(5))
        numerator, denominator = float(value).as_integer_ratio()
        assert numerator * 10**9 <= truth_ns * denominator
        numerator, denominator = float(above).as_integer_ratio()
        assert numerator * 10**9 > truth_ns * denominator


def side_by_side(scan: Scan) -> Scan:
    """Return the same scan in the arrays of a decoder, which are longer than their content."""
    rows, *slots = scan.time_ns.shape
    buffer = ScanBuffer(rows + SPARE, *slots or (None,))
    buffer.point[:rows, ..., :3] = scan.xyz
    buffer.point[:rows, ..., 3] = scan.intensity
    for name in ("time_ns", "ring", "return_type", "lidar_id"):
        buffer.label[name][:rows] = getattr(scan, name)
    return replace(
        scan,
        xyz=buffer.point[:rows, ..., :3],
        intensity=buffer.point[:rows, ..., 3],
        time_ns=buffer.label["time_ns"][:rows],
        ring=buffer.label["ring"][:rows],
        return_type=buffer.label["return_type"][:rows],
        lidar_id=buffer.label["lidar_id"][:rows],
    )


@pytest.mark.parametrize("name", LAYOUTS)
@pytest.mark.parametrize("kind", SCANS)
@pytest.mark.parametrize("begin", [0, 3])
def test_arrays_are_packed_wherever_they_are(kind: str, name: str, begin: int) -> None:
    """Side by side, apart or in larger items; for any alignment of the first record."""
    scan = SCANS[kind]()
    layout = LAYOUTS[name]
    together = side_by_side(scan)
    spread = replace(
        scan,
        xyz=np.stack([scan.xyz, scan.xyz], axis=-1)[..., 0],
        time_ns=np.repeat(scan.time_ns, 2, axis=0)[::2],
        ring=scan.ring.astype(">u2"),
    )
    swapped = replace(together, lidar_id=together.lidar_id.copy())
    found = []
    for one in (scan, together, spread, swapped):
        room = np.zeros(one.time_ns.size * layout.step + begin, np.uint8)
        records = room[begin:].view(layout.dtype).reshape(one.time_ns.T.shape)
        layout.pack(one, records)
        found.append(room.tobytes())
    assert len(set(found)) == 1
    if name != "autoware":
        check_records(found[0][begin:], scan, name, seed=begin)
