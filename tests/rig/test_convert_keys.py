"""`convert:` of a rig: options as on the command line, with file, line and key of mistakes."""

from __future__ import annotations

from pathlib import Path

import pytest

from mlbatch.errors import RigError
from mlbatch.options import WHOLE, Option
from mlbatch.rig.convert_keys import CONVERT, RigOption, key_of
from mlbatch.rig.rig import Rig, RigSensor, read_rig
from mlbatch.rig.write import write_rig
from mlbatch.rig.yaml_tree import read_yaml
from tests.contract.test_help import OPTIONS

SENSORS = "sensors: [{name: a}]\n"
# Options of one run, and those that the rig has a key for.
NOT_IN_A_RIG = {
    *(
        "--rig",
        "--dataset",
        "--output",
        "--report",
        "--html",
        "--html-scans",
        "--dry-run",
        "--resume",
        "--overwrite",
    ),
    "--shard",
    *("--rate", "--metadata", "--exclude-box"),
    *("--accumulate", "--voxel", "--crs"),
}
ALIASES = {"--include-sensor", "--exclude-sensor", "--copy-topic"}


def _read(folder: Path, section: str) -> Rig:
    file = folder / "rig.yaml"
    file.write_text(SENSORS + section)
    return read_rig(file)


def test_every_option_of_convert_is_a_key() -> None:
    options = set(OPTIONS["convert"]) - NOT_IN_A_RIG - ALIASES
    # Ignored with a note, and hidden.
    keys = {f"--{key.name.replace('_', '-')}" for key in CONVERT.keys} - {"--engine"}
    assert keys == options, "set in_rig in mlbatch/options.py, or list it in NOT_IN_A_RIG here"


def test_options_are_read_as_on_the_command_line(tmp_path: Path) -> None:
    section = """\
convert:
  format: mcap
  max_wait: 2.50
  split: yes
  keep_partial: no
  jobs: 4
  only: [left, 001234]
  ignore: 10.0.0.9:7502
  decode: {firing_azimuth: off, crc: check}
"""
    found = _read(tmp_path, section).options
    assert {option.name: option.values for option in found} == {
        "format": ("mcap",),
        "max_wait": ("2.50",),
        "split": ("true",),
        "keep_partial": ("false",),
        "jobs": ("4",),
        "only": ("left", "001234"),
        "ignore": ("10.0.0.9:7502",),
        "decode": ("firing_azimuth=off", "crc=check"),
    }
    places = {option.name: option.place for option in found}
    assert places["jobs"] == f"{tmp_path / 'rig.yaml'}:7: convert.jobs"


def test_a_whole_number_without_an_upper_bound_may_be_large(tmp_path: Path) -> None:
    key = key_of(Option("points", WHOLE, "Points.", low=1))
    assert key.form == {"type": "integer", "minimum": 1, "maximum": 2**31}
    file = tmp_path / "one.yaml"
    file.write_text("70000")
    assert key.read(read_yaml(file)) == ("70000",)
    file.write_text("0")
    with pytest.raises(RigError, match="a whole number from 1 to"):
        key.read(read_yaml(file))


def test_a_trajectory_is_relative_to_the_rig_file_as_all_paths_in_it(tmp_path: Path) -> None:
    elsewhere = tmp_path / "poses.tum"
    for text, value in (
        ("drive/poses.tum", str(tmp_path / "drive" / "poses.tum")),
        (str(elsewhere), str(elsewhere)),
        ("imu", "imu"),
        ("constant-velocity", "constant-velocity"),
    ):
        (found,) = _read(tmp_path, f"convert: {{deskew: {text}}}\n").options
        assert found.values == (value,)


def test_a_written_trajectory_is_relative_to_the_new_rig_file(tmp_path: Path) -> None:
    rig = _read(tmp_path, "convert: {deskew: drive/poses.tum}\n")
    folder = tmp_path / "copy"
    folder.mkdir()
    (folder / "rig.yaml").write_text(write_rig(rig, folder))
    assert "deskew: " in (folder / "rig.yaml").read_text()
    assert str(tmp_path) not in (folder / "rig.yaml").read_text()
    (found,) = read_rig(folder / "rig.yaml").options
    assert Path(found.values[0]).resolve() == (tmp_path / "drive" / "poses.tum").resolve()


def test_written_options_are_read_back(tmp_path: Path) -> None:
    options = (
        RigOption("compression", ("zstd:3",)),
        RigOption("split", ("true",)),
        RigOption("max_wait", ("2.50",)),
        RigOption("max_range", ("80",)),
        RigOption("only", ("left", "001234")),
        RigOption("decode", ("firing_azimuth=off", "crc=check")),
        RigOption("deskew", ("imu",)),
        RigOption("fail_on", ("loss>0.1%,underfilled>0",)),
    )
    file = tmp_path / "rig.yaml"
    file.write_text(write_rig(Rig((RigSensor("a"),), options=options), tmp_path))
    found = {option.name: option.values for option in read_rig(file).options}
    assert found == {option.name: option.values for option in options}
