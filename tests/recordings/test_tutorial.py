"""docs/tutorials/your-recording.md, step by step, on a real pair of Ousters."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

import mlbatch
from tests.builders.run import command
from tests.recordings import RECORDINGS

PAIR = RECORDINGS / "ouster" / "two-sensors_same-ports_nonlegacy"
NAMES = ("same_ports_nonlegacy.pcap", "same_ports_nonlegacy.1.json", "same_ports_nonlegacy.2.json")
UNKNOWN = "extrinsics: unknown"
POSES = (
    "extrinsics: {translation_m: [0.3, 0.5, 1.8], rotation_rpy_deg: [0, 10, 90]}",
    "extrinsics: {translation_m: [0.3, -0.5, 1.8], rotation_rpy_deg: [0, 10, -90]}",
)


def test_each_error_names_the_next_step(tmp_path: Path) -> None:
    """One packet each, from clocks that count from power-on."""
    for name in NAMES:
        shutil.copy(PAIR / name, tmp_path)
    drive, rig, scans = tmp_path / NAMES[0], tmp_path / "rig.yaml", tmp_path / "scans"
    seen = command("inspect", drive, "--write-rig", rig)
    assert seen.code == 0, seen.err
    assert "clocks: unsynchronised" in seen.out
    convert = ("convert", drive, "--rig", rig, "-o", scans)

    assert "use --align-clocks or --clock host" in command(*convert).err
    assert "give translation_m and a rotation" in command(*convert, "--clock", "host").err
    text = rig.read_text(encoding="utf-8")
    assert text.count(UNKNOWN) == len(POSES)
    for pose in POSES:
        text = text.replace(UNKNOWN, pose, 1)
    rig.write_text(text, encoding="utf-8")
    made = command(*convert, "--clock", "host")
    assert made.code == 0, made.err
    assert "warning: short: no whole window of 100 ms" in made.err

    assert command("report", scans).code == 0
    assert (tmp_path / "scans.html").is_file()
    (scan,) = mlbatch.read(scans)
    assert scan.sensors == ("ouster_122239000672", "ouster_122247000785")
    assert scan.point_count == _returns("1") + _returns("2")


def _returns(number: str) -> int:
    """Returns that the vendor's decoder found (MANIFEST.md)."""
    with np.load(PAIR / f"reference.{number}.npz") as npz:
        hits = (npz["range_mm"] > 0) & npz["valid"][:, None, :, None]
        return int(hits.sum())
