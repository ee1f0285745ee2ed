"""The peer of the speed comparison: ouster-sdk 1.0.1, frames collated and projected to xyz.

Run it by the interpreter of an environment that has ouster-sdk; it imports nothing of mlbatch.
It takes the SDK's own path from a pcap to points of all sensors in one body frame: `open_source`
with its collator, then the lookup table of each sensor, extrinsics folded in. Everything optional
is off: no index, only the fields that mlbatch decodes too, and float32 points unless `--double`.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys

import numpy as np
import numpy.typing as npt

FIELDS = ["RANGE", "REFLECTIVITY"]


def pose(text: str) -> npt.NDArray[np.float64]:
    """Body from sensor, (4, 4), metres, of a text `x,y,z,yaw_deg`."""
    x, y, z, yaw_deg = (float(part) for part in text.split(","))
    cosine, sine = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    return np.array([[cosine, -sine, 0, x], [sine, cosine, 0, y], [0, 0, 1, z], [0, 0, 0, 1]])


def run(options: argparse.Namespace) -> dict[str, object]:
    """Read the recording once; returns what was found."""
    # By name, since checks run where the SDK is absent.
    sdk = importlib.import_module("ouster.sdk")
    core = importlib.import_module("ouster.sdk.core")
    settings: dict[str, object] = {"meta": options.metadata}
    if options.extrinsics:
        settings["extrinsics"] = [pose(text) for text in options.extrinsics]
    if not options.all_fields:
        settings["field_names"] = FIELDS
    source = sdk.open_source(options.recording, **settings)
    table_type = core.XYZLut if options.double else core.XYZLutFloat
    tables = [table_type(info, use_extrinsics=True) for info in source.sensor_info]
    sets = slots = valid = complete = 0
    frames = [0] * len(tables)
    last = np.zeros(3)
    for frame_set in source:
        sets += 1
        for sensor, frame in enumerate(frame_set):
            if frame is None:
                continue
            xyz = tables[sensor](frame)
            frames[sensor] += 1
            complete += bool(frame.complete())
            slots += xyz.size // 3
            valid += int(np.count_nonzero(frame.field("RANGE")))
            last = xyz[xyz.shape[0] // 2, xyz.shape[1] // 2]
    return {
        "frame_sets": sets,
        "frames": frames,
        "frames_complete": complete,
        "slots": slots,
        "points": valid,
        "last_xyz": [float(value) for value in last],
    }


def main() -> int:
    """Print what was found as one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", help="pcap")
    parser.add_argument("metadata", nargs="+", help="metadata json of each sensor")
    parser.add_argument(
        "--extrinsics", action="append", metavar="X,Y,Z,YAW", help="m, deg; one for each sensor"
    )
    parser.add_argument("--all-fields", action="store_true", help="decode every field")
    parser.add_argument("--double", action="store_true", help="XYZLut (float64), not XYZLutFloat")
    print(json.dumps(run(parser.parse_args())))
    return 0


if __name__ == "__main__":
    sys.exit(main())
