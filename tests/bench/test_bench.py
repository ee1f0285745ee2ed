"""The benchmark: its command line, comparisons worked by hand, recordings, and peers as stubs."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import sys
from collections import namedtuple
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import dpkt
import pytest

from tests.bench import latency, runner
from tests.bench.__main__ import main
from tests.bench.cases import CAPTURE, RECORDINGS, RIG, Case, Conversion, is_current
from tests.bench.measure import BenchError, Usage
from tests.bench.peers import PEERS, installed, run_peer
from tests.bench.recordings import make
from tests.bench.results import (
    COPY,
    CPU,
    DRY_RUN,
    FLOOR,
    LIBRARY,
    MEMORY,
    OURS,
    OWN_CPU,
    PEER,
    START,
    WALL,
    WRITE,
    WRITING,
    Json,
    Result,
    Row,
    Run,
    Workload,
    changes,
    lines,
    ratios,
    read_document,
)
from tests.builders.run import command as convert
from tests.contract.tree import run_python

SECONDS = 1.0
SHORT = ("--seconds", "1", "--repeat", "1", "--case", "three-vlp16")


class Output(NamedTuple):
    """Output of a benchmark, and its exit code."""

    code: int
    out: str
    err: str


def command(*words: str | Path) -> Output:
    """Run it with these words in this process."""
    out = io.StringIO()
    err = io.StringIO()
    code: object = 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main([str(word) for word in words])
        except SystemExit as leave:
            code = leave.code
    return Output(int(str(code)), out.getvalue(), err.getvalue())


def test_a_short_run_and_another_against_it(tmp_path: Path) -> None:
    done = command(*SHORT, "--json", "--keep", tmp_path)
    assert (done.code, done.err) == (0, "")
    found = json.loads(done.out)
    rows = {row["program"]: row for row in found["rows"]}
    assert list(rows) == ["mlbatch", "python with numpy", "memory copy"]
    ours = rows["mlbatch"]
    copied = rows["memory copy"]
    assert ours["scans"] > 5
    # 32 slots in a block of 110.592 us, of three sensors, in whole windows.
    assert ours["slots"] == pytest.approx(3 * 32 * ours["scans"] * 0.1 / 110.592e-6, rel=0.001)
    capture = tmp_path / "three-vlp16-1s" / "capture.pcap"
    assert ours["read_bytes"] == capture.stat().st_size
    assert copied["written_bytes"] == ours["read_bytes"] + 24 * ours["points"]
    assert len(ours["cpu_s"]) == len(ours["stages_s"]["decode"]) == 1
    assert 0 < ours["own_cpu_s"][0] < ours["cpu_s"][0]
    assert {"cpu", "cores", "memory_mb", "python", "numpy", "mlbatch"} <= set(found["machine"])
    assert any("velodyne-decoder was not measured" in note for note in found["notes"])
    earlier = tmp_path / "earlier.json"
    earlier.write_text(done.out, encoding="utf-8")
    before_ns = capture.stat().st_mtime_ns
    done = command(*SHORT, "--keep", tmp_path, "--against", earlier)
    assert (done.code, done.err) == (0, "")
    assert "before" in done.out
    # The recording was used again, and nothing else is left.
    assert capture.stat().st_mtime_ns == before_ns
    assert sorted(path.name for path in tmp_path.iterdir()) == ["earlier.json", "three-vlp16-1s"]


def test_outputs_are_measured_and_deleted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    case = Case("small", ("three-vlp16",), "mcap", ("plain write", "mcap library"))
    monkeypatch.setattr("tests.bench.__main__.CASES", (case,))
    done = command("--seconds", "1", "--repeat", "2", "--json", "--keep", tmp_path)
    assert done.code == 0
    found = json.loads(done.out)
    rows = {row["program"]: row for row in found["rows"]}
    assert list(rows) == ["dry run", "mcap", "plain write", "mcap library"]
    assert rows["mcap"]["written_bytes"] == rows["plain write"]["written_bytes"]
    # 24 bytes a point, and a little around them.
    assert 1 < rows["mcap"]["written_bytes"] / (24 * rows["mcap"]["points"]) < 1.02
    assert [path.name for path in tmp_path.iterdir()] == ["three-vlp16-1s"]


def test_a_failed_conversion_is_reported_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong = Conversion("wrong", "three-vlp16", options=("--rate", "0.01"))
    case = Case("small", ("three-vlp16",), "", (), (Conversion("right", "three-vlp16"), wrong))
    monkeypatch.setattr("tests.bench.__main__.CASES", (case,))
    done = command("--seconds", "1", "--repeat", "1", "--keep", tmp_path)
    assert done.code == 1
    assert "small  right" in done.out
    assert "note: small: wrong: expected exit code 0, found 2: mlbatch: error: --rate" in done.out
    assert done.err.startswith("bench: error: 1 conversion(s) failed, small: wrong first")


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (("--seconds", "0.5"), 2, "--seconds: expected 1 to 3600, found 0.5"),
        (("--seconds", "nan"), 2, "--seconds: expected 1 to 3600, found nan"),
        (("--repeat", "0"), 2, "--repeat: expected 1 to 1000, found 0"),
        (("--case", "none"), 2, "--case: expected one of dual-4, "),
        (("--against", "/no/file"), 1, "/no/file: expected an earlier result"),
        (("--peer-python", "/no/python"), 1, "--peer-python: expected a program, found /no/python"),
        (("--keep", "/dev/null"), 1, "/dev/null: expected a folder to write to, found File exists"),
    ],
)
def test_mistakes(words: tuple[str, ...], code: int, message: str) -> None:
    done = command(*words)
    assert done.code == code
    assert done.err.startswith(f"bench: error: {message}")
    assert done.err.count("\n") == 1


def test_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = namedtuple("usage", ["total", "used", "free"])
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(2, 1, 5_000_000))
    done = command("--case", "pandar64", "--seconds", "10", "--keep", tmp_path)
    assert done.code == 1
    # 3000 packets of 1198 bytes and 58 around them, in 10 s.
    assert "expected about 37 MB of free disk, found 5 MB; choose another with --keep" in done.err
    assert not list(tmp_path.iterdir())


# -- results --------------------------------------------------------------------------------------

STAGES = {"read": 0.1, "decode": 0.4, "merge": 0.2, "write": 0.0}
READ = Workload(1_000_000, 800_000, 100, 10.0, 4_000_000)
WRITTEN = replace(READ, written_bytes=20_000_000)
FLOORED = replace(WRITTEN, read_bytes=0)
MACHINE: dict[str, Json] = {
    "cpu": "Abacus",
    "cpu_flags": "sse2 avx",
    "cores": 2,
    "memory_mb": 1000,
    "system": "S",
    "load": 0.5,
    "mlbatch": "0.1.0",
    "python": "3.11.7",
}


def run(
    cpu_s: float,
    own_cpu_s: float = 0.5,
    wall_s: float = 2.0,
    workload: Workload = READ,
    stages_s: Mapping[str, float] | None = None,
) -> Run:
    """A run of a million slots in 10 s."""
    return Run(cpu_s, wall_s, 80.0, own_cpu_s, workload, stages_s or {})


def row(program: str, runs: Sequence[Run], role: str = OURS, base: str = "") -> Row:
    """A program of the case `dual-4`."""
    return Row("dual-4", program, role, base, runs[0].workload, tuple(runs))


def result(*rows: Row) -> Result:
    """A result with these rows."""
    return Result("2026-01-02T03:04:05Z", MACHINE, 10.0, 3, rows, (), ())


OTHER = replace(READ, read_bytes=5_000_000)
PLAIN = row("numpy", [run(1.0, 0.6)])
DRY = row(DRY_RUN, [run(1.0, 0.6)])
WRITES = row("mcap", [run(2.0, 1.0, wall_s=3.0, workload=WRITTEN)], base=DRY_RUN)


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        pytest.param(
            [
                row("numpy", [run(1.0, 0.5), run(3.0, 2.0)]),
                row("sdk", [run(2.0, 2.0), run(3.0, 1.0)], PEER),
            ],
            {("numpy", "sdk", CPU): (0.5, 1.0), ("numpy", "sdk", OWN_CPU): (0.25, 2.0)},
            id="runs in pairs",
        ),
        pytest.param(
            [row("numpy", [run(1.0, workload=OTHER)]), row("sdk", [run(2.0)], PEER)],
            {},
            id="a peer on another recording",
        ),
        pytest.param(
            [PLAIN, row("fragments", [run(1.25, wall_s=2.0)], base="numpy")],
            {("fragments", "numpy", CPU): (1.25,), ("fragments", "numpy", WALL): (1.0,)},
            id="a base",
        ),
        pytest.param(
            [
                PLAIN,
                row(COPY, [run(9.0, 0.1, workload=FLOORED)], FLOOR),
                row(START, [run(9.0, 0.1, workload=FLOORED)], FLOOR),
            ],
            {("numpy", COPY, OWN_CPU): pytest.approx((6.0,)), ("numpy", START, MEMORY): (1.0,)},
            id="floors of a dry run",
        ),
        pytest.param(
            [
                DRY,
                WRITES,
                row(WRITE, [run(9.0, 0.1, wall_s=2.0, workload=FLOORED)], FLOOR),
                row(LIBRARY, [run(9.0, 1.6, workload=FLOORED)], FLOOR),
            ],
            {
                ("mcap", DRY_RUN, CPU): (2.0,),
                ("mcap", DRY_RUN, WALL): (1.5,),
                ("mcap", WRITE, WALL): (1.5,),
                # (1.0 - 0.6) s of 1.6 s.
                ("mcap", LIBRARY, WRITING): pytest.approx((0.25,)),
            },
            id="floors of an output",
        ),
    ],
)
def test_comparisons(rows: list[Row], expected: dict[tuple[str, str, str], object]) -> None:
    assert {(one.program, one.to, one.of): one.values for one in ratios(rows)} == expected


def test_changes_are_ratios_of_medians() -> None:
    rows = [row("numpy", [run(1.0), run(2.0), run(9.0)]), row("native", [run(1.0)])]
    lists = {"cpu_s": [8.0, 4.0, 3.0], "own_cpu_s": [0.5], "wall_s": [1.0], "rss_mb": [0.0]}
    found = {one.of: one for one in changes(rows, {("dual-4", "numpy"): lists})}
    # The earlier document has no memory.
    assert set(found) == {CPU, OWN_CPU, WALL}
    assert (found[CPU].before, found[CPU].now, found[CPU].ratio) == (4.0, 2.0, 0.5)


def test_a_line_has_medians_in_the_units_of_the_head() -> None:
    runs = [run(cpu_s, stages_s=STAGES) for cpu_s in (1.0, 5.0, 2.0)]
    head, line = (one.split("  ") for one in lines(result(row("numpy", runs)))[5:7])
    cells = dict(zip(filter(None, head), filter(None, line), strict=True))
    assert {name.strip(): cell.strip() for name, cell in cells.items()} == {
        "case": "dual-4",
        "program": "numpy",
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
    }


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected the output of `python -m tests.bench --json`"),
        ('{"schema": "mlbatch.bench/9", "rows": []}', "expected schema mlbatch.bench/1, found"),
        ('{"schema": "mlbatch.bench/1", "rows": [{"case": "a"}]}', "KeyError"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "old.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(BenchError, match="expected") as caught:
        read_document(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)


# -- measured processes ---------------------------------------------------------------------------

# Run in a small process: pages of the measuring process count, too.
MEASURED = """
import json, sys
from dataclasses import asdict
from pathlib import Path
from tests.bench.measure import measure
codes = {
    "idle": "import time; time.sleep(0.3)",
    "busy": "import time\\nwhile time.process_time() < 0.5: pass",
    "large": "x = b'1' * 300_000_000",
}
found = {name: measure(name, [sys.executable, "-c", code], Path()) for name, code in codes.items()}
print(json.dumps({name: asdict(usage) for name, usage in found.items()}))
"""


def test_cpu_memory_and_time_are_those_of_the_process(tmp_path: Path) -> None:
    found = json.loads(run_python(MEASURED, tmp_path))
    idle, busy, large = (Usage(**found[name]) for name in ("idle", "busy", "large"))
    # True on a machine of any speed and load: a sleeping process uses no CPU.
    assert 0 < idle.cpu_s <= idle.wall_s - 0.29
    assert busy.cpu_s >= 0.5
    assert large.rss_mb - idle.rss_mb == pytest.approx(300, abs=15)


def test_the_measuring_process_imports_no_large_package() -> None:
    """Its pages count in the memory of measured processes."""
    loaded = run_python(
        "import sys\nimport tests.bench.__main__ as bench\n"
        "bench.settings_from(bench.parser().parse_args([]))\n"
        "print([name for name in ('numpy', 'mcap', 'yaml') if name in sys.modules])"
    )
    assert loaded.strip() == "[]"


def test_programs_alternate_in_both_directions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []

    def record(session: runner.BenchSession, conversion: Conversion) -> Run:
        order.append(conversion.name)
        return Run(1.0, 1.0, 1.0, 1.0, Workload(slots=1))

    monkeypatch.setattr(runner.BenchSession, "_convert", record)
    pair = (Conversion("a", "three-vlp16"), Conversion("b", "three-vlp16"))
    case = Case("small", ("three-vlp16",), "", (), pair)
    settings = runner.Settings((case,), 1.0, 3, keep=tmp_path)
    assert [row.program for row in runner.bench(settings).rows] == ["a", "b"]
    # After runs that are not measured, which compile.
    assert order[2:] == ["a", "b", "b", "a", "a", "b"]
    assert sorted(order[:2]) == ["a", "b"]


@pytest.mark.slow
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


# -- recordings -----------------------------------------------------------------------------------


def test_fragments_give_the_same_scans(tmp_path: Path) -> None:
    found = []
    for name in ("dual-4", "dual-4-fragments"):
        place = tmp_path / name
        place.mkdir()
        make(RECORDINGS[name], SECONDS, place)
        words = ("--rig", place / RIG, "-o", place / "out")
        assert convert("convert", place / CAPTURE, *words).code == 0
        found.append([path.read_bytes() for path in sorted((place / "out").glob("*.npz"))])
        with (place / CAPTURE).open("rb") as file:
            longest = max(len(frame) for _, frame in dpkt.pcap.Reader(file))
        assert (longest <= 1514) == ("fragments" in name)
    assert found[0] == found[1] != []


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_conversion_accepts_every_packet(tmp_path: Path, name: str) -> None:
    recording = RECORDINGS[name]
    make(recording, SECONDS, tmp_path)
    assert is_current(tmp_path, recording)
    size = (tmp_path / recording.file).stat().st_size
    assert size == pytest.approx(recording.bytes_per_s * SECONDS, rel=0.05)
    words = ("--rig", tmp_path / RIG, "--dry-run", "--report", tmp_path / "report.json")
    done = convert("convert", tmp_path / recording.file, *words)
    report = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    # How the times of clouds are read, and how many points have no place.
    expected = ["clouds", "clouds"] if recording.is_bag else []
    assert [one["code"] for one in report["warnings"]] == expected
    assert done.code == 0
    assert not report["unassigned"]
    assert [one["name"] for one in report["sensors"]] == [one.name for one in recording.sensors]
    for sensor in report["sensors"]:
        assert sensor["packets"]["read"] == sensor["packets"]["accepted"] > 0
        assert 0.7 < sensor["points"]["written"] / sensor["points"]["slots"] < 0.9
    # Of ten windows the first, the last, and one at a phase are incomplete.
    slots = sum(sensor["points"]["slots"] for sensor in report["sensors"])
    assert 0.75 < slots / (recording.slots_per_s * SECONDS) < 0.95


# -- peers ----------------------------------------------------------------------------------------

# Returns a sweep of five points after ten packets, and one of two points at the end.
DECODER = """
class Model:
    VLP16 = "VLP-16"
