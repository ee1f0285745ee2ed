"""Outputs appear whole or not at all, and nothing else is touched."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mlbatch.errors import ExportError
from mlbatch.writers import WriterOptions, open_writer
from mlbatch.writers.atomic import check_free_space, prepare, write_text
from tests.builders.scans import (
    SUMMARY,
    dense_scan,
    run_info,
    run_job,
)

ROOT = Path(__file__).resolve().parents[2]
OUTPUTS = [("mcap", "out.mcap"), ("npz", "out"), ("ply", "out")]
OUTPUTS += [("rosbag1", "out.bag"), ("rosbag2", "out")]

# Writes scans until something stops it; says "ready" once data are under way.
CHILD = """
import sys
from pathlib import Path
from mlbatch.errors import ExportError
from mlbatch.writers import WriterOptions, open_writer
from tests.builders.scans import (SUMMARY, dense_scan, run_info, run_job,)

writer = open_writer(sys.argv[1], Path(sys.argv[2]), run_info(), WriterOptions())
try:
    for index in range(int(sys.argv[3])):
        run_job(writer.write(dense_scan(index, 40_000)))
        if index == 8:
            print("ready", flush=True)
    writer.finish(SUMMARY)
except ExportError as err:
    writer.abandon()
    print(err)
"""


def start(name: str, target: Path, scans: int, limit_bytes: int = 0) -> subprocess.Popen[str]:
    """Start the child; `limit_bytes`: no file may grow larger."""
    code = CHILD
    if limit_bytes:
        limit = f"resource.setrlimit(resource.RLIMIT_FSIZE, ({limit_bytes}, {limit_bytes}))"
        code = f"import resource; {limit}\n{CHILD}"
    command = [sys.executable, "-c", code, name, str(target), str(scans)]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=ROOT, stdout=pipe, stderr=pipe, text=True)


@pytest.mark.parametrize(("name", "file"), OUTPUTS)
def test_a_killed_run_leaves_only_a_partial(name: str, file: str, tmp_path: Path) -> None:
    with start(name, tmp_path / file, 1_000_000) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "ready\n"
        child.send_signal(signal.SIGKILL)
        child.wait()
    assert [path.name for path in tmp_path.iterdir()] == [f"{file}.partial"]
    # The next run to the same output is not hindered by it.
    writer = open_writer(name, tmp_path / file, run_info(), WriterOptions())
    run_job(writer.write(dense_scan()))
    writer.finish(SUMMARY)
    assert (tmp_path / file).exists()
    assert not (tmp_path / f"{file}.partial").exists()


@pytest.mark.parametrize(("name", "file"), OUTPUTS)
def test_a_refusing_disk_is_one_line(name: str, file: str, tmp_path: Path) -> None:
    with start(name, tmp_path / file, 20, limit_bytes=500_000) as child:
        said, errors = child.communicate()
    assert errors == ""
    [line] = said.splitlines()
    assert f"{file}.partial" in line
    assert "wanted to write it, got 'File too large'; raise the limit" in line
    assert [path.name for path in tmp_path.iterdir()] == [f"{file}.partial"]


def test_a_full_disk_says_what_to_do(tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("this system has no /dev/full")
    writer = open_writer("npz", tmp_path / "out", run_info(), WriterOptions())
    os.symlink("/dev/full", tmp_path / "out.partial" / "000000.npz")
    with pytest.raises(ExportError, match=r"got 'No space left on device'; free space"):
        run_job(writer.write(dense_scan()))


@pytest.mark.parametrize(("name", "file"), OUTPUTS)
def test_an_existing_output_is_refused(name: str, file: str, tmp_path: Path) -> None:
    (tmp_path / file).write_text("old")
    with pytest.raises(ExportError, match=r"got an existing one; choose another or --overwrite"):
        open_writer(name, tmp_path / file, run_info(), WriterOptions())
    assert (tmp_path / file).read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize(("name", "file"), OUTPUTS)
def test_overwriting_happens_at_the_end(name: str, file: str, tmp_path: Path) -> None:
    target = tmp_path / file
    for scans in ((0, 1, 2), (7,)):
        writer = open_writer(name, target, run_info(), WriterOptions(overwrite=True))
        before = sorted(path.name for path in tmp_path.rglob("*") if ".partial" not in str(path))
        for index in scans:
            run_job(writer.write(dense_scan(index)))
        after = sorted(path.name for path in tmp_path.rglob("*") if ".partial" not in str(path))
        assert before == after
        writer.finish(SUMMARY)
    assert not [path for path in tmp_path.rglob("*") if ".partial" in path.name]
    if target.is_dir():
        files = ["metadata.yaml", "out_0.mcap"] if name == "rosbag2" else [f"000007.{name}"]
        assert sorted(path.name for path in target.iterdir()) == [*files, "scans.csv"]


@pytest.mark.parametrize(("name", "file"), OUTPUTS)
def test_an_older_output_and_its_table_stay_if_the_report_fails(
    name: str, file: str, tmp_path: Path
) -> None:
    def files() -> dict[Path, bytes]:
        paths = (path for path in tmp_path.rglob("*") if path.is_file())
        return {path: path.read_bytes() for path in paths if ".partial" not in str(path)}

    def refuse(partial: Path) -> None:
        raise ExportError("no room for the report")

    writer = open_writer(name, tmp_path / file, run_info(), WriterOptions())
    run_job(writer.write(dense_scan(0)))
    writer.finish(SUMMARY)
    before = files()
    writer = open_writer(name, tmp_path / file, run_info(), WriterOptions(overwrite=True))
    run_job(writer.write(dense_scan(1)))
    with pytest.raises(ExportError, match="no room"):
        writer.finish(replace(SUMMARY, scans_csv="another table\n"), refuse)
    assert files() == before


@pytest.mark.parametrize("stranger", ["notes.txt", "left/photo.jpg", ".git/config"])
def test_a_folder_with_other_files_is_never_replaced(stranger: str, tmp_path: Path) -> None:
    (tmp_path / "out" / stranger).parent.mkdir(parents=True)
    (tmp_path / "out" / stranger).write_text("mine")
    with pytest.raises(ExportError, match=Path(stranger).name):
        open_writer("npz", tmp_path / "out", run_info(), WriterOptions(overwrite=True))
    assert (tmp_path / "out" / stranger).read_text() == "mine"


def test_a_recorded_bag_is_never_replaced(tmp_path: Path) -> None:
    """It looks like an output of ours, but has no table of scans."""
    (tmp_path / "drive").mkdir()
    for name in ("drive_0.mcap", "metadata.yaml"):
        (tmp_path / "drive" / name).write_text("mine")
    with pytest.raises(ExportError, match=r"drive_0\.mcap|metadata\.yaml"):
        open_writer("rosbag2", tmp_path / "drive", run_info(), WriterOptions(overwrite=True))
    assert len(list((tmp_path / "drive").iterdir())) == 2


def test_files_and_folders_do_not_replace_each_other(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    with pytest.raises(ExportError, match="wanted a file"):
        prepare(tmp_path / "folder", overwrite=True, folder=False)
    with pytest.raises(ExportError, match="wanted a folder"):
        prepare(tmp_path / "file", overwrite=True, folder=True)
    if Path("/dev/null").exists():
        with pytest.raises(ExportError, match="wanted a file"):
            prepare(Path("/dev/null"), overwrite=True, folder=False)


def test_an_output_that_appeared_meanwhile_is_kept(tmp_path: Path) -> None:
    writer = open_writer("mcap", tmp_path / "out.mcap", run_info(), WriterOptions())
    (tmp_path / "out.mcap").write_text("other run")
    with pytest.raises(ExportError, match="existing"):
        writer.finish(SUMMARY)
    assert (tmp_path / "out.mcap").read_text() == "other run"


@pytest.mark.parametrize("target", ["missing/out", "file/out"])
def test_a_missing_parent_folder_is_named(target: str, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ExportError, match="mkdir -p"):
        prepare(tmp_path / target, overwrite=False, folder=True)


@pytest.mark.parametrize("target", ["..", "/", "."])
def test_folders_are_no_names(target: str) -> None:
    with pytest.raises(ExportError, match="add a name"):
        prepare(Path(target), overwrite=True, folder=True)


def test_a_folder_without_permission_is_named(tmp_path: Path) -> None:
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    if os.access(locked, os.W_OK):
        pytest.skip("this user may write everywhere")
    with pytest.raises(ExportError, match="choose an output where you may write"):
        prepare(locked / "out", overwrite=False, folder=True)


def test_too_little_free_disk_is_said(tmp_path: Path) -> None:
    check_free_space(tmp_path / "out", 1)
    with pytest.raises(ExportError, match="wanted about 1000000000000 MB of free disk"):
        check_free_space(tmp_path / "out", 10**18)


def test_texts_replace_older_ones_whole(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    write_text(path, "long text\n")
    write_text(path, "µ\n")
    assert path.read_bytes() == b"\xc2\xb5\n"
    assert len(list(tmp_path.iterdir())) == 1


def test_scans_are_only_read_during_the_call(tmp_path: Path) -> None:
    writer = open_writer("npz", tmp_path / "out", run_info(), WriterOptions())
    scan = dense_scan()
    wanted = scan.intensity.copy()
    run_job(writer.write(scan))
    scan.intensity[:] = -1
    writer.finish(SUMMARY)
    with np.load(tmp_path / "out" / "000000.npz") as loaded:
        np.testing.assert_array_equal(loaded["intensity"], wanted)
