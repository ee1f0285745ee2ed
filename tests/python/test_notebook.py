"""What notebooks use: short texts, tables, drawings, documents as dicts, pages."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import mlbatch
from mlbatch.errors import MlbatchError, UsageError
from mlbatch.python.recording import Recording
from tests.builders.sessions import CAPTURE, FIXTURE
from tests.contract.tree import run_python
from tests.python.test_dataset import assert_equal


@pytest.fixture(scope="module")
def rec() -> Recording:
    return mlbatch.open(CAPTURE, rig=FIXTURE / "rig.yaml")


def test_every_object_is_a_line_and_a_table(rec: Recording, tmp_path: Path) -> None:
    run = mlbatch.convert(rec, tmp_path / "a<b>.mcap")
    for shown, words in (
        (rec, "left, right"),
        (rec[0]["left"], "points of left, 17"),
        (run, "a<b>.mcap: 7 scans of left, right"),
        (mlbatch.inspect(CAPTURE), "ouster_122647000123 OS-0-32-U1"),
        (mlbatch.dataset(tmp_path / "a<b>.mcap"), "7 scans of 1 output"),
    ):
        assert words in repr(shown)
        assert len(repr(shown)) < 120
        assert "\n" not in repr(shown)
        if hasattr(shown, "_repr_html_"):
            table = shown._repr_html_()
            assert table.startswith(("<pre>", "<table>"))
            assert "<b>" not in table


def test_help_fits_a_screen() -> None:
    printed = run_python("import mlbatch; help(mlbatch.open)")
    assert len(printed.splitlines()) <= 24


def test_documents_instead_of_files(
    rec: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Paths in a rig that is given as a dict begin at the current folder."""
    monkeypatch.chdir(FIXTURE)
    rig = yaml.safe_load((FIXTURE / "rig.yaml").read_text("utf-8"))
    rig["sensors"][0]["extrinsics"]["translation_m"] = np.array([0.3, 0.95, 2.45])
    opened = mlbatch.open(CAPTURE, rig=rig)
    monkeypatch.chdir(tmp_path)
    assert_equal(opened[2], rec[2])
    documents = {
        name: json.loads((FIXTURE / f"{name}.json").read_text("utf-8"))
        for name in ("left", "right")
    }
    given: tuple[Any, ...] = (documents, list(documents.values()))
    for metadata in given:
        opened = mlbatch.open(CAPTURE, metadata=metadata, identity_extrinsics=True)
        assert len(opened.sensors) == 2
    assert len(mlbatch.inspect(CAPTURE, metadata=documents).files) == 2
    wrongs: tuple[Any, ...] = ({"left": "left.json"}, {"../left": {}}, [{"a": object()}])
    for wrong in wrongs:
        with pytest.raises(UsageError, match="metadata: expected"):
            mlbatch.open(CAPTURE, metadata=wrong)


def test_a_scan_is_drawn(rec: Recording) -> None:
    pytest.importorskip("matplotlib").use("agg")
    scan = rec[0]
    for color, values in (("height", scan.xyz[:, 2]), ("lidar", scan.lidar_id)):
        (drawn,) = scan.plot(color).collections
        np.testing.assert_allclose(drawn.get_offsets(), scan.xyz[:, :2])
        np.testing.assert_array_equal(drawn.get_array(), values)
    with pytest.raises(UsageError, match="color: expected one of height, time"):
        scan.plot("depth")


def test_pages_by_functions_with_the_names_of_packages(tmp_path: Path) -> None:
    mlbatch.convert(CAPTURE, tmp_path / "s.mcap", rig=FIXTURE / "rig.yaml")
    page = mlbatch.report(tmp_path / "s.mcap", html_scans=2)
    assert page == tmp_path / "s.mcap.html"
    assert page.read_text("utf-8").startswith("<!DOCTYPE html>")
    with pytest.raises(MlbatchError, match="replace it with --overwrite"):
        mlbatch.report(tmp_path / "s.mcap")
    with pytest.raises(UsageError, match="html_scans: expected"):
        mlbatch.report(tmp_path / "s.mcap", html_scans=0, overwrite=True)
    found = mlbatch.compare(CAPTURE, FIXTURE / "rig.yaml", html=tmp_path / "c.html")
    assert found.rate_hz == "10"
    assert (tmp_path / "c.html").exists()
    for wrong in (0, -1, math.inf, math.nan):
        with pytest.raises(UsageError, match="tolerance: expected"):
            mlbatch.compare(CAPTURE, tolerance=wrong)


def test_paths_are_checked_at_the_call(tmp_path: Path) -> None:
    for call in (mlbatch.read, mlbatch.scans, mlbatch.open, mlbatch.dataset, mlbatch.inspect):
        with pytest.raises(MlbatchError, match=r"absent\.mcap: expected .*found"):
            call(tmp_path / "absent.mcap")