class Config:
    def __init__(self, model):
        assert model == "VLP-16"
class StreamDecoder:
    def __init__(self, config):
        self.count = 0
    def decode(self, stamp, packet):
        assert len(packet) == 1206
        self.count += 1
        return (stamp, [0] * 5) if self.count == 10 else None
    def finish(self):
        return (0.0, [0] * 2)
"""
# Two frames of three by four pixels per sensor, of which one is missing.
SDK = """
import numpy as np
from ouster.sdk import core
class Frame:
    def field(self, name):
        assert name == "RANGE"
        return np.array([0, 5, 7])
class Source:
    sensor_info = ["a", "b"]
    def __iter__(self):
        return iter([[Frame(), Frame()], [Frame(), None]])
def open_source(path, meta, extrinsics, **rest):
    assert [name[-6:] for name in meta] == ["a.json", "b.json"]
    assert extrinsics[1][:3, 3].tolist() == [0.0, -0.6, 1.8]
    assert np.allclose(extrinsics[1][:2, 0], [0, 1])
    assert rest in ({}, {"field_names": ["RANGE", "REFLECTIVITY"]})
    return Source()
"""
CORE = """
import numpy as np
class XYZLut:
    def __init__(self, info, use_extrinsics):
        assert use_extrinsics
    def __call__(self, frame):
        return np.zeros((3, 4, 3))
