"""Batches that are interrupted, changed, shared or planned; test_outcomes: how sessions end."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import signal
import threading
from functools import partial
from pathlib import Path

import pytest

from mlbatch.batch.driver import Batch
from mlbatch.batch.manifest import Common, sessions_of
from mlbatch.batch.plan import (
    USUAL_BYTES_PER_S,
    USUAL_RATIO,
    USUAL_START_S,
    Plan,
    PlannedSession,
)
from mlbatch.batch.task import tasks_of
from mlbatch.errors import Interrupted
from tests.batch.sessions import (
    Dataset,
    end,
    processes_of,
    run,
    scans,
    start,
    wait_for,
    write_dataset,
)
from tests.builders.run import command

GOOD = ["a1", "a2", "b1"]


@pytest.fixture
def good(tmp_path: Path) -> Dataset:
    return write_dataset(tmp_path / "good", GOOD)


def converted(data: Dataset, name: str, folder: Path) -> bytes:
    """The output of `mlbatch convert` alone."""
    output = folder / f"{name}.mcap"
    capture = data.folder / "raw" / name / "drive.pcap"
    assert command("convert", capture, "-o", output, "--rate", "20", "--quiet").code == 0
    return output.read_bytes()


def states(out: Path) -> dict[str, str]:
    """States of all session.json."""
    return {
        path.parent.name: json.loads(path.read_text(encoding="utf-8"))["state"]
        for path in out.glob("*/session.json")
    }


@pytest.mark.parametrize("workers", ["1", "2"])
def test_a_full_disk_ends_the_batch_in_one_line(tmp_path: Path, workers: str) -> None:
    data = write_dataset(tmp_path / "data", ["a1", "full1", "z1", "z2", "z3"])
    out = tmp_path / "out"
    ended = run(data, out, "--workers", workers)
    assert (ended.code, ended.out) == (1, "")
    assert ended.err.startswith(
        f"mlbatch: error: {out / 'full1'}: expected space for its output, found a full disk; free "
        "space, and the same command continues with this session and those that were not begun ("
    )
    assert ended.err.count("\n") == 1
    # A session that another worker had begun ends in order.
    assert states(out) in ([{"a1": "done"}] if workers == "1" else [{"a1": "done"}, {}])
    assert (out / "full1" / "started.json").exists()
    assert not (out / "z3").exists()
    assert command("batch-status", out).out.split("full1")[1].split()[0] == "unfinished"
    ended = run(data, out, "--workers", workers)
    assert ended.code == 0
    assert states(out) == dict.fromkeys(["a1", "full1", "z1", "z2", "z3"], "done")


def _any(out: Path, name: str) -> bool:
    return any(out.glob(f"*/{name}"))


def test_a_killed_driver_leaves_no_process_and_a_second_run_equals_the_first(
    good: Dataset, tmp_path: Path
) -> None:
    whole = tmp_path / "whole"
    assert run(good, whole, "--workers", "2").code == 0
    out = tmp_path / "out"
    for name in ("started.json", "session.json"):
        driver = start(good, out, "--workers", "2")
        wait_for(partial(_any, out, name))
        driver.kill()
        driver.communicate()
        wait_for(lambda: not list(processes_of(str(out))))
        # What is not complete does not look like it.
        for folder in out.iterdir():
            if (folder / "session.json").exists():
                assert (folder / "scans.mcap").exists()
                assert not (folder / "scans.mcap.partial").exists()
    ended = run(good, out, "--workers", "2")
    assert ended.code == 0
    assert set(ended.table.values()) <= {"done", "skipped"}
    assert scans(out) == scans(whole)
    assert states(out) == dict.fromkeys(GOOD, "done")
    assert not list(out.glob("*/started.json"))


def test_an_interrupt_ends_in_order(good: Dataset, tmp_path: Path) -> None:
    out = tmp_path / "out"
    driver = start(good, out, "--workers", "2")
    wait_for(lambda: list(out.glob("*/log.txt")))
    driver.send_signal(signal.SIGINT)
    ended = end(driver)
    assert ended.code == 130
    (line,) = ended.err.splitlines()
    assert "interrupted; " in line
    assert "of 3 sessions have ended" in line
    assert not list(processes_of(str(out)))
    assert run(good, out).code == 0


@pytest.mark.parametrize("started", [1, 2])
def test_an_interrupt_while_workers_start_leaves_no_process(
    started: int, good: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first workers run their sessions already when the interrupt comes."""
    out = tmp_path / "out"
    sessions = sessions_of([str(good.manifest)], Common())
    tasks = tasks_of(sessions, str(out), tmp_path, retries=0, pages=False)
    start_thread = threading.Thread.start
    count = itertools.count()

    def start_some(thread: threading.Thread) -> None:
        if next(count) == started:
            wait_for(lambda: list(processes_of(str(out))))
            raise KeyboardInterrupt
        start_thread(thread)

    monkeypatch.setattr(threading.Thread, "start", start_some)
    with pytest.raises(Interrupted, match="0 of 3 sessions have ended"):
        Batch(workers=3).run(tasks)
    assert not list(processes_of(str(out)))


