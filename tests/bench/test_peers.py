"""Peers: found in environments and measured; here with stub packages."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.bench.cases import RECORDINGS
from tests.bench.measure import BenchError
from tests.bench.peers import PEERS, installed, run_peer
from tests.bench.recordings import make
from tests.bench.results import Workload

VLP16 = RECORDINGS["three-vlp16"]
DUAL = RECORDINGS["dual-4"]
BY_NAME = {peer.name: peer for peer in PEERS}
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


def test_versions_of_installed_peers(stubbed: Path) -> None:
    found = installed(sys.executable, stubbed)
    assert found == {"ouster-sdk": "1.0.1", "velodyne-decoder": "3.1.0"}


def test_an_environment_without_peers(tmp_path: Path) -> None:
    assert installed(sys.executable, tmp_path) == {}


@pytest.mark.parametrize(
    ("python", "message"),
    [
        ("/no/python", "expected a program, found /no/python: No such file"),
        ("/bin/true", "expected a Python interpreter, found another program"),
        ("/bin/false", "expected exit code 0, found 1"),
    ],
)
def test_other_programs_are_refused(tmp_path: Path, python: str, message: str) -> None:
    with pytest.raises(BenchError, match="--peer-python") as caught:
        installed(python, tmp_path)
    assert message in str(caught.value)


def test_peers_fit_sensors_and_outputs() -> None:
    def fitting(recording: str, output: str) -> list[str]:
        return [peer.name for peer in PEERS if peer.fits(RECORDINGS[recording], output)]

    assert fitting("dual-12", "") == ["ouster-sdk", "ouster-sdk lean"]
    assert fitting("dual-4", "ply") == ["ouster-cli"]
    assert fitting("three-vlp16", "") == ["velodyne-decoder", "velodyne-decoder lean"]
    assert fitting("vls128", "") == ["velodyne-decoder", "velodyne-decoder lean"]
    assert fitting("mixed", "") == fitting("pandar64", "") == fitting("dual-4", "mcap") == []


@pytest.mark.parametrize("name", ["velodyne-decoder", "velodyne-decoder lean"])
def test_velodyne_decoder_reads_the_packets_of_each_sensor(stubbed: Path, name: str) -> None:
    make(VLP16, 0.1, stubbed)
    run = run_peer(BY_NAME[name], sys.executable, VLP16, stubbed, 0.1, stubbed)
    size = (stubbed / "capture.pcap").stat().st_size
    packets = (size - 24) // (1206 + 58)
    # Three sensors with two sweeps each.
    assert run.workload == Workload(packets * 384, 21, 6, 0.1, size, 0)
    assert 0 < run.own_cpu_s < run.cpu_s


@pytest.mark.parametrize("name", ["ouster-sdk", "ouster-sdk lean"])
def test_ouster_sdk_gets_metadata_and_extrinsics(stubbed: Path, name: str) -> None:
    make(DUAL, 0.1, stubbed)
    run = run_peer(BY_NAME[name], sys.executable, DUAL, stubbed, 0.1, stubbed)
    size = (stubbed / "capture.pcap").stat().st_size
    assert run.workload == Workload(3 * 12, 3 * 2, 2, 0.1, size, 0)


def test_ouster_cli_leaves_no_output(stubbed: Path) -> None:
    make(DUAL, 0.1, stubbed)
    run = run_peer(BY_NAME["ouster-cli"], sys.executable, DUAL, stubbed, 0.1, stubbed)
    assert (run.workload.points, run.workload.written_bytes) == (12, 33)
    assert not list(stubbed.glob("*.ply"))
