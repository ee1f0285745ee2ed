"""Layouts, firing times and optical centres of HESAI lidars, read from docs/sources/hesai.md.

The page quotes files of the vendor's SDK and manuals (sections 2, 3, 5, 6 and 12). Times are in
ns after the time of a block.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

import numpy as np

from mlbatch.arrays import I64Array

PAGE = Path(__file__).resolve().parents[2] / "docs" / "sources" / "hesai.md"
# A beam that does not fire.
SILENT = -1
_TABLE = re.compile(r"^`([^`]+)`\n\n```text\n([-\d\s]+)```$", re.MULTILINE)
_SAME = re.compile(r"^`([^`]+)`: same as `([^`]+)`$", re.MULTILINE)
# Operation modes of the 128-channel families by the number in their packets (section 3): mode 1 has
# no table of its own, the OT128 none for energy saving.
_MODES = {
    "128E3X": ("high-res", "standard", "standard", "energy saving"),
    "OT128": ("high-res", "standard", "standard", "standard"),
}
_TITLES = {
    "Pandar20A": ("P20A",),
    "Pandar20B": ("P20B",),
    "Pandar40P": ("P40",),
    "Pandar40M": ("P40",),
    "Pandar64": ("P64",),
    "PandarQT64": ("QT64",),
    "QT128C2X": ("QT128 loop 1", "QT128 loop 2"),
    "AT128": ("AT128",),
    "JT128": ("JT128",),
}
_CENTRES = {
    "Pandar40P": "40P",
    "Pandar40M": "40P",
    "Pandar64": "64",
    "PandarQT64": "QT64",
    "QT128C2X": "QT128",
    "PandarXT-16": "XT",
    "PandarXT-32": "XT",
    "XT32M2X": "XT32M2X",
    "Pandar128E3X": "128E3X",
    "OT128": "OT128",
    "JT128": "JT128",
}
# Section 5; no firing times of a JT16 are known.
_FORMULAS = {
    "PandarXT-16": [368 + 3024 * (channel - 1) for channel in range(1, 17)],
    "PandarXT-32": [368 + 1512 * (channel - 1) for channel in range(1, 33)],
    "XT32M2X": [368 + 2888 * ((channel - 1) % 16) for channel in range(1, 33)],
    "JT16": [0] * 16,
}

# Names in the tables of sections 2 (layout), 3 (tails) and 5 (times of blocks).
LAYOUTS = {
    "Pandar40P": ("40p", "40P, 64", "40P"),
    "Pandar64": ("64", "40P, 64", "64"),
    "PandarQT64": ("qt64", "QT64", "QT64"),
    "QT128C2X": ("qt128", "QT128", "QT128"),
    "PandarXT-16": ("xt16", "XT family", "XT-16"),
    "PandarXT-32": ("xt32", "XT family", "XT-32"),
    "XT32M2X": ("xt32m", "XT family", "XT32M2X"),
    "Pandar128E3X": ("128e3x, ot128", "128E3X, OT128, JT128", "128E3X, single"),
    "OT128": ("128e3x, ot128", "128E3X, OT128, JT128", "OT128"),
    "JT128": ("128e3x, ot128", "128E3X, OT128, JT128", "JT128"),
    "AT128": ("at128", "AT128", "AT128"),
}


def layout(model: str) -> list[int]:
    """Bytes of the header, blocks, channels, byte of the azimuth in a block and of the first
    channel, bytes of a channel without options."""
    cells = _cells("## 2. ", LAYOUTS[model][0])
    return [int(re.findall(r"\d+", cells[column])[0]) for column in (1, 2, 3, 5, 6, 7)]


def tail(model: str, field: str) -> int | None:
    """Where a tail has a field, or its length; None: it has none."""
    heads = _cells("## 3. ", "field")
    cell = _cells("## 3. ", field)[heads.index(LAYOUTS[model][1])]
    return None if cell == "-" else int(cell.split()[0])


def cadence_ns(model: str) -> tuple[int, float]:
    """Time of the first firing group of a packet, or of the last if they are counted back from it
    (negative step), and from group to group."""
    text = _cells("## 5. ", LAYOUTS[model][2])[1]
    base, sign, step, divisor = re.findall(
        r"(?:(-?\d+) )?([+-]) ?\(?(\d+) x [^/]*(?://[^/]*)?(?:/ (\d))?", text
    )[0]
    return int(base or 0), int(f"{sign}{step}") / int(divisor or 1)


def _cells(heading: str, first: str) -> list[str]:
    """Cells of the row of a section that begins with a text."""
    text = PAGE.read_text(encoding="utf-8").partition(f"\n{heading}")[2].partition("\n## ")[0]
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")]
    return next(row for row in rows if row[0] == first)


def firing_ns(model: str) -> I64Array:
    """(tables, channels) times of a model; tables: loops of a QT128, else one.

    The families of `by_state` are not among them.
    """
    if model in _FORMULAS:
        return np.array([_FORMULAS[model]], np.int64)
    return np.stack([_tables()[title] for title in _TITLES[model]])


def by_state(family: str) -> dict[tuple[int, int], I64Array]:
    """Times of "128E3X" or "OT128" by operation mode and azimuth state, 0 to 3 each.

    Modes with two tables use them in turn.
    """
    tables = _tables()
    found = {}
    for operation, mode in enumerate(_MODES[family]):
        states = [title for title in tables if title.startswith(f"{family} {mode}, azimuth state")]
        for state in range(4):
            found[operation, state] = tables[sorted(states)[state % len(states)]]
    return found


def optical_centre_mm(model: str) -> tuple[float, ...]:
    """x to the right, y forward, z up, by section 6; of a JT16 as the SDK rotates it."""
    text = PAGE.read_text(encoding="utf-8").partition("c in mm (x, y, z): ")[2].partition("\n")[0]
    if model == "JT16":
        numbers = text.partition("190 deg, to (")[2].partition(")")[0]
    else:
        found = re.findall(r"([\w, ]+?) \(([-\d., ]+)\)", text)
        by_name = {name.strip(): row for names, row in found for name in names.split(",")}
        numbers = by_name[_CENTRES[model]]
    return tuple(map(float, numbers.split(",")))


@lru_cache(maxsize=1)
def _tables() -> Mapping[str, I64Array]:
    """All tables of section 12, by title without what is in parentheses."""
    text = PAGE.read_text(encoding="utf-8").partition("\n## 12. ")[2]
    tables = {}
    for title, numbers in _TABLE.findall(text):
        # Some tables have a dash for beams that do not fire, others 0, which their title says.
        silent = "0" if "0 = does not fire" in title else "-"
        words = [SILENT if word == silent else int(word) for word in numbers.split()]
        tables[_short(title)] = np.array(words, np.int64)
    for title, other in _SAME.findall(text):
        tables[_short(title)] = tables[_short(other)]
    return tables


def _short(title: str) -> str:
    return title.partition(" (")[0].removesuffix(", far field")
