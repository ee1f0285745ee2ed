"""Other programs that do a part of the same work, in an environment of their own."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from mlbatch.bench.cases import CAPTURE, FULL, LOW, VLP16, Recording
from mlbatch.bench.measure import BenchError, measure
from mlbatch.bench.results import Counted, Run

_VERSIONS: Final = """
import importlib.metadata as metadata, json, sys
found = {}
for name in sys.argv[2:]:
    try:
        found[name] = metadata.version(name)
    except metadata.PackageNotFoundError:
        pass
open(sys.argv[1], "w").write(json.dumps(found))
"""


@dataclass(frozen=True, slots=True)
class Peer:
    """A peer: its distribution, the script that runs it and in which way.

    kinds: sensors that it knows; output: what it writes, as in a case.
    """

    name: str
    distribution: str
    script: str
    way: str
    kinds: frozenset[str]
    output: str = ""

    def fits(self, recording: Recording, output: str) -> bool:
        """Whether it can be measured on this."""
        return output == self.output and {s.kind for s in recording.sensors} <= self.kinds


_OUSTER: Final = frozenset({LOW, FULL})
PEERS: Final = (
    Peer("ouster-sdk", "ouster-sdk", "peer_ouster.py", "all", _OUSTER),
    Peer("ouster-sdk lean", "ouster-sdk", "peer_ouster.py", "lean", _OUSTER),
    Peer("ouster-cli", "ouster-sdk", "peer_ouster.py", "ply", _OUSTER, "ply"),
    Peer("velodyne-decoder", "velodyne-decoder", "peer_velodyne.py", "all", frozenset({VLP16})),
)


def installed(python: str, scratch: Path) -> dict[str, str]:
    """Versions of the peers in an environment; raises BenchError where it has no interpreter."""
    result = scratch / "versions.json"
    names = sorted({peer.distribution for peer in PEERS})
    measure("--peer-python", [python, "-c", _VERSIONS, str(result), *names], scratch)
    try:
        found: dict[str, str] = json.loads(result.read_text(encoding="utf-8"))
    except (OSError, ValueError) as err:
        raise BenchError(
            f"--peer-python {python}: wanted a Python interpreter, got another program; "
            "give the python of an environment"
        ) from err
    return found


def run_peer(
    peer: Peer, python: str, recording: Recording, folder: Path, recorded_s: float, scratch: Path
) -> Run:
    """Measure a peer once on a recording in a folder."""
    script = Path(__file__).with_name(peer.script).read_text(encoding="utf-8")
    result = scratch / "peer.json"
    capture = folder / CAPTURE
    # As text, since a script's own folder would come first among places to import from.
    command = [python, "-c", script, peer.way, str(capture), str(result)]
    usage = measure(peer.name, [*command, *_sensors(recording, folder)], scratch)
    told = json.loads(result.read_text(encoding="utf-8"))
    counted = Counted(
        *(told["slots"], told["points"], told["scans"], recorded_s),
        *(capture.stat().st_size, told.get("written_bytes", 0)),
    )
    return Run(usage.cpu_s, usage.wall_s, usage.rss_mb, told["own_cpu_s"], counted)


def _sensors(recording: Recording, folder: Path) -> Sequence[str]:
    """Metadata file and mounting of each sensor."""
    return [
        ",".join([str(folder / sensor.file), *map(str, sensor.translation_m), str(sensor.yaw_deg)])
        for sensor in recording.sensors
        if sensor.file
    ]
