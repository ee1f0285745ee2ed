"""Which format an output gets, and what is refused."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from mlbatch.errors import ExportError, UsageError
from mlbatch.writers import (
    WriterOptions,
    check_target,
    choose_format,
    format_names,
    open_writer,
    plugin,
    report_paths,
)
from tests.builders.scans import run_info


def test_formats_are_the_modules_of_the_package() -> None:
    assert format_names() == ("mcap", "npz", "ply", "rosbag1", "rosbag2")


@pytest.mark.parametrize("name", format_names())
def test_a_plug_in_is_called_as_its_format(name: str) -> None:
    assert name == plugin(name).FORMAT


@pytest.mark.parametrize(
    ("target", "asked", "wanted"),
    [
        ("out.mcap", None, "mcap"),
        ("OUT.MCAP", None, "mcap"),
        ("out", None, "npz"),
        ("drive.2024", None, "npz"),
        ("out", "ply", "ply"),
        ("out", "npz", "npz"),
        ("out", "mcap", "mcap"),
        ("out.mcap", "mcap", "mcap"),
        ("out.bag", None, "rosbag1"),
        ("out", "rosbag1", "rosbag1"),
        ("out", "rosbag2", "rosbag2"),
    ],
)
def test_suffix_and_option_choose(target: str, asked: str | None, wanted: str) -> None:
    assert choose_format(Path(target), asked) == wanted


@pytest.mark.parametrize(
    ("target", "asked", "hint"),
    [
        ("a/x.ply", None, "-o a/x --format ply"),
        ("x.npz", "npz", "-o x --format npz"),
        ("x.ply", "mcap", "folder"),
        ("x.mcap", "npz", "leave out .mcap"),
        ("x.pcd", None, "pcd, not in this version"),
        ("x.db3", None, "-o x --format rosbag2"),
        ("x.bag", "rosbag2", "leave out .bag"),
        ("x.bag", "mcap", "the name of a .mcap file for --format mcap, got that of a rosbag1"),
        ("x.mcap", "rosbag1", "change .mcap or leave out the option"),
        ("x", "las", "'las' (not in this version)"),
        ("x", "stl", "one of mcap, npz, ply, rosbag1, rosbag2"),
    ],
)
def test_refusals_say_what_to_do(target: str, asked: str | None, hint: str) -> None:
    with pytest.raises(UsageError) as caught:
        choose_format(Path(target), asked)
    assert hint in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["npz", "ply"])
def test_point_layouts_belong_to_mcap(name: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="point-layout"):
        open_writer(name, tmp_path / "out", run_info(), WriterOptions("velodyne"))
    assert not list(tmp_path.iterdir())


def test_unknown_point_layout_names_the_known(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="standard, velodyne, ouster"):
        open_writer("mcap", tmp_path / "out.mcap", run_info(), WriterOptions("velodine"))
    assert not list(tmp_path.iterdir())


def test_ply_has_no_organized_form(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="organized"):
        open_writer("ply", tmp_path / "out", run_info("organized"), WriterOptions())


def test_listing_formats_loads_no_heavy_package() -> None:
    code = (
        "import sys; from mlbatch.writers import format_names; format_names(); "
        "sys.exit(any(name in sys.modules for name in ('numpy', 'mcap')))"
    )
    root = Path(__file__).resolve().parents[2]
    assert subprocess.run([sys.executable, "-c", code], cwd=root, check=False).returncode == 0


def test_places_of_side_files() -> None:
    folder = report_paths(Path("a/out"), "npz")
    assert (folder.report, folder.scans_csv) == (Path("a/out/report.json"), Path("a/out/scans.csv"))
    file = report_paths(Path("a/x.mcap"), "mcap")
    assert file.report == Path("a/x.mcap.report.json")
    assert file.scans_csv == Path("a/x.mcap.scans.csv")


@pytest.mark.parametrize(
    ("name", "file"),
    [("mcap", "x.mcap"), ("npz", "x"), ("ply", "x"), ("rosbag1", "x.bag"), ("rosbag2", "x")],
)
def test_checking_a_target_leaves_nothing(name: str, file: str, tmp_path: Path) -> None:
    check_target(name, tmp_path / file, WriterOptions(split=True), "dense")
    assert not list(tmp_path.iterdir())


def test_checking_a_target_refuses_as_opening_does(tmp_path: Path) -> None:
    (tmp_path / "x.mcap").write_text("old")
    with pytest.raises(ExportError, match="existing"):
        check_target("mcap", tmp_path / "x.mcap", WriterOptions(), "dense")
    assert (tmp_path / "x.mcap").read_text() == "old"
    with pytest.raises(UsageError, match="organized"):
        check_target("ply", tmp_path / "x", WriterOptions(), "organized")
