"""Scans of outputs by number are those of `mlbatch.read`."""

from __future__ import annotations

import multiprocessing
import pickle
import shutil
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mlbatch
from mlbatch.errors import RecordingError, UsageError
from mlbatch.python.recording import Recording
from tests.builders.sessions import FIXTURE
from tests.outputs.test_read import FORMATS

OPTIONS: dict[str, dict[str, Any]] = {
    "plain": {},
    "split": {"split": True, "slices": 3},
    "head": {"keep_partial": True, "layout": "organized"},
    "sweeps": {"batching": "latest"},
}
CASES = [
    *((name, kind, word) for name, kind in FORMATS for word in ("plain", "split")),
    *((name, kind, "sweeps") for name, kind in FORMATS[:5]),
    *((name, kind, "head") for name, kind in FORMATS[:5]),
]


@pytest.fixture(scope="module")
def rec() -> Recording:
    return mlbatch.open(FIXTURE / "two_lidars.pcap", rig=FIXTURE / "rig.yaml")


def assert_equal(one: mlbatch.Scan, other: mlbatch.Scan) -> None:
    """Equal in every field, also where values are NaN."""
    for field in fields(mlbatch.Scan):
        found, expected = getattr(one, field.name), getattr(other, field.name)
        if isinstance(expected, np.ndarray):
            assert found.dtype == expected.dtype, field.name
            np.testing.assert_array_equal(found, expected, err_msg=field.name)
        elif field.name != "info":
            assert found == expected, field.name
    assert one.info[1:] == other.info[1:]
    assert [sensor.name for sensor in one.info.sensors] == list(other.sensors)


def _assert_as_read(path: Path) -> None:
    found = mlbatch.dataset(path)
    scans = list(mlbatch.read(path))
    assert len(found) == len(scans) > 0
    # In another order than that of the file.
    for number in reversed(range(len(scans))):
        assert_equal(found[number], scans[number])
    table = found.table
    assert table["start_ns"].tolist() == [scan.start_ns for scan in scans]
    assert table["index"].tolist() == [scan.index for scan in scans]
    assert table["slice"].tolist() == [scan.slice for scan in scans]
    assert table["sensor"].tolist() == [scan.sensor for scan in scans]
    is_split = scans[0].sensor != ""
    points = [-1 if is_split else scan.point_count for scan in scans]
    assert table["points"].tolist() == points
    assert set(table["session"]) == {path.name}


@pytest.mark.parametrize(("name", "kind", "word"), CASES)
def test_every_scan_is_that_of_read(
    name: str, kind: str | None, word: str, rec: Recording, tmp_path: Path
) -> None:
    mlbatch.convert(rec, tmp_path / name, format=kind, **OPTIONS[word])
    _assert_as_read(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("zstd.mcap", {"compression": "zstd"}),
        ("lz4.mcap", {"compression": "lz4", "point_layout": "hesai"}),
        ("bag", {"format": "rosbag2", "max_bag_duration": 0.2}),
    ],
)
def test_packed_chunks_and_bags_of_several_files(
    name: str, options: dict[str, Any], rec: Recording, tmp_path: Path
) -> None:
    mlbatch.convert(rec, tmp_path / name, **options)
    _assert_as_read(tmp_path / name)


@pytest.fixture
def outputs(rec: Recording, tmp_path: Path) -> Path:
    """Two outputs, an unfinished one, a shard, and files that are none."""
    folder = tmp_path / "out"
    folder.mkdir()
    mlbatch.convert(rec, folder / "a.mcap", rate=20, keep_partial=True)
    mlbatch.convert(rec, folder / "b", format="npz", rate=20)
    shutil.copytree(folder / "b", folder / "c.partial")
    shutil.copytree(folder / "b", folder / "d")
    (folder / "d" / "shard.json").write_text("{}", "utf-8")
    (folder / "notes.txt").write_text("", "utf-8")
    return folder


def test_many_outputs(outputs: Path) -> None:
    found = mlbatch.dataset(f"{outputs}/*")
    both = [*mlbatch.read(outputs / "a.mcap"), *mlbatch.read(outputs / "b")]
    assert len(found) == len(both)
    assert_equal(found[-1], both[-1])
    assert_equal(found[len(found) - 2], both[-2])
    assert [path.name for path in found.skipped] == ["c.partial", "d"]
    part = found[1:-1:3]
    assert_equal(part[1], both[4])
    assert part.table.tolist() == found.table[1:-1:3].tolist()
    assert len(found[5:5]) == len(found[5:5].table) == 0
    for number in (len(found), -len(found) - 1):
        with pytest.raises(IndexError, match=str(len(found))):
            found[number]
    assert [scan.start_ns for scan in found] == [scan.start_ns for scan in both]


def test_other_processes_read_the_same(outputs: Path) -> None:
    """Forked and spawned ones, as workers of a torch DataLoader."""
    found = mlbatch.dataset(f"{outputs}/*")
    assert_equal(pickle.loads(pickle.dumps(found))[3], found[3])
    order = np.random.default_rng(3).permutation(len(found)).tolist()
    for method in ("fork", "spawn"):
        with multiprocessing.get_context(method).Pool(2) as pool:
            for number, scan in zip(order, pool.imap(found.__getitem__, order), strict=True):
                assert_equal(scan, found[number])


def _points_or_error(found: mlbatch.Dataset, number: int) -> int | str:
    try:
        return found[number].point_count
    except RecordingError as err:
        return str(err)


def _flip(path: Path, at: int) -> None:
    data = bytearray(path.read_bytes())
    data[at] ^= 0xFF
    path.write_bytes(data)


def test_damage_is_an_error_of_its_file_or_chunk_alone(outputs: Path) -> None:
    found = mlbatch.dataset(outputs / "a.mcap", outputs / "b")
    _flip(outputs / "b" / "000002.npz", 5000)
    # A chunk of 4 MB holds several scans of this size.
    _flip(outputs / "a.mcap", 1 << 20)
    first = len(mlbatch.dataset(outputs / "a.mcap"))
    points = [_points_or_error(found, number) for number in range(len(found))]
    damaged = [number for number, one in enumerate(points) if isinstance(one, str)]
    whole = np.setdiff1d(np.arange(len(found)), damaged)
    assert [points[number] for number in whole] == found.table["points"][whole].tolist()
    assert all("a.mcap" in str(points[number]) for number in damaged[:-1])
    assert "000002.npz" in str(points[damaged[-1]])
    chunk = len(damaged) - 1
    assert 0 < chunk < first
    assert damaged == [*range(chunk), first + 2]


def test_what_is_no_finished_output_is_refused(outputs: Path) -> None:
    for path, words in (
        (outputs / "c.partial", "unfinished"),
        (outputs / "d", "shard"),
        (outputs / "b" / "000001.npz", "one file of a folder"),
        (outputs / "absent.mcap", "No such file"),
        (FIXTURE / "two_lidars.pcap", "another kind"),
    ):
        with pytest.raises(RecordingError, match=words):
            mlbatch.dataset(path)
    with pytest.raises(UsageError, match="1 other path"):
        mlbatch.dataset(f"{outputs}/*.txt")
    with pytest.raises(UsageError, match="name an output"):
        mlbatch.dataset()
