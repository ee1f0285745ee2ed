"""Columns to points: positions and counts by hand; all else: `tests/decode/test_engine.py`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from mlbatch.arrays import F64Array, I64Array
from mlbatch.batching.merge import ColumnMerge
from mlbatch.decode.decoder import Decoder, ScanHeader, WindowColumns
from mlbatch.decode.source import Source
from mlbatch.frames.transforms import from_rpy_deg
from mlbatch.native.arena import PacketArena
from mlbatch.pipeline.sensor import new_ring
from mlbatch.sensors import read_calibration
from mlbatch.simulate.ouster.encode import IntLike, OusterSpec, encode_packets
from mlbatch.types import RunInfo, Scan, SensorInfo
from tests.builders.sessions import write_metadata

START_NS = 1_800_000_000_100_000_000
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


@dataclass
class StoredSensor:
    """A sensor with a whole revolution in its ring; ranges_mm: (columns, beams) by field name."""

    folder: Path
    spec: OusterSpec
    fields: dict[str, IntLike]
    body_from_sensor: F64Array = field(default_factory=lambda: np.eye(4))
    ring_base: int = 0
    min_range_m: float = 0.0
    max_range_m: float = math.inf
    source: Source = field(init=False)
    ring_index: I64Array = field(init=False)

    def __post_init__(self) -> None:
        calibration = read_calibration(write_metadata(self.folder / "lidar.json", self.spec))
        assert calibration is not None
        lidar = calibration.lidar({}, None)
        mids = np.arange(COLUMNS)
        payloads = encode_packets(self.spec, mids, mids, np.zeros(COLUMNS, np.int64), self.fields)
        data = np.frombuffer(b"".join(payloads), np.uint8)
        ring = new_ring(lidar, PacketArena())
        start = np.arange(len(payloads), dtype=np.int64) * lidar.packet_size
        first = ring.keep(data.copy(), start).ring_index
        self.ring_index = (first[:, None] + ring.column_offsets(16)).ravel()
        self.source = Source(
            lidar,
            ring,
            self.body_from_sensor,
            self.ring_base,
            self.min_range_m,
            self.max_range_m,
        )


def _ranges(value: int = 0, **cells: int) -> IntLike:
    """(COLUMNS, 16) ranges in mm; `c3_b1=4000` sets column 3, beam 1."""
    ranges = np.full((COLUMNS, 16), value, np.int64)
    for name, value_mm in cells.items():
        column, beam = (int(part[1:]) for part in name.split("_"))
        ranges[column, beam] = value_mm
    return ranges


def _decoder(
    *stored: StoredSensor, layout: str = "dense", boxes: Sequence[Sequence[float]] = ()
) -> Decoder:
    sensors = tuple(
        SensorInfo(f"s{number}", "", 16, one.source.lidar.returns, one.ring_base, np.eye(4))
        for number, one in enumerate(stored)
    )
    info = RunInfo(sensors, "base_link", "10", "utc", layout=layout)
    boxes_m = np.array(boxes, np.float64).reshape(-1, 6)
    return Decoder(info, [one.source for one in stored], boxes_m)


def _scan(
    decoder: Decoder, stored: Sequence[StoredSensor], columns: Sequence[tuple[int, int]]
) -> Scan:
    """A scan of (sensor, measurement id), 100 us apart."""
    sensor = np.array([number for number, _ in columns], np.int64)
    mids = np.array([mid for _, mid in columns], np.int64)
    place = np.array([stored[s].ring_index[mid] for s, mid in columns], np.int64)
    stamps = START_NS + np.arange(len(columns), dtype=np.int64) * 100_000
    due = WindowColumns(stamps, sensor, place, mids)
    angles = [one.source.lidar.beams.angle_rad for one in stored]
    merge = ColumnMerge([None if angle is None else len(angle) for angle in angles])
    (figures,) = merge.figures(due, [len(due)])
    return decoder.scan(due, ScanHeader(3, 0, START_NS, START_NS + 10**8, True, 17, figures))


def _xyz(scan: Scan) -> list[list[float]]:
    return [[round(float(value), 4) + 0.0 for value in point] for point in scan.xyz]


# -- positions of points --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cell", "xyz"),
    [
        # The lidar frame looks back, the sensor frame forward; the rotor rotates clockwise.
        ("c0_b2", [-4, 0, 0]),
        ("c128_b2", [0, 4, 0]),
        ("c256_b2", [4, 0, 0]),
        ("c384_b2", [0, -4, 0]),
        # sin 30 degrees is a half.
        ("c256_b0", [4 * math.cos(math.pi / 6), 0, 2]),
        # Azimuth offsets run against the encoder: 90 degrees after mid 128 is mid 256.
        ("c128_b1", [4, 0, 0]),
    ],
)
def test_a_point_at_four_metres(tmp_path: Path, cell: str, xyz: list[float]) -> None:
    one = StoredSensor(tmp_path, FLAT, {"RANGE": _ranges(**{cell: 4000})})
    scan = _scan(_decoder(one), [one], [(0, mid) for mid in range(COLUMNS)])
    assert _xyz(scan) == [[round(value, 4) for value in xyz]]


def test_extrinsics_rotate_then_translate(tmp_path: Path) -> None:
    pose = from_rpy_deg((10.0, 20.0, 30.0), (0.0, 0.0, 90.0))
    one = StoredSensor(tmp_path, FLAT, {"RANGE": _ranges(c256_b2=4000)}, pose)
    scan = _scan(_decoder(one), [one], [(0, 256)])
    assert _xyz(scan) == [[10, 24, 30]]
    # The range is as measured.
    assert scan.range_m is not None
    assert scan.range_m.tolist() == [4.0]


def test_beams_begin_at_their_distance_from_the_axis(tmp_path: Path) -> None:
    """n = 15.8 mm: (r - n) along the beam, plus n along the column's angle (section 6)."""
    spec = replace(FLAT, beam_offset_mm=(16.0, 0.0))
    ranges = _ranges(c256_b2=4000, c256_b1=4000)
    one = StoredSensor(tmp_path, spec, {"RANGE": ranges})
    scan = _scan(_decoder(one), [one], [(0, 256)])
    assert _xyz(scan) == [[0.016, -3.984, 0], [4, 0, 0]]


