"""docs/python.md and docs/extend.md name what the interface has (test_blocks.py runs them)."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import mlbatch
from mlbatch import api
from mlbatch.errors import MlbatchError, UsageError
from tests.builders.sessions import FIXTURE
from tests.contract.tree import ROOT

PAGE = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
EXTEND = (ROOT / "docs" / "extend.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", sorted(set(mlbatch.__all__) - {"MlbatchError", "Run", "Scan"}))
def test_every_name_is_described(name: str) -> None:
    assert re.search(rf"`(mlbatch\.)?{name}\b", PAGE), name


def test_the_example_of_a_package_is_that_of_the_page() -> None:
    (block,) = re.findall(r"^```toml\n(.*?)^```$", EXTEND, re.MULTILINE | re.DOTALL)
    project = ROOT / "examples" / "mlbatch-example" / "pyproject.toml"
    assert block in project.read_text(encoding="utf-8")


def test_options_have_the_names_of_the_command() -> None:
    """Those of Python that are none of the command: what the command has as arguments."""
    import inspect

    from tests.contract.test_help import OPTIONS

    known = {option.removeprefix("--").replace("-", "_") for option in OPTIONS["convert"]}
    known |= {"recording", "recordings", "output", "exclude_boxes", "copy_topics", "fsync"}
    for function in (api.open, api.scans, api.convert):
        assert set(inspect.signature(function).parameters) <= known, function.__name__


# By the columns of the page: an option of Python, and a value of it that is not the usual one.
SESSION = {
    "rig": FIXTURE / "rig.yaml",
    "dataset": None,
    "metadata": [FIXTURE / "left.json"],
    "only": "by serial number",
    "ignore": "by serial number",
    "identity_extrinsics": True,
    "clock": "host",
    "align_clocks": True,
    "align_to": "first",
    "decode": {"vlp16.rate": "10"},
    "strict": True,
}
WINDOWS = {
    "rate": 20,
    "start": "+0.1s",
    "end": "+0.3s",
    "slices": 2,
    "layout": "organized",
    "sort": "points",
    "split": True,
    "keep_partial": True,
    "drop_incomplete": 50,
    "max_wait": 2,
    "min_range": 1,
    "max_range": 50,
    "exclude_boxes": [(-1, -1, -1, 1, 1, 1)],
    "keep_repeated": True,
    "batching": "latest",
    "batching_times": "own",
    "deskew": "constant-velocity",
    "deskew_to": "end",
    "no_pose_check": True,
}
OUTPUT = {
    "copy_topics": "/tf",
    "stamp": "end",
    "format": "npz",
    "point_layout": "velodyne",
    "compression": "zstd",
    "ply_style": "float",
    "max_bag_duration": 1,
    "overwrite": True,
    "fsync": False,
    "report": "report.json",
    "jobs": 2,
    "accumulate": "map.ply",
    "voxel": 0.5,
    "crs": "EPSG:32632",
}
# At rest in Munich: one pose per 0.4 s around the recording.
POSES = "\n".join(
    f"{1_777_881_599 + 0.4 * step:.1f} 691000 5335000 520 0 0 0 1" for step in range(20)
)
# What an option needs beside it.
WITH: dict[str, dict[str, Any]] = {
    "align_to": {"align_clocks": True},
    "batching_times": {"batching": "latest"},
    "deskew_to": {"deskew": "constant-velocity"},
    "ply_style": {"format": "ply"},
    "max_bag_duration": {"format": "rosbag2"},
    "decode": {"decode": {}},
    "copy_topics": {"copy_topics": ()},
}
OTHERWISE = {"exclude-box": "exclude_boxes", "pass": "copy_topics", "no-fsync": "fsync"}
SYNONYMS = {"copy-topic", "include-sensor", "exclude-sensor", "output"}


def test_the_page_has_every_option_of_the_command() -> None:
    """In a row of its table, or among those that Python does not have."""
    from tests.contract.test_help import OPTIONS

    rows = [line for line in PAGE.splitlines() if re.match(r"\| [a-z ]+: `", line)]
    named = [re.findall(r"`(\w+)`", row.split("|")[1]) for row in rows]
    assert named == [list(SESSION), list(WINDOWS), list(OUTPUT)]
    (absent,) = re.findall(r"^Not available from Python: .*\n.*$", PAGE, re.MULTILINE)
    words = {option.removeprefix("--") for option in OPTIONS["convert"]} - SYNONYMS
    for word in sorted(words):
        name = OTHERWISE.get(word, word.replace("-", "_"))
        assert any(name in row for row in named) != (f"`--{word}" in absent), word


@pytest.mark.parametrize("name", [*SESSION, *WINDOWS, *OUTPUT])
def test_every_option_of_the_page_works(name: str, tmp_path: Path) -> None:
    capture = FIXTURE / "two_lidars.pcap"
    value = {**SESSION, **WINDOWS, **OUTPUT}[name]
    options: dict[str, Any] = {"rig": FIXTURE / "rig.yaml", name: value, **WITH.get(name, {})}
    if name in ("only", "ignore"):
        # Its rig names both.
        options = {name: "ouster_122647000123", "identity_extrinsics": True}
    if name == "report":
        options["report"] = tmp_path / "report.json"
    if name in ("accumulate", "voxel", "crs"):
        (tmp_path / "poses.tum").write_text(POSES)
        options |= {"accumulate": tmp_path / "map.ply", "deskew": tmp_path / "poses.tum"}
    if name == "crs":
        pytest.importorskip("pyproj")
    run = mlbatch.convert(capture, None, **options)
    assert run.report.scans.written > 0
    if name in OUTPUT:
        return
    scans = list(mlbatch.scans(capture, **options))
    assert len({(scan.index, scan.slice) for scan in scans}) == run.report.scans.written
    assert {scan.sensor != "" for scan in scans} == {name == "split"}
    opened = {key: options.pop(key) for key in SESSION if key in options}
    rec = mlbatch.open(capture, **opened)
    assert len(list(rec.scans(**options))) == len(scans)
    assert mlbatch.convert(rec, None, **options).report.scans.points == run.report.scans.points


def test_the_engine_is_ignored_with_a_warning() -> None:
    with pytest.warns(DeprecationWarning, match="engine is ignored, since everything is compiled"):
        mlbatch.open(FIXTURE / "two_lidars.pcap", engine="numpy")  # type: ignore[call-arg]


@pytest.mark.parametrize("function", [mlbatch.open, mlbatch.scans, mlbatch.convert])
def test_an_unknown_option_is_named(function: Callable[..., object]) -> None:
    words = ("scans.mcap",) if function is mlbatch.convert else ()
    with pytest.raises(UsageError, match=r"option.*found 'metdata'; write metadata, or see docs"):
        function("a.pcap", *words, metdata="numpy")
    with pytest.raises(UsageError, match=r"option.*found 'resume'; see docs/python"):
        function("a.pcap", *words, resume=True)


def test_options_of_sensors_belong_to_open() -> None:
    rec = mlbatch.open(FIXTURE / "two_lidars.pcap", rig=FIXTURE / "rig.yaml")
    with pytest.raises(UsageError, match="found 'rig'"):
        rec.scans(rig="rig.yaml")  # type: ignore[call-arg]
    with pytest.raises(UsageError, match="expected strict with paths only"):
        mlbatch.convert(rec, None, strict=True)


def test_values_out_of_any_range(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rec = mlbatch.open(FIXTURE / "two_lidars.pcap", rig=FIXTURE / "rig.yaml")
    with pytest.raises(UsageError, match="start: expected nanoseconds of at most 8589934592 s"):
        rec.scans(start=2**70)
    with pytest.raises(UsageError, match="exclude_boxes: expected"):
        rec.scans(exclude_boxes=[1])  # type: ignore[list-item]
    with pytest.raises(IndexError, match="no such scan"):
        rec[10**30]
    with pytest.raises(UsageError, match="expected at least one path"):
        mlbatch.inspect([])
    monkeypatch.chdir(tmp_path)
    with pytest.raises(MlbatchError, match="found an empty folder"):
        mlbatch.verify(".")
