"""Make `expected.json` of the fixtures: golden files of `mlbatch digest`.

    python -m tests.golden.expected

Only after an intended change of the output; commit it alone, with the reason.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import mlbatch
from mlbatch.digests import golden_text
from tests.builders.run import ROOT, command

# Recording, rig, and options of each.
FIXTURES = {
    "two_lidars": ("two_lidars.pcap", "rig.yaml"),
    "four_makers": ("four_makers.pcap", "rig.yaml"),
    "moving": ("moving.mcap", "moving.rig.yaml", "--deskew", "imu"),
}


def expected(fixture: str) -> Path:
    """The golden file of a fixture."""
    return ROOT / "fixtures" / fixture / "expected.json"


def converted(fixture: str, folder: Path) -> Path:
    """The fixture as npz, with its partial scans."""
    source = ROOT / "fixtures" / fixture
    recording, rig, *options = FIXTURES[fixture]
    words: tuple[str | Path, ...] = (
        "--rig",
        source / rig,
        "--keep-partial",
        "--quiet",
        "--overwrite",
        *options,
    )
    done = command("convert", source / recording, "-o", folder / fixture, *words)
    assert done.code == 0, done.err
    return folder / fixture


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        for name in FIXTURES:
            golden = mlbatch.digest(converted(name, Path(place)))
            expected(name).write_text(golden_text(golden), encoding="utf-8")
