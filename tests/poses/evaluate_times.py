"""Count how often `inspect` names how the times of simulated decoded clouds must be read.

    python -m tests.poses.evaluate_times --runs 50

Each run is another yard, speed and turn, with one of eight readings of the times of one lidar.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from mlbatch.pipeline.cloud_times import TimeFinding
from mlbatch.pipeline.inspect import inspect
from tests.builders.time_readings import READINGS, Reading, drive, scenario, write_clouds

# What must be written in the rig for each reading, by a word in it; none: the times fit.
_NAMED = {
    "header at the end": ("right points", "{from: end}"),
    "header at the start, rig says end": ("right points", "{from: start}"),
    "ages": ("right points", "{from: back}"),
    "20 ms late": ("right clock", -0.020),
    "97 ms late": ("right clock", -0.097),
}
# Most error of an offset, s.
_OFFSET_S = 0.005


def verdict(reading: Reading, findings: Sequence[TimeFinding]) -> str:
    """Right, not decided or wrong."""
    right = next(one for one in findings if one.sensor == "right")
    keys = {name: value for one in findings for name, value in one.set.items()}
    if not keys and any("not decided" in (one.order, one.delay) for one in findings):
        return "not decided"
    named = _NAMED.get(reading.name)
    if named is None:
        return "wrong" if keys else "right"
    key, value = named
    if right.is_open:
        return "not decided" if key in keys else "wrong"
    if isinstance(value, str):
        return "right" if keys == {key: value} else "wrong"
    found = keys.get(key)
    if len(keys) != 1 or found is None:
        return "wrong"
    late_s = float(found[len("{offset_s:") : -1]) - float(str(value))
    return "right" if abs(late_s) < _OFFSET_S else "wrong"


def main() -> None:
    """Print a line a run, and the counts."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--standing", action="store_true")
    parser.add_argument("--all", action="store_true", help="all readings of each run")
    chosen = parser.parse_args()
    counts: Counter[str] = Counter()
    for seed in range(chosen.first, chosen.first + chosen.runs):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            moved = drive(folder, scenario(seed, moving=not chosen.standing), seed)
            readings = READINGS if chosen.all else (READINGS[seed % len(READINGS)],)
            for reading in readings:
                path, rig = write_clouds(folder, moved, (READINGS[0], reading))
                begin_s = time.process_time()
                findings = inspect([path], (), rig=rig).point_times
                found = verdict(reading, findings)
                counts[found] += 1
                print(f"{seed} {reading.name}: {found}, {time.process_time() - begin_s:.1f} s")
                for one in findings:
                    print(f"    {one.describe()}", flush=True)
    print(", ".join(f"{count} {name}" for name, count in counts.most_common()))


if __name__ == "__main__":
    main()
