"""Messages of the command line about lidars that have no decoder."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.builders.captures import udp_frame
from tests.builders.others import EE, filled
from tests.builders.sessions import EPOCH_NS, Records, Shell, Unit, write_session

WHAT = "ROBOSENSE lidar M1: no decoder in this version"
WHERE = "10.0.0.8 > port 6699"
ADVICE = "expected a supported lidar, found none; see `mlbatch sensors` for those that are"


def _m1() -> Records:
    return [
        (EPOCH_NS + 1_327_000 * n, frame)
        for n in range(20)
        for frame in udp_frame(
            filled(1210, {0: bytes.fromhex("55aa5aa5"), 4: bytes((0, n))}),
            src="10.0.0.8",
            dport=6699,
        )
    ]


def test_a_recording_of_a_lidar_without_decoder_is_refused(shell: Shell, tmp_path: Path) -> None:
    capture = write_session(tmp_path, more=_m1())
    outcome = shell(f"convert {capture} -o out")
    assert (outcome.code, outcome.out) == (1, "")
    assert outcome.err == f"mlbatch: error: {capture}: {WHERE} carries {WHAT}; {ADVICE}\n"
    assert not (tmp_path / "out").exists()


def test_metadata_that_are_missing_are_asked_for_first(shell: Shell, tmp_path: Path) -> None:
    capture = write_session(tmp_path, Unit(), more=_m1(), metadata=False)
    outcome = shell(f"convert {capture} -o out")
    assert outcome.code == 1
    assert "10.0.0.1 > port 7502 carries Ouster lidar, serial 111" in outcome.err
    assert "give the sensor's with --metadata FILE" in outcome.err


def test_a_lidar_without_decoder_among_others_is_refused_unless_ignored(
    shell: Shell, tmp_path: Path
) -> None:
    capture = write_session(tmp_path, Unit(), more=_m1())
    outcome = shell(f"convert {capture} -o out")
    assert outcome.code == 1
    assert outcome.err == (
        f"mlbatch: error: {capture}: {WHERE}: {WHAT}; {ADVICE}; leave it out with --ignore "
        "10.0.0.8:6699\n"
    )
    outcome = shell(f"convert {capture} -o out --ignore 10.0.0.8:6699 --strict")
    assert outcome.code == 0, outcome.err
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["warnings"] == []
    assert [(one["stream"], one["packets"]) for one in report["unassigned"]] == [(WHERE, 20)]


@pytest.mark.parametrize("stream", ["{source_ip: 10.0.0.8, port: 6699}", "{port: 6699}"])
@pytest.mark.parametrize("model", ["", "    model: Helios 32\n"])
def test_a_sensor_of_the_rig_without_decoder(
    shell: Shell, tmp_path: Path, stream: str, model: str
) -> None:
    capture = write_session(tmp_path, Unit(), more=_m1())
    text = f"sensors:\n  - name: front\n    stream: {stream}\n{model}"
    (tmp_path / "rig.yaml").write_text(text)
    outcome = shell(f"convert {capture} --rig rig.yaml -o out")
    assert outcome.code == 1
    selector = stream[1:-1].replace(":", "")
    assert outcome.err == (
        f"mlbatch: error: rig.yaml: sensor front: {selector} carries {WHAT}; {ADVICE}\n"
    )


def test_inspect_says_what_is_missing(shell: Shell, tmp_path: Path) -> None:
    position = filled(512, {0: EE + b"712190403180"})
    beside = [(EPOCH_NS, frame) for frame in udp_frame(position, src="10.0.0.8", dport=10110)]
    capture = write_session(tmp_path, Unit(), more=_m1() + beside)
    outcome = json.loads(shell(f"inspect {capture} --json").out)
    found = {one["stream"]: (one["what"], one["missing"]) for one in outcome["streams"]}
    assert found[WHERE] == (WHAT, "decoder")
    assert found["10.0.0.8 > port 10110"] == ("HESAI GPS packet", "")
    assert found["10.0.0.1 > port 7502"][1] == ""
