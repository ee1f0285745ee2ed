"""`mlbatch simulate` at the command line: its summary, and its errors in one line."""

from __future__ import annotations

import re

from tests.builders.sessions import Shell
from tests.builders.simulated import scenario_text

ONE = "  - {name: front, model: VLP-16, loss: 0.1}\n"


def test_the_summary_names_lidars_and_files(shell: Shell) -> None:
    with open("s.yaml", "w") as file:
        file.write(scenario_text(ONE))
    done = shell("simulate", "s.yaml", "-o", "drive.pcap", "--seed", "3", "--duration", "0.2")
    assert (done.code, done.err) == (0, "")
    lines = done.out.splitlines()
    assert lines[0] == "s: 0.2 s, seed 3"
    # 754 packets a second, each of 384 shots, in chunks of 48 packets.
    assert re.fullmatch(r"front  VLP-16  73728  73728    \d+ +\d+", lines[2]), lines[2]
    assert lines[3] == "201 poses, 0 samples of the body's IMU"
    assert lines[4] == "wrote drive.pcap, drive.truth.tum, drive.rig.yaml"
