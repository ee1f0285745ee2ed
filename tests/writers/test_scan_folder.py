"""Folders with a file a scan: names, sensors, and files that other runs make."""

from __future__ import annotations

import zlib
from pathlib import Path

import pytest

from mlbatch.writers import open_writer
from mlbatch.writers.base import FilesWriter, WriterOptions
from mlbatch.writers.scan_folder import scan_name
from tests.builders.files import Noted
from tests.builders.scans import SUMMARY, dense_scan, run_info, run_job


@pytest.mark.parametrize(
    ("index", "slice_", "slices", "name"),
    [
        (42, 0, 1, "000042"),
        (42, 3, 4, "000042-3"),
        (1_234_567, 0, 1, "1234567"),
        (-1, 0, 1, "head"),
        (-1, 3, 4, "head-3"),
    ],
)
def test_names(index: int, slice_: int, slices: int, name: str) -> None:
    assert scan_name(index, slice_, slices) == name


def test_files_of_other_runs_are_left_to_them(tmp_path: Path) -> None:
    """A skipped scan has no file, but is in lists of all; others are noted once they are whole."""
    noted = Noted()
    options = WriterOptions(files=noted, split=True)
    writer = open_writer("nuscenes", tmp_path / "out", run_info(), options)
    assert isinstance(writer, FilesWriter)
    run_job(writer.skip(dense_scan(0), 1))
    job = writer.write(dense_scan(1), 1)
    job.pack()
    assert noted.crcs == {}
    job.commit()
    writer.finish(SUMMARY)
    out = tmp_path / "out"
    files = sorted(path.relative_to(out).as_posix() for path in out.rglob("*.bin"))
    assert files == ["right/000001.pcd.bin", "right/000001.time.bin"]
    crcs = {name: zlib.crc32((out / name).read_bytes()) for name in files}
    assert noted.crcs == {(1, 0, 1): crcs}
    assert len((out / "right/times.txt").read_text().splitlines()) == 2
