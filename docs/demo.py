"""Say in plain words what `make demo` has made: the last thing that it runs.

    python docs/demo.py demo

All figures come from the report of the run (report.json, docs/report.md).
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

MCAP, SCANS, PICTURE = "two_lidars.mcap", "scans", "two_lidars.png"


@dataclass(frozen=True, slots=True)
class Outcome:
    """The figures of a report that a newcomer wants to know."""

    names: tuple[str, ...]
    scans: int
    points: int
    rate_hz: str
    period_ms: Fraction


def main() -> int:
    """Read the report in the demo's folder and tell."""
    parser = argparse.ArgumentParser(description="Say what the demo has made.")
    parser.add_argument("folder", type=Path, help="where the demo wrote its files")
    folder: Path = parser.parse_args().folder
    try:
        text = (folder / SCANS / "report.json").read_text(encoding="utf-8")
        print(told(read_outcome(text), folder))
    except (OSError, ValueError, KeyError) as error:
        print(f"demo: {error}", file=sys.stderr)
        return 1
    return 0


def read_outcome(text: str) -> Outcome:
    """The figures in the text of a report.json."""
    report = json.loads(text)
    scans, grid = report["scans"], report["grid"]
    return Outcome(
        tuple(sensor["name"] for sensor in report["sensors"]),
        scans["written"],
        scans["points"],
        grid["rate_hz"],
        Fraction(grid["period_ns"]) / 1_000_000,
    )


def told(outcome: Outcome, folder: Path) -> str:
    """A sentence about what there is, and one line for each thing to look at."""
    lidars = f"{len(outcome.names)} lidars ({', '.join(outcome.names)})"
    period = f"{float(outcome.period_ms):g} ms"
    return f"""
The packets of {lidars} have become {outcome.scans} scans with {outcome.points} points,
exactly {outcome.rate_hz} a second; each holds what all lidars saw in the same {period}.

  {folder / PICTURE}   one of them as a picture: open it in any image viewer or browser
  {folder / MCAP}  all of them for ROS 2, Foxglove and others (topic /points)
  {folder / SCANS}/           all of them for numpy, a file each, with report.json and scans.csv"""


if __name__ == "__main__":
    sys.exit(main())
