"""Plug-ins of other distributions, by the package in examples/."""

from __future__ import annotations

import importlib.metadata
import json
import math
import os
import re
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mlbatch import entry_points, readers, sensors, writers
from mlbatch.errors import UsageError
from mlbatch.writers.formats import format_names
from tests.contract.tree import ROOT

EXAMPLE = ROOT / "examples" / "mlbatch-example"
START_NS = 1_700_000_000_000_000_000
COLUMN_NS = 250_000
PACKETS = 250
# The first setuptools that makes wheels on its own is 70.1.
FIRST_WITH_WHEELS = 71
RANGE_M = 10.0
ELEVATION_DEG = (-15.0, -5.0, 5.0, 15.0)


def _packet(number: int) -> bytes:
    """Eight columns of an Example-4 at 10 Hz: 400 columns a revolution, 10 m everywhere."""
    first_ns = START_NS + number * 8 * COLUMN_NS
    packet = struct.pack("<4sIQ", b"EX4\0", number, first_ns)
    for column in range(number * 8, number * 8 + 8):
        packet += struct.pack("<H", column % 400 * 90)
        packet += struct.pack("<HB", round(RANGE_M / 0.005), 77) * 4
    return packet


def _has(distribution: str, major: int) -> bool:
    """Whether a distribution is installed, in this major version or a later one."""
    try:
        return int(importlib.metadata.version(distribution).partition(".")[0]) >= major
    except importlib.metadata.PackageNotFoundError:
        return False


def write_framelog(path: Path) -> Path:
    """Half a second of one sensor."""
    data = b"FRAMELOG"
    for number in range(PACKETS):
        payload = _packet(number)
        host_ns = START_NS + (number + 1) * 8 * COLUMN_NS
        data += struct.pack("<Q4sHH", host_ns, bytes((10, 0, 0, 7)), 5000, len(payload)) + payload
    path.write_bytes(data)
    return path


def _register(site: Path) -> Path:
    """A site folder with the example, as an installation leaves it."""
    shutil.copytree(EXAMPLE / "mlbatch_example", site / "mlbatch_example")
    text = (EXAMPLE / "pyproject.toml").read_text(encoding="utf-8")
    lines = []
    for line in text.partition("[project.entry-points")[2].partition("[tool")[0].splitlines():
        group, is_head, _ = line.removeprefix("[project.entry-points").partition("]")
        lines.append(f"[{group.strip('. ').strip(chr(34))}]" if is_head else line.replace('"', ""))
    about = site / "mlbatch_example-1.0.0.dist-info"
    about.mkdir()
    metadata = "Metadata-Version: 2.1\nName: mlbatch-example\nVersion: 1.0.0\n"
    (about / "METADATA").write_text(metadata, encoding="utf-8")
    (about / "entry_points.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return site


def _run(site: Path, cwd: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "mlbatch", *arguments],
        capture_output=True,
        text=True,
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{site}"},
        check=False,
    )


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _register(tmp_path_factory.mktemp("site"))


def _check_conversion(site: Path, folder: Path) -> None:
    """Reader, sensor and writer of the example in one run; numbers by hand."""
    write_framelog(folder / "drive.flog")
    done = _run(site, folder, "convert", "drive.flog", "-o", "raw", "--format", "rawf32")
    assert (done.returncode, done.stderr) == (0, "")
    report = json.loads((folder / "raw" / "report.json").read_text(encoding="utf-8"))
    assert report["inputs"][0]["container"] == "frame log"
    (sensor,) = report["sensors"]
    assert (sensor["model"], sensor["packets"]["lost"]) == ("Example-4", 0)
    assert sensor["packets"]["accepted"] == PACKETS
    # Half a second from a bound of the grid: scans 1 to 3 of 400 columns are whole.
    files = sorted((folder / "raw").glob("*.rawf32"))
    assert [path.name for path in files] == ["000000.rawf32", "000001.rawf32", "000002.rawf32"]
    rows = np.fromfile(files[0], "<f4").reshape(-1, 4)
    assert len(rows) == 400 * 4
    assert set(rows[:, 3].tolist()) == {77.0}
    for beam, elevation_deg in enumerate(ELEVATION_DEG):
        away = RANGE_M * math.cos(math.radians(elevation_deg))
        up = RANGE_M * math.sin(math.radians(elevation_deg))
        np.testing.assert_allclose(rows[beam, :3], [away, 0, up], atol=1e-5)
        # A quarter of a revolution later, clockwise from above: to the right.
        np.testing.assert_allclose(rows[400 + beam, :3], [0, -away, up], atol=1e-5)


def test_the_example_in_use(site: Path, tmp_path: Path) -> None:
    _check_conversion(site, tmp_path)


def test_the_example_installed(tmp_path: Path) -> None:
    """By pip, where it can build without a network."""
    # Not imported here: setuptools changes what other modules import.
    for name, first in (("pip", 1), ("setuptools", FIRST_WITH_WHEELS)):
        if not _has(name, first):
            pytest.skip(f"no {name} {first} in this environment")
    # A build writes next to its sources.
    source = shutil.copytree(EXAMPLE, tmp_path / "source")
    site = tmp_path / "site"
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--quiet", "--target", str(site)]
    command = [sys.executable, "-m", "pip", "install", *options, str(source)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    _check_conversion(site, tmp_path)


def test_the_example_is_listed_and_verified(site: Path, tmp_path: Path) -> None:
    write_framelog(tmp_path / "drive.flog")
    for words, text in (
        ("sensors", "Example-4"),
        ("inspect drive.flog", "Example-4"),
        ("convert drive.flog -o x --format none", "rawf32"),
        ("convert drive.flog -o scans.mcap", "wrote scans.mcap"),
        ("verify scans.mcap", "ok"),
    ):
        done = _run(site, tmp_path, *words.split())
        assert text in done.stdout + done.stderr, words
        assert (done.returncode == 0) == (text != "rawf32")


def test_the_page_names_the_modules_of_the_example() -> None:
    page = (ROOT / "docs" / "extend.md").read_text(encoding="utf-8")
    for module in ("framelog", "sensor", "rawf32"):
        assert (EXAMPLE / "mlbatch_example" / f"{module}.py").is_file()
        assert f"`mlbatch_example/{module}.py`" in page


# -- mistakes -------------------------------------------------------------------------------------


def _distribution(site: Path, name: str, group: str, line: str) -> None:
    about = site / f"{name}-1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1\n")
    (about / "entry_points.txt").write_text(f"[{group}]\n{line}\n")


