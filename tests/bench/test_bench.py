"""The benchmark: its command line, ratios worked by hand, recordings, and peers as stubs."""

from __future__ import annotations

import json
import re
import sys
from argparse import Namespace
from pathlib import Path

import dpkt
import pytest

import tests.bench.__main__ as bench
from tests.bench import latency
from tests.bench.cases import RECORDINGS, RIG, Conversion
from tests.bench.measure import Usage
from tests.bench.recordings import make
from tests.builders.run import command as convert
from tests.contract.tree import ROOT, run_python

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


def test_a_run_counts_what_it_converts_and_writes(tmp_path: Path) -> None:
    options = Namespace(seconds=1.0, repeat=1, peer_python=None)
    session = bench.Bench(options, tmp_path, tmp_path / "run")
    session.scratch.mkdir()
    done = session.convert(Conversion("", "three-vlp16", output="mcap"))
    # 32 slots in a block of 110.592 us, of three sensors, in eight whole windows; 24 bytes a point,
    # of which four fifths return, and a little around them.
    assert done.slots == pytest.approx(3 * 32 * 0.8 / 110.592e-6, rel=0.001)
    assert 0.7 < done.written_bytes / (24 * done.slots) < 0.9
    assert 0 < done.own_cpu_s < done.usage.cpu_s
    assert not list(session.scratch.iterdir())


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
        "bench.parser().parse_args([])\n"
        "print([name for name in ('numpy', 'mcap', 'yaml') if name in sys.modules])"
    )
    assert loaded.strip() == "[]"


def test_programs_alternate_in_both_directions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []

    def record(session: bench.Bench, program: str | Conversion) -> bench.Run:
        order.append(program if isinstance(program, str) else program.name)
        return bench.Run(Usage(1.0, 1.0, 1.0), 1.0)

    monkeypatch.setattr(bench.Bench, "convert", record)
    monkeypatch.setattr(bench.Bench, "other", record)
    options = Namespace(seconds=1.0, repeat=3, peer_python=None)
    runs = bench.Bench(options, tmp_path, tmp_path).measure("dual-4-imu")
    assert [len(runs[name]) for name in ("no IMU", "IMU", "python with numpy")] == [3, 3, 3]
    # After runs that are not measured, which compile.
    programs = ["no IMU", "IMU", "start"]
    assert order == [*programs[:2], *programs, *programs[::-1], *programs]


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


def test_fragments_give_the_same_scans(tmp_path: Path) -> None:
    found = []
    for name in ("dual-4", "dual-4-fragments"):
        place = tmp_path / name
        place.mkdir()
        make(RECORDINGS[name], SECONDS, place)
        words = ("--rig", place / RIG, "-o", place / "out")
        assert convert("convert", place / RECORDINGS[name].file, *words).code == 0
        found.append([path.read_bytes() for path in sorted((place / "out").glob("*.npz"))])
        with (place / RECORDINGS[name].file).open("rb") as file:
            longest = max(len(frame) for _, frame in dpkt.pcap.Reader(file))
        assert (longest <= 1514) == ("fragments" in name)
    assert found[0] == found[1] != []


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
    modules = {"ouster__sdk": SDK, "ouster__sdk__core": CORE}
    package(place, "ouster-sdk", "1.0.1", **modules)
    monkeypatch.setenv("PYTHONPATH", str(place))
    return tmp_path


@pytest.mark.parametrize("lean", ["", "-lean"])
@pytest.mark.parametrize(
    ("name", "recording", "slots"),
    [
        # 384 slots in each packet of 1206 bytes, with 58 around them, after 24 of the file.
        ("velodyne-decoder", "three-vlp16", None),
        ("ouster-sdk", "dual-4", 36),
    ],
)
def test_peers_read_the_recording(
    stubbed: Path, name: str, lean: str, recording: str, slots: int | None
) -> None:
    options = Namespace(seconds=1.0, repeat=1, peer_python=Path(sys.executable))
    session = bench.Bench(options, stubbed, stubbed / "run")
    session.scratch.mkdir()
    done = session.peer(name + lean, recording)
    size = (session.recording(recording) / "capture.pcap").stat().st_size
    assert done.slots == slots or (size - 24) // (1206 + 58) * 384
    assert 0 < done.own_cpu_s < done.usage.cpu_s
