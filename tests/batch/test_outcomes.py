"""How sessions end is the same on threads, on a Dask cluster and in object storage.

Meanwhile a Dask worker is killed, and the network to the server is cut, while recordings are read
and while outputs are written.
"""

from __future__ import annotations

import json
import os
import signal
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from tests.batch.network import cloud_of
from tests.batch.sessions import (
    Dataset,
    Ended,
    Options,
    end,
    run,
    start,
    wait_for,
    write_dataset,
)
from tests.builders.run import command


@dataclass(frozen=True, slots=True)
class Row:
    """A session; line: a part of the reason in the table; parts: of names of outputs."""

    state: str = "done"
    attempts: int = 1
    line: str = ""
    parts: tuple[str, ...] = ("",)
    suffix: str = ".mcap"
    options: Options = field(default_factory=dict)


JUMP: Options = {"on-jump": "split", "fault": "jump:ouster_111:37s@0.3s", "keep-partial": True}
DROP: Options = {"fail-on": "loss>1%", "fault": "drop:ouster_111:20%"}
ROWS = {
    "a1": Row(),
    # Crashed and killed sessions are tried again once; exit codes 1 and 2 are final.
    "crash": Row("failed", 2, "SIGSEGV", ()),
    "cut": Row(line="cut_off"),
    "hopeless": Row("failed", 1, "expected a recording", ()),
    "killed": Row(attempts=2),
    "lossy": Row("failed", 1, "limit exceeded: loss>1%", options=DROP),
    "npz": Row(suffix="", options={"format": "npz"}),
    "rosbag1": Row(suffix=".bag", options={"format": "rosbag1"}),
    "segments": Row(parts=(".seg1", ".seg2"), options=JUMP),
}
WAYS = ("threads", "dask", "remote")


@dataclass(frozen=True, slots=True)
class Batch:
    """A batch, the same command again, and the files after each."""

    first: Ended
    again: Ended
    files: dict[str, bytes]
    files_again: dict[str, bytes]
    status: str


def test_known_bad_sessions_are_no_failures_and_limits_end_sessions(tmp_path: Path) -> None:
    """The first word of a limit that is raised makes a session run again."""
    more = 'known_bad: {"hopeless*": rain in the lens, b1: no GNSS}\nlimits: {disk: 1 MB}'
    data = write_dataset(tmp_path / "data", ["a1", "big", "b1", "hopeless", "slow"], more=more)
    out = tmp_path / "out"
    words = ("--only", "big", "--only", "slow", "--time-limit", "4 s", "--retries", "0")
    first = run(data, out, *words)
    assert (first.code, first.table) == (3, {"big": "failed", "slow": "failed"})
    assert "beyond its limit of disk, 1 MB; " in first.out
    assert "beyond its limit of time, 4 s; " in first.out
    assert not list(out.glob("big/scans*"))
    # The same limits: the same failures, and nothing runs.
    assert run(data, out, *words).table == first.table
    assert not list((data.folder / "marks").glob("a*"))
    second = run(data, out, "--time-limit", "2 h", "--disk-limit", "1 TB")
    bad = dict.fromkeys(("b1", "hopeless"), "known_bad")
    assert (second.code, second.table) == (0, bad | dict.fromkeys(("a1", "big", "slow"), "done"))
    assert second.last == "5 sessions: 3 done, 0 skipped, 0 failed, 2 known_bad"
    assert not list(out.glob("b1/scans*"))
    page = tmp_path / "status.html"
    assert command("batch-status", out, "--page", page).code == 0
    text = page.read_text(encoding="utf-8")
    assert "3 of 5 sessions are done" in text
    assert "2 known as bad, not converted." in text
    assert "rain in the lens" in text
    log = (out / "batch.log").read_text(encoding="utf-8").splitlines()
    assert sum(line.endswith("session slow: begun") for line in log) == 2
    assert any("session slow: failed" in line and "limit of time, 4 s" in line for line in log)
    # Bad no more: it is converted; one that is bad now loses its output.
    data.manifest.write_text(data.manifest.read_text(encoding="utf-8").replace("b1:", "a1:"))
    third = run(data, out, "--time-limit", "2 h", "--disk-limit", "1 TB")
    assert (third.table["a1"], third.table["b1"]) == ("known_bad", "done")
    assert not list(out.glob("a1/scans*"))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    options = {name: row.options for name, row in ROWS.items()}
    return write_dataset(tmp_path_factory.mktemp("outcomes") / "data", ROWS, options)


