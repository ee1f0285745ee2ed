"""What a command does before its work: it loads what it needs, and spares the collector."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pytest

from tests.builders.every_model import CASES, SOURCE, job_of, sent_by
from tests.builders.lidar_packets import vendor_of
from tests.builders.sessions import SMALL, Unit, write_session
from tests.contract.tree import ROOT, modules, run_python


def _loaded(names: Iterable[str], arguments: list[str], first: str = "typer") -> set[str]:
    """Which of these modules a command loads, beyond those that `first` loads."""
    printed = run_python(
        f"import atexit, sys, {first}\n"
        f"names = [name for name in {tuple(names)!r} if name not in sys.modules]\n"
        "from mlbatch.cli import main\n"
        "atexit.register(lambda: print('loaded', *[n for n in names if n in sys.modules]))\n"
        f"sys.argv[1:] = {arguments!r}\n"
        "main()\n"
    )
    return set(printed.splitlines()[-1].split()[1:])


def test_the_command_line_spares_the_collector() -> None:
    printed = run_python(
        "import atexit, gc, sys\n"
        "from mlbatch.cli import main\n"
        "before = gc.get_threshold()[0]\n"
        # Last in, first out: the command line's own comes before this one.
        "atexit.register(lambda: print(gc.get_threshold()[0] > before, gc.get_freeze_count()))\n"
        "sys.argv[1:] = ['--version']\n"
        "main()\n"
    )
    is_rarer, frozen = printed.splitlines()[-1].split()
    assert is_rarer == "True"
    assert int(frozen)


def test_the_library_leaves_the_collector_alone() -> None:
    printed = run_python(
        "import gc, sys\n"
        "before = gc.get_threshold(), gc.get_freeze_count(), gc.isenabled()\n"
        "import mlbatch.api, mlbatch.cli.app, mlbatch.pipeline.run\n"
        "print(before == (gc.get_threshold(), gc.get_freeze_count(), gc.isenabled()))\n"
    )
    assert printed.strip() == "True"


# Other vendors, containers and messages that are not there, outputs and
# commands that were not requested.
NEEDLESS = (
    *("mlbatch.sensors.hesai.sensor", "mlbatch.sensors.hesai.identify"),
    *("mlbatch.sensors.livox.sensor", "mlbatch.sensors.livox.identify"),
    *("mlbatch.sensors.pointcloud.sensor", "mlbatch.sensors.robosense.sensor"),
    *("mlbatch.sensors.velodyne.sensor", "mlbatch.sensors.robosense.identify"),
    *("mlbatch.sensors.velodyne.identify", "mlbatch.readers.formats.mcap"),
    *("mlbatch.readers.formats.pcapng", "mlbatch.readers.formats.rosbag1"),
    *("mlbatch.readers.bag.recording", "mlbatch.readers.bag.packet_messages"),
    *("mlbatch.readers.bag.folder", "mlbatch.readers.bag.clouds", "mlbatch.faults.replay"),
    *("mlbatch.frames.urdf", "mlbatch.pipeline.inspect", "mlbatch.comparison.compare"),
    *("mlbatch.verification.outputs", "mlbatch.api"),
    *("mlbatch.writers.formats.npz", "mlbatch.writers.formats.ply"),
    *("mlbatch.writers.formats.rosbag1", "mlbatch.cli.compare"),
    *("mlbatch.cli.inspect", "mlbatch.cli.verify", "mlbatch.cli.report", "mlbatch.page.document"),
    *("mlbatch.cli.simulate", "mlbatch.simulate.recording", "mlbatch.simulate.ouster.encode"),
    "mlbatch.simulate.interface",
    *("mlbatch.cli.batch", "mlbatch.cli.convert_remote", "mlbatch.batch.task"),
    *("mlbatch.cli.digest", "mlbatch.digests.golden"),
    *("mlbatch.pipeline.deskew", "mlbatch.motion.se3"),
    *("mlbatch.batching.fusion", "mlbatch.batching.sweeps", "mlbatch.pipeline.shards"),
    *("numpy.ma", "rosbags", "rich", "mcap.writer", "importlib.metadata"),
    *("mlbatch.readers.capture.odd", "dpkt", "mlbatch.page.templates", "jinja2"),
    *("mlbatch.sensors.advice", "mlbatch.pipeline.time_limits"),
    *("mlbatch.reports.limits", "mlbatch.discovery.overlap", "mlbatch.pipeline.imu_poses"),
)


def test_what_is_needless_is_there() -> None:
    names = {name.removeprefix("mlbatch.") for name in NEEDLESS if name.startswith("mlbatch.")}
    assert names <= {module.name for module in modules()}


def test_a_capture_loads_only_what_it_needs(tmp_path: Path) -> None:
    capture = write_session(tmp_path, Unit())
    rig = tmp_path / "rig.yaml"
    rig.write_text(f"sensors: [{{name: front, metadata: {SMALL.serial}.json}}]\n")
    output = tmp_path / "scans.mcap"
    arguments = ["convert", str(capture), "--rig", str(rig), "-o", str(output), "--quiet"]
    # numpy 1.26 loads numpy.ma itself, and typer 0.15 loads rich.
    assert _loaded(NEEDLESS, arguments, "numpy, typer") == set()
    assert output.is_file()


# -- vendors --------------------------------------------------------------------------------------

VENDORS = ("hesai", "livox", "ouster", "pointcloud", "robosense", "velodyne")
TWO, FOUR = ROOT / "fixtures" / "two_lidars", ROOT / "fixtures" / "four_makers"


def _vendors_loaded(arguments: list[str]) -> set[str]:
    """Vendors whose plug-ins a command loads."""
    names = _loaded([f"mlbatch.sensors.{name}.sensor" for name in VENDORS], arguments)
    return {name.split(".")[2] for name in names}


@pytest.mark.parametrize("has_rig", [False, True])
@pytest.mark.parametrize("vendor", ["hesai", "robosense", "velodyne"])
def test_a_capture_of_one_vendor_loads_no_other(vendor: str, has_rig: bool, tmp_path: Path) -> None:
    spec = next(spec for spec in CASES if vendor_of(spec) == vendor)
    sent = sent_by(spec)
    job = job_of(sent, tmp_path)
    arguments = ["convert", str(job.recordings[0]), "--dry-run", "--quiet", "--keep-partial"]
    if has_rig:
        rig = tmp_path / "rig.yaml"
        named = "" if vendor == "hesai" else f", model: {spec.reported_model}"
        file = f", metadata: {sent.file}" if sent.file else ""
        rig.write_text(
            f"sensors: [{{name: one{named}{file}, stream: {{source_ip: {SOURCE}, port: 2368}}, "
            "extrinsics: {translation_m: [0, 0, 0], rotation_rpy_deg: [0, 0, 0]}}]\n"
        )
        arguments += ["--rig", str(rig)]
    else:
        arguments += ["--identity-extrinsics"]
        arguments += ["--metadata", str(tmp_path / sent.file)] if sent.file else []
    assert _vendors_loaded(arguments) == {vendor}


def test_vendors_of_fixtures() -> None:
    """IMU packets and multicast DNS load no vendor; four vendors load all of them."""
    capture = str(TWO / "two_lidars.pcap")
    convert = ["convert", capture, "--rig", str(TWO / "rig.yaml"), "--dry-run", "--quiet"]
    assert _vendors_loaded(convert) == _vendors_loaded(["inspect", capture]) == {"ouster"}
    loaded = _vendors_loaded(["inspect", str(FOUR / "four_makers.pcap")])
    assert {"hesai", "ouster", "robosense", "velodyne"} <= loaded


# -- help -----------------------------------------------------------------------------------------

# What only a run needs.
OF_A_RUN = (
    *("numpy", "yaml", "mcap", "rosbags", "zstandard", "lz4", "ctypes", "importlib.metadata"),
    *("mlbatch.types", "mlbatch.rig", "mlbatch.sensors", "mlbatch.readers", "mlbatch.writers"),
    *("mlbatch.pipeline", "mlbatch.discovery", "mlbatch.reports", "mlbatch.cli.run"),
)


@pytest.mark.parametrize("arguments", [["--help"], ["convert", "--help"], ["--version"]])
def test_help_loads_nothing_of_a_run(arguments: list[str]) -> None:
    assert _loaded(OF_A_RUN, arguments) == set()
