"""Reports and tables of runs, by hand."""

from __future__ import annotations

import json
from typing import Any

NS_PER_S = 10**9
START_NS = 1_800_000_000 * NS_PER_S
PERIOD_NS = 100_000_000
COLUMNS = 512


def sensor(name: str, lidar_id: int = 0, **packets: int) -> dict[str, Any]:
    """One sensor of a report, of 1000 packets."""
    lost = packets.get("lost", 0)
    bad = packets.get("bad_size", 0)
    read = 1000 - lost
    pose = [[1.0, 0.0, 0.0, float(lidar_id)], [0.0, 1.0, 0.0, 0.0]]
    pose += [[0.0, 0.0, 1.0, 2.0], [0.0, 0.0, 0.0, 1.0]]
    return {
        "name": name,
        "model": "OS-1-32-U1",
        "lidar_id": lidar_id,
        "stream": "10.0.0.1 > port 7502",
        "mode": "512x10",
        "packets": {
            "read": read,
            "accepted": read - bad,
            "rejected": {"bad_size": bad} if bad else {},
            "lost": lost,
            "reordered": 0,
        },
        "columns": {"decoded": 16000, "written": 15000, "dropped": {"head": 400, "tail": 600}},
        "points": {
            **{"slots": 1000, "no_return": 100, "range": 50, "box": 30, "repeated": 20},
            **{"written": 800, "clipped": 0},
        },
        "clock": {
            **{"source": "sensor", "epoch": "utc", "offset_to_host_ms": -1.5},
            **{"drift_ppm": packets.get("drift_ppm"), "notes": []},
        },
        "extrinsics": {"source": "rig", "body_from_sensor": pose},
        "calibration": f"{name}.json",
    }


def report(*sensors: dict[str, Any], scans: int = 10, **more: Any) -> dict[str, Any]:
    """A report of a run."""
    return {
        "schema": "mlbatch.report/1",
        "version": "0.1.0",
        "command": "mlbatch convert drive.pcap -o scans",
        "inputs": [{"path": "/data/drive.pcap", "bytes": 1_000_000, "container": "pcap"}],
        "timescale": "utc",
        "grid": {"rate_hz": "10", "period_ns": "100000000", "t_init_ns": START_NS, "slices": 1},
        "capture": {"frames": 1, "datagrams": 1, "skipped": {}},
        "unassigned": [],
        "sensors": list(sensors),
        "messages": [],
        "scans": {
            **{"written": scans, "empty": 0, "incomplete": 0, "dropped_incomplete": 0},
            **{"points": 1000 * scans, "span_ms": {"p50": 99.8}, "period_ms": {"p50": 100.0}},
        },
        "timing": {"wall_s": 1.0, "recorded_s": scans / 10, "realtime_factor": 2.0},
        "warnings": [],
        **more,
    }


def text(document: dict[str, Any]) -> str:
    """A report as JSON."""
    return json.dumps(document)


def table(
    names: tuple[str, ...],
    columns: list[list[int]],
    expected: int | None = None,
    *,
    has_head: bool = False,
) -> str:
    """scans.csv of windows with these columns of each sensor (a list a window), of so many."""
    head = ["index", "slice", "start_ns", "end_ns", "first_stamp_ns", "last_stamp_ns", "points"]
    head += ["columns", *(f"columns_{name}" for name in names), "complete"]
    head += [f"max_gap_ns_{name}" for name in names]
    head += [f"{word}_{name}" for word in ("coverage", "overlap", "missing") for name in names]
    lines = [",".join([*head, "ready_host_ns"])]
    for index, own in enumerate(columns):
        start_ns = START_NS + index * PERIOD_NS
        end_ns = start_ns + PERIOD_NS
        lacks = ["" if expected is None else str(expected - count) for count in own]
        complete = "true" if all(own) else "false"
        cells = [index - has_head, 0, start_ns, end_ns, start_ns + 100_000, end_ns - 100_000]
        cells += [10 * sum(own), sum(own), *own]
        row = [*map(str, cells), complete, *("195300" if count else "0" for count in own)]
        row += ["1.000"] * len(own) + ["0.000"] * len(own) + lacks + [str(end_ns + 2_000_000)]
        lines.append(",".join(row))
    return "\n".join(lines) + "\n"
