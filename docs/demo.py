"""Print a summary of what `make demo` made: its last step.

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
    """Figures of a report for the summary."""

    names: tuple[str, ...]
    scans: int
    points: int
    rate_hz: str
    period_ms: Fraction


def main() -> int:
    """Read the report in the demo folder; print the summary."""
    parser = argparse.ArgumentParser(description="Summarise what the demo made.")
    parser.add_argument("folder", type=Path, help="folder that the demo wrote to")
    folder: Path = parser.parse_args().folder
    try:
        text = (folder / SCANS / "report.json").read_text(encoding="utf-8")
        print(describe(read_outcome(text), folder))
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


def describe(outcome: Outcome, folder: Path) -> str:
    """Return one sentence on the result and one line per file."""
    lidars = f"{len(outcome.names)} lidars ({', '.join(outcome.names)})"
    period = f"{float(outcome.period_ms):g} ms"
    return f"""
Packets of {lidars} became {outcome.scans} scans with {outcome.points} points at exactly
{outcome.rate_hz} Hz; each scan has all columns of all lidars from the same {period}.

  {folder / PICTURE}   picture of one scan, for any image viewer or browser
  {folder / MCAP}  all scans for ROS 2, Foxglove and others (topic /points)
  {folder / SCANS}/           all scans for numpy, one file each, with report.json and scans.csv"""


if __name__ == "__main__":
    sys.exit(main())
