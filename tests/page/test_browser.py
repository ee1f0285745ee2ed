"""Pages in a real browser: no error, no request, every plot drawn, in light and dark."""

from __future__ import annotations

import io
import time
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from mlbatch.page import Source, write_page
from mlbatch.report.report import RunReport
from tests.builders.sessions import FIXTURE
from tests.contract.tree import run_mlbatch
from tests.page.browser import CHROMIUM, NO_CHROMIUM, Browser, browser
from tests.page.runs import report, sensor, table
from tests.page.test_page import HOSTILE

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)

TIME_PLOTS = ("timeline", "fill", "gap", "points", "span", "delay")
# Share of opaque pixels, and number of different colours, of a canvas.
LOOK = """(() => [...document.querySelectorAll('canvas')].map(c => {
  const d = new Uint32Array(
    c.getContext('2d').getImageData(0, 0, c.width, c.height).data.buffer);
  return [c.id || 'top', d.filter(p => p >>> 24 > 100).length / d.length, new Set(d).size,
    c.width, Math.round(c.getBoundingClientRect().width)];
}))()"""
# A row of the timeline in the middle of the lane of a sensor: share of red pixels.
RED = """((lane) => { const c = document.getElementById('timeline');
  const d = c.getContext('2d').getImageData(0, lane * 56 + 16 + 20, c.width, 1).data;
  let n = 0; for (let i = 0; i < d.length; i += 4) if (d[i] > 180 && d[i + 1] < 120) n++;
  return n / c.width; })"""


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with browser(tmp_path_factory.mktemp("profile")) as found:
        yield found


