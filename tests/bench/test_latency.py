"""The latency benchmark pushes every packet and times those after the warm-up."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.bench import latency
from tests.bench.cases import CAPTURE, RECORDINGS, RIG
from tests.bench.recordings import make

pytestmark = pytest.mark.slow


def test_packets_that_close_a_slice_are_timed_apart(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make(RECORDINGS["dual-4"], 1.0, tmp_path)
    arguments = [str(tmp_path / CAPTURE), "--rig", str(tmp_path / RIG)]
    assert latency.main([*arguments, "--warm", "300", "--packets", "500", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    # 1280 packets per second: 500 packets are 0.39 s, 39 slices of 10 ms.
    assert found["all"]["pushes"] == 500
    assert found["closing"]["pushes"] == pytest.approx(39, abs=2)
    assert found["closing"]["cpu_us"][0] > found["others"]["cpu_us"][0]
