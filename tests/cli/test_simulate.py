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


def test_quiet_prints_nothing(shell: Shell) -> None:
    done = shell("simulate", "room", "-o", "drive.pcap", "--duration", "0.1", "--quiet")
    assert (done.code, done.out, done.err) == (0, "", "")


def test_a_mistake_is_one_line(shell: Shell) -> None:
    done = shell("simulate", "attic", "-o", "drive.pcap")
    assert done.code == 1
    assert done.err.startswith("mlbatch: error: attic: expected a scenario file or one of forest-")
    assert done.err.count("\n") == 1


def test_an_unknown_suffix_is_wrong_usage(shell: Shell) -> None:
    done = shell("simulate", "room", "-o", "drive.bag")
    assert done.code == 2
    assert "-o: expected a name that ends with .pcap, .mcap, .db3, found drive.bag" in done.err
