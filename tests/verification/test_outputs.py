"""What a verdict says of outputs that lack a part, are rewritten, or compressed."""

from __future__ import annotations

import importlib
import shutil
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest
import zstandard

from mlbatch.outputs.damage import CheckLog, DamageError
from mlbatch.outputs.mcap_file import unpacked
from mlbatch.outputs.metadata import metadata_of_grid
from mlbatch.verification import VerifyError, verify
from tests.builders.rewritten_outputs import bag, mcap
from tests.builders.verify_outputs import copied, damaged, made
from tests.verification.edits import edit_of

MB = 1 << 20
PACK: dict[str, Callable[[bytes], bytes]] = {
    "zstd": zstandard.ZstdCompressor().compress,
    "lz4": importlib.import_module("lz4.frame").compress,
}


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


@pytest.mark.parametrize("kind", ["kitti", "nuscenes"])
def test_without_a_report_the_grid_is_unknown(kind: str, tmp_path: Path) -> None:
    verdict = damaged(kind, tmp_path, edit_of("remove report.json"))
    assert verdict.ok
    outcomes = {check.name: check.outcome for check in verdict.checks}
    assert outcomes["grid"] == outcomes["report"] == "not checkable"


def test_numbers_that_python_refuses_are_none() -> None:
    log = CheckLog()
    metadata = metadata_of_grid(log, "out.mcap", {"slices": "9" * 5000, "t_init_ns": "9" * 19})
    assert (metadata.slices, metadata.t_init_ns) == (None, 10**19 - 1)
    assert "out.mcap mlbatch.grid slices" in [one.where for one in log.violations]


def test_frames_are_named_in_order(tmp_path: Path) -> None:
    """The order in a set depends on the process."""
    edit = edit_of("message /tf_static 0 words base cars")
    found = {one.where: one for one in damaged("scans.mcap", tmp_path, edit).violations}
    root = found["scans.mcap /tf_static message 0 root"]
    assert (root.expected, root.found) == ("['base_link']", "['base_link', 'cars_link']")


@pytest.mark.parametrize(
    "kind", ["scans.mcap", "split.mcap", "organized.mcap", "bag2", "scans.bag"]
)
def test_rewritten_files_are_clean(kind: str, tmp_path: Path) -> None:
    verdict = damaged(kind, tmp_path, bag(lambda sent: [sent]) if kind == "scans.bag" else mcap())
    assert verdict.ok, verdict.violations


@pytest.mark.parametrize("name", PACK)
def test_compressed_chunks_are_checked_alike(name: str) -> None:
    plain, packed = verify(made("scans.mcap")), verify(made(f"{name}.mcap"))
    assert packed.ok, packed.violations
    assert [(one.name, one.checked) for one in packed.checks] == [
        (one.name, one.checked) for one in plain.checks
    ]
    assert made(f"{name}.mcap").stat().st_size < made("scans.mcap").stat().st_size


@pytest.mark.parametrize("name", PACK)
def test_declared_sizes_bound_memory(name: str) -> None:
    """256 MB of zeros in a chunk."""
    packed = PACK[name](bytes(256 * MB))
    tracemalloc.start()
    try:
        with pytest.raises(DamageError):
            unpacked(name, packed, 1000)
        with pytest.raises(DamageError):
            unpacked(name, packed[: len(packed) // 100], 300 * MB * 256)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert most < 8 * MB
    assert len(unpacked(name, packed, 256 * MB)) == 256 * MB