class XYZLutFloat(XYZLut):
    pass
"""
CLI = """
import pathlib, sys
def run():
    assert sys.argv[1] == "source" and sys.argv[-3:-1] == ["--decimate", "false"]
    pathlib.Path("peer.ply").write_bytes(b"ply\\nelement vertex 12\\nend_header\\n")
    sys.exit(0)
"""


def package(place: Path, name: str, version: str, **modules: str) -> None:
    """A distribution with these modules (dots as __)."""
    info = place / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    for module, text in modules.items():
        path = place.joinpath(*module.split("__"))
        path.mkdir(parents=True, exist_ok=True)
        (path / "__init__.py").write_text(text)


@pytest.fixture
def stubbed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to work in, with both stub packages in the search path."""
    place = tmp_path / "packages"
    place.mkdir()
    package(place, "velodyne-decoder", "3.1.0", velodyne_decoder=DECODER)
    modules = {"ouster__sdk": SDK, "ouster__sdk__core": CORE, "ouster__cli__core": CLI}
    package(place, "ouster-sdk", "1.0.1", **modules)
    monkeypatch.setenv("PYTHONPATH", str(place))
    return tmp_path


# Peer, recording, slots, points, scans and bytes written; 384 slots a packet of a Velodyne.
@pytest.mark.parametrize(
    ("name", "recording", "counts"),
    [
        # Three sensors with two sweeps each.
        ("velodyne-decoder", "three-vlp16", (None, 21, 6, 0)),
        ("velodyne-decoder lean", "three-vlp16", (None, 21, 6, 0)),
        ("ouster-sdk", "dual-4", (36, 6, 2, 0)),
        ("ouster-sdk lean", "dual-4", (36, 6, 2, 0)),
        ("ouster-cli", "dual-4", (12, 12, 1, 33)),
    ],
)
def test_peers_read_the_recording(
    stubbed: Path, name: str, recording: str, counts: tuple[int | None, ...]
) -> None:
    assert installed(sys.executable, stubbed) == {
        "ouster-sdk": "1.0.1",
        "velodyne-decoder": "3.1.0",
    }
    peer = next(one for one in PEERS if one.name == name)
    assert peer.fits(RECORDINGS[recording], peer.output)
    assert not peer.fits(RECORDINGS["mixed"], peer.output)
    make(RECORDINGS[recording], 0.1, stubbed)
    done = run_peer(peer, sys.executable, RECORDINGS[recording], stubbed, 0.1, stubbed)
    size = (stubbed / CAPTURE).stat().st_size
    slots, points, scans, written = counts
    slots = (size - 24) // (1206 + 58) * 384 if slots is None else slots
    assert done.workload == Workload(slots, points or 0, scans or 0, 0.1, size, written or 0)
    assert 0 < done.own_cpu_s < done.cpu_s
    assert not list(stubbed.glob("*.ply"))
