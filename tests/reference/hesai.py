"""Firing times and optical centres of HESAI lidars, read from docs/sources/hesai.md.

The page quotes files of the vendor's SDK and manuals (sections 5, 6 and 12). Times are in ns after
the time of a block.
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
