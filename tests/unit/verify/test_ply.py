"""PLY folders and outputs that cannot be judged at all."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from mlbatch.verify import VerifyError, verify
from tests.unit.verify.made import (
    Edit,
    both,
    copied,
    forget,
    made,
    raw,
    removed,
    renamed,
    report,
    row,
    spoiled,
    text,
)

ONE = "000001.ply"
VERTEX = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "intensity")]
    + [("time", "<f8"), ("ring", "<i4"), ("return_type", "u1"), ("lidar_id", "u1")]
)


@pytest.fixture(scope="module", autouse=True)
def _clean() -> Iterator[None]:
    yield
    forget()


def vertex(name: str, place: int, value: float | None) -> Edit:
    """Put a value into a vertex; None: the other one of 0 and 1."""

    def change(data: bytearray) -> bytearray:
        begin = data.index(b"end_header\n") + len(b"end_header\n")
        vertices = np.frombuffer(data, VERTEX, offset=begin)
        vertices[name][place] = 1 - vertices[name][place] if value is None else value
        return data

    return raw(ONE, change)


PLY: dict[str, tuple[Edit, str, str]] = {
    "start": (text(ONE, "200000000\ncomment end", "200000007\ncomment end"), "grid", "start_ns"),
    "end": (text(ONE, "00\ncomment index", "01\ncomment index"), "grid", "000001.ply end_ns"),
    "index": (text(ONE, "index 1", "index 2"), "index", "000001.ply index"),
    "slice": (text(ONE, "slice 0", "slice 1"), "index", "000001.ply index"),
    "name": (renamed(ONE, "000007.ply"), "names", "000007.ply"),
    "incomplete": (text(ONE, "complete true", "complete false"), "table", "line 4 complete"),
    "no word for complete": (text(ONE, "complete true", "complete yes"), "container", ONE),
    "rate": (text(ONE, "rate_hz 10", "rate_hz 20"), "metadata", "000001.ply rate"),
    "timescale": (text(ONE, "timescale utc", "timescale tai"), "metadata", "timescale"),
    "frame": (text(ONE, "frame_id base_link", "frame_id map"), "metadata", "frame_id"),
    "sensors": (text(ONE, "from 0: left right", "from 0: a b"), "metadata", "sensors"),
    "vertices": (text(ONE, "element vertex ", "element vertex 1"), "container", ONE),
    "more vertices than Python counts": (
        text(ONE, "element vertex ", "element vertex " + "1" * 5000),
        "container",
        ONE,
    ),
    "start beyond all counting": (text(ONE, "start_ns 1", f"start_ns {10**20}1"), "grid", ONE),
    "index beyond all counting": (text(ONE, "index 1", "index " + "1" * 5000), "container", ONE),
    "property": (text(ONE, "property int ring", "property uint ring"), "container", ONE),
    "big endian": (text(ONE, "binary_little", "binary_big"), "container", ONE),
    "cut off": (raw(ONE, lambda data: data[:-7]), "container", ONE),
    "empty": (raw(ONE, lambda data: b""), "container", ONE),
    "no number": (vertex("x", 8, np.nan), "finite", "000001.ply point 8"),
    "time that is none": (vertex("time", 8, np.nan), "times", "000001.ply point 8"),
    "time before the scan": (vertex("time", 8, -1e-9), "times", "000001.ply point 8"),
    "time past the scan": (vertex("time", 8, 0.1011), "times", "000001.ply point 8"),
    "time that steps back": (vertex("time", -1, 0.05), "order", "000001.ply point"),
    "ring of the other": (vertex("ring", -1, -1), "rings", "000001.ply point"),
    "ring that is none": (vertex("ring", 8, 90), "rings", "000001.ply point"),
    "return type": (vertex("return_type", 8, 99), "returns", "000001.ply point 8"),
    "sensor": (vertex("lidar_id", 8, 5), "sensors", "000001.ply point 8"),
    "sensor of others": (vertex("lidar_id", 8, None), "rings", "000001.ply point 8"),
    "scan missing": (removed(ONE), "table", "line 4 scan"),
    "points of a line": (row(2, "points", 1), "table", "line 4 points"),
    "first stamp": (row(2, "first_stamp_ns", lambda n: n + 30_000), "table", "first_stamp_ns"),
    "ledger": (report("capture", "frames", to=0), "ledger", "capture.frames"),
}


@pytest.mark.parametrize("name", PLY)
def test_ply(name: str, tmp_path: Path) -> None:
    edit, check, where = PLY[name]
    places = [(one.check, one.where) for one in spoiled("ply", tmp_path, edit).violations]
    assert any(one == check and where in place for one, place in places), places


# -- nothing to judge -----------------------------------------------------------------------------


def emptied(folder: Path) -> None:
    for file in folder.iterdir():
        file.unlink()


def foreign(path: Path) -> None:
    path.write_bytes(b"\x89MCAP0\r\n" + bytes(100))


NOTHING: dict[str, tuple[str, Callable[[Path], None], str]] = {
    "no such output": ("npz", shutil.rmtree, "no such file or folder"),
    "empty folder": ("npz", emptied, "an empty folder"),
    "folder without scans": (
        "npz",
        both(*(removed(f"{name}.npz") for name in ("head", "000000", "000001", "000002"))),
        "a folder without scans",
    ),
    "scans of strange names": (
        "npz",
        both(*(renamed(f"{n}.npz", f"x{n}.npz") for n in ("head", "000000", "000001", "000002"))),
        "strange names",
    ),
    "first scan damaged": ("npz", raw("head.npz", lambda data: b"PK"), "restore the first scan"),
    "rate that is none": (
        "ply",
        text("head.ply", "rate_hz 10", "rate_hz ten"),
        "expected a positive number of Hz",
    ),
    "report that is no JSON": ("npz", text("report.json", "{", "["), "a report in JSON"),
    "empty file": ("scans.mcap", raw("", lambda data: b""), "an empty file"),
    "other file": ("scans.mcap", raw("", lambda data: b"abc"), "a file of another kind"),
    "damaged MCAP": ("scans.mcap", raw("", lambda data: data[:200_000]), "a whole MCAP file"),
    "foreign MCAP": ("scans.mcap", foreign, "a whole MCAP file"),
    "no grid": ("scans.mcap", text("", "mlbatch.grid", "mlbatch.gird"), "mlbatch.grid"),
    "damaged bag": ("scans.bag", raw("", lambda data: data[:200_000]), "convert again"),
    "bag without scans": ("bag2", removed("bag2_0.mcap"), "a bag with one MCAP file"),
    "metadata that is no YAML": ("bag2", text("metadata.yaml", "version", "\t{"), "wanted YAML"),
}


@pytest.mark.parametrize("name", NOTHING)
def test_one_line_says_what_is_wrong(name: str, tmp_path: Path) -> None:
    kind, edit, words = NOTHING[name]
    with pytest.raises(VerifyError, match=words) as error:
        spoiled(kind, tmp_path, edit)
    assert "\n" not in str(error.value)
    assert str(tmp_path) in str(error.value)


def test_what_an_unfinished_run_left_is_no_output(tmp_path: Path) -> None:
    path = copied("npz", tmp_path)
    left = path.rename(tmp_path / "npz.partial")
    with pytest.raises(VerifyError, match="unfinished"):
        verify(left)
    copied("npz", tmp_path)
    verdict = verify(path)
    assert [(one.check, one.where) for one in verdict.violations] == [("container", "npz.partial")]


def test_a_report_elsewhere_is_taken(tmp_path: Path) -> None:
    path = copied("npz", tmp_path)
    other = (path / "report.json").rename(tmp_path / "told.json")
    without = {check.name: check for check in verify(path).checks}
    assert without["ledger"].outcome == without["report"].outcome == "not provable"
    assert "--report" in without["ledger"].limit
    with_it = {check.name: check.outcome for check in verify(path, other).checks}
    assert with_it["ledger"] == with_it["report"] == "ok"
    with pytest.raises(VerifyError, match="wanted a report"):
        verify(path, tmp_path / "none.json")


def test_a_bag_alone_tells_what_stays_open(tmp_path: Path) -> None:
    path = Path(shutil.copy(made("scans.bag"), tmp_path))
    verdict = verify(path)
    assert verdict.ok
    open_ = {check.name for check in verdict.checks if check.outcome == "not provable"}
    assert {"grid", "index", "t_init", "columns", "table", "ledger", "report"} <= open_
