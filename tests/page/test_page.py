"""Pages of runs: `mlbatch report` and `convert --html`."""

from __future__ import annotations

import base64
import json
import re
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from mlbatch.outputs.read import open_scans
from mlbatch.page.clouds import _view, choose_places, chosen_clouds, read_clouds
from mlbatch.page.windows import read_windows
from tests.builders.sessions import FIXTURE, Shell
from tests.page.runs import report, sensor, table, text

CAPTURE = FIXTURE / "two_lidars.pcap"
FIX = f"{CAPTURE} --rig {FIXTURE / 'rig.yaml'}"
# Points of a window: fixtures/two_lidars/SOURCE.md.
POINTS = 27998
HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>'\"&"
FORMATS = {
    "npz": "",
    "npz organized": "--layout organized",
    "npz split": "--split",
}


def plot_data(page: Path) -> Any:
    """The data of the plots in a page."""
    found = re.search(r'id="data">(.*?)</script>', page.read_text(encoding="utf-8"), re.DOTALL)
    assert found is not None
    return json.loads(found[1])


def unpacked(packed: Any) -> Any:
    """An array of a page."""
    return np.frombuffer(base64.b64decode(packed["data"]), f"<{packed['type']}")


@dataclass
class Shown:
    """Points of a page, in the order of the page."""

    xyz: npt.NDArray[np.float64]
    time_ms: npt.NDArray[np.float64]
    ring: npt.NDArray[np.int64]
    lidar: npt.NDArray[np.uint8]
    intensity: npt.NDArray[np.uint8]


def points_of(cloud: Any) -> Shown:
    """Unpack a scan of a page, one value after another."""
    data = zlib.decompress(base64.b64decode(cloud["data"]), wbits=-15)
    count = cloud["shown"]
    words = []
    for plane in range(5):
        low = data[2 * plane * count :]
        value = 0
        values = []
        for i in range(count):
            coded = low[i] + 256 * low[count + i]
            value += -(coded + 1) // 2 if coded % 2 else coded // 2
            values.append(value % 65536)
        words.append(np.array(values))
    assert len(data) == 12 * count
    return Shown(
        xyz=np.stack(words[:3], axis=1) * cloud["step"] + cloud["low"],
        time_ms=cloud["times"][0] + words[3] / 65535 * (cloud["times"][1] - cloud["times"][0]),
        ring=words[4],
        lidar=np.frombuffer(data, np.uint8, count, 10 * count),
        intensity=np.frombuffer(data, np.uint8, count, 11 * count),
    )


@pytest.mark.parametrize("case", FORMATS)
def test_points_of_a_page_are_those_of_the_scan(case: str, shell: Shell) -> None:
    assert shell(f"convert {FIX} -o scans --quiet").code == 0
    assert shell(f"convert {FIX} -o shown {FORMATS[case]} --quiet").code == 0
    outcome = shell("report shown -o page.html")
    assert (outcome.code, outcome.err, outcome.out) == (0, "", "wrote page.html\n")
    page = Path("page.html").read_text(encoding="utf-8")
    assert "Packets, windows and clocks are fine; surfaces agree within " in page
    clouds = plot_data(Path("page.html"))["clouds"]
    # All 7, since they are small.
    assert [cloud["title"] for cloud in clouds] == [f"Scan {k}, +0.{k} s" for k in range(7)]
    cloud = clouds[0]
    shown = points_of(cloud)
    with np.load("scans/000000.npz") as scan:
        arrays = {name: scan[name] for name in ("xyz", "lidar_id", "ring", "time_ns")}
    time_ns = arrays["time_ns"].astype(np.int64)
    assert len(shown.lidar) == len(time_ns) == POINTS
    # A page has them by lidar and ring.
    order = np.lexsort((time_ns, arrays["ring"], arrays["lidar_id"]))
    np.testing.assert_array_equal(shown.lidar, arrays["lidar_id"][order])
    # The rings of a scan of one sensor begin at 0; both sensors have 32.
    ring = arrays["ring"] % (32 if case == "npz split" else 64)
    np.testing.assert_array_equal(shown.ring, ring[order])
    assert np.abs(shown.xyz - arrays["xyz"][order]).max() <= 0.5 * cloud["step"] + 1e-5
    assert cloud["step"] == 0.005
    off_ms = shown.time_ms - time_ns[order] / 1e6
    assert np.abs(off_ms).max() <= 100 / 65535


