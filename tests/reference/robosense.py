"""Layouts, times, lenses, units and return modes of ROBOSENSE by docs/sources/robosense.md."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

PAGE = Path(__file__).resolve().parents[2] / "docs" / "sources" / "robosense.md"
DUAL = "dual"


def bpearl_v4_elevation_deg() -> list[float]:
    """Nominal elevations by channel, section 6."""
    text = _page().partition("Bpearl v4 in deg: ")[2].partition(";")[0]
    return [float(word) for word in text.split()]


def return_modes(family: str) -> dict[int, str]:
    """DIFOP byte 300 in a row of section 4: `DUAL`, or the only return."""
    text = _page().partition("\n## 4. ")[2].partition("\n## ")[0]
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")]
    (codes,) = (row[2] for row in rows if row[0] == family and row[1].startswith("DIFOP 300"))
    found = {}
    for code, words in re.findall(r"(\d) ([a-z][a-z+ ]*)", codes):
        mode = words.strip().replace("nearest", "first")
        found[int(code)] = DUAL if "+" in mode else mode
    return found


# The rules of section 5, k from 1.
_RULES: dict[str, Sequence[float]] = {
    "RS-LiDAR-16": [2.8 * (k - 1) for k in range(1, 17)],
    "RS-LiDAR-32": [2.88 * ((k - 1) % 16) + 1.44 * (k // 16) for k in range(1, 33)],
    "RS-Bpearl v3": [
        2.56 * ((k - 1) % 16) + 1.28 * ((k - 1) // 16) + 5.2 * (9 <= k <= 16 or 25 <= k <= 32)
        for k in range(1, 33)
    ],
    "Helios 32": [1.73 * (k - 1) for k in range(1, 33)],
    "Helios 16": [27.68 + 1.73 * (k - 1) for k in range(1, 17)],
    "Ruby 128": [3.236 * (((k - 1) % 64) // 4) for k in range(1, 129)],
}


def firing_us(model: str) -> Sequence[Sequence[float]]:
    """Times of the channels after their round; of an Airy 96 by mount, of a Plus 80 and an 80v."""
    if model in _RULES:
        return [_RULES[model]]
    if model == "Airy 96":
        return [_listed(f"Airy {mount}", 8) for mount in ("normal", "side", "M")]
    if model == "Airy 48":
        return [_listed("Airy M", 4)]
    if model == "RS-Bpearl v4":
        return [_listed("Bpearl v4", 1)]
    if model == "Ruby Plus 48":
        return [_listed(model, 2)]
    if model in ("Ruby 80", "Ruby 48"):
        counts = map(int, _listed(model, 1))
        return [[3.236 * (n % 16) for n, count in enumerate(counts) for _ in range(count)]]
    runs = re.findall(r"([\d.]+) x(\d)", _list(model + ","))
    grouped = [float(time) for time, count in runs for _ in range(int(count))]
    return [grouped] + [_listed("Ruby Plus 80v", 4)] * (model == "Ruby Plus 80")


def blocks(model: str) -> tuple[int, bytes, int, int, int]:
    """Bytes of the header, first bytes of a block, blocks, readings in each and its bytes,
    section 3."""
    _, header, first, count, readings, stride, *_ = _row("## 3. ", model)
    return (
        int(header),
        bytes.fromhex(first.partition(",")[0]),
        int(count),
        int(readings.split()[0]),
        int(stride),
    )


def fields(model: str) -> tuple[int, int]:
    """Bytes of the time and of the return mode in the header of a packet, section 2; 0: none."""
    names = {"RS-": "RSMsopHeaderV1", "Airy": "RSAIRYHeader", "Ruby": "RSMsopHeaderV2"}
    struct = next((one for start, one in names.items() if model.startswith(start)), None)
    row = _row("| struct | time", f"`{struct or 'RSHELIOSMsopHeader'}`")
    return int(row[1].partition("-")[0]), int(re.sub("^-", "0", row[2]).split()[0])


def magic(model: str) -> bytes:
    """First bytes of a packet, section 1."""
    kind = "first kind (RS" if model.startswith("RS-") else "second kind (Helios"
    kind = "80-byte header" if model.startswith("Ruby") else kind
    line = next(line for line in _page().splitlines() if "| MSOP, " in line and kind in line)
    return bytes.fromhex(line.split("`")[1])


def angles(model: str) -> tuple[int, int, float]:
    """Bytes of elevations and azimuths in a device packet (0: none) and degrees, section 6."""
    _, elevation, azimuth, _, unit = _row("| model | elevation at", model)
    at = [int(re.findall(r"\d+", cell)[0]) for cell in (elevation, azimuth)]
    return at[0], at[1], float(re.findall(r"[\d.]+", unit)[0])


def unit_m(model: str) -> float:
    """Metres of a count, section 3."""
    return float(_row("## 3. ", model)[7].partition(",")[0])


def lens_m(model: str) -> tuple[float, float]:
    """Radius and height, section 6."""
    _, radius, height = _row("| model | R m | Z m |", model)
    return float(radius.partition(" (")[0]), float(height)


def round_us(model: str) -> float:
    """From round to round, section 5."""
    text = _page().partition("Round = ")[2].partition("\n")[0]
    found = {
        name: float(time)
        for time, names in re.findall(r"([\d.]+)(?: us)? \(([^)]*)\)", text)
        for name in names.split(", ")
    }
    return next(
        time
        for name, time in found.items()
        if _short(model).startswith(name.partition(" 55.55")[0]) or f"Ruby {name}" == model
    )


def _row(heading: str, model: str) -> list[str]:
    """Cells of the first row below a heading that names a model, or one of its family."""
    # Of a section, or of a table alone.
    end = "\n\n" if heading.startswith("|") else "\n## "
    text = _page().partition(f"\n{heading}")[2].partition(end)[0]
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")]
    family, _, lines = _short(model).rpartition(" ")
    for wanted in (
        _short(model),
        f"{family.removeprefix('Ruby ')} {lines}",
        family,
        f"{family} 96",
    ):
        for row in rows:
            if wanted in row[0].split(", "):
                return row
    # A row of a family: its first model, then lines alone.
    return next(row for row in rows if row[0].startswith(f"{family} ") and lines in row[0])


def _short(model: str) -> str:
    return model.replace("RS-LiDAR", "RS").replace("RS-Bpearl", "Bpearl")


def _list(title: str) -> str:
    """What follows a title in the lists of section 5, up to the next one."""
    text = _page().partition("\n```text\nBpearl v4")
    lists = f"Bpearl v4{text[2].partition('```')[0]}"
    found = re.search(rf"^{re.escape(title)}(.*\n(?: .*\n)*)", lists, re.MULTILINE)
    assert found is not None, title
    return found[1].partition("(")[0]


def _listed(title: str, each: int) -> list[float]:
    """Times of a list, of so many channels each."""
    return [float(word) for word in _list(title + " ").split() for _ in range(each)]


def _page() -> str:
    return PAGE.read_text(encoding="utf-8")