@pytest.fixture(scope="module", params=WAYS)
def batch(
    request: pytest.FixtureRequest, data: Dataset, tmp_path_factory: pytest.TempPathFactory
) -> Batch:
    """The sessions of all rows, run in one way."""
    data.forget_kills()
    folder = tmp_path_factory.mktemp(request.param)
    ways = {"threads": by_threads, "dask": by_dask, "remote": by_server}
    return ways[request.param](data, folder)


def by_threads(data: Dataset, folder: Path) -> Batch:
    """Two workers."""
    out = folder / "out"
    first = run(data, out, "--workers", "2")
    before = files_of(out)
    again = run(data, out, "--workers", "2")
    return Batch(first, again, before, files_of(out), command("batch-status", out, "--json").out)


def by_dask(data: Dataset, folder: Path) -> Batch:
    """Two workers, each a process of one thread with the saboteur; one is killed."""
    distributed = pytest.importorskip("distributed")
    out = folder / "out"
    env = {name: data.env[name] for name in ("PYTHONPATH", "SABOTEUR_MARKS")}
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, host="127.0.0.1", env=env
    ) as cluster:
        words = ("--scheduler", cluster.scheduler_address)
        driver = start(data, out, *words)

        def is_due() -> bool:
            # A session whose worker is killed counts its attempts anew.
            running = {path.parent.name for path in out.glob("*/started.json")}
            ended = len(list(out.glob("*/session.json")))
            return ended >= 2 and bool(running) and running.isdisjoint(("crash", "killed"))

        wait_for(is_due)
        os.kill(cluster.workers[0].process.pid, signal.SIGKILL)
        first = end(driver)
        before = files_of(out)
        again = run(data, out, *words)
    return Batch(first, again, before, files_of(out), command("batch-status", out, "--json").out)


def by_server(data: Dataset, folder: Path) -> Batch:
    """Recordings and output in object storage."""
    manifest = folder / "manifest.yaml"
    text = data.manifest.read_text(encoding="utf-8")
    manifest.write_text(text.replace('"raw/', '"s3://data/raw/'), encoding="utf-8")
    cache = folder / "cache"
    words = (manifest, "-o", "s3://data/out", "--cache", cache, "--workers", "2")
    with cloud_of(data) as cloud:
        cloud.network.cut_after = {"to client": 300_000, "to server": 300_000}
        first = cloud.run("batch", *words)
        assert not cloud.network.cut_after, "it was cut both times"
        before = cloud.files("out/")
        assert not any("started" in name or "partial" in name for name in before)
        # Copies of recordings and outputs are removed when a session has ended.
        assert {path.name for path in cache.rglob("*") if path.is_file()} == {"log.txt"}
        again = cloud.run("batch", *words)
        status = cloud.run("batch-status", "s3://data/out/", "--json").out
        return Batch(first, again, before, cloud.files("out/"), status)


def files_of(out: Path) -> dict[str, bytes]:
    """Content of all files of an output."""
    paths = [path for path in out.rglob("*") if path.is_file()]
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in sorted(paths)}


