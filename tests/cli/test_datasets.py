"""Every row of docs/datasets.md: its command, on a look-alike of the dataset.

Expected by hand: each lidar measures (1, 0, 0) in its frame, a column each ms of sweeps of 100 ms
(`tests/builders/datasets.py`); raw packets are counted.
"""

from __future__ import annotations

import json
import math
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mlbatch
from tests.builders import datasets as made
from tests.builders.sessions import REPOSITORY, Outcome, Shell

PAGE = (REPOSITORY / "docs" / "datasets.md").read_text(encoding="utf-8")
RIGS = REPOSITORY / "examples" / "datasets"
ROW = re.compile(r"^\| ([^|`]+) \|[^|]*\| `(mlbatch [^`]+)` \| (.+) \|$", re.MULTILINE)
ROWS: dict[str, tuple[str, str]] = {
    name: (command, last) for name, command, last in ROW.findall(PAGE)
}
CLOUD_COLUMNS = made.SWEEPS * made.COLUMNS
Place = tuple[float, float, float]


@dataclass(frozen=True)
class Row:
    """A dataset: how its look-alike is made, and what a run must give.

    places: by sensor, where (1, 0, 0) of its frame is in the body; packets: of each sensor, 0:
    those of clouds.
    """

    make: Callable[[], None]
    places: dict[str, Place]
    packets: int = 0


def _after_a_quarter(x: float, y: float, z: float) -> Place:
    """A quarter about z turns (1, 0, 0) to (0, 1, 0)."""
    return x, y + 1, z


def _turned(yaw: float, pitch: float, origin: Place) -> Place:
    """(1, 0, 0) after pitch and yaw; roll does not move it."""
    x = math.cos(yaw) * math.cos(pitch)
    y = math.sin(yaw) * math.cos(pitch)
    return origin[0] + x, origin[1] + y, origin[2] - math.sin(pitch)


RAW = made.SCAN_PACKETS * made.SCANS
CONVERTED = {
    # Kit (0.9, 0, 2); the top a quarter about z, optical centres above the mounting faces.
    "Autoware samples": Row(made.autoware, {
        "top": _after_a_quarter(0.9, 0.0, 2.06611),
        "left": (1.9, 0.5, 1.7377), "right": (1.9, -0.5, 1.7377)}, RAW),
    "SubT-MRS": Row(made.subt_mrs, {"velodyne_1": (1.0, 0.0, 0.0)}, RAW),
    "Ford AV": Row(made.ford_av, {
        colour: _after_a_quarter(*place) for colour, place in made.FORD.items()}, RAW),
    "UTBM": Row(made.utbm, {"left": (0.5, 1.4, 1.5), "right": (1.5, 1.4, 1.5)}, RAW),
    "NTU VIRAL": Row(made.ntu_viral, {
        "horizontal": (0.95, 0.0, 0.055), "vertical": _after_a_quarter(-0.55, 0.03, 0.05)}),
    "MCD": Row(made.mcd, {
        "ouster": _after_a_quarter(0.0, 0.1, 0.2), "livox": (1.0, -0.1, 0.2)}),
    "Hilti 2021": Row(made.hilti_2021, {"ouster": (1.0, 0.0, 0.0), "livox": (1.05, 0.0, -0.1)}),
    # The Livox at (0.08, -0.01, -0.18) of the VLP-16: (1.08, -0.01, -0.18) there, and after the
    # quarter (0.01, 1.08, -0.18) + (0.06, 0.01, 0.17).
    "BotanicGarden": Row(made.botanic_garden, {
        "vlp16": _after_a_quarter(0.06, 0.01, 0.17), "livox": (0.07, 1.09, -0.01)}),
    "M3DGR": Row(made.m3dgr, {"avia": (1.1, 0.0, 0.3), "mid360": (1.0, 0.0, 0.5)}),
    # The first column of the Ouster's matrix, and its last.
    "GEODE": Row(made.geode, {
        "velodyne": (1.0961, -0.1338, 0.3032),
        "ouster": (0.998409 - 0.037768, -0.05634 + 0.25853, -0.00218 - 0.389902)}),
    # Named by their topics. Without a base_link the body is the common ancestor, box_base.
    "GrandTour": Row(made.grand_tour, {
        "boxi": _after_a_quarter(0.1, 0.0, 0.3), "boxi_livox": (1.2, 0.0, 0.1)}),
    # Rz(yaw) Ry(pitch) Rx(roll) (1, 0, 0) + t, by the radians of the dataset's README.
    "TIERS": Row(made.tiers, {
        "os0": (0.5**0.5, 0.5**0.5, 0.0),
        "os1": _turned(2.34826, 3.12619, (0.0100882, 0.581502, -0.0210581)),
        "velodyne": _turned(3.07795, 3.09161, (-0.164831, 0.173188, 0.117624)),
        "avia": _turned(0.00549421, 0.000246092, (-0.0608374, 0.29663, -0.122276)),
        "horizon": _turned(3.12905, 3.14022, (0.00345477, 0.145195, -0.134907))}),
    # The left one at (-0.27, 0, -0.22) of the centre, which is 0.28 m above the IMU.
    "UrbanNav": Row(made.urban_nav, {
        "center": (1.0, 0.0, 0.28), "left": _after_a_quarter(-0.27, 0.0, 0.06),
        "right": (1.32, 0.0, 0.08)}),
    "HeLiPR": Row(made.helipr, {
        "ouster": (1.0, 0.0, 1.9), "velodyne": (1.3, 0.0, 1.9), "avia": (1.6, 0.0, 1.8),
        "aeva": (1.6, 0.0, 1.7)}),
    "A2D2": Row(made.a2d2, {
        "front_center": (2.7, 0.0, 0.95),
        "front_left": (1.5 + 0.5**0.5, 0.6 + 0.5**0.5, 0.95)}),
}  # fmt: skip
REFUSED = {
    "Complex Urban": made.complex_urban,
    "nuPlan": made.nuplan,
    "Lyft Level 5": made.lyft,
    "Waymo Open": made.waymo,
    "Argoverse 2": made.argoverse2,
    "PandaSet": made.pandaset,
}


