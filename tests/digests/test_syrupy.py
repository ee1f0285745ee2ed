"""`mlbatch.digest` as a snapshot of syrupy, as docs/digest.md shows."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.builders.run import ROOT, TWO_LIDARS
from tests.digests.test_digest import MOVED, RIG, other_rig

TEST = """
import mlbatch


def test_driver(tmp_path, snapshot):
    mlbatch.convert({capture!r}, tmp_path / "out", rig="rig.yaml", end="+0.2s")
    assert mlbatch.digest(tmp_path / "out") == snapshot
"""


def run(folder: Path, *words: str) -> tuple[int, str]:
    """pytest in a folder; exit code and output."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *words]
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, env=env, check=False)
    return done.returncode, done.stdout


def test_a_snapshot_finds_a_change(tmp_path: Path) -> None:
    pytest.importorskip("syrupy")
    capture = str(TWO_LIDARS / "two_lidars.pcap")
    (tmp_path / "test_driver.py").write_text(TEST.format(capture=capture), encoding="utf-8")
    other_rig(tmp_path, ("rate_hz: 10", "rate_hz: 10"))
    code, printed = run(tmp_path, "--snapshot-update")
    assert code == 0, printed
    assert run(tmp_path)[0] == 0
    text = RIG.read_text(encoding="utf-8").replace(*MOVED)
    (tmp_path / "rig.yaml").write_text(text, encoding="utf-8")
    code, printed = run(tmp_path)
    assert code == 1
    assert "0.9501" in printed