@pytest.fixture(scope="module")
def alone(data: Dataset, tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, bytes]]:
    """The scans of `mlbatch convert`, by session."""
    found = {}
    for name, row in ROWS.items():
        folder = tmp_path_factory.mktemp(name)
        output = folder / f"scans{row.suffix}"
        capture = data.folder / "raw" / name / "drive.pcap"
        words: list[str | Path] = ["convert", capture, "-o", output, "--rate", "20"]
        for option, value in row.options.items():
            words += [f"--{option}"] if value is True else [f"--{option}", str(value)]
        if row.parts:
            command(*words, "--quiet")
        found[name] = scans_of(files_of(folder))
    return found


def scans_of(files: dict[str, bytes]) -> dict[str, bytes]:
    """The scans among files, without the reports, which have times of the run."""
    return {
        name: data
        for name, data in files.items()
        if name.startswith("scans") and not name.endswith("report.json")
    }


@pytest.mark.parametrize("name", ROWS)
def test_a_session_ends(name: str, batch: Batch, alone: dict[str, dict[str, bytes]]) -> None:
    row = ROWS[name]
    files = {
        path.removeprefix(f"{name}/"): data
        for path, data in batch.files.items()
        if path.startswith(f"{name}/")
    }
    record = json.loads(files["session.json"])
    assert (record["state"], record["attempts"]) == (row.state, row.attempts)
    assert (record["exit_code"] == 0) == (row.state == "done")
    assert batch.first.table[name] == row.state
    (line,) = [line for line in batch.first.out.splitlines() if line.startswith(f"{name} ")]
    assert row.line in line
    # As `convert` alone, and with a report and a page for each output.
    assert scans_of(files) == alone[name]
    outputs = [one for one in record["outputs"] if not one.endswith(".csv")]
    assert outputs == [f"scans{part}{row.suffix}" for part in row.parts]
    reports = [f"report{part}.json" for part in row.parts]
    others = {*reports, *(f"page{part}.html" for part in row.parts), "log.txt", "session.json"}
    assert {one for one in files if not one.startswith("scans")} == others
    check_figures(record, [json.loads(files[one]) for one in reports])
    sizes = [len(data) for one, data in files.items() if one.startswith("scans")]
    assert record["output_bytes"] == sum(sizes)


def check_figures(record: dict[str, Any], reports: list[dict[str, Any]]) -> None:
    """The figures of a record are those of its reports."""
    sensors = [sensor for report in reports for sensor in report["sensors"]]
    warnings = {one["code"] for report in reports for one in report["warnings"]}
    assert record["scans"] == sum(report["scans"]["written"] for report in reports)
    assert record["points"] == sum(report["scans"]["points"] for report in reports)
    assert record["packets"] == sum(one["packets"]["read"] for one in sensors)
    assert record["lost"] == sum(one["packets"]["lost"] for one in sensors)
    assert record["fill"] == min((one["fill"] for one in sensors), default=None)
    assert record["warnings"] == sorted(warnings)


def test_a_second_run_does_nothing(batch: Batch) -> None:
    failed = [name for name, row in ROWS.items() if row.state == "failed"]
    assert (batch.first.code, batch.again.code) == (3, 3)
    done = len(ROWS) - len(failed)
    last = f"{len(ROWS)} sessions: {{}}, {len(failed)} failed"
    assert batch.first.last == last.format(f"{done} done, 0 skipped")
    assert batch.again.last == last.format(f"0 done, {done} skipped")
    # Every failure is a line when it happens, and in the table.
    assert len(batch.first.err.splitlines()) == len(failed)
    assert batch.again.err == ""
    assert batch.files_again == batch.files


def test_the_state_is_that_of_the_records(batch: Batch) -> None:
    status = json.loads(batch.status)
    assert status["schema"] == "mlbatch.status/1"
    for one in status["sessions"]:
        record = json.loads(batch.files[f"{one['name']}/session.json"])
        assert record == {"schema": "mlbatch.session/1", **one["record"]}
        pages = [name for name in batch.files if name.startswith(f"{one['name']}/page")]
        assert one["page"] == min(pages, default="")
