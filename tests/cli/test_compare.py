"""`mlbatch compare`: the table, its JSON, and mistakes."""

from __future__ import annotations

import json
import re
import sys

import pytest

from tests.builders.sessions import (
    CAPTURE,
    FIXTURE,
    REPOSITORY,
    Shell,
)

MAKERS = REPOSITORY / "fixtures" / "four_makers"


def test_the_table_of_the_fixture(shell: Shell) -> None:
    outcome = shell(f"compare {CAPTURE} --rig {FIXTURE / 'rig.yaml'}")
    assert (outcome.code, outcome.err) == (0, "")
    title, head, *rows = outcome.out.splitlines()
    assert title == (
        "0.9 s of left (7 sweeps of 100.0 ms), right (8 sweeps of 100.0 ms); windows at 10 Hz; "
        "times in ms"
    )
    assert head.split("  ")[0] == "joined by"
    # 37 ms apart (fixtures/two_lidars/SOURCE.md): 163 ms or 137 ms, and 100 ms.
    longest = {re.split("  +", row)[0]: float(re.split("  +", row)[7]) for row in rows}
    expected = {"latest sweeps": 163, "approximate time": 137, "timeout collate": 163}
    assert longest == pytest.approx({**expected, "windows (mlbatch)": 100}, abs=0.5)


def test_json_and_all_vendors(shell: Shell) -> None:
    """Sweeps per second: SOURCE.md of the fixture."""
    words = f"compare {MAKERS / 'four_makers.pcap'} --rig {MAKERS / 'rig.yaml'} --json"
    outcome = shell(f"{words} --rate 10 --tolerance 0.08 --timeout 0.2")
    assert (outcome.code, outcome.err) == (0, "")
    found = json.loads(outcome.out)
    assert found["schema"] == "mlbatch.compare/2"
    assert (found["rate_hz"], found["period_ms"]) == ("10", 100)
    assert (found["tolerance_ms"], found["timeout_ms"]) == (80, 200)
    sweeps_hz = {one["name"]: 1000 / one["revolution_ms"] for one in found["sensors"]}
    expected_hz = {"left": 9.999, "roof": 10, "right": 12.5, "rear": 9.95}
    # Sweeps are cut at columns: one column more or less is 0.01 Hz.
    assert sweeps_hz == pytest.approx(expected_hz, abs=0.015)
    assert [one["policy"] for one in found["policies"]][-1] == "windows (mlbatch)"
    assert found["policies"][-1]["span_ms"]["max"] < 100


def test_latencies_of_the_fixture(shell: Shell) -> None:
    """Sweeps of 100 ms, 37 ms apart (SOURCE.md): a set is complete as its last sweep ends.

    Windows end 10 ms after their period, which waits for late packets.
    """
    outcome = shell(f"compare {CAPTURE} --rig {FIXTURE / 'rig.yaml'} --json")
    policies = {one["policy"]: one["latency_ms"] for one in json.loads(outcome.out)["policies"]}
    expected = {
        "latest sweeps": 163,
        "approximate time": 137,
        "timeout collate": 163,
        "windows (mlbatch)": 110,
    }
    found = {name: latency["p50"] for name, latency in policies.items()}
    assert found == pytest.approx(expected, abs=0.6)


def test_figures_without_matplotlib(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    outcome = shell(f"compare {CAPTURE} --figures plots")
    assert (outcome.code, outcome.out) == (1, "")
    assert re.fullmatch(
        r"mlbatch: error: --figures: expected the package matplotlib, found none \(.*\); "
        r"pip install 'mlbatch-lidar\[plot\]'\n",
        outcome.err,
    )
