"""Checked access to the values of an Ouster metadata file, whatever its shape.

Source: facts/ouster.md section 1. Nested, flat, reduced and merged files hold the same fields under
the same names, only in other places; so all objects are laid into one, and each field is looked up
by its name. Sections that hold an error text instead of an object count as absent.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np

from mlbatch.errors import RigError
from mlbatch.types import F64Array
from mlbatch.units import M_PER_MM

# Later ones win: config_params repeats fields of the data format as they were asked for.
_SECTIONS = (
    "config_params",
    "sensor_info",
    "beam_intrinsics",
    "lidar_intrinsics",
    "imu_intrinsics",
    "imu_data_format",
    "data_format",
    "lidar_data_format",
)
# Any of these at the top makes a file Ouster's; others, too, might call a section `sensor_info`.
_MARKS = ("beam_altitude_angles", "beam_intrinsics", "lidar_data_format")
_SENSOR_INFO_MARKS = ("prod_line", "prod_sn", "initialization_id")
_SHOWN_CHARS = 60
_RIGID_TOLERANCE = 1e-3
_REMEDY = "save the metadata from the sensor again"


@dataclass(frozen=True, slots=True)
class Document:
    """A metadata file as one mapping from field name to JSON value."""

    path: Path
    values: dict[str, object]

    def fail(self, key: str, wanted: str, got: object) -> NoReturn:
        """Raise the error of a value that cannot be used."""
        text = got if isinstance(got, str) else json.dumps(got, default=str)
        shown = text if len(text) <= _SHOWN_CHARS else text[: _SHOWN_CHARS - 3] + "..."
        shown = " ".join(shown.split()) or "nothing"
        raise RigError(
            f"{self.path}: Ouster metadata, {key}: wanted {wanted}, got {shown}; {_REMEDY}"
        )

    def text(self, key: str) -> str:
        """A text, or "" where absent."""
        value = self.values.get(key)
        if value is None:
            return ""
        if not isinstance(value, str):
            self.fail(key, "a text", value)
        return value

    def integer(self, key: str, low: int, high: int) -> int | None:
        """A whole number from low to high, or None where absent."""
        value = self.values.get(key)
        if value is None:
            return None
        wanted = f"a whole number from {low} to {high}"
        if isinstance(value, bool) or not isinstance(value, int | float):
            self.fail(key, wanted, value)
        if value != value or not low <= value <= high or value != int(value):
            self.fail(key, wanted, value)
        return int(value)

    def number(self, key: str) -> float | None:
        """A finite number, or None where absent."""
        value = self.values.get(key)
        return None if value is None else float(self._finite(key, "a finite number", [value])[0])

    def numbers(self, key: str, count: int | None, wanted: str) -> F64Array | None:
        """A list of finite numbers, of `count` entries if given, or None where absent."""
        value = self.values.get(key)
        if value is None:
            return None
        if not isinstance(value, list):
            self.fail(key, wanted, value)
        if count is not None and len(value) != count:
            self.fail(key, wanted, f"{len(value)} entries")
        return self._finite(key, wanted, value)

    def pose_mm(self, key: str) -> F64Array | None:
        """A rigid (4, 4) transform, millimetres in the file, metres here; None where absent."""
        pose = self._pose(key)
        if pose is not None:
            pose[:3, 3] *= M_PER_MM
        return pose

    def pose_m(self, key: str) -> F64Array | None:
        """A rigid (4, 4) transform in metres; None where absent."""
        return self._pose(key)

    def _pose(self, key: str) -> F64Array | None:
        wanted = "16 finite numbers, a rigid transform row by row"
        values = self.numbers(key, 16, wanted)
        if values is None:
            return None
        pose = values.reshape(4, 4)
        rotation = pose[:3, :3]
        rigid = (
            # Beyond, the product below would overflow; no rotation has such numbers.
            np.abs(rotation).max() <= 2.0
            and np.abs(rotation @ rotation.T - np.eye(3)).max() <= _RIGID_TOLERANCE
            and np.linalg.det(rotation) > 0
            and bool(np.all(pose[3] == (0.0, 0.0, 0.0, 1.0)))
        )
        if not rigid:
            self.fail(key, wanted, self.values[key])
        return pose

    def _finite(self, key: str, wanted: str, values: list[object]) -> F64Array:
        for value in values:
            if isinstance(value, bool) or not isinstance(value, int | float):
                self.fail(key, wanted, value)
        try:
            numbers = np.array(values, np.float64)
        except OverflowError:
            self.fail(key, wanted, "a number beyond all bounds")
        if not np.isfinite(numbers).all():
            self.fail(key, wanted, str(numbers[~np.isfinite(numbers)][0]))
        return numbers


def read_document(path: Path, content: bytes) -> Document | None:
    """The metadata in a file, or None if it is another kind of file."""
    if not content.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{"):
        return None
    try:
        top = json.loads(content.decode("utf-8-sig"))
    except (ValueError, RecursionError) as err:
        if not any(f'"{mark}"'.encode() in content for mark in _MARKS):
            return None
        text = str(err).splitlines()[0][:200]
        raise RigError(
            f"{path}: Ouster metadata: wanted a JSON document, got {text}; {_REMEDY}"
        ) from err
    if not isinstance(top, dict) or not _is_ours(top):
        return None
    values: dict[str, object] = {}
    for section in _SECTIONS:
        inner = top.get(section)
        if isinstance(inner, dict):
            values.update(inner)
    values.update((key, value) for key, value in top.items() if key not in _SECTIONS)
    added = top.get("ouster-sdk")
    if isinstance(added, dict):
        values["extrinsic"] = added.get("extrinsic")
    return Document(path, values)


def _is_ours(top: dict[str, object]) -> bool:
    info = top.get("sensor_info")
    return any(mark in top for mark in _MARKS) or (
        isinstance(info, dict) and any(mark in info for mark in _SENSOR_INFO_MARKS)
    )
