"""Outputs of the tool have no violation, and what a format shows is checked.

Every format, layout and preset of both fixtures: test_digests.py. Unusual lidars: ranges of an
HDL-64E begin elsewhere, a Ruby gives each return its own column, a PandarQT64 has the longest
columns.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mlbatch.outputs.stored_scan import COLUMN_NS
from mlbatch.verification import CHECKS, verify
from tests.builders.every_model import hesai, job_of, robosense, sent_by, velodyne
from tests.builders.run import ROOT, command

SUFFIX = {"mcap": ".mcap", "rosbag1": ".bag"}
# Checks with values in each format, of merged scans at the standard layout.
MESSAGES = set(CHECKS) - {"names", "geometry", "duplicates", "messages"}
CHECKED = {
    "npz": set(CHECKS) - {"stamps", "tf_static", "frames", "imu", "messages"},
    "ply": set(CHECKS)
    - {"stamps", "tf_static", "frames", "imu", "messages", "geometry", "duplicates"},
    "mcap": MESSAGES,
    "rosbag2": MESSAGES | {"names"},
    "rosbag1": MESSAGES,
}


@pytest.mark.parametrize("form", CHECKED)
def test_what_a_format_shows_is_checked(form: str, tmp_path: Path) -> None:
    source = ROOT / "fixtures" / "two_lidars"
    target = tmp_path / f"out{SUFFIX.get(form, '')}"
    words = ("--rig", source / "rig.yaml", "--quiet", "--format", form)
    run = command("convert", source / "two_lidars.pcap", "-o", target, *words)
    assert (run.code, run.err) == (0, "")
    verdict = verify(target)
    assert verdict.ok, verdict.violations
    assert {check.name for check in verdict.checks if check.checked} == CHECKED[form]


ODD = {
    "HDL-64E": velodyne("HDL-64E S3", "dual"),
    "Ruby": robosense("Ruby 128", "dual"),
    "QT64": hesai("PandarQT64", "dual"),
    "JT128": hesai("JT128", "strongest"),
    "Airy": robosense("Airy 96", "strongest"),
}


@pytest.mark.parametrize("name", ODD)
def test_odd_lidars_are_clean(name: str, tmp_path: Path) -> None:
    sent = sent_by(ODD[name])
    columns, _, _ = sent.spec.shape(len(sent.payloads))
    longest_ns = int(np.ptp(sent.spec.said_times_ns(columns), axis=1).max())
    assert 5 * longest_ns < COLUMN_NS
    (path,) = job_of(sent, tmp_path).recordings
    words: tuple[str | Path, ...] = ("--metadata", tmp_path / sent.file) if sent.file else ()
    if sent.spec.rig_model:
        words = ("--rig", tmp_path / "rig.yaml")
    for layout in ("dense", "organized"):
        target = tmp_path / layout
        more = ("--rate", "20", "--keep-partial", "--layout", layout)
        run = command("convert", path, "-o", target, *words, *more)
        assert run.code == 0, run.err
        verdict = verify(target)
        assert verdict.ok, verdict.violations
        assert verdict.points > 0
