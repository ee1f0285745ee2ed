"""Options kept in the rig: taken where the command line is silent, refused with their place."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.builders.sessions import CAPTURE, FIXTURE, Shell, arrays, names, report_of


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """The rig of the fixture, to which tests add a section."""
    text = (FIXTURE / "rig.yaml").read_text(encoding="utf-8")
    for name in ("left.json", "right.json"):
        (tmp_path / name).symlink_to(FIXTURE / name)
    path = tmp_path / "rig.yaml"
    path.write_text(text)
    return path


def _add(rig: Path, section: str) -> None:
    rig.write_text(f"{rig.read_text()}\nconvert:\n{section}")


def test_options_of_the_rig_are_those_of_the_command_line(shell: Shell, rig: Path) -> None:
    _add(rig, "  format: ply\n  slices: 2\n  only: [left]\n  max_range: 20\n  keep_partial: true\n")
    assert shell(f"convert {CAPTURE} -r {rig} -o by_rig").code == 0
    plain = FIXTURE / "rig.yaml"
    words = "-f ply --slices 2 --only left --max-range 20 --keep-partial"
    assert shell(f"convert {CAPTURE} -r {plain} -o by_words {words}").code == 0
    files = names("by_rig", ".ply")
    assert files == names("by_words", ".ply")
    assert any("-1" in name for name in files)
    for name in files:
        assert Path("by_rig", name).read_bytes() == Path("by_words", name).read_bytes()


def test_a_trajectory_is_found_next_to_the_rig(shell: Shell, tmp_path: Path) -> None:
    """The rig is in a folder above the current one, and named from there."""
    folder = tmp_path / "rigs"
    folder.mkdir()
    for name in ("left.json", "right.json"):
        (folder / name).symlink_to(FIXTURE / name)
    text = (FIXTURE / "rig.yaml").read_text(encoding="utf-8")
    (folder / "rig.yaml").write_text(f"{text}\nconvert: {{deskew: poses.tum}}\n")
    assert shell(f"convert {CAPTURE} -r {FIXTURE / 'rig.yaml'} -o usual -q").code == 0
    begin_s = int(arrays("usual/000000.npz")["start_ns"]) // 10**9 - 1
    times_s = [begin_s + tenths / 10 for tenths in range(50)]
    (folder / "poses.tum").write_text(
        "".join(f"{time_s:.1f} 0 0 0 0 0 0 1\n" for time_s in times_s)
    )
    outcome = shell(f"convert {CAPTURE} -r {folder / 'rig.yaml'} -o out")
    assert outcome.code == 0, outcome.err
    assert report_of("out/report.json")["deskew"]["source"] == "poses.tum"
    (folder / "poses.tum").unlink()
    outcome = shell(f"convert {CAPTURE} -r {folder / 'rig.yaml'} -o again")
    assert outcome.code == 1
    assert "convert.deskew: --deskew: expected imu, constant-velocity or the file" in outcome.err


def test_the_command_line_wins(shell: Shell, rig: Path) -> None:
    _add(rig, "  slices: 2\n  only: [left]\n  format: ply\n")
    words = "--slices 1 --include-sensor right -f npz"
    assert shell(f"convert {CAPTURE} -r {rig} -o out {words}").code == 0
    report = report_of("out/report.json")
    assert report["grid"]["slices"] == 1
    assert [one["name"] for one in report["sensors"]] == ["right"]
    assert names("out")


def test_a_default_value_on_the_command_line_wins_as_well(shell: Shell, rig: Path) -> None:
    _add(rig, "  layout: organized\n")
    assert shell(f"convert {CAPTURE} -r {rig} -o out.mcap --layout dense").code == 0
    assert shell("verify out.mcap").code == 0
    assert ", organized" not in shell("verify out.mcap").out


@pytest.mark.parametrize("command", ["inspect", "compare"])
def test_other_commands_ignore_them(shell: Shell, rig: Path, command: str) -> None:
    before = shell(f"{command} {CAPTURE} -r {rig}")
    _add(rig, "  only: [left]\n")
    after = shell(f"{command} {CAPTURE} -r {rig}")
    assert (after.code, after.out) == (0, before.out)
