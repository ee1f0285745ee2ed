"""Cases, the disk that they need, and when a kept recording is used again."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.bench import cases
from tests.bench.cases import CAPTURE, CASES, KINDS, RECORDINGS, disk_bytes, is_current
from tests.bench.recordings import make


def test_names_are_unique() -> None:
    assert len({case.name for case in CASES}) == len(CASES)
    assert set(KINDS) == {sensor.kind for one in RECORDINGS.values() for sensor in one.sensors}


def test_disk_bytes() -> None:
    by_name = {case.name: case for case in CASES}
    # Two lidars, and their IMUs.
    low = 2 * 640 * (8448 + 58) + 2 * 100 * (48 + 58)
    assert RECORDINGS["dual-4"].bytes_per_s == low
    # The recording, plain and in fragments, but no output.
    assert disk_bytes([by_name["dual-4"]], 2.0) == 4 * low
    # The recording once, and all its slots at 48 bytes.
    assert disk_bytes([by_name["dual-4-mcap"]], 1.0) == low + 2 * 10_240 * 128 * 48


def test_a_kept_recording_is_current_unless_its_encoders_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = RECORDINGS["three-vlp16"]
    assert not is_current(tmp_path, recording)
    make(recording, 0.2, tmp_path)
    assert is_current(tmp_path, recording)
    with monkeypatch.context() as changed:
        changed.setattr(cases, "digest", lambda: "of other encoders")
        assert not is_current(tmp_path, recording)
    assert is_current(tmp_path, recording)
    (tmp_path / CAPTURE).unlink()
    assert not is_current(tmp_path, recording)
