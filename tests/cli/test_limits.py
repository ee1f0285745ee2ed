"""Calibrations of what no lidar can be: refused, with file and key; verify never sees them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mlbatch.verification import verify
from tests.builders.run import command
from tests.builders.sessions import Unit, twin, write_session

TRANSFORM: list[float] = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
# Length in mm; True where a lidar can have it.
LENGTHS = [(400.0, True), (-400.0, True), (501.0, False), (1500.0, False), (6e18, False)]


def _damage(path: Path, section: str, key: str, x_mm: float) -> None:
    """Move a transform of a metadata file along x."""
    document = json.loads(path.read_text())
    transform = [*TRANSFORM]
    transform[3] = x_mm
    document[section][key] = transform
    path.write_text(json.dumps(document))


@pytest.mark.parametrize(("x_mm", "is_possible"), LENGTHS)
@pytest.mark.parametrize(
    ("section", "key"),
    [
        ("beam_intrinsics", "beam_to_lidar_transform"),
        ("lidar_intrinsics", "lidar_to_sensor_transform"),
    ],
)
def test_metadata_are_refused_or_give_an_output_without_fault(
    section: str, key: str, x_mm: float, is_possible: bool, tmp_path: Path
) -> None:
    capture = write_session(tmp_path, Unit(turns=4))
    path = tmp_path / "111.json"
    _damage(path, section, key, x_mm)
    run = command("convert", capture, "--metadata", path, "-o", tmp_path / "out", "--no-fsync")
    if is_possible:
        assert run.code == 0
        assert verify(tmp_path / "out").ok
    else:
        assert run.code == 1
        assert run.err.startswith(f"mlbatch: error: {path}: Ouster metadata, ")
        # Both lengths count where each alone is possible.
        assert key in run.err or "lidar_to_sensor_transform" in run.err


def test_metadata_next_to_the_recording_are_named_where_they_are_missed(tmp_path: Path) -> None:
    unit = Unit(turns=4)
    capture = write_session(tmp_path, unit, twin(unit, 222))
    path = tmp_path / "111.json"
    _damage(path, "beam_intrinsics", "beam_to_lidar_transform", 6e18)
    words = ("--identity-extrinsics", "--strict", "-o", tmp_path / "out")
    run = command("convert", capture, *words)
    assert run.code == 1
    assert (
        f"({path}: Ouster metadata, beam_to_lidar_transform: expected a translation of at most "
        "1000 mm, found 6e+18 mm; save the metadata from the sensor again)"
    ) in run.err
