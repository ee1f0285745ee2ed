"""Golden files: what they contain, that equal outputs are equal, and what is found."""

from __future__ import annotations

import copy
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mlbatch
from mlbatch.digests import compare, golden_text, read_golden
from mlbatch.digests.golden import describe
from mlbatch.errors import MlbatchError
from tests.builders.run import TWO_LIDARS, command
from tests.verification.edits import edit_of

CAPTURE = TWO_LIDARS / "two_lidars.pcap"
RIG = TWO_LIDARS / "rig.yaml"
FORMATS = {
    "npz": ("out", ()),
    "organized": ("out", ("--layout", "organized")),
    "split": ("out", ("--split",)),
    "ply": ("out", ("--format", "ply")),
    "mcap": ("out.mcap", ()),
    "mcap split": ("out.mcap", ("--split", "--slices", "2")),
    "rosbag1": ("out.bag", ()),
    "rosbag2": ("out", ("--format", "rosbag2", "--compression", "zstd")),
}
# The first sensor is moved by 0.1 mm; its clock is 1 us ahead.
MOVED = ("translation_m: [0.3, 0.95, 2.45]", "translation_m: [0.3, 0.9501, 2.45]")
LATER = ("    metadata: left.json", "    metadata: left.json\n    clock: {offset_s: 0.000001}")
LOST = ("--fault", "drop:left:1%")
Golden = dict[str, Any]


def convert(folder: Path, kind: str, *options: str | Path, rig: Path = RIG) -> Path:
    """The fixture in a format."""
    name, own = FORMATS[kind]
    folder.mkdir(exist_ok=True)
    words = (CAPTURE, "--rig", rig, "-o", folder / name, "--quiet", *own, *options)
    done = command("convert", *words)
    assert done.code == 0, done.err
    return folder / name


def other_rig(folder: Path, change: tuple[str, str]) -> Path:
    """The rig of the fixture with a text replaced."""
    text = RIG.read_text(encoding="utf-8")
    assert change[0] in text
    for name in ("left.json", "right.json"):
        (folder / name).write_bytes((TWO_LIDARS / name).read_bytes())
    (folder / "rig.yaml").write_text(text.replace(*change), encoding="utf-8")
    return folder / "rig.yaml"


def without_report(golden: Golden) -> Golden:
    """The scans alone: what their points and stamps say."""
    return golden | {"run": {}}


def fields(golden: Golden, scan: int = 0) -> Golden:
    """The fields of a scan."""
    found: Golden = golden["scans"][scan]["fields"]
    return found


# -- content ----------------------------------------------------------------------------------


def test_a_field_is_described_by_checksum_statistics_and_four_points() -> None:
    array = np.array([1.5, 0.25, 9.0, -2.0, 0.125, 4.0, 1.0], np.float32)
    # printf "\\0\\0\\300\\077..." | sha256sum, the bytes of IEEE 754 written by hand.
    found = describe(array, None)
    assert found == {
        "sha256": "aef6e6143f2f43fa",
        "mean": pytest.approx(13.875 / 7, abs=1e-9),
        "min": -2.0,
        "max": 9.0,
        "samples": [1.5, 9.0, 0.125, 1.0],
    }


def test_empty_slots_have_no_part_in_statistics() -> None:
    array = np.array([[np.nan, 3.0], [5.0, np.nan]], np.float32)
    found = describe(array, np.isfinite(array))
    assert (found["mean"], found["min"], found["max"]) == (4.0, 3.0, 5.0)
    assert found["samples"] == [3.0, 3.0, 3.0, 5.0]


def test_an_array_without_values_has_only_a_checksum() -> None:
    # SHA-256 of nothing.
    assert describe(np.zeros(0, np.uint8), None) == {"sha256": "e3b0c44298fc1c14"}


def test_counts_are_those_of_the_scene(tmp_path: Path) -> None:
    """Figures of fixtures/two_lidars/SOURCE.md."""
    golden: Golden = mlbatch.digest(convert(tmp_path, "npz"))
    assert [scan["points"] for scan in golden["scans"]] == [27998] * 7
    assert [scan["columns"] for scan in golden["scans"]] == [[512, 512]] * 7
    assert golden["run"]["grid"]["t_init_ns"] == golden["scans"][0]["start_ns"]
    assert [one["packets"]["read"] for one in golden["run"]["sensors"]] == [271, 271]
    assert golden["run"]["warnings"] == []


def test_a_file_gives_the_document_back(tmp_path: Path) -> None:
    golden = mlbatch.digest(convert(tmp_path, "mcap"))
    path = tmp_path / "golden.json"
    path.write_text(golden_text(golden), encoding="utf-8")
    assert read_golden(path) == golden | {"version": mlbatch.__version__}
    # A line a scan.
    lines = path.read_text(encoding="utf-8").splitlines()
    assert sum('"index"' in line for line in lines) == 7


# -- the same ---------------------------------------------------------------------------------


def test_an_mcap_file_alone_has_its_report_inside(tmp_path: Path) -> None:
    output = convert(tmp_path, "mcap")
    golden = mlbatch.digest(output)
    alone = tmp_path / "alone.mcap"
    output.rename(alone)
    assert mlbatch.digest(alone) == golden


# -- found ------------------------------------------------------------------------------------