def test_large_scans_are_thinned_by_whole_columns(
    shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert shell(f"convert {FIX} -o scans --quiet").code == 0
    # Two scans (one is first and has the fewest points) in room for one.
    monkeypatch.setattr("mlbatch.page.clouds.MOST_CHARS", 60_000)
    assert shell("report scans -o page.html").code == 0
    text = Path("page.html").read_text(encoding="utf-8")
    clouds = plot_data(Path("page.html"))["clouds"]
    assert "2 of 7 scans, with every 2nd column; " in text
    assert f"{POINTS:,} points, {clouds[0]['shown']:,} of them shown" in clouds[0]["text"]
    shown = points_of(clouds[0])
    # Half of the columns of 512 per revolution, with each ring that the scan has.
    with np.load("scans/000000.npz") as scan:
        assert set(shown.ring.tolist()) == set(scan["ring"].tolist())
    of_ring = shown.time_ms[shown.ring == shown.ring[0]]
    assert np.diff(np.sort(of_ring)).min() > 1.5 * 100 / 512
    assert 0.45 * POINTS < len(shown.ring) < 0.55 * POINTS


def test_a_page_is_full_but_not_beyond(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    assert shell(f"convert {FIX} -o scans --quiet").code == 0
    table = Path("scans/scans.csv").read_text(encoding="utf-8")
    windows = read_windows(table, 1)
    assert windows is not None
    (one, *_) = read_clouds(open_scans(Path("scans")), choose_places(windows, 1), windows)
    for room in (3, 4, 5):
        limit = int((room + 0.9) * one.chars)
        monkeypatch.setattr("mlbatch.page.clouds.MOST_CHARS", limit)
        clouds = chosen_clouds(Path("scans"), windows, None)
        rows = [cloud.place.row for cloud in clouds]
        assert rows == sorted(set(rows))
        assert limit - 2 * one.chars < sum(cloud.chars for cloud in clouds) <= limit


def test_empty_scans_promise_no_room(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    """First, middle and worst have few points; all others together are beyond the limit."""
    far = "--min-range 13"
    assert shell(f"convert {FIX} -o scans --quiet").code == 0
    assert shell(f"convert {FIX} -o none --quiet {far}").code == 0
    for index in (0, 3):
        Path(f"none/{index:06}.npz").replace(f"scans/{index:06}.npz")
    windows = read_windows(Path("scans/scans.csv").read_text(encoding="utf-8"), 1)
    assert windows is not None
    (one,) = read_clouds(open_scans(Path("scans")), choose_places(windows, 7)[1:2], windows)
    assert one.total == POINTS
    monkeypatch.setattr("mlbatch.page.clouds.MOST_CHARS", 3 * one.chars)
    clouds = chosen_clouds(Path("scans"), windows, None)
    assert 0 < clouds[0].total < 1000
    assert sum(cloud.chars for cloud in clouds) <= 3 * one.chars


FAR = (
    # Around the body; 5 km away; two lidars 1.85 km apart, one with a fortieth of the points.
    ([(0.0, 0.0, 0.0)], [4000], (0.0, 0.0, 0.0), 50.0),
    ([(3000.0, 4000.0, 50.0)], [4000], (3000.0, 4000.0, 50.0), 50.0),
    ([(0.0, 0.0, 0.0), (1850.0, 0.0, 0.0)], [4000, 100], (0.0, 0.0, 0.0), 1895.0),
    # No point at all.
    ([(0.0, 0.0, 0.0)], [0], (0.0, 0.0, 0.0), 1.0),
)


@pytest.mark.parametrize(("places", "counts", "centre", "radius"), FAR)
def test_the_view_has_most_points_of_every_lidar(
    places: list[tuple[float, float, float]],
    counts: list[int],
    centre: tuple[float, float, float],
    radius: float,
) -> None:
    """Rings of 50 m radius around each lidar."""
    parts = []
    for place, count in zip(places, counts, strict=True):
        turn = np.arange(count) * 2.399963
        ring = np.stack([50 * np.cos(turn), 50 * np.sin(turn), np.sin(7 * turn)], axis=1)
        parts.append(ring + place)
    lidar = np.repeat(np.arange(len(counts), dtype=np.uint8), counts)
    found, view_m = _view(np.concatenate(parts).T, lidar)
    assert found == pytest.approx(centre, abs=2)
    assert view_m == pytest.approx(radius, abs=5)


@pytest.mark.parametrize(("model", "share"), [("OS-1-32-U1", "80.0 %"), ("PointCloud2", "88.9 %")])
def test_slots_that_no_point_of_a_cloud_fills_are_not_counted(
    model: str, share: str, shell: Shell
) -> None:
    # Of 1,000 slots 100 have no point and 800 are written; 800 of 900 are 88.9 %.
    Path("run.json").write_text(text(report({**sensor("left"), "model": model})))
    assert shell("report run.json -o page.html").code == 0
    page = Path("page.html").read_text(encoding="utf-8")
    assert f"in the output 800 ({share})" in page
    assert ("no return 100" in page) == (share == "80.0 %")


def test_hostile_names_are_text(shell: Shell) -> None:
    """No value of a report or table becomes markup, an attribute or a script."""
    name = HOSTILE
    document = report(sensor(name), sensor("right", 1, lost=3))

    def hostile(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: hostile(inner) for key, inner in value.items()}
        if isinstance(value, list):
            return [hostile(inner) for inner in value]
        return HOSTILE + value if isinstance(value, str) else value

    schema = document["schema"]
    document = hostile(document)
    document["schema"] = schema
    document["sensors"][0]["packets"]["rejected"] = {HOSTILE: 4}
    document["sensors"][0]["columns"]["dropped"] = {HOSTILE: 4}
    document["warnings"] = [{"code": HOSTILE, "sensor": HOSTILE, "message": HOSTILE}]
    document["faults"] = [{"fault": HOSTILE, "packets": 3}]
    document["messages"] = [{"topic": HOSTILE, "read": 3, "written": 3, "dropped": {}}]
    document["unassigned"] = [{"stream": HOSTILE, "packets": 3, "what": f"lidar {HOSTILE}"}]
    Path("report.json").write_text(text(document), encoding="utf-8")
    quoted = table(("left", "right"), [[512, 512]] * 3).replace("left", f'"x{HOSTILE[:-2]}"')
    head, _, rest = quoted.partition("\n")
    cells = [cell.replace('"x', "").replace('"', "") for cell in head.split(",")]
    line = ",".join('"' + cell.replace('"', '""') + '"' for cell in cells)
    Path("scans.csv").write_text(f"{line}\n{rest}", encoding="utf-8")
    assert shell("report report.json -o report.html").code == 0
    page = Path("report.html").read_text(encoding="utf-8")
    assert page.count("<script") == 2
    assert page.count("</script") == 2
    assert "<img" not in page
    for tag in re.findall(r"<[a-z][^>]*>", page.partition("</style>")[2]):
        assert "alert" not in tag or "&lt;script&gt;" in tag, tag
    assert plot_data(Path("report.html"))["sensors"][0] == HOSTILE + name


def test_names_that_are_no_text_are_written(shell: Shell) -> None:
    document = report(sensor("left"))
    document["inputs"][0]["path"] = "/data/\udcff.pcap"
    Path("run.json").write_text(text(document), encoding="utf-8")
    assert shell("report run.json").code == 0
    assert "\\udcff" in Path("run.html").read_text(encoding="utf-8")


def test_a_page_begins_with_the_scan_that_lacks_most(shell: Shell) -> None:
    words = "--html page.html --quiet --fault stall:right:300ms-600ms --max-wait 0.1"
    assert shell(f"convert {FIX} -o scans.mcap {words}").code == 0
    data = plot_data(Path("page.html"))
    assert "worst" in data["clouds"][data["begin"]]["text"]
