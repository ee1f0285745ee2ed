"""Plug-ins of other distributions, by the package in examples/."""

from __future__ import annotations

import importlib.metadata
import json
import math
import os
import shutil
import struct
import subprocess
import sys
from importlib.machinery import PathFinder
from pathlib import Path

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


def test_the_example_is_converted(site: Path, tmp_path: Path) -> None:
    write_framelog(tmp_path / "drive.flog")
    arguments = ["convert", "drive.flog", "-o", "scans.mcap"]
    assert _run(site, tmp_path, *arguments).returncode == 0
    assert "violated" not in _run(site, tmp_path, "verify", "scans.mcap").stdout


def test_the_example_is_listed(site: Path, tmp_path: Path) -> None:
    assert "Example-4" in _run(site, tmp_path, "sensors").stdout
    write_framelog(tmp_path / "drive.flog")
    assert "Example-4" in _run(site, tmp_path, "inspect", "drive.flog").stdout
    done = _run(site, tmp_path, "convert", "drive.flog", "-o", "x", "--format", "none")
    assert "rawf32" in done.stderr


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


def test_a_plugin_that_cannot_be_imported(other: Path) -> None:
    (other / "broken_reader.py").write_text("import no_such_module\n")
    _distribution(other, "broken", entry_points.READERS, "odd = broken_reader")
    expected = (
        "mlbatch.readers odd of broken: expected to import broken_reader, found "
        "ModuleNotFoundError: No module named 'no_such_module'; correct, update or uninstall"
    )
    with pytest.raises(UsageError, match=expected):
        readers.readers()


def test_a_plugin_without_a_part(other: Path) -> None:
    (other / "half_sensor.py").write_text("VENDOR = 'Half'\nMODELS = ()\nBUILT_IN = ()\n")
    _distribution(other, "half", entry_points.SENSORS, "half = half_sensor")
    with pytest.raises(UsageError, match="in half_sensor, found no read_calibration, describe; "):
        sensors.plugins()


def test_the_name_of_a_built_in_plugin(other: Path) -> None:
    _distribution(other, "taken", entry_points.WRITERS, "npz = json")
    with pytest.raises(UsageError, match="npz of taken: expected a name of its own"):
        format_names()


def test_two_plugins_of_one_name(other: Path) -> None:
    _distribution(other, "one", entry_points.WRITERS, "same = one_writer")
    _distribution(other, "two", entry_points.WRITERS, "same = two_writer")
    with pytest.raises(UsageError, match="one plug-in of this name, found those of one and two;"):
        format_names()


def test_a_writer_of_another_format(other: Path) -> None:
    (other / "odd_writer.py").write_text(
        "FORMAT = 'even'\nSUFFIX = None\nCOMPRESSES = False\nextras = open_writer = print\n"
    )
    _distribution(other, "odd", entry_points.WRITERS, "odd = odd_writer")
    with pytest.raises(UsageError, match="odd of odd: expected FORMAT 'odd', found 'even'"):
        writers.plugin("odd")


def test_nothing_is_looked_up_where_a_built_in_plugin_fits(other: Path) -> None:
    (other / "loud.py").write_text("raise SystemExit\n")
    for group in (entry_points.READERS, entry_points.WRITERS):
        _distribution(other, group.replace(".", ""), group, "loud = loud")
    capture = ROOT / "fixtures" / "two_lidars" / "two_lidars.pcap"
    from mlbatch.types import StreamTable

    assert readers.open_recording(capture, StreamTable()).container == "pcap"
    assert writers.choose_format(Path("scans.mcap"), None) == "mcap"


# -- the quick search -----------------------------------------------------------------------------


class _Lookups:
    """Counts uses of `importlib.metadata`."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.groups: list[str] = []
        monkeypatch.setattr(importlib.metadata, "entry_points", self._entry_points)

    def _entry_points(self, group: str) -> list[importlib.metadata.EntryPoint]:
        self.groups.append(group)
        return []


def _leave_out_finders(monkeypatch: pytest.MonkeyPatch) -> None:
    """Search without the finders that libraries of other tests may have added."""
    finders = [
        finder
        for finder in sys.meta_path
        if finder is PathFinder or not hasattr(finder, "find_distributions")
    ]
    monkeypatch.setattr(sys, "meta_path", finders)


def test_metadata_are_not_read_without_plugins(
    other: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _leave_out_finders(monkeypatch)
    _distribution(other, "unrelated", "mlbatch.sensors_of_others", "x = y")
    monkeypatch.setattr(sys, "path", [str(other), "", str(other / "missing")])
    lookups = _Lookups(monkeypatch)
    assert entry_points.names(entry_points.SENSORS) == ()
    assert lookups.groups == []


def test_metadata_are_read_where_one_distribution_has_plugins(
    other: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _leave_out_finders(monkeypatch)
    about = other / "own.egg-info"
    about.mkdir()
    (about / "entry_points.txt").write_text("[mlbatch.sensors]\nx = y\n")
    monkeypatch.setattr(sys, "path", [str(other)])
    lookups = _Lookups(monkeypatch)
    entry_points.names(entry_points.READERS)
    assert lookups.groups == []
    entry_points.names(entry_points.SENSORS)
    assert lookups.groups == [entry_points.SENSORS]


@pytest.mark.parametrize("name", ["packages.zip", "thing-1.egg"])
def test_metadata_are_read_where_archives_are_on_the_path(
    name: str, other: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (other / name).write_bytes(b"PK")
    monkeypatch.setattr(sys, "path", [str(other / name)])
    lookups = _Lookups(monkeypatch)
    entry_points.names(entry_points.WRITERS)
    assert lookups.groups == [entry_points.WRITERS]


def test_metadata_are_read_where_another_finder_has_distributions(
    other: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Finder:
        def find_spec(self, *_: object) -> None:
            return None

        def find_distributions(self, *_: object) -> list[object]:
            return []

    monkeypatch.setattr(sys, "path", [str(other)])
    monkeypatch.setattr(sys, "meta_path", [*sys.meta_path, Finder()])
    lookups = _Lookups(monkeypatch)
    entry_points.names(entry_points.WRITERS)
    assert lookups.groups == [entry_points.WRITERS]
