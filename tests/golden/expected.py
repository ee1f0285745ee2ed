"""Make `expected.json` of `fixtures/two_lidars`: digests, and a few values that explain a change.

    python -m tests.golden.expected

Only after an intended change of the output; commit it alone, with the reason.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from pathlib import Path

import numpy as np

from tests.builders.run import (
    FIXTURE,
    TWO_LIDARS,
    Cloud,
    csv_without_arrival,
    digest,
    load,
    scan_files,
    to_file,
)

EXPECTED = TWO_LIDARS / "expected.json"

Value = str | int | float | bool | list[float]
Entry = dict[str, Value | dict[str, str] | list[dict[str, Value]]]


def describe(folder: Path) -> dict[str, str | dict[str, Entry]]:
    """All of a run in a folder of npz files."""
    table = csv_without_arrival((folder / "scans.csv").read_text(encoding="utf-8"))
    return {
        "scans.csv": hashlib.sha256(table.encode()).hexdigest(),
        "scans": {path.name: scan(path) for path in scan_files(folder)},
    }


def scan(path: Path) -> Entry:
    """One scan: readable figures, some points, the digests of all arrays."""
    cloud = Cloud.of(path)
    arrays = load(path)
    count = len(cloud.xyz)
    return {
        "start_ns": int(arrays["start_ns"]),
        "complete": bool(arrays["complete"]),
        "points": count,
        "columns": len(cloud.column_stamp_ns),
        "first_stamp_ns": int(cloud.column_stamp_ns[0]),
        "last_stamp_ns": int(cloud.column_stamp_ns[-1]),
        "mean_m": [round(float(mean), 4) for mean in cloud.xyz.mean(axis=0, dtype=np.float64)],
        "some": [point(cloud, number) for number in (0, count // 3, count // 3 * 2, count - 1)],
        "sha256": {key: digest(array) for key, array in arrays.items()},
    }


def point(cloud: Cloud, number: int) -> dict[str, Value]:
    """One point for people."""
    return {
        "xyz_m": [round(float(value), 4) for value in cloud.xyz[number]],
        "range_m": round(float(cloud.range_m[number]), 4),
        "intensity": float(cloud.intensity[number]),
        "at_ns": int(cloud.at_ns[number]),
        "ring": int(cloud.ring[number]),
        "lidar_id": int(cloud.lidar_id[number]),
    }


def main() -> None:
    """Convert the fixture and write what came out."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "scans"
        to_file(FIXTURE, folder, "npz")
        text = json.dumps(describe(folder), indent=1)
    EXPECTED.write_text(text + "\n", encoding="utf-8", newline="\n")


if __name__ == "__main__":
    main()
