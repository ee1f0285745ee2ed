"""A peer: ouster-sdk (BSD-3-Clause), frames collated and projected into one body frame.

Source: the API of ouster-sdk 1.0. Run by the interpreter that has it; imports nothing of mlbatch.
It takes the SDK's own way: `open_source` with its collator, then the lookup table of each sensor,
extrinsics folded in. `all`: every field and XYZLut (float64), as the SDK does by default; `lean`:
only the fields that mlbatch decodes, and XYZLutFloat; `ply`: one PLY file of all points by its
command line, in sensor frames.

    python peer_ouster.py all|lean|ply RECORDING RESULT METADATA,X,Y,Z,YAW_DEG...
"""

from __future__ import annotations

import contextlib
import importlib
import json
import sys
import time
from pathlib import Path

import numpy as np
import numpy.typing as npt

LEAN_FIELDS = {
    "RNG15_RFL8_NIR8": ["RANGE", "REFLECTIVITY"],
    "RNG19_RFL8_SIG16_NIR16": ["RANGE", "REFLECTIVITY", "SIGNAL"],
}


def pose(values: list[float]) -> npt.NDArray[np.float64]:
    """Body from sensor, (4, 4), of x, y, z in m and yaw in degrees."""
    x, y, z, yaw_deg = values
    cosine, sine = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    return np.array([[cosine, -sine, 0, x], [sine, cosine, 0, y], [0, 0, 1, z], [0, 0, 0, 1]])


def run(way: str, recording: str, sensors: list[str]) -> dict[str, object]:
    """Read the recording once; says what was found."""
    # By name, since checks run where the SDK is absent.
    sdk = importlib.import_module("ouster.sdk")
    core = importlib.import_module("ouster.sdk.core")
    began_s = time.process_time()
    names = [sensor.split(",")[0] for sensor in sensors]
    settings: dict[str, object] = {
        "meta": names,
        "extrinsics": [pose([float(part) for part in one.split(",")[1:]]) for one in sensors],
    }
    if way == "lean":
        metadata = json.loads(Path(names[0]).read_text(encoding="utf-8"))
        settings["field_names"] = LEAN_FIELDS[metadata["lidar_data_format"]["udp_profile_lidar"]]
    source = sdk.open_source(recording, **settings)
    table_type = core.XYZLutFloat if way == "lean" else core.XYZLut
    tables = [table_type(info, use_extrinsics=True) for info in source.sensor_info]
    slots = points = scans = 0
    for frames in source:
        scans += 1
        for number, frame in enumerate(frames):
            if frame is not None:
                slots += tables[number](frame).size // 3
                points += int(np.count_nonzero(frame.field("RANGE")))
    own_cpu_s = time.process_time() - began_s
    return {"slots": slots, "points": points, "scans": scans, "own_cpu_s": own_cpu_s}


def save(recording: str, sensors: list[str]) -> dict[str, object]:
    """Let the SDK's command line write a PLY file; says what it holds."""
    cli = importlib.import_module("ouster.cli.core")
    began_s = time.process_time()
    metadata = [part for sensor in sensors for part in ("--meta", sensor.split(",")[0])]
    sys.argv = ["ouster-cli", "source", *metadata, recording]
    sys.argv += ["save", "--decimate", "false", "peer.ply"]
    # The command line ends its process where it is done.
    with contextlib.suppress(SystemExit):
        cli.run()
    own_cpu_s = time.process_time() - began_s
    points = size = 0
    for path in Path().glob("peer*.ply"):
        with path.open("rb") as file:
            points += next(int(line.split()[2]) for line in file if b"element vertex" in line)
        size += path.stat().st_size
        path.unlink()
    if not points:
        raise RuntimeError("ouster-cli saved no points")
    found = {"slots": points, "points": points, "scans": 1, "written_bytes": size}
    return {**found, "own_cpu_s": own_cpu_s}


if __name__ == "__main__":
    way, recording, result, *sensors = sys.argv[1:]
    found = save(recording, sensors) if way == "ply" else run(way, recording, sensors)
    Path(result).write_text(json.dumps(found), encoding="utf-8")
