"""Other programs that do a part of the same work, in environments of their own."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tests.bench.cases import CAPTURE, FULL, LOW, VLP16, VLS128, BenchRecording
from tests.bench.measure import BenchError, measure
from tests.bench.results import Run, Workload

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
    """A program to compare with."""

    name: str
    distribution: str
    # Name in programs.py.
    program: str
    # Sensor kinds that it can decode.
    kinds: frozenset[str]
    # Output format, as in a case; empty: none.
    output: str = ""

    def fits(self, recording: BenchRecording, output: str) -> bool:
        """Whether it can process this recording to this output."""
        kinds = {sensor.kind for sensor in recording.sensors}
        return output == self.output and kinds <= self.kinds


_OUSTER: Final = frozenset({LOW, FULL})
_VELODYNE: Final = frozenset({VLP16, VLS128})
PEERS: Final = (
    Peer("ouster-sdk", "ouster-sdk", "ouster-sdk", _OUSTER),
    Peer("ouster-sdk lean", "ouster-sdk", "ouster-sdk-lean", _OUSTER),
    Peer("ouster-cli", "ouster-sdk", "ouster-cli", _OUSTER, "ply"),
    Peer("velodyne-decoder", "velodyne-decoder", "velodyne-decoder", _VELODYNE),
    Peer("velodyne-decoder lean", "velodyne-decoder", "velodyne-decoder-lean", _VELODYNE),
)


def installed(python: str, scratch: Path) -> dict[str, str]:
    """Versions of the peers that an interpreter has; BenchError if it is no interpreter."""
    result = scratch / "versions.json"
    names = sorted({peer.distribution for peer in PEERS})
    measure("--peer-python", [python, "-c", _VERSIONS, str(result), *names], scratch)
    try:
        versions: dict[str, str] = json.loads(result.read_text(encoding="utf-8"))
    except (OSError, ValueError) as err:
        raise BenchError(
            f"--peer-python {python}: expected a Python interpreter, found another program; "
            "give the python of an environment"
        ) from err
    return versions


def run_peer(
    peer: Peer,
    python: str,
    recording: BenchRecording,
    folder: Path,
    recorded_s: float,
    scratch: Path,
) -> Run:
    """Measure a peer once on the recording in `folder`."""
    result = scratch / "peer.json"
    capture = folder / CAPTURE
    # As text: Python puts the folder of a script first in its search path.
    script = Path(__file__).with_name("programs.py").read_text(encoding="utf-8")
    command = [python, "-c", script, peer.program, str(result), str(capture)]
    usage = measure(peer.name, [*command, *_sensor_arguments(recording, folder)], scratch)
    found = json.loads(result.read_text(encoding="utf-8"))
    workload = Workload(
        slots=found["slots"],
        points=found["points"],
        scans=found["scans"],
        recorded_s=recorded_s,
        read_bytes=capture.stat().st_size,
        written_bytes=found.get("written_bytes", 0),
    )
    return Run(usage.cpu_s, usage.wall_s, usage.rss_mb, found["own_cpu_s"], workload)


def _sensor_arguments(recording: BenchRecording, folder: Path) -> Iterator[str]:
    """Metadata file and pose of each sensor, as `PATH,X,Y,Z,YAW_DEG`; its model without a file."""
    for sensor in recording.sensors:
        if sensor.file:
            pose = (*sensor.translation_m, sensor.yaw_deg)
            yield ",".join([str(folder / sensor.file), *map(str, pose)])
        else:
            yield sensor.kind
