"""Kinds of outputs; outputs that cannot be checked are refused in one line."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from mlbatch.verification import VerifyError, verify
from tests.builders.verify_outputs import (
    Edit,
    both,
    copied,
    damaged,
    flipped,
    made,
    raw,
    removed,
    renamed,
    text,
)


def emptied(folder: Path) -> None:
    for file in folder.iterdir():
        file.unlink()


NPZ_NAMES = ("head", "000000", "000001", "000002")
NOTHING: dict[str, tuple[str, Edit, str]] = {
    "no such output": ("npz", shutil.rmtree, "no such file or folder"),
    "empty folder": ("npz", emptied, "an empty folder"),
    "folder without scans": (
        "npz",
        both(*(removed(f"{name}.npz") for name in NPZ_NAMES)),
        "a folder without scans",
    ),
    "scans of strange names": (
        "npz",
        both(*(renamed(f"{name}.npz", f"x{name}.npz") for name in NPZ_NAMES)),
        "strange names",
    ),
    "first scan damaged": ("npz", raw("head.npz", lambda data: b"PK"), "restore the first scan"),
    "rate that is none": (
        "ply",
        text("head.ply", "rate_hz 10", "rate_hz ten"),
        "a positive number of Hz",
    ),
    "report that is no JSON": ("npz", text("report.json", "{", "["), "a report in JSON"),
    "empty file": ("scans.mcap", raw("", lambda data: b""), "an empty file"),
    "other file": ("scans.mcap", raw("", lambda data: b"abc"), "a file of another kind"),
    "damaged MCAP": ("scans.mcap", raw("", lambda data: data[:200_000]), "a whole MCAP file"),
    "foreign MCAP": (
        "scans.mcap",
        raw("", lambda data: data[:8] + bytes(100)),
        "a whole MCAP file",
    ),
    "no grid": ("scans.mcap", text("", "mlbatch.grid", "mlbatch.gird"), "mlbatch.grid"),
    "damaged bag": ("scans.bag", raw("", lambda data: data[:200_000]), "convert again"),
    "other metadata.yaml": (
        "bag2",
        text("metadata.yaml", "  version", "  a: &a [1]\n  b: [*a, *a]\n  version"),
        "an alias",
    ),
    "bag without scans": ("bag2", removed("bag2_0.mcap"), "a bag with MCAP files, found none"),
    "other file of a bag": ("bag2", raw("bag2_0.mcap", flipped(0)), "an MCAP file, found another"),
    "metadata that is no YAML": ("bag2", text("metadata.yaml", "version", "\t{"), "expected YAML"),
}


@pytest.mark.parametrize("name", NOTHING)
def test_refused_in_one_line(name: str, tmp_path: Path) -> None:
    kind, edit, words = NOTHING[name]
    with pytest.raises(VerifyError, match=words) as error:
        damaged(kind, tmp_path, edit)
    assert "\n" not in str(error.value)
    assert str(tmp_path) in str(error.value)


def test_unfinished_outputs_are_refused(tmp_path: Path) -> None:
    path = copied("npz", tmp_path)
    left = path.rename(tmp_path / "npz.partial")
    with pytest.raises(VerifyError, match="unfinished"):
        verify(left)
    copied("npz", tmp_path)
    verdict = verify(path)
    assert [(one.check, one.where) for one in verdict.violations] == [("container", "npz.partial")]


def test_a_report_elsewhere_is_read(tmp_path: Path) -> None:
    path = copied("npz", tmp_path)
    other = (path / "report.json").rename(tmp_path / "elsewhere.json")
    without = {check.name: check for check in verify(path).checks}
    assert without["ledger"].outcome == without["report"].outcome == "not checkable"
    assert "--report" in without["ledger"].limit
    with_it = {check.name: check.outcome for check in verify(path, other).checks}
    assert with_it["ledger"] == with_it["report"] == "ok"
    with pytest.raises(VerifyError, match="expected a report"):
        verify(path, tmp_path / "none.json")


def test_a_bag_alone_is_partly_checkable(tmp_path: Path) -> None:
    path = Path(shutil.copy(made("scans.bag"), tmp_path))
    verdict = verify(path)
    assert verdict.ok
    limited = {check.name for check in verdict.checks if check.outcome == "not checkable"}
    assert {"grid", "index", "t_init", "columns", "table", "ledger", "report"} <= limited