@pytest.fixture
def shell(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> Shell:
    monkeypatch.chdir(tmp_path)
    for rig in RIGS.glob("*.yaml"):
        shutil.copy(rig, tmp_path)
    return Shell(monkeypatch, capsys)


def _command(name: str) -> str:
    return ROWS[name][0].removeprefix("mlbatch ")


def test_every_row_of_the_page_is_run() -> None:
    assert list(ROWS) == [*CONVERTED, *REFUSED]
    named = {word for command, _ in ROWS.values() for word in command.split()}
    assert {rig.name for rig in RIGS.glob("*.yaml")} == {w for w in named if w.endswith(".yaml")}


@pytest.mark.parametrize("rig", sorted(path.name for path in RIGS.glob("*.yaml")))
def test_every_rig_says_where_its_topics_and_poses_are_from(rig: str) -> None:
    text = (RIGS / rig).read_text(encoding="utf-8")
    if "refused" in text.partition("\n")[0]:
        return
    for word in ("Topics", "Poses"):
        assert re.search(rf"^# {word}: \S", text, re.MULTILINE), word


def test_lidars_of_utbm_and_tiers_are_those_of_their_definitions() -> None:
    """Namespaces of the launch file of UTBM; five clouds in the README of TIERS."""
    assert "{topic: /hdl32e_left/velodyne_packets}" in (RIGS / "utbm.yaml").read_text()
    topics = re.findall(r"topic: (\S+)\}", (RIGS / "tiers.yaml").read_text())
    assert topics == ["/os_cloud_node/points", "/os_cloud_nodee/points", "/velodyne_points",
                      "/avia/livox/lidar", "/livox/lidar"]  # fmt: skip


def _run_recipe() -> None:
    """The block of the page."""
    (recipe,) = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    exec(recipe, {})


@pytest.mark.parametrize("name", CONVERTED)
def test_rows_that_are_converted(shell: Shell, name: str) -> None:
    row = CONVERTED[name]
    row.make()
    if name == "A2D2":
        _run_recipe()
    outcome = shell(_command(name))
    assert outcome.code == 0, outcome.err
    report = _report()
    sensors = report["sensors"]
    assert len(sensors) == len(row.places)
    points = _points(len(sensors))
    for number, sensor in enumerate(sensors):
        place = row.places[sensor["name"]]
        pose = np.array(sensor["extrinsics"]["body_from_sensor"])
        np.testing.assert_allclose(pose @ (1, 0, 0, 1), (*place, 1), atol=2e-6)
        packets = sensor["packets"]
        columns = sensor["columns"]
        assert packets["read"] == packets["accepted"] == (row.packets or CLOUD_COLUMNS)
        assert columns["written"] + sum(columns["dropped"].values()) == columns["decoded"]
        assert sensor["points"]["written"] == len(points[number]) > 0
        if not row.packets:
            assert columns["decoded"] == CLOUD_COLUMNS
            # One window may be cut off at each end, with a column that rounding puts there.
            assert columns["written"] >= CLOUD_COLUMNS - 2 * made.COLUMNS - 1
            assert len(points[number]) == made.RINGS * columns["written"]
            np.testing.assert_allclose(points[number], np.tile(place, (len(points[number]), 1)),
                                       atol=1e-5)  # fmt: skip
    assert shell("verify scans.mcap").code == 0


def test_a_lidar_that_the_rig_lacks_is_named(shell: Shell) -> None:
    """TIERS has five lidars: the clouds of one that is not in the rig are counted as unassigned."""
    made.tiers()
    rig = Path("tiers.yaml").read_text(encoding="utf-8")
    Path("four.yaml").write_text(rig.partition("  - name: horizon")[0], encoding="utf-8")
    words = "convert indoor02.bag --rig four.yaml --dry-run"
    outcome = shell(words)
    assert (outcome.code, _warnings(outcome)) == (0, ["not_in_rig"])
    assert "--ignore /livox/lidar" in outcome.err
    report = json.loads(outcome.out)
    assert [one["name"] for one in report["sensors"]] == ["os0", "os1", "velodyne", "avia"]
    (one,) = report["unassigned"]
    assert (one["stream"], one["packets"]) == ("/livox/lidar", CLOUD_COLUMNS)
    assert one["what"].startswith("not_in_rig: ")
    strict = shell(f"{words} --strict")
    assert (strict.code, "(not_in_rig, an error because of --strict)" in strict.err) == (1, True)
    ignored = shell(f"{words} --strict --ignore /livox/lidar")
    assert (ignored.code, _warnings(ignored)) == (0, [])
    table = shell("inspect indoor02.bag --rig four.yaml")
    assert "/livox/lidar: " in table.out + table.err


@pytest.mark.parametrize(
    ("topic", "frame", "codes"),
    [
        ("/velodyne_points_filtered", "velodyne", []),
        ("/left/cropped/points", "base_link", []),
        ("/right/points", "velodyne_2", ["not_in_rig"]),
    ],
)
def test_clouds_made_from_those_in_the_rig_are_no_lidars(
    shell: Shell, topic: str, frame: str, codes: list[str]
) -> None:
    """Copies have the stamps of the headers, in the frame or the namespace of their source."""
    shift_ns = 2 if codes else 0
    source = ("/left/points", made.VELODYNE, made.before_end_s)
    copy = made.clouds(topic, *source[1:], frame=frame, header_ns=made.LAST, clock_ns=shift_ns)
    depth = made.clouds("/camera/depth/points", made.XYZI, lambda *_: 0.0)
    made.bag("d.bag", made.clouds(*source, frame="velodyne", header_ns=made.LAST), copy, depth)
    stream = "stream: {topic: /left/points}, points: {from: end}"
    Path("rig.yaml").write_text(f"sensors: [{{name: left, {stream}}}]\n", encoding="utf-8")
    outcome = shell("convert d.bag --rig rig.yaml --dry-run")
    assert (outcome.code, _warnings(outcome)) == (0, codes), outcome.err


@pytest.mark.parametrize("name", [name for name, row in CONVERTED.items() if not row.packets])
def test_points_are_at_the_times_they_were_measured(shell: Shell, name: str) -> None:
    """Columns of all lidars n ms after the start; float32 and float64 seconds are rounded."""
    row = CONVERTED[name]
    row.make()
    if name == "A2D2":
        _run_recipe()
    command = _command(name).replace("scans.mcap", "scans") + " --keep-partial"
    assert shell(command).code == 0
    found: dict[int, set[int]] = {}
    for path in sorted(Path("scans").glob("*.npz")):
        with np.load(path) as scan:
            for stamp, lidar in zip(
                scan["column_stamp_ns"].tolist(), scan["column_lidar_id"].tolist(), strict=True
            ):
                found.setdefault(lidar, set()).add(round((stamp - made.START_NS) / 1e4) * 10_000)
    expected = {
        number * made.SWEEP + column * made.MS
        for number in range(made.SWEEPS)
        for column in range(made.COLUMNS)
    }
    for lidar in range(len(row.places)):
        # Rounding may put the first column into the window before the first.
        assert expected - found[lidar] <= {0}, lidar
        assert found[lidar] <= expected, lidar


def _warnings(outcome: Outcome) -> list[str]:
    """Codes without those for information."""
    return [code for code in outcome.warnings if code != "clouds"]


def _report() -> dict[str, Any]:
    (path,) = [one for one in Path().glob("scans*.json") if "report" in one.name]
    found: dict[str, Any] = json.loads(path.read_text())
    return found


def _points(lidars: int) -> list[Any]:
    """Points of each lidar, (p, 3)."""
    parts: list[list[Any]] = [[] for _ in range(lidars)]
    for scan in mlbatch.read(Path("scans.mcap")):
        for lidar, found in enumerate(parts):
            found.append(scan.xyz[scan.lidar_id == lidar])
    return [np.concatenate(found) for found in parts]


@pytest.mark.parametrize("name", REFUSED)
def test_rows_that_are_refused(shell: Shell, name: str) -> None:
    REFUSED[name]()
    outcome = shell(_command(name))
    assert outcome.code == 1
    assert ROWS[name][1] in outcome.err
    assert outcome.err.startswith("mlbatch: error: ")
    assert outcome.err.count("\n") == 1
    assert not [path for path in Path().iterdir() if path.name.startswith("scans")]


# -- what goes wrong without the rows' rigs -------------------------------------------------------


def test_the_offsets_of_tiers_are_those_of_the_error(shell: Shell) -> None:
    made.tiers()
    rig = Path("tiers.yaml").read_text()
    clock = re.compile(r"^    clock: .*\n", re.MULTILINE)
    Path("plain.yaml").write_text(clock.sub("", rig))
    outcome = shell("convert indoor02.bag --rig plain.yaml -o scans.mcap")
    assert outcome.code == 1
    given = re.findall(r"(\w+) clock: \{offset_s: ([\d.]+)\}", outcome.err)
    assert given == [("os0", "1699999500.000"), ("os1", "1699999500.000")]


def test_undistorted_clouds_of_grand_tour_are_refused(shell: Shell) -> None:
    made.bag(
        "mission/m_hesai_undist.bag",
        made.clouds(
            "/boxi/hesai/points_undistorted", made.HESAI, made.since_1970_s, frame="hesai_lidar"
        ),
    )
    outcome = shell("convert mission/*.bag -o scans.mcap")
    assert outcome.code == 1
    assert "points_undistorted: expected points where they were measured" in outcome.err


@pytest.mark.parametrize(("name", "make"), [("ntu_viral", made.ntu_viral), ("mcd", made.mcd)])
def test_headers_at_the_end_are_warned_about_without_a_rule(
    shell: Shell, name: str, make: Callable[[], None]
) -> None:
    make()
    rig = Path(f"{name}.yaml").read_text()
    Path("plain.yaml").write_text(re.sub(r"^    points: .*\n", "", rig, flags=re.MULTILINE))
    recording = _command({"ntu_viral": "NTU VIRAL", "mcd": "MCD"}[name]).split()[1]
    outcome = shell(f"convert {recording} --rig plain.yaml -o scans.mcap")
    assert outcome.code == 0
    assert "points are up to 94.0 ms later than the log time of their message" in outcome.err
    assert "points: {from: end}" in outcome.err
