"""Which format an output gets, what is refused, where the side files are, and how many jobs."""

from __future__ import annotations

import contextlib
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

from mlbatch.errors import UsageError
from mlbatch.writers import (
    check_target,
    choose_format,
    threads,
)
from mlbatch.writers.base import WriterOptions
from mlbatch.writers.formats import format_names
from mlbatch.writers.threads import jobs_for, parse_jobs

ROOT = Path(__file__).resolve().parents[2]


def test_formats_are_found_by_their_place() -> None:
    modules = (ROOT / "mlbatch" / "writers" / "formats").glob("[!_]*.py")
    assert format_names() == tuple(sorted(path.stem for path in modules))
    assert set(format_names()) >= {"mcap", "npz", "ply", "pcd", "las", "laz", "kitti"}


def test_listing_formats_loads_no_heavy_package() -> None:
    code = (
        "import sys; from mlbatch.writers import format_names; format_names(); "
        "sys.exit(any(name in sys.modules for name in ('numpy', 'mcap')))"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


@pytest.mark.parametrize(
    ("target", "asked", "expected"),
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
def test_suffix_and_option_choose(target: str, asked: str | None, expected: str) -> None:
    assert choose_format(Path(target), asked) == expected


@pytest.mark.parametrize(
    ("target", "asked", "hint"),
    [
        ("a/x.ply", None, "-o a/x --format ply"),
        ("x.npz", "npz", "-o x --format npz"),
        ("x.ply", "mcap", "folder"),
        ("x.mcap", "npz", "leave out .mcap"),
        ("x.pcd", None, "-o x --format pcd"),
        ("x.LAZ", "laz", "-o x --format laz"),
        ("x.tar", None, "-o x --format webdataset"),
        ("x.bin", None, "-o x --format kitti"),
        ("x.db3", None, "-o x --format rosbag2"),
        ("x.bagg", None, "the nearest is .bag"),
        ("x.bag", "rosbag2", "leave out .bag"),
        ("x.bag", "mcap", "the name of a .mcap file for --format mcap, found that of a rosbag1"),
        ("x.mcap", "rosbag1", "change .mcap or leave out the option"),
        ("x", "bin", "found 'bin'; choose one"),
        ("x", "stl", "one of kitti, las, laz, mcap, npz, nuscenes, pcd, ply"),
    ],
)
def test_refusals_name_a_remedy(target: str, asked: str | None, hint: str) -> None:
    with pytest.raises(UsageError) as caught:
        choose_format(Path(target), asked)
    assert hint in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_package_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with contextlib.suppress(ImportError):
        # laspy looks for lazrs once, when it is imported: later tests need what it finds.
        importlib.import_module("laspy")
    for missing in ("laspy", "lazrs"):
        monkeypatch.setitem(sys.modules, missing, None)
    # Only LAZ is compressed.
    check_target("las", tmp_path / "x", WriterOptions(), "dense")
    with pytest.raises(UsageError) as caught:
        check_target("laz", tmp_path / "x", WriterOptions(), "dense")
    assert str(caught.value).startswith("--format laz: expected the package lazrs, found none")
    assert str(caught.value).endswith("; pip install 'mlbatch-lidar[las]'")
    assert not list(tmp_path.iterdir())


# -- number of jobs: as asked, or by cores and output ---------------------------------------------

FAST = WriterOptions("standard", False, False)
SLOW = WriterOptions("standard", False, False, compression="zstd")


@pytest.mark.parametrize("text", ["0", "65", "-1", "1.0", "", "Auto", "\u0663", "9" * 5000])
def test_other_texts_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match="--jobs: expected 1 to 64, or auto, found"):
        parse_jobs("--jobs", text)


@pytest.mark.parametrize(
    ("name", "options", "cores", "jobs"),
    [
        ("mcap", FAST, 8, 1),
        ("npz", FAST, 8, 1),
        ("mcap", SLOW, 1, 1),
        ("mcap", SLOW, 3, 3),
        ("rosbag2", SLOW, 8, 4),
        ("laz", FAST, 2, 1),
        ("las", FAST, 64, 1),
    ],
)
def test_several_jobs_where_writing_is_slow(
    name: str, options: WriterOptions, cores: int, jobs: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(threads, "_cores", lambda: cores)
    assert jobs_for(None, name, options) == jobs
    assert jobs_for(5, name, options) == 5
