"""README and docs/ agree with the code: commands run, tables agree, all names are present."""

from __future__ import annotations

import re
import runpy
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml

from mlbatch.discovery import sampler
from mlbatch.discovery.calibrations import MAX_CALIBRATION_FILE_BYTES
from mlbatch.discovery.discover import SensorSelection
from mlbatch.frames import urdf
from mlbatch.lidar import limits as lidar_limits
from mlbatch.options import BY_NAME
from mlbatch.page.findings import REMEDIES
from mlbatch.pipeline.job import Job
from mlbatch.pipeline.run import convert
from mlbatch.readers import readers, source
from mlbatch.readers.bag import recording as bag_recording
from mlbatch.readers.capture import recording as capture
from mlbatch.reports import ledger
from mlbatch.reports.report import build_report
from mlbatch.rig import yaml_tree
from mlbatch.ros.packet_types import PACKET_TYPES
from mlbatch.sensors import MAX_CALIBRATION_BYTES, models
from mlbatch.writers.formats import format_names
from mlbatch.writers.point_layouts import CLOUD_LAYOUTS, PLY_LAYOUT
from tests.bench.cases import CASES, RECORDINGS
from tests.consumers.environments import ENVIRONMENTS
from tests.contract.blocks import PAGES
from tests.contract.test_help import OPTIONS
from tests.contract.tree import PACKAGE, ROOT, run_mlbatch, run_python

LINKED = (*PAGES, *sorted((ROOT / "docs" / "sources").glob("*.md")))
README = (ROOT / "README.md").read_text(encoding="utf-8")
MODELS = (ROOT / "docs" / "models.md").read_text(encoding="utf-8")
FIXTURE = "fixtures/two_lidars/two_lidars.pcap"
RIG = "fixtures/two_lidars/rig.yaml"
MAKE_TABLE = "runpy.run_path('docs/sensors_table.py', run_name='__main__')"
LINK = re.compile(r"\]\(([^)#:\s]*)(?:#([^)]*))?\)")


def _page(name: str) -> str:
    return (ROOT / "docs" / name).read_text(encoding="utf-8")


