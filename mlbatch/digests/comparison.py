"""Differences of two descriptions: all values exactly, but for the last digits of poses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TypeAlias

Json: TypeAlias = "dict[str, Json] | list[Json] | str | int | float | bool | None"


# Extrinsics are float64 of the rig: the same to all but the last digits.
_POSE = "body_from_sensor"
_POSE_TOLERANCE = 1e-9
_NOTHING = "nothing"
# The program that made a golden file is not compared.
_ORIGIN = ("schema", "version")


@dataclass(frozen=True, slots=True)
class Difference:
    """One value that differs; where: scan and field, or keys."""

    where: str
    expected: Json
    found: Json

    def __str__(self) -> str:
        """One line; numbers with their difference."""
        text = f"{self.where}: expected {_shown(self.expected)}, found {_shown(self.found)}"
        by = _difference(self.expected, self.found)
        if by is not None:
            text += f" ({by:+})" if isinstance(by, int) else f" ({by:+.3g})"
        return text


@dataclass(slots=True)
class Comparison:
    """Result of a comparison."""

    differences: list[Difference] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """True without a difference."""
        return not self.differences


def compare(expected: dict[str, Json], found: dict[str, Json]) -> Comparison:
    """Compare a golden document with another: arrays are equal if their bytes are.

    No tolerance: statistics of an array do not bound the change of a point; `diff` compares points.
    """
    result = Comparison()
    for key in dict.fromkeys((*expected, *found)):
        if key not in ("scans", *_ORIGIN):
            result.differences += walk(key, expected.get(key), found.get(key))
    old = _by_window(expected)
    new = _by_window(found)
    for window in dict.fromkeys((*old, *new)):
        if window in old and window in new:
            _compare_scan(result, f"scan {window}", old[window], new[window])
        else:
            points = [
                scans[window].get("points") if window in scans else None for scans in (old, new)
            ]
            result.differences.append(Difference(f"scan {window} points", *points))
    return result


def _by_window(golden: dict[str, Json]) -> dict[str, dict[str, Json]]:
    """The scans by their names."""
    scans = golden.get("scans")
    by_name: dict[str, dict[str, Json]] = {}
    for scan in scans if isinstance(scans, list) else ():
        if isinstance(scan, dict):
            by_name[scan_name(scan.get("index"), scan.get("slice"), scan.get("sensor"))] = scan
    return by_name


def scan_name(index: Json, part: Json, sensor: Json) -> str:
    """A scan as its file is named, without suffix: 000042, 000042-3, left/000042."""
    name = "head" if index == -1 else f"{index:06d}" if isinstance(index, int) else str(index)
    name += f"-{part}" if part else ""
    return f"{sensor}/{name}" if sensor else name


def _compare_scan(
    result: Comparison, where: str, old: dict[str, Json], new: dict[str, Json]
) -> None:
    for key in dict.fromkeys((*old, *new)):
        if key != "fields":
            result.differences += walk(f"{where} {key}", old.get(key), new.get(key))
    if old.get("points") != new.get("points"):
        # Then all else differs, too.
        return
    before = old.get("fields")
    now = new.get("fields")
    before = before if isinstance(before, dict) else {}
    now = now if isinstance(now, dict) else {}
    for name in dict.fromkeys((*before, *now)):
        _compare_field(result, where, name, before.get(name), now.get(name))


def _compare_field(result: Comparison, where: str, name: str, old: Json, new: Json) -> None:
    if not isinstance(old, dict) or not isinstance(new, dict):
        stored = ["not stored" if value is None else "stored" for value in (old, new)]
        result.differences.append(Difference(f"{where} {name}", *stored))
        return
    if old.get("sha256") == new.get("sha256"):
        return
    found = [
        difference
        for key in ("mean", "min", "max", "samples")
        for difference in walk(f"{where} {name} {key}", old.get(key), new.get(key))
    ]
    # The figures may hide differences at other points.
    checksums = (old.get("sha256"), new.get("sha256"))
    result.differences += found or [Difference(f"{where} {name} sha256", *checksums)]


def walk(where: str, old: Json, new: Json, tolerance: float = 0.0) -> Iterator[Difference]:
    """Differences of two JSON values; where: the name of both; tolerance: of reals."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in dict.fromkeys((*old, *new)):
            allowed = _POSE_TOLERANCE if key == _POSE else tolerance
            yield from walk(f"{where}.{key}".strip("."), old.get(key), new.get(key), allowed)
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for number, (one, other) in enumerate(zip(old, new, strict=True)):
            yield from walk(f"{where}[{number}]", one, other, tolerance)
    elif not _is_same(old, new, tolerance):
        yield Difference(where, old, new)


def _is_same(old: Json, new: Json, tolerance: float) -> bool:
    by = _difference(old, new)
    if isinstance(by, float):
        return abs(by) <= tolerance
    return type(old) is type(new) and old == new


def _difference(old: Json, new: Json) -> int | float | None:
    """new - old: an integer, of integers; None if one is no number."""
    if isinstance(old, bool) or isinstance(new, bool):
        return None
    if isinstance(old, (int, float)) and isinstance(new, (int, float)):
        return new - old
    return None


def _shown(value: Json) -> str:
    if value is None:
        return _NOTHING
    text = repr(value) if isinstance(value, str) else str(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
