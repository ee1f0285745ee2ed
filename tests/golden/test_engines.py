"""The engines give the same bytes: every model and mode, fixtures, and real recordings.

What the engine `numpy` gives is checked elsewhere (`test_every_model.py` and others).
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from mlbatch.discovery.discover import SensorSelection
from mlbatch.pipeline.job import Job
from mlbatch.report.report import report_text
from tests.builders import four_makers
from tests.builders.engines import WANTED, check_conversion, needs_native
from tests.builders.run import FIXTURE, command, in_memory, prints
from tests.golden.test_every_model import CASES, Sent, job_of

pytestmark = needs_native

MAKERS = Job(
    (four_makers.FOLDER / "four_makers.pcap",),
    SensorSelection(rig=four_makers.FOLDER / "rig.yaml"),
    keep_partial=True,
)


@pytest.mark.parametrize(
    ("make", "words"),
    CASES,
    ids=[f"{make.__name__[:-5]} {' '.join(words)}" for make, words in CASES],
)
def test_every_model(make: Callable[..., Sent], words: tuple[str, ...], tmp_path: Path) -> None:
    job = job_of(make(*words), tmp_path)
    pairs = check_conversion(job)
    everything, _, cut, near, *_ = (pair.one.counts[0] for pair in pairs)
    assert everything.written > cut.written
    assert cut.box > 0
    assert near.written > 0
    still = {"firing_azimuth": "off"}
    check_conversion(replace(job, selection=replace(job.selection, decode=still)), WANTED[:1])


@pytest.mark.parametrize("job", [FIXTURE, MAKERS], ids=["two lidars", "four makers"])
def test_rigs(job: Job) -> None:
    check_conversion(job)


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"slices": 3},
        {"split": True},
        {"split": True, "slices": 2, "layout": "organized"},
        {"jobs": 2},
        {"keep_partial": False, "keep_repeated": True},
    ],
    ids=str,
)
@pytest.mark.parametrize("job", [FIXTURE, MAKERS], ids=["two lidars", "four makers"])
def test_whole_conversions(job: Job, change: dict[str, int]) -> None:
    job = replace(job, **change)  # type: ignore[arg-type]
    one, other = (in_memory(replace(job, engine=engine)) for engine in ("numpy", "native"))
    assert prints(one) == prints(other)
    assert report_text(one.report, machine=False) == report_text(other.report, machine=False)
    assert other.report.timing is not None
    assert other.report.timing.engine == "native"


@pytest.mark.parametrize("suffix", ["mcap", "bag", "folder"])
def test_outputs_do_not_tell_the_engine(suffix: str, tmp_path: Path) -> None:
    (recording,) = FIXTURE.recordings
    for engine in ("numpy", "native"):
        target: list[str | Path] = ["-o", tmp_path / f"{engine}.{suffix}"]
        words = [*target, "--engine", engine, "--quiet"]
        outcome = command("convert", recording, "--rig", FIXTURE.selection.rig or "", *words)
        assert (outcome.code, outcome.err) == (0, "")
    one, other = (contents(tmp_path / f"{name}.{suffix}") for name in ("numpy", "native"))
    assert one == other


def contents(output: Path) -> dict[str, bytes]:
    """Files of an output by name, without the report."""
    if output.is_file():
        return {"": output.read_bytes()}
    return {path.name: path.read_bytes() for path in output.iterdir() if path.stem != "report"}


def test_the_report_tells_the_engine(tmp_path: Path) -> None:
    (recording,) = FIXTURE.recordings
    report = tmp_path / "report.json"
    words: list[str | Path] = ["--dry-run", "--engine", "native", "--report", report]
    assert command("convert", recording, "--rig", FIXTURE.selection.rig or "", *words).code == 0
    assert json.loads(report.read_text(encoding="utf-8"))["timing"]["engine"] == "native"