# -- slots without a point ------------------------------------------------------------------------


def test_an_empty_window_gives_an_empty_scan(tmp_path: Path) -> None:
    one = StoredSensor(tmp_path, FLAT, {"RANGE": _ranges()})
    scan = _scan(_decoder(one), [one], [(0, 0), (0, 1)])
    assert (scan.points, scan.xyz.shape, len(scan.column_stamp_ns)) == (0, (0, 3), 2)


@pytest.mark.parametrize("layout", ["dense", "organized"])
def test_a_window_without_a_column_gives_an_empty_scan(tmp_path: Path, layout: str) -> None:
    one = StoredSensor(tmp_path, FLAT, {"RANGE": _ranges()})
    scan = _scan(_decoder(one, layout=layout), [one], [])
    assert (scan.points, len(scan.xyz), len(scan.column_stamp_ns)) == (0, 0, 0)


# -- coverage of a revolution --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mids", "coverage", "overlap"),
    [
        (range(COLUMNS), 1.0, 0.0),
        (range(COLUMNS // 2), 0.5, 0.0),
        # A revolution and a quarter: the first quarter is covered twice.
        ([*range(COLUMNS), *range(COLUMNS // 4)], 1.0, 0.25),
        ([*range(COLUMNS), *range(COLUMNS), *range(COLUMNS)], 1.0, 1.0),
        ([5], 1 / 120, 0.0),
    ],
)
def test_coverage_and_overlap_of_a_revolution(
    tmp_path: Path, mids: Sequence[int], coverage: float, overlap: float
) -> None:
    for name in ("1", "2"):
        (tmp_path / name).mkdir()
    one = StoredSensor(tmp_path / "1", FLAT, {"RANGE": _ranges(4000)})
    two = StoredSensor(tmp_path / "2", FLAT, {"RANGE": _ranges(4000)}, ring_base=16)
    columns = [(0, mid) for mid in mids]
    assert _scan(_decoder(one), [one], columns).coverage == pytest.approx((coverage,))
    scan = _scan(_decoder(one, two), [one, two], [*columns, (1, 7)])
    assert scan.coverage == pytest.approx((coverage, 1 / 120))
    assert scan.overlap == pytest.approx((overlap, 0.0))