@pytest.fixture
def other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of modules and distributions, on the path of this process."""
    monkeypatch.syspath_prepend(str(tmp_path))
    entry_points.forget()
    format_names.cache_clear()
    return tmp_path


@pytest.fixture(autouse=True)
def _nothing_remains() -> object:
    yield
    entry_points.forget()
    format_names.cache_clear()


ODD = "FORMAT = 'even'\nSUFFIX = None\nCOMPRESSES = False\nextras = open_writer = print\n"
# Modules; distributions with a group and a line; what asks for plug-ins; the error.
MISTAKES: list[tuple[dict[str, str], list[tuple[str, str, str]], Callable[[], object], str]] = [
    (
        {"broken": "import no_such_module\n"},
        [("dist", entry_points.READERS, "odd = broken")],
        readers.readers,
        "mlbatch.readers odd of dist: expected to import broken, found ModuleNotFoundError: No "
        "module named 'no_such_module'; correct, update or uninstall",
    ),
    (
        {"half_sensor": "VENDOR = 'Half'\nMODELS = ()\nBUILT_IN = ()\n"},
        [("dist", entry_points.SENSORS, "half = half_sensor")],
        sensors.plugins,
        "in half_sensor, found no read_calibration, describe; ",
    ),
    (
        {},
        [("dist", entry_points.WRITERS, "npz = json")],
        format_names,
        "npz of dist: expected a name of its own",
    ),
    (
        {},
        [(name, entry_points.WRITERS, f"same = {name}_writer") for name in ("one", "two")],
        format_names,
        "one plug-in of this name, found those of one and two;",
    ),
    (
        {"odd_writer": ODD},
        [("dist", entry_points.WRITERS, "odd = odd_writer")],
        lambda: writers.plugin("odd"),
        "odd of dist: expected FORMAT 'odd', found 'even'",
    ),
]


@pytest.mark.parametrize(("texts", "distributions", "ask", "message"), MISTAKES)
def test_mistakes(
    texts: dict[str, str],
    distributions: list[tuple[str, str, str]],
    ask: Callable[[], object],
    message: str,
    other: Path,
) -> None:
    for name, text in texts.items():
        (other / f"{name}.py").write_text(text)
    for name, group, line in distributions:
        _distribution(other, name, group, line)
    with pytest.raises(UsageError, match=re.escape(message)):
        ask()


def test_nothing_is_looked_up_where_a_built_in_plugin_fits(other: Path) -> None:
    (other / "loud.py").write_text("raise SystemExit\n")
    for group in (entry_points.READERS, entry_points.WRITERS):
        _distribution(other, group.replace(".", ""), group, "loud = loud")
    capture = ROOT / "fixtures" / "two_lidars" / "two_lidars.pcap"
    from mlbatch.types import StreamTable

    assert readers.open_recording(capture, StreamTable()).container == "pcap"
    assert writers.choose_format(Path("scans.mcap"), None) == "mcap"


# -- the quick search -----------------------------------------------------------------------------


class _Finder:
    def find_spec(self, *_: object) -> None:
        return None

    def find_distributions(self, *_: object) -> list[object]:
        return []


# What is on the path, and the groups that are looked up in the metadata of all distributions.
SEARCHES = {
    "plug-ins of others": ("unrelated.dist-info/entry_points.txt", "mlbatch.sensors_of_others", []),
    "a plug-in": ("own.egg-info/entry_points.txt", "mlbatch.sensors", [entry_points.SENSORS]),
    "a zip": ("packages.zip", "", [entry_points.READERS, entry_points.SENSORS]),
    "an egg": ("thing-1.egg", "", [entry_points.READERS, entry_points.SENSORS]),
    "another finder": ("", "", [entry_points.READERS, entry_points.SENSORS]),
}


@pytest.mark.parametrize("name", SEARCHES)
def test_metadata_are_read_where_they_may_have_plugins(
    name: str, other: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, group, expected = SEARCHES[name]
    # Libraries of other tests may have added finders.
    finders: list[Any] = [one for one in sys.meta_path if one is PathFinder]
    finders += [one for one in sys.meta_path if not hasattr(one, "find_distributions")]
    monkeypatch.setattr(sys, "meta_path", [*finders, *([] if file else [_Finder()])])
    if file:
        (other / file).parent.mkdir(exist_ok=True)
        (other / file).write_text(f"[{group}]\nx = y\n")
    is_archive = file.endswith((".zip", ".egg"))
    place = str(other / file) if is_archive else str(other)
    monkeypatch.setattr(sys, "path", [place, "", str(other / "missing")])
    lookups: list[str] = []

    def looked_up(group: str) -> list[importlib.metadata.EntryPoint]:
        lookups.append(group)
        return []

    monkeypatch.setattr(importlib.metadata, "entry_points", looked_up)
    for asked in (entry_points.READERS, entry_points.SENSORS):
        assert entry_points.names(asked) == ()
    assert lookups == expected