# Another rig, options, a difference of the run, and one of the scans without their report.
FOUND: dict[str, tuple[tuple[str, str], tuple[str, ...], str, str]] = {
    "a tenth of a millimetre": (MOVED, (), "run.sensors[0].body_from_sensor[1][3]", " xyz "),
    "one percent of loss": (("", ""), LOST, "run.sensors[0].packets.lost", " points"),
    "a microsecond of clock": (LATER, (), "", " time_ns "),
}


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("name", FOUND)
def test_a_small_change_is_found(name: str, kind: str, tmp_path: Path) -> None:
    change, options, of_run, of_scans = FOUND[name]
    rig = other_rig(tmp_path, change)
    golden = mlbatch.digest(convert(tmp_path / "a", kind))
    other = mlbatch.digest(convert(tmp_path / "b", kind, *options, rig=rig))
    if of_run:
        assert of_run in [one.where for one in compare(golden, other).differences]
    # Also where there is no report.
    bare = compare(without_report(golden), without_report(other)).differences
    assert any(of_scans in one.where for one in bare)


@pytest.fixture(scope="module")
def npz(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The fixture as npz, not to be changed."""
    return convert(tmp_path_factory.mktemp("npz"), "npz")


# Changes of a document, of `o` and its scan `s`, and the difference that they are.
CHANGES = {
    "s['fields']['xyz']['mean'][1] += 0.00004": "scan 000003 xyz mean[1]",
    "s['fields']['range_m']['samples'][2] -= 0.001": "scan 000003 range_m samples[2]",
    "s['fields']['ring']['max'] += 1": "scan 000003 ring max",
    # Other bytes with the same figures.
    "s['fields']['ring']['mean'] += 0": "scan 000003 ring sha256",
    "s['fill'][0] -= 0.0001": "scan 000003 fill[0]",
    "s['points'] -= 1": "scan 000003 points",
    "s['columns'][1] += 1": "scan 000003 columns[1]",
    "s['start_ns'] += 1": "scan 000003 start_ns",
    "del o['scans'][2]": "scan 000002 points",
    "del s['fields']['ring']": "scan 000003 ring",
    "o['run']['warnings'] = ['loss left']": "run.warnings",
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_of_a_document_is_found(change: str, npz: Path) -> None:
    golden: Golden = mlbatch.digest(npz)
    other = copy.deepcopy(golden)
    scan = other["scans"][3]
    if "fields" in change:
        scan["fields"][change.split("'")[3]]["sha256"] = "0" * 16
    exec(change, {"o": other, "s": scan})
    for pair in ((golden, other), (other, golden)):
        assert [one.where for one in compare(*pair).differences] == [CHANGES[change]]


# Points that are moved, and the scans of these numbers. None of the points is first, last, lowest,
# highest or between, and sums of 27,998 coordinates hide them.
MOVED_POINTS: dict[str, tuple[dict[int, float], range]] = {
    "one point by 0.5 m": ({5000: 0.5}, range(7)),
    "eight points by 0.1 m": (dict.fromkeys(range(5000, 5008), 0.1), range(7)),
    "a pair by +5 m and -5 m": ({5000: 5.0, 5001: -5.0}, range(0, 7, 2)),
    "one point by one step of float32": ({5000: 1e-6}, range(3, 4)),
}


@pytest.mark.parametrize("name", MOVED_POINTS)
def test_moved_points_are_found_in_every_scan(name: str, npz: Path, tmp_path: Path) -> None:
    moves, scans = MOVED_POINTS[name]
    output = tmp_path / "out"
    shutil.copytree(npz, output)
    golden = tmp_path / "golden.json"
    assert command("digest", npz, "-o", golden).code == 0
    for number in scans:
        for point, by_m in moves.items():
            edit_of(f"add {number:06d}.npz xyz ({point},2) {by_m}")(output)
        with (
            np.load(npz / f"{number:06d}.npz") as old,
            np.load(output / f"{number:06d}.npz") as new,
        ):
            moved = np.flatnonzero((old["xyz"] != new["xyz"]).any(axis=1)).tolist()
        assert moved == list(moves)
    ended = command("digest", output, "--against", golden)
    assert ended.code == 1
    named = {line.split(":")[0].split()[1] for line in ended.out.splitlines()}
    assert named == {f"{number:06d}" for number in scans}
    # The version that made the golden file.
    assert mlbatch.__version__ in ended.err


@pytest.mark.parametrize("schema", ["mlbatch.digest/1", "mlbatch.digest/2"])
def test_files_of_earlier_schemas_are_read(schema: str, npz: Path, tmp_path: Path) -> None:
    """They have other keys: `four` for `samples`, and those of schema 1 no version."""
    golden: Golden = mlbatch.digest(npz)
    path = tmp_path / "golden.json"
    text = json.dumps(golden | {"schema": schema}).replace('"samples":', '"four":')
    path.write_text(text, encoding="utf-8")
    assert command("digest", npz, "--against", path).code == 0
    other = copy.deepcopy(golden)
    fields(other)["xyz"]["sha256"] = "0" * 16
    fields(other)["xyz"]["samples"][1][2] += 0.5
    places = [one.where for one in compare(read_golden(path), other).differences]
    assert places == ["scan 000000 xyz samples[1][2]"]


# -- the command ------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["", "[]", "{", '{"schema": "mlbatch.report/1"}', "null"])
def test_another_file_is_no_golden_file(text: str, tmp_path: Path) -> None:
    path = tmp_path / "golden.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(MlbatchError, match="golden file"):
        read_golden(path)


def test_any_json_in_a_golden_file_is_a_difference(tmp_path: Path) -> None:
    golden: Golden = mlbatch.digest(convert(tmp_path, "npz"))
    several: tuple[list[Any], ...] = (
        [None],
        [1, "a"],
        [{"index": {}}],
        [{"index": 0, "fields": 3}],
    )
    for scans in several:
        broken = json.loads(json.dumps({"schema": golden["schema"], "scans": scans}))
        assert not compare(broken, golden).ok
