"""Tables of ROBOSENSE that its encoder does not cover, read from docs/sources/robosense.md."""

from __future__ import annotations

import re
from pathlib import Path

PAGE = Path(__file__).resolve().parents[2] / "docs" / "sources" / "robosense.md"
DUAL = "dual"


def bpearl_v4_elevation_deg() -> list[float]:
    """Nominal elevations by channel, section 6."""
    text = PAGE.read_text(encoding="utf-8").partition("Bpearl v4 in deg: ")[2].partition(";")[0]
    return [float(word) for word in text.split()]


def return_modes(family: str) -> dict[int, str]:
    """DIFOP byte 300 in a row of section 4: `DUAL`, or the only return."""
    text = PAGE.read_text(encoding="utf-8").partition("\n## 4. ")[2].partition("\n## ")[0]
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")]
    (codes,) = (row[2] for row in rows if row[0] == family and row[1].startswith("DIFOP 300"))
    found = {}
    for code, words in re.findall(r"(\d) ([a-z][a-z+ ]*)", codes):
        mode = words.strip().replace("nearest", "first")
        found[int(code)] = DUAL if "+" in mode else mode
    return found
