"""Messages of the command line about lidars that have no decoder."""

from __future__ import annotations

import json
from pathlib import Path

from tests.builders.captures import udp_frame
from tests.builders.others import EE, filled
from tests.builders.sessions import EPOCH_NS, Shell, Unit, report_of, write_session
from tests.cli.test_mistakes import m1

WHAT = "ROBOSENSE lidar M1: no decoder in this version"
WHERE = "10.0.0.8 > port 6699"


def test_a_lidar_without_decoder_can_be_ignored(shell: Shell, tmp_path: Path) -> None:
    capture = write_session(tmp_path, Unit(), more=m1())
    outcome = shell(f"convert {capture} -o out --ignore 10.0.0.8:6699 --strict")
    assert outcome.code == 0, outcome.err
    report = report_of("out/report.json")
    assert report["warnings"] == []
    assert [(one["stream"], one["packets"]) for one in report["unassigned"]] == [(WHERE, 20)]


def test_inspect_says_what_is_missing(shell: Shell, tmp_path: Path) -> None:
    position = filled(512, {0: EE + b"712190403180"})
    beside = [(EPOCH_NS, frame) for frame in udp_frame(position, src="10.0.0.8", dport=10110)]
    capture = write_session(tmp_path, Unit(), more=m1() + beside)
    outcome = json.loads(shell(f"inspect {capture} --json").out)
    found = {one["stream"]: (one["what"], one["missing"]) for one in outcome["streams"]}
    assert found[WHERE] == (WHAT, "decoder")
    assert found["10.0.0.8 > port 10110"] == ("HESAI GPS packet", "")
    assert found["10.0.0.1 > port 7502"][1] == ""
