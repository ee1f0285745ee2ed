"""The Snakemake rule of docs/batch.md runs."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.batch.sessions import run, scans, write_dataset
from tests.builders.run import ROOT

RULE = re.compile(r"^Snakemake:\n\n```text\n(.*?)^```$", re.MULTILINE | re.DOTALL)

pytest.importorskip("snakemake", reason="needs the extra dev-integrations (Snakemake)")


def test_the_rule_of_the_page_runs(tmp_path: Path) -> None:
    (rule,) = RULE.findall((ROOT / "docs" / "batch.md").read_text(encoding="utf-8"))
    assert len(rule.splitlines()) <= 12
    data = write_dataset(tmp_path / "data", ["a1", "a2", "a3"])
    (data.folder / "Snakefile").write_text(rule, encoding="utf-8")
    program = tmp_path / "bin" / "mlbatch"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m mlbatch "$@"\n', encoding="utf-8")
    program.chmod(0o755)
    path = f"{program.parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        [sys.executable, "-m", "snakemake", "--cores", "2"],
        cwd=data.folder,
        env=data.env | {"PATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert run(data, tmp_path / "whole").code == 0
    assert scans(data.folder / "OUT") == scans(tmp_path / "whole")