def _rows(page: str) -> list[list[str]]:
    """Cells of all table rows, without marks of code."""
    lines = [line for line in page.splitlines() if line.startswith("|")]
    return [
        [cell.strip().replace("`", "") for cell in line.strip("|").split("|")] for line in lines
    ]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the commands of the README can be typed."""
    folder = tmp_path_factory.mktemp("readme")
    (folder / "fixtures").symlink_to(ROOT / "fixtures")
    return folder


def test_the_table_of_sensors_is_up_to_date(tmp_path: Path) -> None:
    """It is made of the models, never written by hand."""
    copy = tmp_path / "models.md"
    copy.write_text(MODELS, encoding="utf-8")
    run_python(f"import runpy, sys; sys.argv[1:] = [{str(copy)!r}]\n{MAKE_TABLE}")
    assert copy.read_text(encoding="utf-8") == MODELS, "run python docs/sensors_table.py"


@pytest.mark.parametrize("name", CLOUD_LAYOUTS)
def test_layouts_are_described(name: str) -> None:
    layout = CLOUD_LAYOUTS[name]
    fields = [f"{f.name} {np.dtype(f.dtype).name} {f.offset}" for f in layout.fields]
    rows = [row[:3] for row in _rows(_page("formats.md"))]
    assert [name, ", ".join(fields), str(layout.step)] in rows


def test_formats_are_described() -> None:
    titles = re.findall(r"^## (\w+)", _page("formats.md"), re.MULTILINE)
    assert {title.lower() for title in titles} >= set(format_names())
    assert set(re.findall(r"\w+", BY_NAME["format"].about)) >= set(format_names())


def test_every_container_is_named() -> None:
    for reader in readers():
        assert reader.CONTAINER in README


def test_every_consumer_and_its_version_is_on_its_page() -> None:
    page = _page("formats.md")
    for environment in ENVIRONMENTS.values():
        for package in environment.packages:
            name, _, version = package.replace("==", "@").rpartition("@")
            # What a program needs and none of its own is left out.
            if name and name not in ("@mcap/nodejs", "@foxglove/rosmsg"):
                assert version in page, package


def _first_cells(page: str) -> set[str]:
    return {name for row in _rows(page) for name in row[0].split(", ")}


def test_every_npz_key_and_ply_property_is_described(place: Path) -> None:
    known = _first_cells(_page("formats.md"))
    done = run_mlbatch(["convert", FIXTURE, "--rig", RIG, "-o", "n"], place)
    assert done.returncode == 0, done.stderr
    with np.load(place / "n" / "000000.npz") as scan:
        assert set(scan.files) <= known
    assert {field.name for field in PLY_LAYOUT.fields} <= known
    head = (place / "n" / "scans.csv").read_text(encoding="utf-8").splitlines()[0]
    for column in head.split(","):
        name = re.sub(r"_(left|right)$", "_<sensor>", column)
        assert f"`{name}`" in _page("formats.md")


@pytest.mark.parametrize("kind", ["CAPTURE", "PACKET", "COLUMN", "IMU"])
def test_every_reason_is_described(kind: str) -> None:
    reasons = getattr(ledger, f"{kind}_REASONS")
    assert set(reasons) <= _first_cells(_page("report.md"))


def test_every_key_of_the_report_is_described() -> None:
    selection = SensorSelection(rig=ROOT / RIG)
    _, inputs = convert(Job((ROOT / FIXTURE,), selection), None)
    page = _page("report.md")
    words = set(re.findall(r"\w+", " ".join(re.findall(r"`[^`]+`", page))))
    assert set(_keys(build_report(inputs))) <= words


def _keys(value: object) -> Iterator[str]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield str(key)
            yield from _keys(inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from _keys(inner)


def _warning_codes() -> set[str]:
    """Codes of warnings that the source has as a text."""
    source = "".join(path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py"))
    codes = set(re.findall(r'\bNote\(\s*"(\w+)"', source))
    assert codes
    return codes


@pytest.mark.parametrize("page", LINKED, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(page: Path) -> None:
    """To a file of the repository, and to a heading or anchor of it."""
    for target, anchor in LINK.findall(_prose(page)):
        path = (page.parent / target).resolve() if target else page
        assert path.exists(), f"{page.name}: {target}"
        if anchor:
            assert anchor in _anchors(path), f"{page.name}: {target}#{anchor}"


def _prose(page: Path) -> str:
    """The text of a page without blocks of code."""
    return re.sub(r"^ *```.*?^ *```$", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)


def _anchors(page: Path) -> set[str]:
    """Anchors of a page: of its headings as Git hosts name them, and its own."""
    text = _prose(page)
    slugs = [
        re.sub(r"[^\w\- ]", "", re.sub(r"`|\[([^]]*)\]\([^)]*\)", r"\1", title).lower())
        for title in re.findall(r"^#+ (.+?) *$", text, re.MULTILINE)
    ]
    return {slug.replace(" ", "-") for slug in slugs} | set(re.findall(r'<a id="([^"]+)"', text))


@pytest.mark.parametrize("name", ["architecture.md", "extend.md"])
def test_files_that_a_page_names_exist(name: str) -> None:
    """Paths in code spans, from the repository, from mlbatch/ or from the end of a path there."""
    named = re.findall(r"`((?:[\w.-]+/)*\w+\.(?:py|c|h|txt))[`,]", _page(name))
    folders = [ROOT / top for top in ("mlbatch", "tests", "examples", "docs", ".ci")]
    files = [
        f"/{path.relative_to(ROOT).as_posix()}" for top in folders for path in top.rglob("*.*")
    ]
    assert named
    assert [one for one in named if not any(file.endswith(f"/{one}") for file in files)] == []


def test_every_page_is_in_the_navigation() -> None:
    made = runpy.run_path(str(ROOT / "docs" / "site_pages.py"))["made_pages"]()
    nav = re.findall(r"([\w/-]+\.md)$", (ROOT / "mkdocs.yml").read_text("utf-8"), re.MULTILINE)
    pages = [path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")]
    assert sorted(nav) == sorted([*pages, *made])


def test_every_warning_has_a_section_with_its_remedy() -> None:
    page = runpy.run_path(str(ROOT / "docs" / "site_pages.py"))["warnings_page"]()
    sections = re.findall(r"^## (\w+)$", page, re.MULTILINE)
    assert _warning_codes() <= set(sections) == set(REMEDIES)
    assert _warning_codes() <= _first_cells(_page("report.md"))
    assert page.count("**What to do:**") == len(sections)


def test_the_page_of_options_has_every_option() -> None:
    page = runpy.run_path(str(ROOT / "docs" / "site_pages.py"))["options_page"]()
    for name, options in OPTIONS.items():
        section = page.partition(f"## mlbatch {name}\n")[2].partition("\n## ")[0]
        names = " ".join(row[0] for row in _rows(section))
        assert set(re.findall(r"(?<![\w-])--[\w-]+", names)) >= set(options), name


def test_the_figures_of_performance_have_cases_that_print_them() -> None:
    """Every row is of cases of the benchmark; every case and recording is named."""
    page = _page("performance.md")
    cases = set(CASES) | set(RECORDINGS)
    rows = _rows(page)[2:]
    assert rows
    for row in rows:
        assert set(row[0].split(", ")) <= cases, row[0]
    assert cases <= set(re.findall(r"`([\w-]+)`", page))


def test_packet_messages_are_counted_as_listed() -> None:
    rows = _rows(_page("recordings.md"))
    kinds = [(kind, row[-1]) for row in rows for kind in row[0].split(", ") if kind in PACKET_TYPES]
    recorded = [kind for kind, source in kinds if source.startswith("recorded bag")]
    assert len(kinds) == len(PACKET_TYPES)
    counts = f"Of {len(kinds)} packet message types {len(recorded)} were checked"
    assert counts in _page("limits.md")


@pytest.mark.parametrize(
    ("text", "bounds"),
    [
        ("256 kB, 1 MB", (capture.MAX_FRAME_BYTES >> 10, capture.MAX_BLOCK_BYTES >> 20)),
        ("256 MB, independent", (source.MAX_RECORD_BYTES >> 20,)),
        (
            "300 kB, 20,000 values, 16 levels",
            (yaml_tree.MAX_BYTES // 1000, yaml_tree.MAX_VALUES, yaml_tree.MAX_DEPTH),
        ),
        ("16 MB, no document types", (urdf.MAX_BYTES >> 20,)),
        ("2 MB, 16 MB; NaN", (MAX_CALIBRATION_FILE_BYTES // 10**6, MAX_CALIBRATION_BYTES // 10**6)),
        ("| 64 of its own source", (sampler.MAX_NEIGHBOURS,)),
        ("| notes on one file | 100 |", (bag_recording.MOST_NOTES,)),
        (
            "rigid, finite, at most 1 m; beams leave within 0.5 m",
            (lidar_limits.MAX_ORIGIN_M, lidar_limits.MAX_BEAM_M),
        ),
        ("rigid, finite, at most 100 m", (lidar_limits.MAX_POSE_M,)),
        ("at most 10 km from the body", (lidar_limits.MAX_TRANSLATION_M / 1000,)),
    ],
)
def test_bounds_of_untrusted_input_are_those_of_the_code(
    text: str, bounds: tuple[float, ...]
) -> None:
    assert text in _page("untrusted.md")
    numbers = [float(word.replace(",", "")) for word in re.findall(r"\d[\d,.]*\d|\d", text)]
    assert numbers == list(bounds)


def test_the_site_needs_no_server_and_no_other_site() -> None:
    """Its search neither: the script that `offline` would load from unpkg.com is one of ours."""
    settings = yaml.safe_load((ROOT / "mkdocs.yml").read_text("utf-8"))
    assert "offline" in settings["plugins"]
    assert not settings["use_directory_urls"]
    assert settings["theme"]["font"] is False
    (script,) = settings["extra"]["polyfills"]
    assert "iframe-worker" in script
    assert (ROOT / "docs" / script).is_file()


def test_recordings_are_neither_denied_nor_kept_secret() -> None:
    """A model of a real recording is on the page of comparisons, and in no row without one."""
    real = {model.name for model in models() if model.verified == "real recording"}
    accuracy = MODELS.partition("## Agreement")[2]
    for name in real:
        # All of the recordings of Ouster are in one row.
        assert name in accuracy or name.startswith("OS"), name
    denied = [row[0] for row in _rows(_page("sensors.md")) if "no recording" in " ".join(row[1:])]
    assert denied
    assert not real & {name for cell in denied for name in cell.split(", ")}
