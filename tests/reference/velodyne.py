"""Beams, firing times and units of Velodynes, read from docs/sources/velodyne.md.

Sections 1 (units), 2 (times, which it has as formulas), 5 (focal lengths) and 6 (angles).
"""

from __future__ import annotations

import math
import re
from pathlib import Path

PAGE = Path(__file__).resolve().parents[2] / "docs" / "sources" / "velodyne.md"
# Length of a firing sequence and times of its lasers, us, by first name of a row of section 2.
_TIMES = {
    "VLP-16": (55.296, [2.304 * laser for laser in range(16)]),
    "HDL-32E": (46.08, [1.152 * laser for laser in range(32)]),
    "VLP-32C": (55.296, [2.304 * (laser // 2) for laser in range(32)]),
    "VLS-128": (55.277, [55.277 / 20 * (laser // 8 + (laser // 8 >= 8)) for laser in range(128)]),
    "HDL-64E S2": (48.0, [6.0 * (j // 4) + (0, 1.26, 2.46, 3.66)[j % 4] for j in range(32)] * 2),
    "HDL-64E S3": (57.6, [7.2 * (j // 4) + (0, 1.3, 2.5, 3.7)[j % 4] for j in range(32)] * 2),
}


def times_us(model: str) -> tuple[float, list[float]]:
    """Length of a firing sequence, and when each laser fires in it."""
    short = model.removeprefix("Puck ")
    rows = (cells[0].split(", ") for cells in _rows("\n## 2. "))
    family = next((names[0] for names in rows if {model, short} & set(names)), model)
    assert family in _TIMES, f"{model}: expected its name in a row of section 2 of {PAGE}"
    return _TIMES[family]


def unit_m(model: str) -> float:
    """Metres of a count."""
    name = model.partition(" S")[0]
    (unit,) = (cells[3] for cells in _rows("\n## 1. ") if len(cells) > 4 and name in cells[1])
    return float(unit.removesuffix(" mm")) / 1000


def beams(model: str) -> tuple[list[float], list[float], list[float]]:
    """Vertical angle and azimuth offset, deg, and height, mm, by laser."""
    text = _text().partition("\n## 6. ")[2].partition("\n## 7. ")[0]
    if model == "VLP-32C":
        found = re.findall(r"\d+ (-?[\d.]+)/(-?[\d.]+)[;.]", text)
        angles = [float(angle) for angle, _ in found]
        return angles, [float(offset) for _, offset in found], _focal(42.4, angles)
    if model == "VLS-128":
        rows = re.findall(r"^\| \d+ \| ([-\d. ]+) \|$", text, re.MULTILINE)
        angles = _numbers(" ".join(rows))
        offsets = _numbers(text.partition("repeats every 8 lasers: ")[2].partition(". w by")[0])
        return angles, offsets * 16, _focal(58.63, angles)
    if model == "HDL-32E":
        even = _numbers(text.partition("even ids 0,2..30: ")[2].partition(";")[0])
        odd = _numbers(text.partition("odd ids 1,3..31: ")[2].partition(". ")[0])
        angles = [angle for pair in zip(even, odd, strict=True) for angle in pair]
        heights = _numbers(text.partition("v mm, ids 0..31: ")[2].partition(".\n")[0])
        return angles, [0.0] * 32, heights
    own = re.split(rf"^(?:.* / )?{model}(?: / .*)?: ", text, maxsplit=1, flags=re.MULTILINE)[1]
    angles = _numbers(own.partition("w = ")[2].partition(". v mm")[0])
    return angles, [0.0] * 16, _numbers(own.partition("v mm = ")[2].partition(". Ring")[0])


def _focal(length_mm: float, angles_deg: list[float]) -> list[float]:
    return [length_mm * math.tan(math.radians(-angle)) for angle in angles_deg]


def _numbers(text: str) -> list[float]:
    return [float(word) for word in text.replace(",", " ").split()]


def _rows(heading: str) -> list[list[str]]:
    """Cells of the tables of a section."""
    lines = _text().partition(heading)[2].partition("\n## ")[0].splitlines()
    return [line.strip("| ").split(" | ") for line in lines if line.startswith("|")]


def _text() -> str:
    return PAGE.read_text(encoding="utf-8")
