"""What a command does before its work: it loads what it needs, and spares the collector."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.builders.sessions import SMALL, Unit, write_session
from tests.contract.tree import modules, run_python


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
    *("mlbatch.frames.urdf", "mlbatch.discovery.inspect", "mlbatch.compare.compare"),
    *("mlbatch.verify.verdict", "mlbatch.bench.runner", "mlbatch.api"),
    *("mlbatch.writers.formats.npz", "mlbatch.writers.formats.ply"),
    *("mlbatch.writers.formats.rosbag1", "mlbatch.cli.bench", "mlbatch.cli.compare"),
    *("mlbatch.cli.inspect", "mlbatch.cli.verify", "mlbatch.cli.report", "mlbatch.page.document"),
    *("numpy.ma", "rosbags", "rich"),
)


@pytest.mark.parametrize("name", [name for name in NEEDLESS if name.startswith("mlbatch.")])
def test_what_is_needless_is_there(name: str) -> None:
    assert name.removeprefix("mlbatch.") in {module.name for module in modules()}


def test_a_capture_loads_only_what_it_needs(tmp_path: Path) -> None:
    capture = write_session(tmp_path, Unit())
    rig = tmp_path / "rig.yaml"
    rig.write_text(f"sensors: [{{name: front, metadata: {SMALL.serial}.json}}]\n")
    output = tmp_path / "scans.mcap"
    arguments = ["convert", str(capture), "--rig", str(rig), "-o", str(output), "--quiet"]
    printed = run_python(
        "import atexit, sys\n"
        # numpy 1.26 loads numpy.ma itself, and typer 0.15 loads rich.
        "import numpy, typer\n"
        f"names = [name for name in {NEEDLESS!r} if name not in sys.modules]\n"
        "from mlbatch.cli import main\n"
        "atexit.register(lambda: print([name for name in names if name in sys.modules]))\n"
        # Slow: it reads the metadata of all distributions.
        "from mlbatch import entry_points\n"
        "lookups = entry_points._entry_points.cache_info\n"
        "atexit.register(lambda: print(lookups().misses, end=' '))\n"
        f"sys.argv[1:] = {arguments!r}\n"
        "main()\n"
    )
    assert printed.strip() == "0 []"
    assert output.is_file()
