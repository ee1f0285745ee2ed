"""What all tests share: one profile of hypothesis, and the command line in an empty folder."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tests.builders.sessions import Shell

# No deadline: how long an example takes depends on how loaded the machine is.
settings.register_profile("mlbatch", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("mlbatch")

# Whole suites of cases, a folder or a file each: `make test-quick` leaves them out.
LONG = (
    "batch/test_batch.py",
    "batch/test_dask.py",
    "batch/test_remote.py",
    "batch/test_snakemake.py",
    "bench/",
    "digest/",
    "fuzz/",
    "golden/",
    "matrix/",
    "property/",
    "recordings/",
    "batching/test_reference.py",
    "cli/test_bench.py",
    "clocks/test_simulated.py",
    "contract/test_models.py",
    "simulate/test_every_model.py",
)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Let the collector of cycles leave the tests alone, which all live to the end.

    It would traverse them repeatedly: half of the time of the collection of tests.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of long suites."""
    here = Path(__file__).parent
    # Paths of ten thousand tests take a second.
    is_long = cache(lambda path: path.relative_to(here).as_posix().startswith(LONG))
    for item in items:
        if is_long(item.path):
            item.add_marker(pytest.mark.long)


@pytest.fixture
def shell(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> Shell:
    """The command line, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return Shell(monkeypatch, capsys)
