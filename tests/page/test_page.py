"""Pages of runs: `mlbatch report` and `convert --html`."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mlbatch.page.clouds import _view, choose_places, read_clouds
from mlbatch.page.windows import read_windows
from tests.builders.sessions import FIXTURE, Shell
from tests.page.runs import report, sensor, table, text

CAPTURE = FIXTURE / "two_lidars.pcap"
FIX = f"{CAPTURE} --rig {FIXTURE / 'rig.yaml'}"
# Points of a window: fixtures/two_lidars/SOURCE.md.
POINTS = 27998
HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>'\"&"
FORMATS = {
    "mcap": ("scans.mcap", ""),
    "organized": ("scans.mcap", "--layout organized"),
    "split": ("scans.mcap", "--split"),
    "zstd": ("scans.mcap", "--compression zstd"),
    "npz": ("scans", ""),
    "npz organized": ("scans", "--layout organized"),
    "npz split": ("scans", "--split"),
    "ply": ("scans", "--format ply"),
    "rosbag1": ("scans.bag", ""),
    "rosbag2": ("scans", "--format rosbag2"),
}


def plot_data(page: Path) -> Any:
    """The data of the plots in a page."""
    found = re.search(r'id="data">(.*?)</script>', page.read_text(encoding="utf-8"), re.DOTALL)
    assert found is not None
    return json.loads(found[1])


def unpacked(packed: Any) -> Any:
    """An array of a page."""
    return np.frombuffer(base64.b64decode(packed["data"]), f"<{packed['type']}")


@pytest.mark.parametrize("case", FORMATS)
def test_a_page_shows_the_scans_of_every_format(case: str, shell: Shell) -> None:
    output, options = FORMATS[case]
    assert shell(f"convert {FIX} -o {output} {options} --quiet").code == 0
    outcome = shell(f"report {output} -o page.html")
    assert (outcome.code, outcome.err, outcome.out) == (0, "", "wrote page.html\n")
    clouds = plot_data(Path("page.html"))["clouds"]
    assert [cloud["title"] for cloud in clouds] == [
        "first and fewest points scan (0)",
        "middle scan (3)",
    ]
    first = clouds[0]
    lidars = unpacked(first["lidar"])
    # fixtures/two_lidars/SOURCE.md: both lidars have points in every scan.
    assert len(lidars) == 27_000 < POINTS
    assert set(lidars.tolist()) == {0, 1}
    xyz = unpacked(first["xyz"]).reshape(-1, 3) / 65535 * first["size"] + first["low"]
    # The hall of the fixture; the machine's own box is excluded.
    assert 5 < np.abs(xyz).max() < 60


def test_points_of_a_page_are_those_of_the_scan(shell: Shell) -> None:
    assert shell(f"convert {FIX} -o scans --quiet").code == 0
    windows = read_windows(Path("scans/scans.csv").read_text(encoding="utf-8"), 1)
    assert windows is not None
    (cloud, _) = read_clouds(Path("scans"), choose_places(windows), windows.sensors)
    assert cloud.total == POINTS
    found = cloud.xyz / 65535 * cloud.size_m + np.array(cloud.low_m)
    with np.load("scans/000000.npz") as scan:
        xyz = scan["xyz"].astype(np.float64)
        lidar = scan["lidar_id"]
    step_m = cloud.size_m / 65535
    rows = np.random.default_rng(1).choice(len(found), 50, replace=False)
    for row in rows:
        far = np.abs(xyz - found[row]).max(axis=1)
        assert far.min() <= step_m
        assert cloud.lidar[row] in lidar[far <= step_m]


FAR = (
    # Around the body; 5 km away; two lidars 1.85 km apart, one with a fortieth of the points.
    ([(0.0, 0.0, 0.0)], [4000], (0.0, 0.0, 0.0), 50.0),
    ([(3000.0, 4000.0, 50.0)], [4000], (3000.0, 4000.0, 50.0), 50.0),
    ([(0.0, 0.0, 0.0), (1850.0, 0.0, 0.0)], [4000, 100], (0.0, 0.0, 0.0), 1895.0),
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
    found, view_m = _view(np.concatenate(parts), lidar)
    assert found == pytest.approx(centre, abs=2)
    assert view_m == pytest.approx(radius, abs=5)


def test_convert_writes_the_page_with_its_command(shell: Shell) -> None:
    outcome = shell(f"convert {FIX} -o scans.mcap --html page.html --quiet")
    assert (outcome.code, outcome.err) == (0, "")
    page = Path("page.html").read_text(encoding="utf-8")
    assert "Packets, windows and clocks are fine; poses not checked" in page
    assert "mlbatch convert" in page
    assert "--html page.html" in page
    assert Path("page.html").stat().st_size < 1_000_000
    again = shell("report scans.mcap.report.json")
    assert again.out == "wrote scans.mcap.html\n"
    assert Path("scans.mcap.html").read_bytes() == Path("page.html").read_bytes()


def test_a_dry_run_has_a_page_without_scans(shell: Shell) -> None:
    assert shell(f"convert {FIX} --dry-run --html page.html --quiet").code == 0
    data = plot_data(Path("page.html"))
    assert data["clouds"] == []
    assert len(unpacked(data["windows"]["step"])) == 7
    assert "The scans are not available" in Path("page.html").read_text(encoding="utf-8")


def test_a_report_alone_makes_a_page_that_says_what_it_lacks(shell: Shell) -> None:
    Path("run.json").write_text(text(report(sensor("left"))), encoding="utf-8")
    assert shell("report run.json").out == "wrote run.html\n"
    page = Path("run.html").read_text(encoding="utf-8")
    assert page.count("No scans.csv was found") == 2
    assert plot_data(Path("run.html"))["windows"] is None


@pytest.mark.parametrize("words", ["report scans", "report scans/report.json"])
def test_the_page_of_a_folder_is_next_to_it(words: str, shell: Shell) -> None:
    """Otherwise the folder could not be overwritten, since it has another file."""
    assert shell(f"convert {FIX} -o scans --quiet").code == 0
    outcome = shell(words)
    assert outcome.code == 0
    assert Path("scans.html").is_file()
    assert plot_data(Path("scans.html"))["clouds"]
    assert shell(f"convert {FIX} -o scans --quiet --overwrite").code == 0


def test_an_mcap_file_alone_contains_its_report_and_table(shell: Shell) -> None:
    assert shell(f"convert {FIX} -o scans.mcap --quiet").code == 0
    Path("scans.mcap").rename("moved.mcap")
    assert shell("report moved.mcap").out == "wrote moved.mcap.html\n"
    data = plot_data(Path("moved.mcap.html"))
    assert len(unpacked(data["windows"]["step"])) == 7
    assert len(data["clouds"]) == 2
    page = Path("moved.mcap.html").read_text(encoding="utf-8")
    assert "The report has no command line" in page


@pytest.mark.parametrize(
    ("fault", "texts"),
    [
        # From 320 to 620 ms after the full second; scan 0 begins at 100 ms.
        ("stall:right:300ms-600ms", ["right sent nothing from +0.3 s to +0.5 s"]),
        ("drop:left:20%", ["left: ", "packets lost"]),
    ],
)
def test_faults_are_in_the_heading(fault: str, texts: list[str], shell: Shell) -> None:
    # Silence is a stall after 0.1 s: the recording is short.
    outcome = shell(
        f"convert {FIX} -o scans.mcap --html page.html --quiet --fault {fault} --max-wait 0.1"
    )
    assert outcome.code == 0, outcome.err
    page = Path("page.html").read_text(encoding="utf-8")
    heading = re.search(r"<strong>(.*?)</strong>", page)
    assert heading is not None
    for words in texts:
        assert words in heading[1]
    assert "verdict problem" in page


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


def test_a_page_is_replaced_only_with_overwrite_and_nothing_else_ever(shell: Shell) -> None:
    Path("run.json").write_text(text(report(sensor("left"))), encoding="utf-8")
    assert shell("report run.json").code == 0
    outcome = shell("report run.json")
    assert outcome.code == 1
    assert "expected a new file, found an earlier page; replace it with --overwrite" in outcome.err
    assert shell("report run.json --overwrite").code == 0
    Path("thesis.html").write_text("<!DOCTYPE html>\n<p>mine", encoding="utf-8")
    outcome = shell("report run.json -o thesis.html --overwrite")
    assert outcome.code == 1
    assert "found another file" in outcome.err
    assert Path("thesis.html").read_text(encoding="utf-8").endswith("mine")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("nothing.json", "expected a report or an output, found no such file or folder"),
        ("other.json", "expected a report of schema mlbatch.report/1, found 'none'"),
        ("damaged.json", "expected a report in JSON, found"),
        ("empty", "expected a report in or next to the output, found none"),
        ("good.json -o missing/page.html", "expected a page in an existing folder"),
        ("good.json -o empty", "expected a file for the page, found a folder"),
        ("empty --report nothing.json", "expected a report, found no such file"),
    ],
)
def test_mistakes_are_one_line(arguments: str, message: str, shell: Shell) -> None:
    Path("other.json").write_text("{}", encoding="utf-8")
    Path("damaged.json").write_text("{", encoding="utf-8")
    Path("good.json").write_text(text(report(sensor("left"))), encoding="utf-8")
    Path("empty").mkdir()
    outcome = shell(f"report {arguments}")
    assert outcome.code == 1
    assert message in outcome.err
    assert outcome.err.count("\n") == 1


@pytest.mark.parametrize(
    ("page", "message"),
    [
        ("scans/page.html", "expected a page outside the output"),
        ("none/page.html", "expected a page in an existing folder"),
        ("run.json", "expected a page apart from the output, its table and report"),
        ("s.mcap.scans.csv", "expected a page apart from the output, its table and report"),
        ("s.mcap", "expected a page outside the output"),
    ],
)
def test_convert_refuses_a_wrong_page_before_it_runs(page: str, message: str, shell: Shell) -> None:
    output = "scans" if "/" in page else "s.mcap"
    outcome = shell(f"convert {FIX} -o {output} --html {page} --report run.json")
    assert outcome.code == 1
    assert message in outcome.err
    assert list(Path().iterdir()) == []


def test_segments_have_numbered_pages(shell: Shell) -> None:
    outcome = shell(
        f"convert {FIX} -o scans.mcap --html page.html --quiet --on-jump split "
        "--fault jump:*:100s@400ms"
    )
    assert outcome.code == 0, outcome.err
    assert sorted(path.name for path in Path().glob("*.html")) == [
        "page.seg1.html",
        "page.seg2.html",
    ]


def test_a_damaged_output_leaves_a_page_that_says_so(shell: Shell) -> None:
    assert shell(f"convert {FIX} -o scans.mcap --quiet").code == 0
    data = bytearray(Path("scans.mcap").read_bytes())
    del data[len(data) // 2 :]
    Path("scans.mcap").write_bytes(data)
    outcome = shell("report scans.mcap -o page.html")
    assert (outcome.code, outcome.err) == (0, "")
    assert "The scans could not be read" in Path("page.html").read_text(encoding="utf-8")
