"""Recordings as users name them: files, folders, patterns."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from mlbatch.errors import RecordingError
from mlbatch.readers.inputs import expand
from tests.builders.mcaps import write_mcap
from tests.builders.sessions import FIXTURE, Shell, Unit, report_of, twin, write_session
from tests.builders.sessions_of_bags import unit_messages

CAPTURE = FIXTURE / "two_lidars.pcap"


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """A folder with two captures of one session, their metadata, and other files."""
    folder = tmp_path / "drive"
    write_session(folder, Unit()).rename(folder / "left.pcap")
    write_session(folder, twin(Unit(), 222)).rename(folder / "right.pcap")
    (folder / "notes.txt").write_text("rain")
    (folder / ".hidden.pcap").write_bytes(CAPTURE.read_bytes()[:1000])
    (folder / "next.pcap.partial").write_bytes(CAPTURE.read_bytes()[:1000])
    (folder / "empty.pcap").write_bytes(b"")
    return folder


def test_a_folder_of_captures_stands_for_them(drive: Path) -> None:
    assert expand([drive]) == (drive / "left.pcap", drive / "right.pcap")


def test_a_pattern_stands_for_what_it_matches(drive: Path) -> None:
    assert expand([drive / "*t.pcap"]) == (drive / "left.pcap", drive / "right.pcap")
    assert expand([drive.parent / "*"]) == expand([drive])
    assert expand([drive.parent / "**" / "r*.pcap"]) == (drive / "right.pcap",)


def test_each_recording_is_taken_once(drive: Path) -> None:
    left = drive / "left.pcap"
    assert expand([left, drive, left]) == (left, drive / "right.pcap")


def test_a_name_with_brackets_is_a_file(tmp_path: Path) -> None:
    file = tmp_path / "drive[1].pcap"
    shutil.copy(CAPTURE, file)
    assert expand([file]) == (file,)


def test_what_is_missing_is_left_to_the_reader(tmp_path: Path) -> None:
    assert expand([tmp_path / "none.pcap"]) == (tmp_path / "none.pcap",)
    (tmp_path / "empty").mkdir()
    assert expand([tmp_path / "empty"]) == (tmp_path / "empty",)


def test_a_bag_is_one_recording(tmp_path: Path) -> None:
    write_mcap(tmp_path / "bag_0.mcap", unit_messages(Unit(turns=1), "top"))
    shutil.copy(tmp_path / "bag_0.mcap", tmp_path / "bag_1.mcap")
    assert expand([tmp_path]) == (tmp_path,)


def test_parts_of_a_bag_among_captures_are_refused(drive: Path) -> None:
    write_mcap(drive / "bag_0.mcap", unit_messages(Unit(turns=1), "top"))
    with pytest.raises(RecordingError, match=r"parts of a bag \(bag_0.mcap\).*left.pcap.*name the"):
        expand([drive])


def test_a_pattern_without_a_match_is_one_line(shell: Shell, tmp_path: Path) -> None:
    outcome = shell("inspect", tmp_path / "*.pcap")
    assert (outcome.code, outcome.out) == (1, "")
    assert outcome.err == (
        f"mlbatch: error: {tmp_path}/*.pcap: expected recordings, found no file that matches the "
        "pattern; check it with `ls`\n"
    )


@pytest.mark.parametrize("name", ["drive", "drive/*t.pcap"])
def test_commands_take_them(shell: Shell, drive: Path, tmp_path: Path, name: str) -> None:
    words = ["convert", str(tmp_path / name), "--identity-extrinsics", "-o"]
    assert shell(*words, "out").code == 0
    inputs = report_of("out/report.json")["inputs"]
    assert [Path(one["path"]).name for one in inputs] == ["left.pcap", "right.pcap"]
    for command in ("inspect", "compare"):
        outcome = shell(command, tmp_path / name, "--json")
        assert outcome.code == 0, outcome.err
        assert "ouster_222" in outcome.out


def test_the_folder_above_a_bag_stands_for_it(tmp_path: Path) -> None:
    bag = tmp_path / "drive" / "bag"
    bag.mkdir(parents=True)
    write_mcap(bag / "bag_0.mcap", unit_messages(Unit(turns=1), "top"))
    (bag / "metadata.yaml").touch()
    assert expand([tmp_path / "drive"]) == (bag,)
    # A file alone: calibrations are next to it.
    (bag / "metadata.yaml").unlink()
    assert expand([bag]) == (bag / "bag_0.mcap",)
    shutil.copytree(bag, tmp_path / "drive" / "other")
    assert expand([tmp_path / "drive"]) == (tmp_path / "drive",)