@pytest.fixture(scope="module")
def real_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a run of the fixture."""
    folder = tmp_path_factory.mktemp("page")
    capture = str(FIXTURE / "two_lidars.pcap")
    rig = str(FIXTURE / "rig.yaml")
    arguments = ["convert", capture, "--rig", rig, "-o", "s.mcap", "--html", "page.html"]
    done = run_mlbatch([*arguments, "--fault", "drop:left:10%"], folder)
    assert done.returncode == 0, done.stderr
    return folder / "page.html"


def page_of(folder: Path, source: Source) -> Path:
    path = folder / "page.html"
    write_page(path, source)
    return path


def pixels(png: bytes) -> npt.NDArray[np.uint8]:
    """The pixels of an 8-bit PNG without filters other than those of PNG 1.2, (h, w, c)."""
    stream = io.BytesIO(png[8:])
    data = b""
    width = height = channels = 0
    while head := stream.read(8):
        size = int.from_bytes(head[:4], "big")
        body = stream.read(size)
        stream.read(4)
        if head[4:] == b"IHDR":
            width, height = (int.from_bytes(body[i : i + 4], "big") for i in (0, 4))
            channels = {2: 3, 6: 4}[body[9]]
        elif head[4:] == b"IDAT":
            data += body
    lines = np.frombuffer(zlib.decompress(data), np.uint8).reshape(height, -1)
    # Filtered bytes: equal ones mean a blank line, which suffices here.
    return lines[:, 1 : 1 + width * channels].reshape(height, width, channels)


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("width", [1400, 400])
def test_every_plot_is_drawn(
    width: int, dark: bool, tab: Browser, real_page: Path, tmp_path: Path
) -> None:
    tab.open(real_page, width=width, dark=dark)
    assert tab.errors == []
    assert tab.requests == [real_page.resolve().as_uri()]
    looks = tab.run(LOOK)
    assert [look[0] for look in looks] == [*TIME_PLOTS, "top", "top", "top", "cloud"]
    for name, share, colours, inner, outer in looks:
        assert share > 0.005, name
        assert colours > 3, name
        # Drawn at the width that is shown; a border is not drawn on.
        assert abs(inner - outer) <= 4, name
    # Nothing is wider than the page.
    assert tab.run("document.documentElement.scrollWidth") <= width
    tab.screenshot(tmp_path / "page.png")
    drawn = pixels((tmp_path / "page.png").read_bytes())
    assert drawn.shape[0] > 2000
    back = tab.run("getComputedStyle(document.body).backgroundColor")
    assert back == ("rgb(17, 21, 27)" if dark else "rgb(246, 247, 249)")


def test_a_stall_is_red_where_it_was(tab: Browser, tmp_path: Path) -> None:
    columns = [[512, 0 if 30 <= index < 60 else 512] for index in range(100)]
    missing = [[512 - count for count in own] for own in columns]
    csv = table(("left", "right"), columns, missing)
    source = Source(
        RunReport.from_json(report(sensor("left"), sensor("right", 1))), csv, None, tmp_path
    )
    tab.open(page_of(tmp_path, source))
    assert tab.errors == []
    assert tab.run(f"{RED}(0)") == 0
    assert tab.run(f"{RED}(1)") == pytest.approx(0.3, abs=0.01)
    heading = tab.run("document.querySelector('#verdict strong').textContent")
    assert heading == "right sent nothing from +3.0 s to +6.0 s: a stall of 30 scans."
    # Without scans, the page says why.
    assert "not available to this page" in tab.run("document.body.textContent")


def test_the_timeline_can_be_enlarged_down_to_windows(tab: Browser, tmp_path: Path) -> None:
    columns = [[512 - (index == 50), 512 - 40 * (index == 50)] for index in range(100)]
    missing = [[512 - count for count in own] for own in columns]
    csv = table(("left", "right"), columns, missing)
    source = Source(
        RunReport.from_json(report(sensor("left"), sensor("right", 1))), csv, None, tmp_path
    )
    tab.open(page_of(tmp_path, source))
    assert tab.run("document.getElementById('range').textContent") == "+0.0 s to +10.0 s"
    tab.drag("#timeline", 0.5, 0.6)
    assert tab.run("document.getElementById('range').textContent") == "+5.0 s to +6.0 s"
    tab.run("document.getElementById('all').click()")
    time.sleep(0.2)
    assert tab.run("document.getElementById('range').textContent") == "+0.0 s to +10.0 s"
    for _ in range(20):
        tab.run("document.getElementById('in').click()")
    time.sleep(0.2)
    # Four windows.
    assert tab.run("document.getElementById('range').textContent") == "+4.8 s to +5.2 s"
    assert tab.errors == []


def test_colours_and_scans_can_be_chosen(tab: Browser, real_page: Path) -> None:
    tab.open(real_page)
    cloud = "document.getElementById('cloud').toDataURL()"
    pictures = {tab.run(cloud)}
    for colour in ("height", "time", "bright", "lidar"):
        tab.run(f"document.querySelector('[data-colour={colour}]').click()")
        assert tab.run("document.querySelector('button.chosen').dataset.colour") == colour
        pictures.add(tab.run(cloud))
    # The first one is that of the lidars.
    assert len(pictures) == 4
    tab.run("document.querySelectorAll('canvas.top')[1].click()")
    assert "middle" in tab.run("document.getElementById('cloudinfo').textContent")
    tab.drag("#cloud", 0.3, 0.6)
    pictures.add(tab.run(cloud))
    assert len(pictures) == 5
    assert tab.errors == []


def test_hostile_names_run_nothing(tab: Browser, tmp_path: Path) -> None:
    warning = {"code": HOSTILE, "sensor": HOSTILE, "message": HOSTILE}
    document = report(sensor(HOSTILE), sensor("right", 1), warnings=[warning], command=HOSTILE)
    csv = table(("left", "right"), [[512, 512]] * 5)
    tab.open(page_of(tmp_path, Source(RunReport.from_json(document), csv, None, tmp_path)))
    assert tab.errors == []
    assert tab.run("document.querySelectorAll('img').length") == 0
    assert tab.run("document.querySelectorAll('script').length") == 2
    assert tab.run("document.getElementById('command').textContent") == HOSTILE


def test_an_hour_of_four_lidars_is_small_and_opens_quickly(tab: Browser, tmp_path: Path) -> None:
    names = ("front", "left", "rear", "right")
    draw = np.random.default_rng(0)
    lost = draw.binomial(32, 0.02, (36_000, 4)) * 16
    columns = (512 - lost).tolist()
    sensors = [sensor(name, i, drift_ppm=i) for i, name in enumerate(names)]
    csv = table(names, columns, lost.tolist())
    source = Source(RunReport.from_json(report(*sensors, scans=36_000)), csv, None, tmp_path)
    page = page_of(tmp_path, source)
    # 36,000 scans; clouds would add 0.7 MB.
    assert page.stat().st_size < 4_000_000
    tab.open(page)
    assert tab.errors == []
    drawn_ms = int(tab.run("document.documentElement.dataset.drawn"))
    # 2 s on a free machine; here others may run.
    assert drawn_ms < 20_000
    looks = tab.run(LOOK)
    assert all(share > 0.005 and colours > 3 for _, share, colours, _, _ in looks)
