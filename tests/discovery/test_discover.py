"""Sensors of a session: names, poses, metadata, choice, warnings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from mlbatch.discovery.calibrations import find_calibrations
from mlbatch.discovery.discover import Discovery, SensorSelection, discover
from mlbatch.errors import RigError
from mlbatch.readers import open_recording
from mlbatch.types import StreamTable
from tests.builders.sessions import SMALL, Unit, write_metadata, write_session


def _discover(capture: Path, selection: SensorSelection | None = None) -> Discovery:
    table = StreamTable()
    return discover([open_recording(capture, table)], table, selection or SensorSelection())


def test_sensors_without_a_serial_number_are_numbered(tmp_path: Path) -> None:
    old = replace(SMALL, profile="LEGACY", serial=0)
    capture = write_session(tmp_path, Unit(spec=old))
    assert [sensor.name for sensor in _discover(capture).sensors] == ["ouster_1"]


def test_metadata_are_searched_in_the_folders_of_all_recordings(tmp_path: Path) -> None:
    first = tmp_path / "1"
    second = tmp_path / "2"
    for folder, serial in ((first, 1), (second, 2)):
        folder.mkdir()
        write_metadata(folder / "any name.JSON", replace(SMALL, serial=serial))
        (folder / "notes.txt").write_text("not looked at")
        (folder / "other.json").write_text("[1, 2]")
    found, examined = find_calibrations([first / "a.pcap", second / "b.pcap", first / "c.pcap"], [])
    assert [calibration.serial for calibration in found] == ["1", "2"]
    assert len(examined) == 4


def test_an_unusable_file_in_the_directory_is_skipped(tmp_path: Path) -> None:
    """It was never named by the user; where it is named it is an error."""
    broken = write_metadata(tmp_path / "broken.json", replace(SMALL, altitude_deg=(1.0, 2.0)))
    assert find_calibrations([tmp_path / "a.pcap"], []) == ([], [broken])
    with pytest.raises(RigError, match=r"broken\.json"):
        find_calibrations([tmp_path / "a.pcap"], [broken])


def test_warnings_of_a_decoder_become_notes(tmp_path: Path) -> None:
    """Here that its output was off, by the metadata, though packets came."""
    capture = write_session(tmp_path, Unit(spec=replace(SMALL, lidar_port=0)))
    (note,) = _discover(capture).notes
    assert (note.code, note.sensor) == ("calibration", "ouster_111")
    assert "off" in note.message
