"""Laws of every format: atomic, locked, independent of threads, equal bytes for equal runs."""

from __future__ import annotations

import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from mlbatch.errors import ExportError, UsageError
from mlbatch.types import Scan
from mlbatch.writers import check_target, open_writer, output_file, plugin
from mlbatch.writers.base import WriterOptions
from mlbatch.writers.formats import format_names
from tests.builders.scans import (
    SUMMARY,
    dense_scan,
    imu_samples,
    organized_scan,
    run_info,
    run_job,
)

ROOT = Path(__file__).resolve().parents[2]
# The name of an output of each format.
OUTPUTS = {name: f"out{plugin(name).SUFFIX or ''}" for name in format_names()}
each_format = pytest.mark.parametrize("name", format_names())

# Writes scans until something stops it; prints "ready" after some of them.
CHILD = """
import sys
from pathlib import Path
from mlbatch.errors import ExportError
from mlbatch.writers import WriterOptions, open_writer
from tests.builders.scans import SUMMARY, dense_scan, run_info, run_job

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
    """Start the child; limit_bytes: no file may grow larger."""
    code = CHILD
    if limit_bytes:
        limit = f"resource.setrlimit(resource.RLIMIT_FSIZE, ({limit_bytes}, {limit_bytes}))"
        code = f"import resource; {limit}\n{CHILD}"
    command = [sys.executable, "-c", code, name, str(target), str(scans)]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=ROOT, stdout=pipe, stderr=pipe, text=True)


def files(folder: Path) -> dict[str, bytes]:
    """Return the files of a folder but those under construction."""
    paths = (path for path in folder.rglob("*") if path.is_file())
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in paths
        if ".partial" not in str(path)
    }


def whole(name: str, folder: Path, scans: list[Scan]) -> dict[str, bytes]:
    """Write scans with IMU samples between them, one after the other; return the files."""
    folder.mkdir()
    writer = open_writer(name, folder / OUTPUTS[name], scans[0].info, WriterOptions())
    for scan in scans:
        writer.write_imu(imu_samples(0, scan.start_ns))
        run_job(writer.write(scan))
    run_job(writer.flush())
    writer.finish(SUMMARY)
    return files(folder)


@each_format
def test_a_killed_run_leaves_only_a_partial(name: str, tmp_path: Path) -> None:
    target = tmp_path / OUTPUTS[name]
    with start(name, target, 1_000_000) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "ready\n"
        child.send_signal(signal.SIGKILL)
        child.wait()
    assert [path.name for path in tmp_path.iterdir()] == [f"{target.name}.partial"]
    # The next run to the same output replaces it.
    writer = open_writer(name, target, run_info(), WriterOptions())
    run_job(writer.write(dense_scan()))
    assert not target.exists()
    writer.finish(SUMMARY)
    assert target.exists()
    assert not target.with_name(f"{target.name}.partial").exists()


@each_format
def test_a_refusing_disk_is_one_line(name: str, tmp_path: Path) -> None:
    file = OUTPUTS[name]
    with start(name, tmp_path / file, 20, limit_bytes=300_000) as child:
        printed, errors = child.communicate()
    assert errors == ""
    [line] = printed.splitlines()
    assert f"{file}.partial" in line
    assert "expected to write it, found 'File too large'; raise the limit" in line
    assert [path.name for path in tmp_path.iterdir()] == [f"{file}.partial"]


@each_format
def test_an_existing_output_is_refused(name: str, tmp_path: Path) -> None:
    target = tmp_path / OUTPUTS[name]
    target.write_text("old")
    with pytest.raises(ExportError, match="found an existing one; choose another or --overwrite"):
        open_writer(name, target, run_info(), WriterOptions())
    with pytest.raises(ExportError, match="existing"):
        check_target(name, target, WriterOptions(), "dense")
    assert files(tmp_path) == {target.name: b"old"}
    assert len(list(tmp_path.iterdir())) == 1


@each_format
def test_overwriting_happens_at_the_end(name: str, tmp_path: Path) -> None:
    target = tmp_path / OUTPUTS[name]
    for scans in ((0, 1, 2), (7,)):
        writer = open_writer(name, target, run_info(), WriterOptions(overwrite=True))
        before = files(tmp_path)
        for index in scans:
            run_job(writer.write(dense_scan(index)))
        assert files(tmp_path) == before
        writer.finish(SUMMARY)
    assert not [path for path in tmp_path.rglob("*") if ".partial" in path.name]
    if target.is_dir():
        own = {
            "rosbag2": ["metadata.yaml", "out_0.mcap"],
            "kitti": ["000007.bin", "times.txt"],
            "nuscenes": ["000007.pcd.bin", "000007.time.bin", "times.txt"],
            "webdataset": ["000000.tar"],
        }.get(name, [f"000007.{name}"])
        assert sorted(path.name for path in target.iterdir()) == sorted([*own, "scans.csv"])


@each_format
def test_an_older_output_and_its_table_stay_if_the_report_fails(name: str, tmp_path: Path) -> None:
    def refuse(partial: Path) -> None:
        raise ExportError("no room for the report")

    target = tmp_path / OUTPUTS[name]
    writer = open_writer(name, target, run_info(), WriterOptions())
    run_job(writer.write(dense_scan(0)))
    writer.finish(SUMMARY)
    before = files(tmp_path)
    writer = open_writer(name, target, run_info(), WriterOptions(overwrite=True))
    run_job(writer.write(dense_scan(1)))
    with pytest.raises(ExportError, match="no room"):
        writer.finish(replace(SUMMARY, scans_csv="another table\n"), refuse)
    assert files(tmp_path) == before


@each_format
def test_stages_in_any_thread_may_come_in_any_order(name: str, tmp_path: Path) -> None:
    """Scans that fill chunks, scans that share one; equal runs give equal bytes."""
    scans = [dense_scan(index, 60_000 if index % 2 else 300) for index in range(6)]
    expected = whole(name, tmp_path / "a", scans)
    (tmp_path / "b").mkdir()
    writer = open_writer(name, tmp_path / "b" / OUTPUTS[name], scans[0].info, WriterOptions())
    jobs = [writer.write(scan) for scan in scans]
    for job in reversed(jobs):
        job.pack()
    for job, scan in zip(jobs, scans, strict=True):
        writer.write_imu(imu_samples(0, scan.start_ns))
        job.append()
    for job in reversed(jobs):
        job.compress()
    for job in jobs:
        job.commit()
    writer.finish(SUMMARY)
    assert files(tmp_path / "b") == expected


@each_format
@pytest.mark.parametrize("kind", ["dense", "organized"])
def test_large_outputs_have_the_same_bytes(
    name: str, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Written past the page cache, so that the end of what is written waits in memory."""
    try:
        check_target(name, tmp_path / "x", WriterOptions(), kind)
    except UsageError:
        pytest.skip("the format has no such layout")
    if kind == "dense":
        scans = [dense_scan(index, 50_000) for index in range(4)]
    else:
        scans = [replace(organized_scan(15_000), index=index) for index in range(4)]
    expected = whole(name, tmp_path / "whole", scans)
    monkeypatch.setattr(output_file, "_DROP_BYTES", 100_000)
    monkeypatch.setattr(output_file, "_STAGE_BYTES", 8 * output_file.BLOCK_BYTES)
    assert whole(name, tmp_path / "large", scans) == expected


@each_format
def test_an_output_that_another_run_writes_is_refused(name: str, tmp_path: Path) -> None:
    """In the same process as well; it is free again after the other ended."""
    target = tmp_path / OUTPUTS[name]
    writer = open_writer(name, target, run_info(), WriterOptions())
    with pytest.raises(ExportError, match="expected no other run that writes it, found one; wait"):
        open_writer(name, target, run_info(), WriterOptions())
    run_job(writer.write(dense_scan(0)))
    writer.finish(SUMMARY)
    assert target.exists()
    overwrite = WriterOptions(overwrite=True)
    open_writer(name, target, run_info(), overwrite).abandon()
    open_writer(name, target, run_info(), overwrite).finish(SUMMARY)
