"""What may be replaced, and errors of the disk; laws of every format are in test_formats.py."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from mlbatch.errors import ExportError
from mlbatch.writers import open_writer
from mlbatch.writers.atomic import prepare
from mlbatch.writers.base import WriterOptions
from tests.builders.scans import SUMMARY, dense_scan, run_info, run_job


def test_a_full_disk_names_a_remedy(tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("this system has no /dev/full")
    writer = open_writer("npz", tmp_path / "out", run_info(), WriterOptions())
    os.symlink("/dev/full", tmp_path / "out.partial" / "000000.npz")
    with pytest.raises(ExportError, match=r"found 'No space left on device'; free space"):
        run_job(writer.write(dense_scan()))


def test_a_recorded_bag_is_never_replaced(tmp_path: Path) -> None:
    """Its files have the names of an output, but there is no scans.csv."""
    (tmp_path / "drive").mkdir()
    for name in ("drive_0.mcap", "metadata.yaml"):
        (tmp_path / "drive" / name).write_text("mine")
    with pytest.raises(ExportError, match=r"drive_0\.mcap|metadata\.yaml"):
        prepare(tmp_path / "drive", overwrite=True, folder=True)
    assert len(list((tmp_path / "drive").iterdir())) == 2


@pytest.mark.parametrize(
    "names",
    [("000000.bin", "times.txt"), ("000000.pcd.bin",), ("000000.pcd",), ("left/000000.laz",)],
)
def test_scans_of_other_programs_are_never_replaced(names: tuple[str, ...], tmp_path: Path) -> None:
    """Data sets have such files too: only with a scans.csv are they an own output."""
    for name in names:
        (tmp_path / "drive" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "drive" / name).write_text("mine")
    with pytest.raises(ExportError, match="expected a folder with nothing but scans to overwrite"):
        prepare(tmp_path / "drive", overwrite=True, folder=True)
    (tmp_path / "drive" / "scans.csv").touch()
    prepare(tmp_path / "drive", overwrite=True, folder=True)
    (tmp_path / "drive" / "000000.bin.txt").touch()
    with pytest.raises(ExportError, match=r"found 000000\.bin\.txt in it"):
        prepare(tmp_path / "drive", overwrite=True, folder=True)


def test_files_and_folders_do_not_replace_each_other(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    with pytest.raises(ExportError, match="expected a file to overwrite"):
        prepare(tmp_path / "folder", overwrite=True, folder=False)
    with pytest.raises(ExportError, match="expected a folder to overwrite"):
        prepare(tmp_path / "file", overwrite=True, folder=True)
    if Path("/dev/null").exists():
        with pytest.raises(ExportError, match="expected a file to overwrite"):
            prepare(Path("/dev/null"), overwrite=True, folder=False)


def test_an_output_that_appeared_meanwhile_is_kept(tmp_path: Path) -> None:
    writer = open_writer("mcap", tmp_path / "out.mcap", run_info(), WriterOptions())
    (tmp_path / "out.mcap").write_text("other run")
    with pytest.raises(ExportError, match="existing"):
        writer.finish(SUMMARY)
    assert (tmp_path / "out.mcap").read_text() == "other run"
