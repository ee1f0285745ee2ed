"""Floors, as functions and as processes; peers are tested with their environments."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader

from tests.bench import programs
from tests.bench.measure import measure


def test_the_write_floor_writes_as_many_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(programs, "BLOCK_BYTES", 1024)
    programs.main("write", "times.json", "2500", "3")
    assert Path("floor.bin").read_bytes() == (bytes(range(256)) * 10)[:2500]
    assert set(json.loads(Path("times.json").read_text())) == {"own_cpu_s", "wall_s"}


def test_the_library_writes_as_many_messages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    programs.main("mcap", "times.json", "3072", "3")
    with Path("floor.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert len(summary.chunk_indexes) == 3
    assert summary.statistics is not None
    assert summary.statistics.message_count == 3


@pytest.mark.parametrize("name", programs.FLOORS)
def test_floors_run_in_processes(tmp_path: Path, name: str) -> None:
    result = tmp_path / "times.json"
    command = [sys.executable, "-m", "tests.bench.programs", name, str(result), "1000000", "0"]
    assert measure(name, command, tmp_path).wall_s > 0
    assert json.loads(result.read_text())["wall_s"] > 0
