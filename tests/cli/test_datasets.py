"""Every recipe: its command on a look-alike of the dataset, its facts, and its row of the page.

Expected by hand: each lidar measures (1, 0, 0) in its frame, a column each ms of sweeps of 100 ms
(`tests/builders/datasets.py`); raw packets are counted. Poses that a recipe does not know are
entered in a copy of it: lidar n at (n, 0, 0).
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mlbatch
from mlbatch.errors import RigError
from mlbatch.rig.recipes import FACTS, FOLDER, MARKS, UNKNOWN, recipe, recipe_names
from mlbatch.rig.rig import read_rig
from mlbatch.rig.yaml_tree import read_yaml
from tests.builders import datasets as made
from tests.builders.bags import Recorded
from tests.builders.points import CLOUD, Form, cloud_of
from tests.builders.run import Outcome
from tests.builders.sessions import REPOSITORY, Shell, report_of
from tests.builders.time_readings import SWEEP_NS, drive, scenario

PAGE = (REPOSITORY / "docs" / "datasets.md").read_text(encoding="utf-8")
CLOUD_COLUMNS = made.SWEEPS * made.COLUMNS
Place = tuple[float, float, float]


@dataclass(frozen=True)
class Row:
    """A dataset: how its look-alike is made, and what a run must give.

    places: by sensor, where (1, 0, 0) of its frame is in the body; packets: of each sensor, 0:
    those of clouds; tolerance_m: larger where a matrix is rounded.
    """

    make: Callable[[], None]
    places: dict[str, Place]
    packets: int = 0
    tolerance_m: float = 2e-6


def _after_a_quarter(x: float, y: float, z: float) -> Place:
    """A quarter about z turns (1, 0, 0) to (0, 1, 0)."""
    return x, y + 1, z


def _turned(yaw: float, pitch: float, origin: Place) -> Place:
    """(1, 0, 0) after pitch and yaw; roll does not move it."""
    x = math.cos(yaw) * math.cos(pitch)
    y = math.sin(yaw) * math.cos(pitch)
    return origin[0] + x, origin[1] + y, origin[2] - math.sin(pitch)


def _entered(*names: str) -> dict[str, Place]:
    return {name: (1.0 + number, 0.0, 0.0) for number, name in enumerate(names)}


VIEWS = ("front_center", "front_left", "front_right", "side_left", "side_right", "rear_center")
# (qx, qy) = (H, -H) turns (1, 0, 0) to (0, -1, 0).
PANDAR = (-0.001, -1.00855, 0.055)
CONVERTED = {
    # Kit (0.9, 0, 2); the top a quarter about z, optical centres above the mounting faces.
    "autoware": Row(made.autoware, {
        "top": _after_a_quarter(0.9, 0.0, 2.06611),
        "left": (1.9, 0.5, 1.7377), "right": (1.9, -0.5, 1.7377)}, made.RAW),
    "subt_mrs": Row(made.subt_mrs, {"velodyne": (1.0, 0.0, 0.0)}, made.RAW),
    "ford_av": Row(made.ford_av, {
        colour: _after_a_quarter(*place) for colour, place in made.FORD.items()}, made.RAW),
    "utbm": Row(made.utbm, {"left": (0.5, 1.4, 1.5), "right": (1.5, 1.4, 1.5)}, made.RAW),
    "ntu_viral": Row(made.ntu_viral, {
        "horizontal": (0.95, 0.0, 0.055), "vertical": _after_a_quarter(-0.55, 0.03, 0.05)}),
    "mcd": Row(made.mcd, {
        "ouster": _after_a_quarter(0.0, 0.1, 0.2), "livox": (1.0, -0.1, 0.2)}),
    "hilti_2021": Row(made.hilti_2021, {"ouster": (1.0, 0.0, 0.0), "livox": (1.0, 0.0, 0.0)}),
    "hilti_2022": Row(made.hilti_2022, {"pandar": PANDAR}),
    "hilti_2023": Row(made.hilti_2023, {"pandar": PANDAR}),
    # The Livox at (0.08, -0.01, -0.18) of the VLP-16: (1.08, -0.01, -0.18) there, and after the
    # quarter (0.01, 1.08, -0.18) + (0.06, 0.01, 0.17).
    "botanic_garden": Row(made.botanic_garden, {
        "vlp16": _after_a_quarter(0.06, 0.01, 0.17), "livox": (0.07, 1.09, -0.01)}),
    "m3dgr": Row(made.m3dgr, _entered("avia", "mid360")),
    # First columns of the matrices, and their last; that of alpha has four digits.
    "geode": Row(made.geode, {
        "velodyne": (0.9999 + 0.0961, -0.0050 - 0.1338, -0.0153 + 0.3032),
        "ouster": (0.998409 - 0.037768, -0.05634 + 0.25853, -0.00218 - 0.389902)},
        tolerance_m=1e-4),
    # box_base is at (0, 0, 0.5) of base.
    "grand_tour": Row(made.grand_tour, {
        "hesai": _after_a_quarter(0.1, 0.0, 0.8), "livox": (1.2, 0.0, 0.6)}),
    # Rz(yaw) Ry(pitch) Rx(roll) (1, 0, 0) + t, by the radians of the dataset's README.
    "tiers": Row(made.tiers, {
        "os0": (0.5**0.5, 0.5**0.5, 0.0),
        "os1": _turned(2.34826, 3.12619, (0.0100882, 0.581502, -0.0210581)),
        "velodyne": _turned(3.07795, 3.09161, (-0.164831, 0.173188, 0.117624)),
        "avia": _turned(0.00549421, 0.000246092, (-0.0608374, 0.29663, -0.122276)),
        "horizon": _turned(3.12905, 3.14022, (0.00345477, 0.145195, -0.134907))}),
    # The left one at (-0.27, 0, -0.22) of the centre, which is 0.28 m above the IMU.
    "urban_nav": Row(made.urban_nav, {
        "center": (1.0, 0.0, 0.28), "left": _after_a_quarter(-0.27, 0.0, 0.06),
        "right": (1.32, 0.0, 0.08)}),
    # First columns and last ones of R_IO, R_IV, R_IL and R_IA.
    "helipr": Row(made.helipr, {
        "ouster": (0.9997155 - 0.417, -0.0224514 - 0.003, 0.0080537 + 0.2996),
        "velodyne": (0.9999958 - 1.372, -0.000826 + 0.0668, 0.0027923 + 0.0297),
        "avia": (0.9992603 + 0.2054, -0.0383981 - 0.3528, -0.0021151 + 0.0706),
        "aeva": (0.9985934 + 0.1337, -0.0476189 + 0.3557, 0.0233164 + 0.2219)}),
    "a2d2": Row(made.a2d2, _entered(*VIEWS)),
    "boreas": Row(made.boreas, {"velodyne": (1.0, 0.0, 0.0)}),
    "truckscenes": Row(made.truckscenes, _entered(*made.TRUCK)),
    "zenseact": Row(made.zenseact, {"velodyne": (1.0, 0.0, 0.0)}),
}  # fmt: skip
# Refused by --dataset at once; and without it by what their files are.
REFUSED = {
    "nuscenes": (made.nuscenes, "nuScenes: it cannot be batched: its points have no time"),
    "complex_urban": (made.complex_urban, "Complex Urban: it cannot be batched"),
    "nuplan": (made.nuplan, "nuPlan: it cannot be batched: clouds are merged"),
    "lyft": (made.lyft, "raw points (.bin)"),
    "waymo": (made.waymo, "one time for all points"),
    "argoverse2": (made.argoverse2, "moved to one time"),
    "pandaset": (made.pandaset, "moved to one time"),
}


# -- facts, and the page --------------------------------------------------------------------------


def test_every_recipe_is_run() -> None:
    assert sorted([*CONVERTED, *REFUSED]) == recipe_names()
    assert len(recipe_names()) >= 18


@pytest.mark.parametrize("name", recipe_names())
def test_facts_have_pages_or_are_not_verified(name: str) -> None:
    facts = recipe(name)
    assert list(facts.pages) == list(FACTS)
    for fact in ("size", "licence", "lidars"):
        assert (getattr(facts, fact) == UNKNOWN) == (not facts.pages[fact])
    # No recipe was run on real files yet.
    assert facts.mark in MARKS[1:]
    # Packets have their own times.
    is_known = facts.pages["topics"] and (facts.pages["times"] or facts.data == "raw")
    assert (facts.mark == "by published facts") == bool(is_known)
    assert facts.refused or facts.mark != "disputed" or facts.not_verified


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("  licence: MIT\n", "", "the fact of its page, licence"),
        ("    size: https", "    size: not verified #", "its page in pages, found not verified"),
    ],
)
def test_a_fact_needs_its_page(old: str, new: str, message: str, tmp_path: Path) -> None:
    text = (FOLDER / "tiers.yaml").read_text(encoding="utf-8")
    assert old in text
    (tmp_path / "rig.yaml").write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(RigError, match=message):
        read_rig(tmp_path / "rig.yaml")


def _row(name: str) -> str:
    facts = recipe(name)
    if facts.refused:
        return f"| {facts.title} | `{name}` | {facts.refused} |"
    cells = (facts.title, f"`{name}`", f"`{facts.recording}`", f"{facts.data}: {facts.lidars}")
    return f"| {' | '.join((*cells, facts.mark, facts.remarks))} |"


def test_the_tables_of_the_page_are_those_of_the_recipes() -> None:
    rows = [line for line in PAGE.splitlines() if line.startswith("|")]
    for names in (CONVERTED, REFUSED):
        wanted = [_row(name) for name in sorted(names)]
        first = rows.index(wanted[0]) if wanted[0] in rows else 0
        assert rows[first : first + len(wanted)] == wanted, "\n".join(wanted)


def test_recipes_are_listed(shell: Shell) -> None:
    *table, legend, use = shell("datasets").out.splitlines()
    assert legend.startswith("not verified: no page that was read states it")
    assert use == "mlbatch convert RECORDING --dataset NAME -o scans.mcap"
    assert [line.split()[0] for line in table] == ["name", *recipe_names()]
    assert "631 GB  " in table[1 + recipe_names().index("tiers")]
    listed = json.loads(shell("datasets --json").out)
    assert {one["name"]: one["mark"] for one in listed}["mcd"] == "by published facts"
    (mcd,) = json.loads(shell("datasets mcd --json").out)
    assert mcd["pages"]["times"][0].endswith("UserManual.md")
    assert shell("datasets mcd").out == (FOLDER / "mcd.yaml").read_text()


# -- converted ------------------------------------------------------------------------------------


def _command(shell: Shell, name: str) -> str:
    """The command of the page, or that with a copy of the recipe in which poses are entered."""
    facts = recipe(name)
    text = (FOLDER / f"{name}.yaml").read_text(encoding="utf-8")
    use = f"--dataset {name}"
    if len(CONVERTED[name].places) > 1 and "extrinsics: unknown" in text:
        refused = shell(f"convert {facts.recording} {use} -o scans.mcap")
        assert refused.code == 1
        assert f"mlbatch datasets {name} > rig.yaml" in refused.err
        known = [one for one in re.findall("extrinsics: .*", text) if not one.endswith("unknown")]
        for number in range(len(CONVERTED[name].places) - len(known)):
            pose = f"extrinsics: {{translation_m: [{number}, 0, 0]}}"
            text = text.replace("extrinsics: unknown", pose, 1)
        use = "--rig rig.yaml"
    if name == "tiers":
        refused = shell(f"convert {facts.recording} {use} -o scans.mcap")
        clocks = re.findall(r"(\w+) (clock: \{offset_s: ([\d.]+)\})", refused.err)
        assert [(sensor, offset) for sensor, _, offset in clocks] == [
            ("os0", "1699999500.000"), ("os1", "1699999500.000")]  # fmt: skip
        for sensor, clock, _ in clocks:
            text = text.replace(f"name: {sensor}\n", f"name: {sensor}\n    {clock}\n")
        use = "--rig rig.yaml"
    if use.startswith("--rig"):
        Path("rig.yaml").write_text(text, encoding="utf-8")
    return f"{facts.recording} {use}"


@pytest.mark.parametrize("name", CONVERTED)
def test_datasets_that_are_converted(shell: Shell, name: str) -> None:
    row = CONVERTED[name]
    row.make()
    found = shell(f"inspect {recipe(name).recording}")
    # One topic alone is that of many recordings.
    assert (name in (found.out + found.err).partition("give --dataset ")[2]) == (name != "subt_mrs")
    command = _command(shell, name)
    outcome = shell(f"convert {command} -o scans.mcap")
    assert outcome.code == 0, outcome.err
    if "--dataset" in command:
        assert "dataset" in outcome.warnings
        assert f"{recipe(name).title}: recipe {recipe(name).mark}" in outcome.err
    sensors = report_of("scans.mcap.report.json")["sensors"]
    assert [sensor["name"] for sensor in sensors] == list(row.places)
    points = _points(len(sensors))
    for number, sensor in enumerate(sensors):
        place = row.places[sensor["name"]]
        pose = np.array(sensor["extrinsics"]["body_from_sensor"])
        np.testing.assert_allclose(pose @ (1, 0, 0, 1), (*place, 1), atol=row.tolerance_m)
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
                                       atol=1e-5 + row.tolerance_m)  # fmt: skip
    assert shell("verify scans.mcap").code == 0


@pytest.mark.parametrize("name", [name for name, row in CONVERTED.items() if not row.packets])
def test_points_are_at_the_times_they_were_measured(shell: Shell, name: str) -> None:
    """Columns of all lidars n ms after the start; float32 and float64 seconds are rounded."""
    row = CONVERTED[name]
    row.make()
    assert shell(f"convert {_command(shell, name)} -o scans --keep-partial").code == 0
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


def _points(lidars: int) -> list[Any]:
    """Points of each lidar, (p, 3)."""
    parts: list[list[Any]] = [[] for _ in range(lidars)]
    for scan in mlbatch.read(Path("scans.mcap")):
        for lidar, found in enumerate(parts):
            found.append(scan.xyz[scan.lidar_id == lidar])
    return [np.concatenate(found) for found in parts]


@pytest.mark.parametrize("name", REFUSED)
def test_datasets_that_are_refused(shell: Shell, name: str) -> None:
    make, reason = REFUSED[name]
    make()
    facts = recipe(name)
    for words, expected in (
        (f"--dataset {name}", f"found {facts.title}: {facts.refused};"),
        ("", reason),
    ):
        outcome = shell(f"convert {facts.recording} {words} -o scans.mcap")
        assert outcome.code in (1, 2)
        assert expected in outcome.err
        assert outcome.err.startswith("mlbatch: error: ")
        assert outcome.err.count("\n") == 1
    assert not [path for path in Path().iterdir() if path.name.startswith("scans")]


def test_a_look_alike_that_moves_shows_how_its_times_are_read(shell: Shell) -> None:
    """MCD: the Ouster's header is the end, the Livox's the start; else they are 0.1 s apart.

    Read as the start, the Ouster is a sweep late: the Livox seems early by it.
    """
    Path("drive").mkdir()
    moved = drive(Path("drive"), scenario(3, duration_s=3.0), 3)
    topics = []
    for lidar, topic in enumerate(("/os_cloud_node/points", "/livox/lidar")):
        messages = []
        for stamp_ns, points_m, start_ns in moved.sweeps[lidar]:
            points = np.zeros(len(points_m), [(f, f"<{kind}") for f, kind in made.MCD.items()])
            for axis, values in zip("xyz", points_m.T, strict=True):
                points[axis] = values
            points["t"] = stamp_ns - start_ns
            at_ns = start_ns + (SWEEP_NS if lidar == 0 else 0)
            data = cloud_of(points, at_ns, Form("ros1", ""))
            messages.append(Recorded(topic, CLOUD, start_ns + SWEEP_NS, data))
        topics.append(messages)
    made.bag("ntu_day_01/ntu_day_01.bag", *topics)
    lines = ["body:\n"]
    for name, pose in zip(("os_sensor", "livox"), moved.poses, strict=True):
        lines.append(f"  {name}:\n    T: {np.asarray(pose).tolist()}\n")
    made.text("ntu_day_01/atv_calib.yaml", "".join(lines))
    text = (FOLDER / "mcd.yaml").read_text()
    assert "from: end" in text
    Path("mcd.yaml").write_text(text.replace("from: end", "from: start"))
    found = json.loads(shell("inspect ntu_day_01 --rig mcd.yaml --json").out)["point_times"]
    assert [one["order"] for one in found] == ["fits", "fits"]
    assert found[1]["delay"] == "differs"
    assert abs(found[1]["late_ms"] + 100.0) < 5.0


# -- mistakes -------------------------------------------------------------------------------------


def test_a_rig_and_a_batch_of_a_dataset(shell: Shell) -> None:
    """`inspect` writes the recipe with its poses; a batch reads the files of each session."""
    made.ntu_viral()
    assert shell("inspect eee_01/eee_01.bag --dataset ntu_viral --write-rig own.yaml").code == 0
    assert "from: end" in Path("own.yaml").read_text()
    assert shell("convert eee_01/eee_01.bag --rig own.yaml -o a.mcap").code == 0
    assert shell("convert eee_01/eee_01.bag --dataset ntu_viral -o b.mcap").code == 0
    assert mlbatch.convert("eee_01/eee_01.bag", "c.mcap", dataset="ntu_viral").path is not None
    assert shell("digest a.mcap").out.split()[0] == shell("digest b.mcap").out.split()[0]
    assert shell("digest c.mcap").out.split()[0] == shell("digest b.mcap").out.split()[0]
    assert shell("batch eee_0*/*.bag --dataset ntu_viral -o out").code == 0
    (note,) = [
        one for one in report_of("b.mcap.report.json")["warnings"] if one["code"] == "dataset"
    ]
    horizontal = Path("eee_01/lidar_horz.yaml").absolute()
    assert note["message"].endswith(f"; poses of {horizontal}, {horizontal.parent}/lidar_vert.yaml")
    again = shell("batch eee_0*/*.bag --dataset ntu_viral -o out")
    assert "1 skipped" in again.out
    Path("eee_01/lidar_horz.yaml").write_text(
        Path("eee_01/lidar_horz.yaml").read_text().replace("0.055", "0.056")
    )
    assert "1 done" in shell("batch eee_0*/*.bag --dataset ntu_viral -o out").out


def test_a_batch_of_folders_of_sweeps(shell: Shell) -> None:
    made.helipr()
    outcome = shell("batch Round*/LiDAR --dataset helipr -o out")
    assert (outcome.code, "1 done" in outcome.out) == (0, True), outcome.err


MISTAKES = {
    "--dataset NTU-viral": "expected the name of a dataset, found 'NTU-viral'; the nearest are "
    "ntu_viral",
    "--dataset x": "expected the name of a dataset, found 'x'; see `mlbatch datasets`",
    "--dataset tiers --rig x.yaml": "expected a dataset or a rig, found both",
    "--dataset tiers": "expected decoded clouds on /os_cloud_node/points, /os_cloud_nodee/points, "
    "/velodyne_points, /avia/livox/lidar, /livox/lidar, found none; the nearest topic of clouds is "
    "/os1_cloud_node2/points, others are /os1_cloud_node1/points",
    "--dataset subt_mrs": "expected a packet of it (topic /velodyne_packets) in the first 10 "
    "seconds, found none",
    "--dataset geode": "expected cali/alpha_config.yaml of GEODE in ",
}


@pytest.mark.parametrize("words", MISTAKES)
def test_mistakes(shell: Shell, words: str) -> None:
    made.ntu_viral()
    outcome = shell(f"convert eee_01/eee_01.bag {words} --dry-run")
    assert outcome.code in (1, 2)
    assert MISTAKES[words] in outcome.err.splitlines()[-1]


def test_the_folder_above_a_drive_names_the_drive(shell: Shell) -> None:
    made.boreas()
    (drive,) = Path().glob("boreas-*")
    outcome = shell("inspect .")
    name = (
        f"found a folder of folders; name {drive.absolute()}: topics or files are those of Boreas"
    )
    assert name in outcome.err


def test_the_calibration_of_two_platforms_is_not_guessed(shell: Shell) -> None:
    made.mcd()
    Path("hhs_calib.yaml").write_text(Path("atv_calib.yaml").read_text())
    outcome = shell("convert ntu_day_01 --dataset mcd --dry-run")
    assert "found atv_calib.yaml, hhs_calib.yaml; keep that of the recordings" in outcome.err


def test_a_lidar_that_the_rig_lacks_is_named(shell: Shell) -> None:
    """The clouds of a lidar that is not in the rig are counted as unassigned."""
    made.botanic_garden()
    text = (FOLDER / "botanic_garden.yaml").read_text(encoding="utf-8")
    Path("one.yaml").write_text(text.partition("  - name: livox")[0], encoding="utf-8")
    words = "convert 1018_00.bag --rig one.yaml --dry-run"
    outcome = shell(words)
    assert (outcome.code, _warnings(outcome)) == (0, ["not_in_rig"])
    assert "--ignore /livox/lidar" in outcome.err
    (one,) = json.loads(outcome.out)["unassigned"]
    assert (one["stream"], one["packets"]) == ("/livox/lidar", CLOUD_COLUMNS)
    assert one["what"].startswith("not_in_rig: ")
    strict = shell(f"{words} --strict")
    assert (strict.code, "(not_in_rig, an error because of --strict)" in strict.err) == (1, True)
    ignored = shell(f"{words} --strict --ignore /livox/lidar")
    assert (ignored.code, _warnings(ignored)) == (0, [])
    table = shell("inspect 1018_00.bag --rig one.yaml")
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


def _warnings(outcome: Outcome) -> list[str]:
    """Codes without those for information."""
    return [code for code in outcome.warnings if code not in ("clouds", "dataset")]


def test_undistorted_clouds_of_grand_tour_are_refused(shell: Shell) -> None:
    topic = "/boxi/hesai/points_undistorted"
    moved = made.clouds(topic, made.HESAI, made.since_1970_s, frame="hesai_lidar")
    made.bag("mission/m_hesai_undist.bag", moved)
    outcome = shell("convert mission/*.bag -o scans.mcap")
    assert outcome.code == 1
    assert "points_undistorted: expected points where they were measured" in outcome.err


@pytest.mark.parametrize("name", ["ntu_viral", "mcd"])
def test_headers_at_the_end_are_warned_about_without_a_rule(shell: Shell, name: str) -> None:
    CONVERTED[name].make()
    text = (FOLDER / f"{name}.yaml").read_text()
    Path("plain.yaml").write_text(re.sub(r"^    points: .*\n", "", text, flags=re.MULTILINE))
    outcome = shell(f"convert {recipe(name).recording} --rig plain.yaml -o scans.mcap")
    assert outcome.code == 0
    assert "points are up to 94.0 ms later than the log time of their message" in outcome.err
    assert "points: {from: end}" in outcome.err


def test_a_copy_of_a_recipe_is_a_rig(shell: Shell) -> None:
    """Also with a fact that is not known."""
    root = read_yaml(FOLDER / "mcd.yaml")
    assert set(root.entries) == {"dataset", "body_frame", "sensors"}
    made.mcd()
    Path("atv_calib.yaml").rename("ntu_day_01/atv_calib.yaml")
    copy = shell("datasets mcd").out
    Path("rigs").mkdir()
    Path("rigs/mcd.yaml").write_text(copy + "convert: {keep_partial: yes}\n")
    for command in ("convert ntu_day_01 --dry-run", "calibrate ntu_day_01 -o refined.yaml"):
        outcome = shell(f"{command} --rig rigs/mcd.yaml")
        # Its files are searched around the recording; there is nothing to calibrate by.
        assert "*_calib.yaml" not in outcome.err, outcome.err
    Path("copy.yaml").write_text(copy.replace("title:", "titel:"))
    outcome = shell("convert ntu_day_01 --rig copy.yaml --dry-run")
    assert "copy.yaml:2: dataset.titel: expected a key of title" in outcome.err


def test_a_recording_without_clouds_is_described(shell: Shell) -> None:
    outcome = shell(f"convert {REPOSITORY}/fixtures/moving/moving.mcap --dataset tiers --dry-run")
    assert outcome.code == 1
    assert "found none; this recording has /imu/data, /left/imu_packets, " in outcome.err
