"""Pages in a real browser: no error, no request, every plot drawn, in light and dark."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mlbatch.page import Source, write_page
from mlbatch.reports.report import RunReport
from tests.builders.sessions import FIXTURE
from tests.contract.tree import run_mlbatch
from tests.page.browser import CHROMIUM, NO_CHROMIUM, Browser
from tests.page.runs import report, sensor, table
from tests.page.test_page import plot_data, points_of

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)

# Set span and delay vary by less than a plot is worth.
TIME_PLOTS = ("timeline", "gap", "points")
# Share of opaque pixels, and number of different colours, of each canvas.
LOOK = """(() => [...document.querySelectorAll('canvas')].map(c => {
  const copy = document.createElement('canvas');
  [copy.width, copy.height] = [c.width, c.height];
  const ctx = copy.getContext('2d');
  ctx.drawImage(c, 0, 0);
  const d = new Uint32Array(ctx.getImageData(0, 0, c.width, c.height).data.buffer);
  return [c.id || 'base', d.filter(p => p >>> 24 > 100).length / d.length, new Set(d).size,
    c.width, Math.round(c.getBoundingClientRect().width)];
}))()"""
# The points as drawn, without what is drawn over them.
POINTS = "document.querySelector('#stage canvas').toDataURL()"
SHOWN = "document.documentElement.dataset.shown"
RANGE = "document.getElementById('range').textContent"
# A row of the timeline in the middle of the lane of a sensor: share of red pixels.
RED = """((lane) => { const c = document.getElementById('timeline');
  const d = c.getContext('2d').getImageData(0, lane * 56 + 16 + 20, c.width, 1).data;
  let n = 0; for (let i = 0; i < d.length; i += 4) if (d[i] > 180 && d[i + 1] < 120) n++;
  return n / c.width; })"""


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


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("width", [1400, 400])
def test_every_plot_is_drawn(width: int, dark: bool, tab: Browser, real_page: Path) -> None:
    tab.open(real_page, width=width, dark=dark)
    tab.wait(SHOWN)
    assert tab.errors == []
    assert tab.requests == [real_page.resolve().as_uri()]
    looks = tab.run(LOOK)
    assert [look[0] for look in looks] == ["base", "cloud", *TIME_PLOTS]
    for name, share, colours, inner, outer in looks:
        assert share > 0.005, name
        assert colours > 3, name
        # Drawn at the width that is shown; a border is not drawn on.
        assert abs(inner - outer) <= 4, name
    # Nothing is wider than the page.
    assert tab.run("document.documentElement.scrollWidth") <= width
    assert tab.screenshot()[1] > 2000
    # The verdict, the cloud and five figures are the first screen.
    low = tab.run("document.querySelector('.cards').getBoundingClientRect().bottom")
    assert tab.run("document.querySelectorAll('.card').length") == 5
    assert low <= 900 or width < 1400
    back = tab.run("getComputedStyle(document.body).backgroundColor")
    assert back == ("rgb(17, 21, 27)" if dark else "rgb(246, 247, 249)")


def test_a_stall_is_red_where_it_was(tab: Browser, tmp_path: Path) -> None:
    columns = [[512, 0 if 30 <= index < 60 else 512] for index in range(100)]
    csv = table(("left", "right"), columns, 512)
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
    csv = table(("left", "right"), columns, 512)
    source = Source(
        RunReport.from_json(report(sensor("left"), sensor("right", 1))), csv, None, tmp_path
    )
    tab.open(page_of(tmp_path, source))
    tab.wait(RANGE, "+0.0 s to +10.0 s")
    tab.drag("#timeline", 0.5, 0.6)
    tab.wait(RANGE, "+5.0 s to +6.0 s")
    tab.run("document.getElementById('all').click()")
    tab.wait(RANGE, "+0.0 s to +10.0 s")
    for _ in range(20):
        tab.run("document.getElementById('in').click()")
    # Four windows.
    tab.wait(RANGE, "+4.8 s to +5.2 s")
    assert tab.errors == []


def test_colours_and_scans_can_be_chosen(tab: Browser, real_page: Path) -> None:
    tab.open(real_page)
    tab.wait(SHOWN)
    pictures = {tab.run(POINTS)}
    for colour in ("height", "time", "bright", "lidar"):
        tab.run(f"document.querySelector('[data-colour={colour}]').click()")
        pressed = "document.querySelector('[data-colour][aria-pressed=true]').dataset.colour"
        tab.wait(pressed, colour)
        pictures.add(tab.run(POINTS))
    # The first one is that of the lidars.
    assert len(pictures) == 4
    tab.run("document.querySelector('[data-scan=\"3\"]').click()")
    tab.wait(SHOWN, "3")
    assert "middle" in tab.run("document.getElementById('cloudinfo').textContent")
    pictures.add(tab.run(POINTS))
    # A click in the timeline shows the scan there, the last of seven.
    tab.drag("#timeline", 0.93, 0.93)
    tab.wait(SHOWN, "6")
    before = json.dumps(tab.run(POINTS))
    tab.drag("#cloud", 0.3, 0.6)
    tab.wait(f"{POINTS} !== {before} || null")
    assert len(pictures) == 5
    assert tab.errors == []


def test_the_cloud_has_keys_and_names_a_point(tab: Browser, real_page: Path) -> None:
    tab.open(real_page)
    tab.wait(SHOWN)
    tab.run("document.getElementById('cloud').focus()")
    for key, shift in (("ArrowLeft", False), ("ArrowUp", True), ("+", False), ("t", False)):
        before = json.dumps(tab.run(POINTS))
        tab.press(key, shift=shift)
        tab.wait(f"{POINTS} !== {before} || null")
    tab.run("document.querySelector('[data-scan=\"0\"]').click()")
    for key, shown in ((".", "1"), (",", "0")):
        tab.press(key)
        tab.wait(SHOWN, shown)
    tab.press(" ")
    # All scans, and the first again.
    tab.wait(SHOWN, "6")
    tab.wait(SHOWN, "0")
    tab.press(" ")
    assert tab.run("document.getElementById('play').textContent") == "Play"
    over = "document.getElementById('cloud').toDataURL()"
    before = tab.run(over)
    tab.hover("#cloud", 0.5, 0.5)
    tab.wait(f"{over} !== {json.dumps(before)} || null")
    assert tab.errors == []


def test_the_browser_unpacks_what_the_page_has(tab: Browser, real_page: Path) -> None:
    """The first lidar has lost a tenth of its packets."""
    tab.open(real_page)
    data = "JSON.parse(document.getElementById('data').textContent)"
    for number, cloud in enumerate(plot_data(real_page)["clouds"][:2]):
        tab.run(f"unpackCloud({data}.clouds[{number}]).then(c => {{ window.unpacked = c; }})")
        tab.wait("window.unpacked && window.unpacked.title", cloud["title"])
        shown = points_of(cloud)
        steps = np.rint((shown.xyz - cloud["low"]) / cloud["step"]).astype(int)
        assert tab.run("[...unpacked.steps]") == steps.ravel().tolist()
        assert tab.run("[...unpacked.ring]") == shown.ring.tolist()
        assert tab.run("[...unpacked.lidar]") == shown.lidar.tolist()
        assert tab.run("[...unpacked.bright]") == shown.intensity.tolist()
        time_ms = np.array(tab.run("[...unpacked.time]")) / 65535 * cloud["times"][1]
        np.testing.assert_allclose(time_ms, shown.time_ms, rtol=0, atol=1e-9)


def test_without_webgl_the_points_are_drawn_and_it_is_said(tab: Browser, real_page: Path) -> None:
    script = """const old = HTMLCanvasElement.prototype.getContext;
      HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
        return kind === 'webgl' ? null : old.call(this, kind, ...more); };"""
    # Pixels of the colour of each lidar, and canvases.
    look = """(() => { const c = document.getElementById('cloud');
      const { data } = c.getContext('2d').getImageData(0, 0, c.width, c.height);
      const words = [...new Uint32Array(data.buffer)];
      const count = (i) => words.filter((one) => one === word(...rgbOf(PALETTE[i]))).length;
      return [count(0), count(1), document.querySelectorAll('#stage canvas').length]; })()"""
    with tab.before_pages(script):
        tab.open(real_page)
        tab.wait(SHOWN)
        *pixels, canvases = tab.run(look)
        why = tab.run("document.getElementById('cloudwhy').textContent")
    assert tab.errors == []
    assert "no WebGL" in why
    assert canvases == 1
    # Two lidars, which are not faded by distance; their marks are small.
    assert min(pixels) > 1000


def test_a_browser_that_cannot_unpack_says_so(tab: Browser, real_page: Path) -> None:
    with tab.before_pages("delete window.DecompressionStream"):
        tab.open(real_page)
        why = tab.run("document.getElementById('cloudwhy').innerText")
        assert tab.run("document.getElementById('stage').hidden")
    assert "no DecompressionStream" in why
    assert tab.errors == []
