"""LAZ files are the LAS files of test_las.py, compressed: equal points, fewer bytes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mlbatch.writers import WriterOptions, open_writer
from tests.builders.scans import SUMMARY, dense_scan, run_job


def test_points_are_those_of_las(tmp_path: Path) -> None:
    laspy = pytest.importorskip("laspy")
    pytest.importorskip("lazrs")
    scan = dense_scan(points=60_000)
    for name in ("las", "laz"):
        writer = open_writer(name, tmp_path / name, scan.info, WriterOptions())
        run_job(writer.write(scan))
        writer.finish(SUMMARY)
    plain = tmp_path / "las" / "000000.las"
    small = tmp_path / "laz" / "000000.laz"
    # Random values; real scans are compressed to a sixth.
    assert small.stat().st_size < plain.stat().st_size / 2
    np.testing.assert_array_equal(laspy.read(plain).points.array, laspy.read(small).points.array)
