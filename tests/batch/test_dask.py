"""Batches on a Dask cluster: the same outputs; a killed worker costs only its session's retry."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.batch.sessions import Dataset, end, run, scans, start, wait_for, write_dataset
from tests.builders.run import command

distributed = pytest.importorskip("distributed")

GOOD = [f"a{number}" for number in range(6)]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_dataset(tmp_path_factory.mktemp("dask") / "data", [*GOOD, "crash", "killed"])


@pytest.fixture(scope="module")
def cluster(data: Dataset) -> Iterator[Any]:
    """Two workers with the saboteur, each a process of one thread."""
    names = ("PYTHONPATH", "SABOTEUR_MARKS")
    env = {name: data.env[name] for name in names}
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        dashboard_address=None,
        host="127.0.0.1",
        env=env,
    ) as found:
        yield found


def test_a_killed_worker_costs_only_a_retry(data: Dataset, cluster: Any, tmp_path: Path) -> None:
    whole = tmp_path / "whole"
    assert run(data, whole, "--workers", "2").code == 3
    data.forget_kills()
    out = tmp_path / "out"
    driver = start(data, out, "--scheduler", cluster.scheduler_address)
    wait_for(
        lambda: len(list(out.glob("*/session.json"))) >= 2 and list(out.glob("*/started.json"))
    )
    os.kill(cluster.workers[0].process.pid, signal.SIGKILL)
    ended = end(driver)
    assert ended.code == 3, ended.err
    assert ended.table == dict.fromkeys([*GOOD, "killed"], "done") | {"crash": "failed"}
    assert scans(out) == scans(whole)
    again = run(data, out, "--scheduler", cluster.scheduler_address)
    assert again.table == dict.fromkeys([*GOOD, "killed"], "skipped") | {"crash": "failed"}


def test_no_scheduler_is_one_line(data: Dataset, tmp_path: Path) -> None:
    # Nothing is bound to port 1.
    words = ("--scheduler", "tcp://127.0.0.1:1", "-o", tmp_path / "out")
    found = command("batch", data.manifest, *words)
    assert (found.code, found.out) == (1, "")
    assert "expected a Dask scheduler" in found.err.splitlines()[-1]
