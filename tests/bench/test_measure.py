"""Resources of one process."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from tests.bench.measure import BenchError, Usage, cpu_model, measure, vector_flags
from tests.contract.tree import run_python

# Run in a small process: pages of the measuring process count, too.
MEASURED = """
import json, sys
from dataclasses import asdict
from pathlib import Path
from tests.bench.measure import measure
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
    # True on a machine of any speed and load: a sleeping process uses no CPU.
    assert 0 < idle.cpu_s <= idle.wall_s - 0.29
    assert busy.cpu_s >= 0.5
    assert large.rss_mb - idle.rss_mb == pytest.approx(300, abs=15)


def test_the_measuring_process_imports_no_large_package() -> None:
    """Its pages count in the memory of measured processes."""
    loaded = run_python(
        "import sys\nimport tests.bench.__main__ as bench\n"
        "bench.settings_from(bench.parser().parse_args([]))\n"
        "print([name for name in ('numpy', 'mcap', 'yaml') if name in sys.modules])"
    )
    assert loaded.strip() == "[]"


def test_bytecode_is_cached_as_for_an_installed_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    (tmp_path / "module.py").write_text("")
    measure("program", [sys.executable, "-c", "import module"], tmp_path)
    assert list((tmp_path / "__pycache__").glob("module.*.pyc"))


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (
            [sys.executable, "-c", "import sys; sys.exit('no\\nmore paper')"],
            "printer: expected exit code 0, found 1: more paper",
        ),
        (
            [sys.executable, "-c", "import os; os._exit(3)"],
            "printer: expected exit code 0, found 3: no message",
        ),
        (["/no/where"], "printer: expected a program, found /no/where: No such file"),
    ],
)
def test_failures(tmp_path: Path, command: list[str], message: str) -> None:
    with pytest.raises(BenchError, match=message):
        measure("printer", command, tmp_path)


# Two cores, as Linux describes them; shortened.
X86 = """processor\t: 0
model name\t: Abacus: 3000
flags\t\t: fpu sse sse2 ht pni ssse3 fma sse4_2 avx f16c avx2 avx512f clwb

processor\t: 1
model name\t: Abacus: 3000
flags\t\t: fpu sse
"""
ARM = "processor\t: 0\nBogoMIPS\t: 50.00\nFeatures\t: fp asimd aes sve crc32\n"


def test_processor_and_vector_instructions() -> None:
    assert cpu_model(X86) == "Abacus: 3000"
    assert vector_flags(X86) == "sse sse2 ssse3 fma sse4_2 avx avx2 avx512f"
    assert (cpu_model(ARM), vector_flags(ARM)) == ("", "asimd sve")
    assert (cpu_model(""), vector_flags("")) == ("", "")
