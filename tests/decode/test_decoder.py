"""Points of columns by hand, and windows without any; all else: `tests/decode/test_engine.py`."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from mlbatch.arrays import F64Array
from mlbatch.decode.decoder import Decoder
from mlbatch.decode.groups import Source
from mlbatch.frames.transforms import from_rpy_deg
from mlbatch.native.arena import PacketArena
from mlbatch.pipeline.sensor import new_ring
from mlbatch.simulate.ouster.encode import OusterSpec, encode_packets
from mlbatch.types import RunInfo, SensorInfo, Window, WindowColumns
from tests.builders.decoded import Readings, readings
from tests.builders.others import rows
from tests.builders.run import FIXTURE, in_memory
from tests.builders.spinning import ouster_calibration

COLUMNS = 512
# Beam 0 looks 30 degrees up, beam 1 is rotated by 90 degrees, the others look along the column's
# angle; no offset of the beams from the axis, and no lift.
FLAT = OusterSpec(
    beams=16,
    columns_per_frame=COLUMNS,
    altitude_deg=(30.0, *[0.0] * 15),
    azimuth_deg=(0.0, 90.0, *[0.0] * 14),
    beam_offset_mm=(0.0, 0.0),
    lidar_to_sensor_mm=np.diag([-1.0, -1.0, 1.0, 1.0]).ravel().tolist(),
)


def revolution(
    *cells: tuple[int, int], spec: OusterSpec = FLAT, pose: F64Array | None = None
) -> Readings:
    """A revolution with returns at 4 m in these cells (column, beam)."""
    ranges = np.zeros((COLUMNS, 16), np.int64)
    ranges[tuple(zip(*cells, strict=True))] = 4000
    mids = np.arange(COLUMNS)
    packets = encode_packets(spec, mids, mids, np.zeros(COLUMNS, np.int64), {"RANGE": ranges})
    return readings(ouster_calibration(spec).lidar({}, None), rows(packets), None, pose)


@pytest.mark.parametrize(
    ("cell", "xyz"),
    [
        # The lidar frame looks back, the sensor frame forward; the rotor rotates clockwise.
        ((0, 2), (-4, 0, 0)),
        ((128, 2), (0, 4, 0)),
        ((256, 2), (4, 0, 0)),
        ((384, 2), (0, -4, 0)),
        # sin 30 degrees is a half.
        ((256, 0), (4 * math.cos(math.pi / 6), 0, 2)),
        # Azimuth offsets run against the encoder: 90 degrees after mid 128 is mid 256.
        ((128, 1), (4, 0, 0)),
    ],
)
def test_a_point_at_four_metres(cell: tuple[int, int], xyz: tuple[float, ...]) -> None:
    found = revolution(cell)
    assert np.argwhere(found.range_m).tolist() == [[*cell, 0]]
    assert found.xyz[cell][0].tolist() == pytest.approx(xyz, abs=1e-5)


def test_extrinsics_rotate_then_translate() -> None:
    found = revolution((256, 2), pose=from_rpy_deg((10.0, 20.0, 30.0), (0.0, 0.0, 90.0)))
    assert found.xyz[256, 2, 0].tolist() == pytest.approx([10, 24, 30], abs=1e-5)
    # The range is as measured.
    assert found.range_m[256, 2, 0] == 4.0


def test_beams_begin_at_their_distance_from_the_axis() -> None:
    """n = 16 mm: (r - n) along the beam, plus n along the column's angle (section 6)."""
    found = revolution((256, 2), (256, 1), spec=replace(FLAT, beam_offset_mm=(16.0, 0.0)))
    assert found.xyz[256, 1:3, 0] == pytest.approx(
        np.array([[0.016, -3.984, 0], [4, 0, 0]]), abs=1e-5
    )


@pytest.mark.parametrize("layout", ["dense", "organized"])
@pytest.mark.parametrize("columns", [0, 16])
def test_windows_without_a_column_or_a_return_have_no_points(columns: int, layout: str) -> None:
    lidar = ouster_calibration(FLAT).lidar({}, None)
    ring = new_ring(lidar, PacketArena())
    first = ring.keep(np.zeros(lidar.packet_size, np.uint8), np.zeros(1, np.int64)).ring_index
    places = (first + ring.column_offsets(16))[:columns]
    own = SensorInfo("one", "", 16, 1, 0, np.eye(4))
    info = RunInfo((own,), "base_link", "10", "utc", layout=layout)
    nothing = np.zeros(columns, np.int64)
    due = WindowColumns(nothing, nothing, places, nothing)
    decoder = Decoder(info, [Source(lidar, ring, np.eye(4), 0)], np.empty((0, 6)))
    scan = decoder.scan(Window(3, 0, 0, 10**8, True, 17, due))
    assert (scan.points, len(scan.column_stamp_ns)) == (0, columns)
    assert len(scan.xyz) == (columns if layout == "organized" else 0)


def test_points_are_counted_by_sensor_in_merged_and_in_split_scans() -> None:
    whole = in_memory(FIXTURE).scans
    counts = [np.bincount(scan.lidar_id, minlength=2).tolist() for scan in whole]
    assert [list(scan.points_per_sensor) for scan in whole] == counts
    split = [scan.points_per_sensor for scan in in_memory(replace(FIXTURE, split=True)).scans]
    assert sorted(split) == sorted(
        pair for left, right in counts for pair in ((left, 0), (0, right))
    )
