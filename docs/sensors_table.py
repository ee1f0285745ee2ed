"""Write the sensor table of docs/models.md from the models: `python docs/sensors_table.py`.

Models of a vendor with the same calibration and verification share a row.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from mlbatch.lidar.interface import SensorModel
from mlbatch.sensors import models

PAGE = Path(__file__).resolve().parent / "models.md"
BEGIN, END = "<!-- sensors: python docs/sensors_table.py -->", "<!-- end of sensors -->"
HEAD = ("vendor", "models (channels)", "calibration", "verified")


def table() -> str:
    """Return the rows, in the order of `mlbatch sensors`."""
    names: dict[tuple[str, ...], list[str]] = {}
    for model in models():
        names.setdefault(_shared(model), []).append(_name(model))
    rows = [HEAD, ("---",) * len(HEAD)]
    rows += [(shared[0], ", ".join(found), *shared[1:]) for shared, found in names.items()]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def with_table(page: str) -> str:
    """Return the page with the current table between its marks."""
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise SystemExit(f"expected the marks {BEGIN} and {END}, found none; restore them")
    return f"{before}{BEGIN}\n\n{table()}\n{END}{after}"


def _shared(model: SensorModel) -> tuple[str, ...]:
    return model.vendor, model.calibration, model.verified


def _name(model: SensorModel) -> str:
    """Return the model name, with its number of channels unless the name has it."""
    channels = str(model.channels)
    return (
        model.name if channels in re.findall(r"\d+", model.name) else f"{model.name} ({channels})"
    )


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else PAGE
    target.write_text(with_table(target.read_text(encoding="utf-8")), encoding="utf-8")