def test_two_drivers_share_a_batch(good: Dataset, tmp_path: Path) -> None:
    """A session that another driver converts is waited for, not converted twice."""
    out = tmp_path / "out"
    drivers = [start(good, out) for _ in range(2)]
    for ended in map(end, drivers):
        assert ended.code == 0, ended.err
    assert states(out) == dict.fromkeys(GOOD, "done")


CHANGES = {
    "option": (["--rate", "10"], "", GOOD),
    "other number of jobs": (["--jobs", "2"], "", []),
    "recording": ([], "raw/a2/drive.pcap", ["a2"]),
    "time of change only": ([], "touch raw/a2/drive.pcap", []),
    "calibration": ([], "raw/b1/111.json", ["b1"]),
    "a report next to a recording": ([], "raw/b1/old.json", []),
    "output removed": ([], "rm out/a2/scans.mcap", ["a2"]),
    "state removed": ([], "rm out/a2/session.json", ["a2"]),
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A batch that is done, in the folder `out`; to be copied."""
    data = write_dataset(tmp_path_factory.mktemp("finished") / "good", GOOD)
    assert run(data, data.folder / "out", "--workers", "2").code == 0
    return data


@pytest.mark.parametrize("name", CHANGES)
def test_only_what_changed_is_converted_again(name: str, finished: Dataset, tmp_path: Path) -> None:
    # Times of change are copied, too; where a batch lies does not matter.
    good = Dataset(Path(shutil.copytree(finished.folder, tmp_path / "good")))
    out = good.folder / "out"
    words, change, expected = CHANGES[name]
    what, _, path = change.rpartition(" ")
    target = good.folder / path
    if what == "touch":
        os.utime(target, ns=(1, 1))
    elif what == "rm":
        target.unlink()
    elif path.endswith("old.json"):
        target.write_text('{"schema": "mlbatch.report/1"}', encoding="utf-8")
    elif path.endswith(".json"):
        target.write_text(target.read_text(encoding="utf-8") + "\n", encoding="utf-8")
    elif path:
        # The last packet is lost.
        target.write_bytes(target.read_bytes()[:-3000])
    ended = run(good, out, *words)
    assert ended.code == 0, ended.out
    assert {name for name, word in ended.table.items() if word == "done"} == set(expected)
    if name == "option":
        assert (out / "a1" / "scans.mcap").read_bytes() != converted(good, "a1", tmp_path)
    elif not expected or "removed" in name:
        assert (out / "a2" / "scans.mcap").read_bytes() == converted(good, "a2", tmp_path)


def test_a_run_with_other_options_is_not_resumed(good: Dataset, tmp_path: Path) -> None:
    """Killed after the output was complete and before session.json; then other options."""
    out = tmp_path / "out"
    assert run(good, out, "--only", "a1").code == 0
    record = json.loads((out / "a1" / "session.json").read_text(encoding="utf-8"))
    (out / "a1" / "session.json").unlink()
    (out / "a1" / "started.json").write_text(json.dumps(record["key"]), encoding="utf-8")
    before = (out / "a1" / "scans.mcap").stat().st_ino
    assert run(good, out, "--only", "a1").table == {"a1": "done"}
    assert (out / "a1" / "scans.mcap").stat().st_ino == before, "it was complete"
    (out / "a1" / "session.json").unlink()
    (out / "a1" / "started.json").write_text(json.dumps(record["key"]), encoding="utf-8")
    assert run(good, out, "--only", "a1", "--rate", "10").code == 0
    assert (out / "a1" / "scans.mcap").read_bytes() != converted(good, "a1", tmp_path)


def test_failed_sessions_are_run_again_only_on_request(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data", ["a1", "hopeless1"])
    out = tmp_path / "out"
    assert run(data, out).code == 3
    log = out / "hopeless1" / "log.txt"
    before = log.stat().st_mtime_ns
    assert run(data, out).code == 3
    assert log.stat().st_mtime_ns == before
    assert run(data, out, "--retry-failed").code == 3
    assert log.stat().st_mtime_ns > before


def test_fail_fast_begins_no_other_session(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data", ["hopeless", "x1", "x2"])
    ended = run(data, tmp_path / "out", "--fail-fast")
    assert ended.code == 3
    assert ended.table == {"hopeless": "failed"}
    assert ended.last == "3 sessions: 0 done, 0 skipped, 1 failed, 2 not begun (--fail-fast)"


def test_a_plan_writes_nothing(good: Dataset, tmp_path: Path) -> None:
    """Of parts, too, which are disjoint and whole."""
    out = tmp_path / "out"
    ended = run(good, out, "--plan", "--workers", "2")
    assert (ended.code, ended.err) == (0, "")
    assert ended.table == dict.fromkeys(GOOD, "missing")
    assert ended.last.startswith("3 of 3 sessions to convert: ")
    assert ended.last.endswith("(from the first 10 s of session a2)")
    assert run(good, out, "--list").out.split() == GOOD
    first, second = (run(good, out, "--plan", "--part", f"{number}/2").table for number in (1, 2))
    assert not set(first) & set(second)
    assert set(first) | set(second) == set(GOOD)
    assert not out.exists()


def _plan(sizes: list[int], workers: int, cores: int = 16) -> Plan:
    sessions = tuple(PlannedSession(str(n), "missing", 1, size) for n, size in enumerate(sizes))
    return Plan(sessions, USUAL_RATIO, USUAL_BYTES_PER_S, USUAL_START_S, "", workers, cores)


@pytest.mark.parametrize(
    ("sizes", "workers", "cores", "expected_s"),
    [
        # 1.5 s of start and 50 MB in a second: short recordings cost their processes.
        ([3_750_000] * 40, 1, 16, 63.0),
        ([3_750_000] * 40, 2, 16, 31.5),
        ([3_750_000] * 40, 8, 2, 31.5),
        # A session is converted by one worker.
        ([5_000_000_000, 50_000_000], 4, 16, 101.5),
    ],
)
def test_a_plan_counts_the_start_of_sessions(
    sizes: list[int], workers: int, cores: int, expected_s: float
) -> None:
    assert _plan(sizes, workers, cores).seconds == pytest.approx(expected_s)


def test_a_foreign_folder_is_not_touched(good: Dataset, tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "a1").mkdir(parents=True)
    (out / "a1" / "thesis.txt").write_text("mine", encoding="utf-8")
    ended = run(good, out)
    assert ended.code == 3
    assert ended.table["a1"] == "failed"
    assert "thesis.txt" in ended.out
    assert (out / "a1" / "thesis.txt").read_text(encoding="utf-8") == "mine"
