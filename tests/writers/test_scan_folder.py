"""Folders with a file a scan: names, sensors, and files that a continued run lacks."""

from __future__ import annotations

from pathlib import Path

import pytest

from mlbatch.errors import ExportError
from mlbatch.writers import WriterOptions, open_writer
from mlbatch.writers.scan_folder import scan_name
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


def test_split_gives_a_folder_a_sensor(tmp_path: Path) -> None:
    writer = open_writer("npz", tmp_path / "out", run_info(), WriterOptions(split=True))
    for sensor in range(2):
        run_job(writer.write(dense_scan(seed=sensor), sensor))
    run_job(writer.flush())
    writer.finish(SUMMARY)
    found = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.npz"))
    assert found == ["out/left/000000.npz", "out/right/000000.npz"]


def test_an_abandoned_output_stays_partial(tmp_path: Path) -> None:
    writer = open_writer("npz", tmp_path / "out", run_info(), WriterOptions())
    run_job(writer.write(dense_scan()))
    writer.abandon()
    assert [path.name for path in tmp_path.iterdir()] == ["out.partial"]


def test_a_skipped_scan_must_have_its_file(tmp_path: Path) -> None:
    (tmp_path / "out.partial").mkdir()
    writer = open_writer("ply", tmp_path / "out", run_info(), WriterOptions(kept_bytes=0))
    with pytest.raises(ExportError, match=r"000000\.ply: expected a scan .*, found no file; leave"):
        run_job(writer.skip(dense_scan()))
    assert writer.checkpoint().scans == 0
