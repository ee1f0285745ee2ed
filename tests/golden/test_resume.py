"""Killed and refused conversions of whole sessions, resumed: byte for byte those in one piece.

`python -m tests.resume_storm` does the same with hundreds of kills.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.builders.sessions import REPOSITORY
from tests.resume_storm import CASES, contents, write_recordings

KILLS = 12
SEED = 3
LIMITED = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv.pop(1)),) * 2)
from mlbatch import cli
cli.main()
"""


def _run(*words: str, cwd: Path = REPOSITORY) -> subprocess.CompletedProcess[str]:
    """Python in a process of its own: a fork of this one would inherit its threads."""
    return subprocess.run(
        [sys.executable, *words],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
        capture_output=True,
        text=True,
        timeout=300,
    )


def test_a_small_storm() -> None:
    options = ("--count", str(KILLS), "--seed", str(SEED), "--turns", "10", "--again", "0")
    done = _run("-m", "tests.resume_storm", *options)
    assert (done.returncode, done.stderr) == (0, ""), done.stdout
    kills, _, _, wrong, *by_signal = map(int, re.findall(r"\d+", done.stdout))
    assert (kills, wrong) == (KILLS, 0)
    assert sum(by_signal) == KILLS


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the cases convert."""
    folder = tmp_path_factory.mktemp("storm")
    write_recordings(folder / "in", 12)
    return folder


@pytest.mark.parametrize(
    ("name", "limit_bytes"),
    [
        ("mcap", 4_500_000),
        ("rosbag1 jobs", 2_500_000),
        ("rosbag2 zstd", 2_000_000),
    ],
)
def test_a_file_that_may_not_grow_is_made_again(
    recordings: Path, name: str, limit_bytes: int
) -> None:
    """A disk that refuses in the midst of a file, as a full one does."""
    case = CASES[name]
    words = ("convert", f"../in/{case.recording}", "-o", case.output, *case.options)
    whole = recordings / f"{name} whole"
    place = recordings / name
    whole.mkdir()
    place.mkdir()
    assert _run("-m", "mlbatch", *words, cwd=whole).returncode == 0
    refused = _run("-c", LIMITED, str(limit_bytes), *words, cwd=place)
    assert refused.returncode == 1
    assert re.search(
        r"partial: expected to write it, found 'File too large'; raise the limit of file sizes or "
        r"choose another disk\n$",
        refused.stderr,
    )
    resumed = _run("-m", "mlbatch", *words, "--resume", cwd=place)
    assert resumed.returncode == 0
    assert "nothing to resume; started over" in resumed.stderr
    assert contents(place) == contents(whole)
