"""KITTI folders: rows of four float32, and times.txt."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mlbatch.writers import WriterOptions, open_writer
from tests.builders.scans import SUMMARY, dense_scan, point_scan, run_info, run_job


def test_one_row_by_hand(tmp_path: Path) -> None:
    scan = point_scan()
    writer = open_writer("kitti", tmp_path / "out", scan.info, WriterOptions())
    run_job(writer.write(scan))
    writer.finish(SUMMARY)
    body = (tmp_path / "out" / "000000.bin").read_bytes()
    assert body == struct.pack("<ffff", 1.0, 2.0, 3.0, 7.0)
    assert (tmp_path / "out" / "times.txt").read_text() == "1700000000.100000000\n"


def test_numpy_reads_all_points(tmp_path: Path) -> None:
    scan = dense_scan(points=20_001)
    writer = open_writer("kitti", tmp_path / "out", scan.info, WriterOptions())
    # The buffer of a larger scan is used again.
    run_job(writer.write(dense_scan(1, 30_000)))
    run_job(writer.write(scan))
    writer.finish(SUMMARY)
    rows = np.fromfile(tmp_path / "out" / "000000.bin", np.float32).reshape(-1, 4)
    np.testing.assert_array_equal(rows[:, :3], scan.xyz)
    np.testing.assert_array_equal(rows[:, 3], scan.intensity)


@pytest.mark.parametrize("split", [False, True])
def test_line_i_of_the_times_is_file_i(split: bool, tmp_path: Path) -> None:
    """In the order of names: the head, which is written first, is last."""
    info = run_info(slices=2)
    folder = tmp_path / "out"
    writer = open_writer("kitti", folder, info, WriterOptions(split=split))
    for index, part in ((-1, 1), (0, 0), (0, 1), (2, 0)):
        scan = dense_scan(max(index, 0), 5)
        start_ns = 1_700_000_000_000_000_007 + (2 * index + part) * 50_000_000
        scan = replace(scan, info=info, index=index, slice=part, start_ns=start_ns)
        run_job(writer.write(scan, 1 if split else None))
    writer.finish(SUMMARY)
    folder = folder / "right" if split else folder
    names = sorted(path.name for path in folder.glob("*.bin"))
    assert names == ["000000-0.bin", "000000-1.bin", "000002-0.bin", "head-1.bin"]
    assert (folder / "times.txt").read_text().splitlines() == [
        "1700000000.000000007",
        "1700000000.050000007",
        "1700000000.200000007",
        "1699999999.950000007",
    ]
