"""Pictures of the pages are what their scripts draw."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
from matplotlib.image import imread

from tests.contract.tree import ROOT

DOCS = ROOT / "docs"


def run(script: str, *arguments: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(DOCS / script), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_time_span_picture_is_what_its_script_draws() -> None:
    assert run("time_span.py").stdout == (DOCS / "time_span.svg").read_text()


def test_picture_shows_each_lidar_in_its_colour(tmp_path: Path) -> None:
    side = np.linspace(0.0, 3.0, 50)
    xyz = np.stack([side, side % 0.7, side], axis=1)
    np.savez(
        tmp_path / "000000.npz",
        xyz=np.concatenate([xyz, xyz + 1.0]).astype(np.float32),
        lidar_id=np.repeat([0, 1], 50).astype(np.uint8),
        sensors=np.array(["left", "right"]),
        index=0,
        start_ns=0,
        end_ns=100_000_000,
    )
    assert run("picture.py", tmp_path, tmp_path / "out.png").returncode == 0
    assert (tmp_path / "out.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    # Red, green, blue and opacity from 0 to 1.
    pixels = imread(tmp_path / "out.png").reshape(-1, 4)
    # Orange has more red than blue, cyan more blue than red.
    assert (pixels[:, 0] > pixels[:, 2] + 80 / 255).any()
    assert (pixels[:, 2] > pixels[:, 0] + 80 / 255).any()
