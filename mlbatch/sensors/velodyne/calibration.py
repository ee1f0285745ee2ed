"""Velodyne calibration files: the YAML of ROS drivers and the db.xml of VeloView.

Source: docs/sources/velodyne.md section 9. YAML gives radians and metres, db.xml degrees and
centimetres; both number the lasers, and a missing correction is 0. The two-point flag and the focal
(intensity) numbers are ignored: the first is missing from many files, and no two readers agree on
the second. Files may be untrusted, so size, depth and number are limited, and entities and aliases
are refused.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mlbatch.arrays import BoolArray, F64Array
from mlbatch.errors import RigError
from mlbatch.lidar.limits import MAX_ORIGIN_M, MAX_SPREAD_M
from mlbatch.units import RAD_PER_DEG

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

# The file of an HDL-64E has 27 kB, its db.xml about 100 kB.
MAX_BYTES = 1_000_000
_SIZES = (16, 32, 64, 128)
_M_PER_CM = 0.01
# Real values are 2 and 4 mm; the 7 mm of VLS-128 files is wrong, but accepted.
_UNIT_RANGE_M = (0.0005, 0.02)
_YAML_LEVELS = 8
_YAML_KEY = re.compile(rb"^[ \t{,]*[\"']?(?:num_lasers|lasers)[\"']?[ \t]*:", re.MULTILINE)
_YAML_WORDS = (b"laser_id", b"vert_correction", b"distance_resolution")
_XML_WORDS = (b"rotCorrection_", b"vertCorrection_", b"distLSB_")
_REMEDY = "use the vendor's file of this sensor"
_UNIT_REMEDY = "check its unit"


@dataclass(frozen=True, slots=True, eq=False)
class VelodyneFile:
    """Corrections of a file; arrays (lasers,) by laser id, 0 if missing.

    unit_m: metres of one distance count, None if missing.
    azimuth_rad: rot_correction of the file, so that a beam points to (rotor azimuth - azimuth_rad),
        clockwise from above.
    """

    path: Path
    lasers: int
    unit_m: float | None
    azimuth_rad: F64Array
    elevation_rad: F64Array
    dist_correction_m: F64Array
    dist_correction_x_m: F64Array
    dist_correction_y_m: F64Array
    vert_offset_m: F64Array
    horiz_offset_m: F64Array
    enabled: BoolArray
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _Quantity:
    """A correction: keys in both formats, and largest plausible value (SI)."""

    yaml: str
    xml: str
    is_angle: bool
    # Largest plausible absolute value, rad or m.
    limit: float
    required: bool = False


_QUANTITIES: Mapping[str, _Quantity] = {
    "azimuth_rad": _Quantity("rot_correction", "rotCorrection_", True, math.pi / 2),
    "elevation_rad": _Quantity("vert_correction", "vertCorrection_", True, math.pi / 2, True),
    "dist_correction_m": _Quantity("dist_correction", "distCorrection_", False, 2.0),
    "dist_correction_x_m": _Quantity("dist_correction_x", "distCorrectionX_", False, 2.0),
    "dist_correction_y_m": _Quantity("dist_correction_y", "distCorrectionY_", False, 2.0),
    "vert_offset_m": _Quantity(
        "vert_offset_correction", "vertOffsetCorrection_", False, MAX_ORIGIN_M
    ),
    "horiz_offset_m": _Quantity(
        "horiz_offset_correction", "horizOffsetCorrection_", False, MAX_ORIGIN_M
    ),
}


@dataclass(frozen=True, slots=True)
class _Format:
    """Key of the laser id, units and keys of a file format; units in SI."""

    id_key: str
    angle_unit: str
    # Factor of angles to rad.
    rad: float
    length_unit: str
    # Factor of lengths to m.
    m: float
    keys: Mapping[str, str]


_YAML = _Format(
    "laser_id", "rad", 1.0, "m", 1.0, {name: one.yaml for name, one in _QUANTITIES.items()}
)
_XML = _Format(
    "id_",
    "degrees",
    RAD_PER_DEG,
    "cm",
    _M_PER_CM,
    {name: one.xml for name, one in _QUANTITIES.items()},
)


@dataclass(frozen=True, slots=True)
class _Entry:
    """One laser as written: position in the file, and texts by key."""

    place: str
    texts: Mapping[str, str]


def read_velodyne(path: Path, content: bytes) -> VelodyneFile | None:
    """Parse a file; None if it is no Velodyne calibration, RigError if it is damaged."""
    if b"\0" in content:
        return None
    start = content[:64].removeprefix(b"\xef\xbb\xbf").lstrip()
    if start.startswith(b"<"):
        if not any(word in content for word in _XML_WORDS):
            return None
        return _read_xml(path, _text(path, content))
    if not any(word in content for word in _YAML_WORDS) or not _YAML_KEY.search(content):
        return None
    return _read_yaml(path, _text(path, content))


def _text(path: Path, content: bytes) -> str:
    if len(content) > MAX_BYTES:
        raise _error(path, "", f"at most {MAX_BYTES} bytes", f"{len(content)}")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as err:
        raise _error(path, "", "UTF-8 text", f"the byte {content[err.start]:#04x}") from err


def _read_yaml(path: Path, text: str) -> VelodyneFile:
    root = _yaml_root(path, text)
    items = root.get("lasers")
    if not isinstance(items, list) or not items:
        raise _error(path, "lasers", "a list of lasers", "none")
    if len(items) not in _SIZES:
        expected = f"{', '.join(map(str, _SIZES))} lasers"
        raise _error(path, "lasers", expected, str(len(items)))
    entries = []
    for index, item in enumerate(items):
        place = f"lasers[{index}]"
        if not isinstance(item, dict):
            raise _error(path, place, "a mapping with laser_id and vert_correction", "none")
        entries.append(_Entry(place, {str(key): str(value) for key, value in item.items()}))
    stated = root.get("num_lasers")
    if stated is not None and str(stated) != str(len(items)):
        raise _error(path, "num_lasers", f"{len(items)}, the lasers listed", str(stated))
    unit = root.get("distance_resolution")
    unit_m = None if unit is None else _unit_m(path, "distance_resolution", str(unit), "m", 1.0)
    return _file(path, _YAML, entries, np.ones(len(items), np.bool_), unit_m)


def _yaml_root(path: Path, text: str) -> Mapping[str, object]:
    """Parse a document with scalars as text, since 1e-3 is no number in YAML 1.1."""
    import yaml

    loader = getattr(yaml, "CBaseLoader", yaml.BaseLoader)
    try:
        depth = 0
        for event in yaml.parse(text, Loader=loader):
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            # Deep nesting overflows the stack of the C loader.
            if depth > _YAML_LEVELS:
                raise _error(path, "", f"at most {_YAML_LEVELS} levels", "more")
            if isinstance(event, yaml.AliasEvent):
                raise _error(path, "", "values written out", f"the alias *{event.anchor}")
        root: object = yaml.load(text, Loader=loader)
    except yaml.YAMLError as err:
        problem = getattr(err, "problem", "") or str(err)
        if "nesting" in problem:
            # From PyYAML 6.0.3 on its scanner counts the brackets ahead of these events.
            raise _error(path, "", f"at most {_YAML_LEVELS} levels", "more") from err
        mark = getattr(err, "problem_mark", None)
        place = f"line {mark.line + 1}" if mark else ""
        raise _error(path, place, "YAML", problem) from err
    return root if isinstance(root, dict) else {}


def _read_xml(path: Path, text: str) -> VelodyneFile | None:
    import xml.etree.ElementTree as ET

    # Boost writes a bare document type; entities require one with brackets.
    if re.search(r"<!ENTITY|<!DOCTYPE[^>]*(\[|SYSTEM|PUBLIC)", text):
        raise _error(path, "", "XML without entities and definitions", "some")
    try:
        # The text is already decoded, so its encoding declaration is removed.
        root = ET.fromstring(re.sub(r"^\s*<\?xml[^>]*\?>", "", text))
    except ET.ParseError as err:
        raise _error(path, "", "XML", str(err)) from err
    table = root if root.tag == "DB" else root.find("DB")
    if table is None:
        return None
    points = table.findall("points_/item")
    if not points or len(points) > max(_SIZES):
        expected = f"1 to {max(_SIZES)} lasers"
        raise _error(path, "DB.points_", expected, str(len(points)) if points else "none")
    entries = list(_xml_entries(points))
    flags = [(one.text or "").strip() for one in table.findall("enabled_/item")]
    enabled = _enabled(path, flags) if flags else np.ones(len(entries), np.bool_)
    unit = table.findtext("distLSB_")
    unit_m = None if unit is None else _unit_m(path, "DB.distLSB_", unit, "cm", _M_PER_CM)
    return _file(path, _XML, entries, enabled, unit_m)


def _xml_entries(points: list[Element]) -> Iterator[_Entry]:
    for index, item in enumerate(points):
        laser = item.find("px")
        texts = {one.tag: one.text or "" for one in (item if laser is None else laser)}
        yield _Entry(f"DB.points_.item[{index}]", texts)


def _enabled(path: Path, flags: list[str]) -> BoolArray:
    if len(flags) > max(_SIZES) or not set(flags) <= {"0", "1"}:
        raise _error(path, "DB.enabled_", f"at most {max(_SIZES)} items of 0 or 1", "others")
    enabled = np.array([flag == "1" for flag in flags])
    if not enabled.any():
        raise _error(path, "DB.enabled_", "enabled lasers", "none")
    return enabled


def _file(
    path: Path, form: _Format, entries: list[_Entry], enabled: BoolArray, unit_m: float | None
) -> VelodyneFile:
    """Corrections of enabled lasers in the order of laser ids.

    Files of 16 and 32 lasers may list 64, with only the first ones enabled.
    """
    by_id = _by_id(path, form, entries)
    used = int(np.flatnonzero(enabled)[-1]) + 1
    lasers = next(size for size in _SIZES if used <= size)
    missing = [laser for laser in range(lasers) if laser not in by_id]
    if missing:
        raise _error(path, "lasers", f"ids 0 to {lasers - 1}", f"no laser {missing[0]}")
    values = {
        name: np.array([_value(path, form, by_id[laser], name) for laser in range(lasers)])
        for name in _QUANTITIES
    }
    _refuse_spread(path, form, values)
    flags = np.zeros(lasers, np.bool_)
    flags[: min(lasers, len(enabled))] = enabled[:lasers]
    on = int(flags.sum())
    notes = () if on == len(entries) else (f"{on} of {len(entries)} lasers are enabled",)
    return VelodyneFile(path, lasers, unit_m, enabled=flags, notes=notes, **values)


def _refuse_spread(path: Path, form: _Format, values: Mapping[str, F64Array]) -> None:
    """Raise RigError if lasers of one sensor would measure from places too far apart."""
    lengths_m = [values[name] for name in _QUANTITIES if name.startswith("dist_correction")]
    # Near corrections of 0 are not given.
    given_m = np.concatenate([lengths_m[0], *(one[one != 0] for one in lengths_m[1:])])
    offset_m = np.hypot(values["vert_offset_m"], values["horiz_offset_m"])
    spread_m = float(np.ptp(given_m) + offset_m.max())
    if spread_m > MAX_SPREAD_M:
        raise _error(
            path,
            form.keys["dist_correction_m"],
            f"lasers that measure from places within {MAX_SPREAD_M:g} m of each other",
            f"{spread_m:.3g} m, with the offsets of a laser",
            _UNIT_REMEDY,
        )


def _by_id(path: Path, form: _Format, entries: list[_Entry]) -> dict[int, _Entry]:
    by_id: dict[int, _Entry] = {}
    highest = max(len(entries), min(_SIZES)) - 1
    for entry in entries:
        place = f"{entry.place}.{form.id_key}"
        text = entry.texts.get(form.id_key, "").strip()
        laser = int(text) if re.fullmatch(r"[0-9]{1,3}", text) else -1
        if not 0 <= laser <= highest:
            raise _error(path, place, f"a laser id from 0 to {highest}", text or "none")
        if laser in by_id:
            raise _error(path, place, "each id once", f"{laser} again")
        by_id[laser] = entry
    return by_id


def _value(path: Path, form: _Format, entry: _Entry, name: str) -> float:
    """A correction in SI units; RigError if it is implausible."""
    quantity = _QUANTITIES[name]
    key = form.keys[name]
    place = f"{entry.place}.{key}"
    text = entry.texts.get(key, "" if quantity.required else "0")
    unit, factor = (form.angle_unit, form.rad) if quantity.is_angle else (form.length_unit, form.m)
    value = _number(path, place, text) * factor
    if abs(value) > quantity.limit:
        expected = f"at most {quantity.limit / factor:.6g} {unit} in absolute value"
        raise _error(path, place, expected, text, _UNIT_REMEDY)
    return value


def _unit_m(path: Path, place: str, text: str, unit: str, factor: float) -> float:
    unit_m = _number(path, place, text) * factor
    low, high = _UNIT_RANGE_M
    if not low <= unit_m <= high:
        expected = f"{low / factor:g} to {high / factor:g} {unit}"
        raise _error(path, place, expected, text, _UNIT_REMEDY)
    return unit_m


def _number(path: Path, place: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise _error(path, place, "a finite number", text.strip() or "none")
    return value


def _error(path: Path, place: str, expected: str, found: str, remedy: str = _REMEDY) -> RigError:
    shown = " ".join(found.split())
    shown = shown if len(shown) <= 60 else shown[:57] + "..."
    where = f"{path}: {place}: " if place else f"{path}: "
    return RigError(f"{where}expected {expected}, found {shown} (Velodyne calibration); {remedy}")
