"""Fields that move together land where they do one by one, with the values that they have."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from mlbatch.decode.scan_buffer import ScanBuffer
from mlbatch.types import Scan
from mlbatch.writers.point_layouts import CLOUD_LAYOUTS, PLY_LAYOUT, points_of
from tests.builders.scans import dense_scan, organized_scan

SCANS: dict[str, Callable[[], Scan]] = {"dense": dense_scan, "organized": organized_scan}
LAYOUTS = {layout.name: layout for layout in (*CLOUD_LAYOUTS.values(), PLY_LAYOUT)}
SPARE = 7


def side_by_side(scan: Scan) -> Scan:
    """The same scan in the arrays of a decoder, which are longer than what is in them."""
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
def test_wide_moves_change_nothing(kind: str, name: str, begin: int) -> None:
    """Whatever the place of the first record in memory."""
    scan, layout = SCANS[kind](), LAYOUTS[name]
    apart, together = points_of(scan), points_of(side_by_side(scan))
    assert (apart.reals is None, apart.labels is None) == (True, True)
    assert together.reals is not None
    assert together.labels is not None
    found = []
    for points in (apart, together):
        room = np.zeros(points.time_ns.size * layout.step + begin, np.uint8)
        records = room[begin:].view(layout.dtype).reshape(points.time_ns.shape)
        layout.pack(points, records)
        found.append(room.tobytes())
    assert found[0] == found[1]
    for axis, letter in enumerate("xyz"):
        np.testing.assert_array_equal(records[letter], apart.xyz[..., axis])
    if "lidar_id" in (layout.dtype.names or ()):
        np.testing.assert_array_equal(records["intensity"], apart.intensity)
        np.testing.assert_array_equal(records["ring"], apart.ring)
        np.testing.assert_array_equal(records["return_type"], apart.return_type)
        np.testing.assert_array_equal(records["lidar_id"], apart.lidar_id)


def test_a_part_that_lies_elsewhere_is_seen() -> None:
    scan = side_by_side(dense_scan())
    assert points_of(replace(scan, intensity=scan.intensity.copy())).reals is None
    assert points_of(replace(scan, xyz=scan.xyz.copy())).reals is None
    assert points_of(replace(scan, ring=scan.ring.copy())).labels is None
    later = {name: getattr(scan, name)[1:] for name in ("xyz", "intensity")}
    assert points_of(replace(scan, **later)).reals is None
    every = {name: getattr(scan, name)[::2] for name in ("xyz", "intensity")}
    assert points_of(replace(scan, **every)).reals is None
    swapped = replace(scan, return_type=scan.lidar_id, lidar_id=scan.return_type)
    assert points_of(swapped).labels is None


def test_no_points_are_no_words() -> None:
    scan = side_by_side(dense_scan(points=0, columns=1))
    records = np.zeros(0, LAYOUTS["standard"].dtype)
    LAYOUTS["standard"].pack(points_of(scan), records)
