"""Every model and mode is recognised; they and the fixtures decode as the literal decoder says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from mlbatch.discovery.discover import SensorSelection
from mlbatch.pipeline.job import Job
from mlbatch.simulate.spinning import SpinningSpec
from tests.builders.engines import WANTED, check_conversion
from tests.builders.every_model import CASES, job_of, sent_by
from tests.builders.lidar_packets import words_of
from tests.builders.run import FIXTURE, FOUR_MAKERS

MAKERS = Job(
    (FOUR_MAKERS / "four_makers.pcap",),
    SensorSelection(rig=FOUR_MAKERS / "rig.yaml"),
    keep_partial=True,
)


@pytest.mark.parametrize("spec", CASES, ids=words_of)
def test_every_model(spec: SpinningSpec, tmp_path: Path) -> None:
    sent = sent_by(spec)
    job = job_of(sent, tmp_path)
    pairs = check_conversion(job)
    lidar = pairs[0].sources[0].lidar
    found = (lidar.model, lidar.channels, lidar.returns)
    assert found == (spec.reported_model, spec.channels, sent.returns)
    assert sent.types in ((), lidar.return_types)
    everything, _, cut, near, *_ = (pair.decoder.counts[0] for pair in pairs)
    assert everything.written > cut.written
    assert cut.box > 0
    assert near.written > 0
    still = {"firing_azimuth": "off"}
    check_conversion(replace(job, selection=replace(job.selection, decode=still)), WANTED[:1])


@pytest.mark.parametrize("job", [FIXTURE, MAKERS], ids=["two lidars", "four makers"])
def test_rigs(job: Job) -> None:
    check_conversion(job)
