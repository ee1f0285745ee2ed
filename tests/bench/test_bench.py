"""The benchmark: its command line, ratios worked by hand, recordings, and peers as stubs."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

import tests.bench.__main__ as bench
from tests.bench import latency
from tests.bench.cases import RECORDINGS, RIG, Conversion
from tests.bench.measure import Usage
from tests.bench.recordings import make
from tests.builders.run import command as convert
from tests.contract.tree import ROOT

SECONDS = 1.0


def test_a_short_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    case = (
        Conversion("mcap", "three-vlp16", output="mcap"),
        Conversion("dry run", "three-vlp16"),
    )
    monkeypatch.setattr(bench, "CASES", {"small": case})
    made_ns = set()
    for _ in range(2):
        words = ("--seconds", "1", "--repeat", "1", "--case", "small", "--keep", str(tmp_path))
        bench.main([*words])
        # The recording is used again, and nothing else is left.
        assert [path.name for path in tmp_path.iterdir()] == ["three-vlp16-1s"]
        made_ns.add((tmp_path / "three-vlp16-1s" / "capture.pcap").stat().st_mtime_ns)
    assert len(made_ns) == 1
    programs = [re.split(r" {2,}", line)[1] for line in capsys.readouterr().out.splitlines()[-4:]]
    assert programs == ["mcap", "dry run", "python with numpy", "plain write"]


def test_rows_have_medians_and_ratios_of_pairs() -> None:
    def runs(*cpu_s: float, own_s: float, wall_s: float, stages: bool = True) -> list[bench.Run]:
        stages_s = (0.1, 0.4, 0.2, 0.0) if stages else ()
        return [
            bench.Run(Usage(cpu, wall_s, 80.0), own_s, 1_000_000 * stages, 0, stages_s)
            for cpu in cpu_s
        ]

    first, other = bench.rows(
        "dual-4",
        10.0,
        {
            "mlbatch": runs(1.0, 5.0, 2.0, own_s=0.5, wall_s=2.0),
            "sdk": runs(2.0, 5.0, 8.0, own_s=1.0, wall_s=0.5, stages=False),
        },
    )
    assert dict(zip(bench.HEAD, first, strict=True)) == {
        "case": "dual-4",
        "program": "mlbatch",
        "CPU s": "2.000",
        "own s": "0.500",
        "time s": "2.000",
        # 2 s for a million slots.
        "ns/slot": "2000.00",
        # 10 s recorded in 2 s.
        "x real": "5.0",
        "MB": "80",
        "read": "100.00",
        "decode": "400.00",
        "merge": "200.00",
        "write": "0.00",
        **dict.fromkeys(bench.HEAD[-5:], ""),
    }
    # The pairs are 2, 1 and 4.
    cells = ["5.000", "1.000", "0.500", "", "20.0", "80", *[""] * 4]
    assert other[2:] == [*cells, "2.00", "0.50", "0.50", "4.00", "100"]


def test_mistakes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = Conversion("wrong", "three-vlp16", ("--rate", "0.01"))
    monkeypatch.setattr(bench, "CASES", {"small": (wrong,)})
    for words, message in (
        ((), "wrong: expected exit code 0, found 2: mlbatch: error: --rate"),
        (("--keep", str(tmp_path / "none")), "[Errno 2] No such file or directory"),
    ):
        with pytest.raises(SystemExit, match=re.escape(f"bench: error: {message}")):
            bench.main(["--seconds", "1", *words])


# -- measured processes ---------------------------------------------------------------------------


@pytest.mark.slow
def test_packets_that_close_a_slice_are_timed_apart(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make(RECORDINGS["dual-4"], 1.0, tmp_path)
    arguments = [str(tmp_path / "capture.pcap"), "--rig", str(tmp_path / RIG)]
    latency.main([*arguments, "--warm", "300", "--packets", "500"])
    closing, others = (line.split() for line in capsys.readouterr().out.splitlines()[1:])
    # 1280 packets per second: 500 packets are 0.39 s, 39 slices of 10 ms.
    assert int(closing[1]) + int(others[1]) == 500
    assert int(closing[1]) == pytest.approx(39, abs=2)
    assert float(closing[2]) > float(others[2])


# -- recordings -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_conversion_accepts_every_packet(tmp_path: Path, name: str) -> None:
    recording = RECORDINGS[name]
    make(recording, SECONDS, tmp_path)
    size_mb = (tmp_path / recording.file).stat().st_size / 1e6
    page = (ROOT / "docs" / "performance.md").read_text(encoding="utf-8")
    if rate := re.search(rf"^\| `{name}` \|[^|]*\(([\d.]+) MB/s\)", page, re.MULTILINE):
        assert size_mb == pytest.approx(float(rate[1]) * SECONDS, rel=0.05)
    words = ("--rig", tmp_path / RIG, "--dry-run", "--report", tmp_path / "report.json")
    done = convert("convert", tmp_path / recording.file, *words)
    report = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    # How the times of clouds are read, and how many points have no place.
    expected = ["clouds", "clouds"] if recording.sensors[0].topic else []
    assert [one["code"] for one in report["warnings"]] == expected
    assert done.code == 0
    assert not report["unassigned"]
    assert [one["name"] for one in report["sensors"]] == [one.name for one in recording.sensors]
    for sensor in report["sensors"]:
        assert sensor["packets"]["read"] == sensor["packets"]["accepted"] > 0
        assert 0.7 < sensor["points"]["written"] / sensor["points"]["slots"] < 0.9


# -- peers ----------------------------------------------------------------------------------------
