"""What one process used, and floors that are processes of their own."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader

from mlbatch.bench import floors
from mlbatch.bench.measure import BenchError, Usage, measure
from tests.contract.tree import run_python

# What a process of its own finds, since pages of the one that measures count, too.
MEASURED = """
import json, sys
from dataclasses import asdict
from pathlib import Path
from mlbatch.bench.measure import measure
codes = {
    "idle": "import time; time.sleep(0.3)",
    "busy": "import time\\nwhile time.process_time() < 0.5: pass",
    "large": "x = b'1' * 300_000_000",
}
found = {name: measure(name, [sys.executable, "-c", code], Path()) for name, code in codes.items()}
print(json.dumps({name: asdict(usage) for name, usage in found.items()}))
"""


def test_cpu_memory_and_time_are_those_of_the_process(tmp_path: Path) -> None:
    found = json.loads(run_python(MEASURED, tmp_path))
    idle, busy, large = (Usage(**found[name]) for name in ("idle", "busy", "large"))
    # However slow the machine is, and whatever else is loaded: who sleeps uses no CPU meanwhile.
    assert 0 < idle.cpu_s <= idle.wall_s - 0.29
    assert busy.cpu_s >= 0.5
    assert large.rss_mb - idle.rss_mb == pytest.approx(300, abs=15)


def test_the_measuring_process_stays_small() -> None:
    """Its pages count as memory of what it starts."""
    loaded = run_python(
        "import sys\nimport mlbatch.cli.bench as bench\nimport mlbatch.bench.results\n"
        "bench._settings(1.0, 1, [], 'all', [], None, None)\n"
        "print([name for name in ('numpy', 'mcap', 'yaml') if name in sys.modules])"
    )
    assert loaded.strip() == "[]"


def test_bytecode_is_kept_as_of_an_installed_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    (tmp_path / "module.py").write_text("")
    measure("program", [sys.executable, "-c", "import module"], tmp_path)
    assert list((tmp_path / "__pycache__").glob("module.*.pyc"))


def test_a_failure_is_told_by_its_last_line(tmp_path: Path) -> None:
    code = "import sys; sys.exit('no\\nmore paper')"
    with pytest.raises(BenchError, match="printer: wanted exit code 0, got 1: more paper"):
        measure("printer", [sys.executable, "-c", code], tmp_path)


def test_silence_is_told_too(tmp_path: Path) -> None:
    with pytest.raises(BenchError, match="got 3: no message"):
        measure("printer", [sys.executable, "-c", "import os; os._exit(3)"], tmp_path)


def test_a_program_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(BenchError, match="printer: wanted a program, got /no/where: No such file"):
        measure("printer", ["/no/where"], tmp_path)


def test_floors_write_what_they_say(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(floors, "_BLOCK_BYTES", 1024)
    floors.main("write", "2500", "3", "times.json")
    assert Path("floor.bin").read_bytes() == (bytes(range(256)) * 10)[:2500]
    assert set(json.loads(Path("times.json").read_text())) == {"cpu_s", "wall_s"}


def test_the_library_gets_as_many_messages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    floors.main("mcap", "3072", "3", "times.json")
    with Path("floor.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert len(summary.chunk_indexes) == 3
    assert summary.statistics is not None
    assert summary.statistics.message_count == 3


@pytest.mark.parametrize("kind", floors.FLOORS)
def test_floors_run_in_processes(tmp_path: Path, kind: str) -> None:
    result = tmp_path / "times.json"
    command = [sys.executable, "-m", "mlbatch.bench.floors", kind, "1000000", "0", str(result)]
    assert measure(kind, command, tmp_path).wall_s > 0
    assert json.loads(result.read_text())["wall_s"] > 0
