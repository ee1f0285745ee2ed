"""Headers and pixels of Ouster packets, read from docs/sources/ouster.md sections 2 and 3."""

from __future__ import annotations

import re
from pathlib import Path

PAGE = Path(__file__).resolve().parents[2] / "docs" / "sources" / "ouster.md"
_DUAL = "RNG19_RFL8_SIG16_NIR16_DUAL"
_LOW = "RNG15_RFL8_NIR8"
_COLOURS = ("RED", "GREEN", "BLUE")


def header_fields(kind: str) -> dict[str, tuple[int, int]]:
    """First byte and bytes of the fields of a "STANDARD" or "FUSA" header, by name."""
    column = {"STANDARD": 1, "FUSA": 2}[kind]
    found = {}
    for row in _rows("### Packet header, two layouts"):
        at = re.match(r"(\d+), u(\d+)", row[column])
        if at is not None:
            found[row[0].partition(" (")[0]] = int(at[1]), int(at[2]) // 8
    return found


def pixels() -> dict[str, tuple[int, dict[str, tuple[int, int, int]]]]:
    """Bytes of a pixel and (first bit, width, shift) of its fields, by profile."""
    found: dict[str, tuple[int, dict[str, tuple[int, int, int]]]] = {}
    for names, size, text in _rows("## 3. Profiles"):
        if not size.isdigit():
            continue
        fields: dict[str, tuple[int, int, int]] = {}
        if "as ..._DUAL to bit 95" in text:
            fields = {name: at for name, at in found[_DUAL][1].items() if at[0] < 96}
        elif f"first 4 B as {_LOW}" in text:
            fields = dict(found[_LOW][1])
        for name, first, width, shift in re.findall(r"(\w+) (\d+),(\d+)(?:,<<(\d))?", text):
            full = re.sub(r"^REFL(?=\d?$)", "REFLECTIVITY", name)
            fields[full] = int(first), int(width), int(shift or 0)
        colours = re.search(r"R,G,B (\d+)/(\d+)/(\d+)", text)
        if colours is not None:
            bits = map(int, colours.groups())
            fields |= {name: (bit, 16, 0) for name, bit in zip(_COLOURS, bits, strict=True)}
        for name in names.split(", "):
            found[name] = int(size), fields
    return found


def _rows(heading: str) -> list[list[str]]:
    """Cells of the first table below a heading, without its head."""
    text = PAGE.read_text(encoding="utf-8").partition(f"\n{heading}")[2]
    table = re.search(r"(?:^\|.*\n)+", text, re.MULTILINE)
    assert table is not None
    return [line.strip("| ").split(" | ") for line in table[0].splitlines()[2:]]
