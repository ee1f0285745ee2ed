"""Ouster metadata JSON: checked access to its values, and the sensor that it describes.

Source: docs/sources/ouster.md section 1 (ouster-sdk 1.0.1 `metadata.cpp`, `sensor_info.cpp`).
Nested, flat, reduced and merged files have the same fields under the same names, in different
objects. All objects are merged into one mapping, in which a field is looked up by its name.
Sections with an error text instead of an object count as absent.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.errors import RigError
from mlbatch.lidar.limits import MAX_BEAM_M, MAX_ORIGIN_M, MAX_POSE_M
from mlbatch.sensors.ouster.profiles import (
    HEADER_TYPES,
    LEGACY,
    MAX_UDP_PAYLOAD,
    PROFILES,
    PacketLayout,
)
from mlbatch.units import M_PER_MM, MM_PER_M, RAD_PER_DEG

# Later sections win: config_params repeats fields of the data format as requested, not as used.
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
# Any of these keys at the top identifies an Ouster file; `sensor_info` alone does not.
_MARKS = ("beam_altitude_angles", "beam_intrinsics", "lidar_data_format")
_SENSOR_INFO_MARKS = ("prod_line", "prod_sn", "initialization_id")
_SHOWN_CHARS = 60
_RIGID_TOLERANCE = 1e-3
REMEDY = "save the metadata from the sensor again"


class Document(NamedTuple):
    """A metadata file as one mapping from field name to JSON value."""

    path: Path
    values: dict[str, object]

    def fail(self, key: str, expected: str, found: object) -> NoReturn:
        """Raise RigError for a value that cannot be used."""
        text = found if isinstance(found, str) else json.dumps(found, default=str)
        shown = text if len(text) <= _SHOWN_CHARS else text[: _SHOWN_CHARS - 3] + "..."
        shown = " ".join(shown.split()) or "nothing"
        raise RigError(
            f"{self.path}: Ouster metadata, {key}: expected {expected}, found {shown}; {REMEDY}"
        )

    def text(self, key: str) -> str:
        """A text, or "" if absent."""
        value = self.values.get(key)
        if value is None:
            return ""
        if not isinstance(value, str):
            self.fail(key, "a text", value)
        return value

    def integer(self, key: str, low: int, high: int) -> int | None:
        """Return a whole number from low to high, or None if the field is absent."""
        value = self.values.get(key)
        if value is None:
            return None
        expected = f"a whole number from {low} to {high}"
        if isinstance(value, bool) or not isinstance(value, int | float):
            self.fail(key, expected, value)
        if value != value or not low <= value <= high or value != int(value):
            self.fail(key, expected, value)
        return int(value)

    def number(self, key: str) -> float | None:
        """A finite number, or None if absent."""
        value = self.values.get(key)
        return None if value is None else float(self._finite(key, "a finite number", [value])[0])

    def numbers(self, key: str, count: int | None, expected: str) -> F64Array | None:
        """A list of finite numbers, of `count` entries if given, or None if absent."""
        value = self.values.get(key)
        if value is None:
            return None
        if not isinstance(value, list):
            self.fail(key, expected, value)
        if count is not None and len(value) != count:
            self.fail(key, expected, f"{len(value)} entries")
        return self._finite(key, expected, value)

    def pose_mm(self, key: str, most_m: float) -> F64Array | None:
        """Return a pose in metres; the file has millimetres. most_m: longest translation."""
        pose = self.pose(key, most_m * MM_PER_M, "mm")
        if pose is not None:
            self.refuse_metres(key, float(np.linalg.norm(pose[:3, 3])))
            pose[:3, 3] *= M_PER_MM
        return pose

    def refuse_metres(self, key: str, length_mm: float) -> None:
        """Refuse a length of less than 1 mm that is not 0: no part is so near another."""
        if 0 < abs(length_mm) < 1:
            shown = f"{length_mm:.4g} mm, {length_mm * MM_PER_M:.4g} mm if the file has metres"
            self.fail(key, "millimetres", shown)

    def pose(self, key: str, most: float, unit: str) -> F64Array | None:
        """A rigid (4, 4) transform; None if absent. most: longest plausible translation."""
        expected = "16 finite numbers, a rigid transform row by row"
        values = self.numbers(key, 16, expected)
        if values is None:
            return None
        pose = values.reshape(4, 4)
        rotation = pose[:3, :3]
        rigid = (
            # Larger numbers are no rotation, and the product below would overflow.
            np.abs(rotation).max() <= 2.0
            and np.abs(rotation @ rotation.T - np.eye(3)).max() <= _RIGID_TOLERANCE
            and np.linalg.det(rotation) > 0
            and bool(np.all(pose[3] == (0.0, 0.0, 0.0, 1.0)))
        )
        if not rigid:
            self.fail(key, expected, self.values[key])
        length = math.hypot(*pose[:3, 3])
        if length > most:
            self.fail(key, f"a translation of at most {most:g} {unit}", f"{length:g} {unit}")
        return pose

    def _finite(self, key: str, expected: str, values: list[object]) -> F64Array:
        for value in values:
            if isinstance(value, bool) or not isinstance(value, int | float):
                self.fail(key, expected, value)
        try:
            numbers = np.array(values, np.float64)
        except OverflowError:
            self.fail(key, expected, "a number too large for a float")
        if not np.isfinite(numbers).all():
            self.fail(key, expected, str(numbers[~np.isfinite(numbers)][0]))
        return numbers


def read_document(path: Path, content: bytes) -> Document | None:
    """Read a metadata file as one mapping; None if it is another kind of file."""
    if not content.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{"):
        return None
    try:
        top = json.loads(content.decode("utf-8-sig"))
    except (ValueError, RecursionError) as err:
        if not any(f'"{mark}"'.encode() in content for mark in _MARKS):
            return None
        text = str(err).splitlines()[0][:200]
        raise RigError(
            f"{path}: Ouster metadata: expected a JSON document, found {text}; {REMEDY}"
        ) from err
    if not isinstance(top, dict) or not _is_ouster(top):
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


def _is_ouster(top: dict[str, object]) -> bool:
    info = top.get("sensor_info")
    return any(mark in top for mark in _MARKS) or (
        isinstance(info, dict) and any(mark in info for mark in _SENSOR_INFO_MARKS)
    )


# Beams are listed from the top; calibrated neighbours may be out of order by less than this.
_RISE_DEG = 0.5
# Largest angles of beams.
# The narrowest field of any Ouster is 22.5 degrees (OS2).
_LEAST_FIELD_DEG = 5.0
_ANGLES_DEG = {"beam_altitude_angles": 90.0, "beam_azimuth_angles": 360.0}
_DEFAULT_LIDAR_PORT = 7502
_DEFAULT_IMU_PORT = 7503
_DEFAULT_COLUMNS_PER_PACKET = 16
# Beam origin offset by prefix of the product line, mm; the empty prefix matches all others.
_DEFAULT_OFFSET_MM = (("OS-0-", 27.67), ("OS-1-", 15.806), ("OS-2-", 13.762), ("", 12.163))
_DEFAULT_LIDAR_TO_SENSOR_M = np.array(
    [[-1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, 1, 0.03618], [0, 0, 0, 1]]
)
_DEFAULT_IMU_TO_SENSOR_M = np.array(
    [[1.0, 0, 0, 0.006253], [0, 1, 0, -0.011775], [0, 0, 1, 0.007645], [0, 0, 0, 1]]
)
_DEFAULT_RETURN_ORDER = "STRONGEST_TO_WEAKEST"
_U16 = 65535


class Metadata(NamedTuple):
    """A sensor as described by its metadata; lengths in metres, angles in rad, ids 0 if unknown.

    altitude_rad, azimuth_rad: (B,), beam 0 is the top one.
    beam_offset_m: x and z of the beam origins in the lidar frame.
    column_window: first and last measurement id sent, first above last if the window spans encoder
        zero.
    imu_samples: samples per IMU packet, 0 unknown.
    """

    path: Path
    product: str
    serial: int
    init_id: int
    layout: PacketLayout
    # Type of the packet header.
    header: str
    columns_per_frame: int
    column_window: tuple[int, int]
    altitude_rad: F64Array
    azimuth_rad: F64Array
    beam_offset_m: tuple[float, float]
    # (4, 4) transforms, m.
    lidar_to_sensor: F64Array
    imu_to_sensor: F64Array
    # (4, 4) sensor to body, as `ouster-sdk` writes it.
    extrinsics: F64Array | None
    lidar_mode: str
    timestamp_mode: str
    # Order of the returns in a packet.
    strongest_first: bool
    lidar_port: int
    imu_port: int
    # Layout of IMU packets.
    imu_profile: str
    imu_samples: int
    notes: tuple[str, ...]

    @property
    def revolutions_per_s(self) -> int:
        """By the mode, such as 1024x10; 0 if the metadata have no mode."""
        hz = self.lidar_mode.rpartition("x")[2]
        return int(hz) if hz.isdigit() else 0


def parse_metadata(document: Document) -> Metadata:
    """Check and convert all fields of a document; RigError names a field that cannot be used."""
    altitude_deg, azimuth_deg = _angles_deg(document)
    layout = _layout(document, len(altitude_deg))
    columns_per_frame, lidar_mode = _frame(document, layout.columns)
    lidar_to_sensor = document.pose_mm("lidar_to_sensor_transform", MAX_ORIGIN_M)
    if lidar_to_sensor is None:
        lidar_to_sensor = _DEFAULT_LIDAR_TO_SENSOR_M.copy()
    beam_offset_m = _beam_offset_m(document)
    _refuse_far_beams(document, beam_offset_m, lidar_to_sensor)
    imu_to_sensor = document.pose_mm("imu_to_sensor_transform", MAX_ORIGIN_M)
    lidar_port = document.integer("udp_port_lidar", 0, _U16)
    imu_port = document.integer("udp_port_imu", 0, _U16)
    return Metadata(
        path=document.path,
        product=document.text("prod_line"),
        serial=_serial(document),
        init_id=document.integer("initialization_id", 0, 2**32) or 0,
        layout=layout,
        header=_header(document, layout),
        columns_per_frame=columns_per_frame,
        column_window=_window(document, columns_per_frame),
        altitude_rad=altitude_deg * RAD_PER_DEG,
        azimuth_rad=azimuth_deg * RAD_PER_DEG,
        beam_offset_m=beam_offset_m,
        lidar_to_sensor=lidar_to_sensor,
        imu_to_sensor=_DEFAULT_IMU_TO_SENSOR_M.copy() if imu_to_sensor is None else imu_to_sensor,
        extrinsics=_extrinsics(document),
        lidar_mode=lidar_mode,
        timestamp_mode=document.text("timestamp_mode"),
        strongest_first=(
            (document.text("return_order") or _DEFAULT_RETURN_ORDER) == _DEFAULT_RETURN_ORDER
        ),
        lidar_port=_DEFAULT_LIDAR_PORT if lidar_port is None else lidar_port,
        imu_port=_DEFAULT_IMU_PORT if imu_port is None else imu_port,
        imu_profile=document.text("udp_profile_imu") or LEGACY,
        imu_samples=document.integer("imu_measurements_per_packet", 0, _U16) or 0,
        notes=tuple(_notes(document, altitude_deg)),
    )


def _angles_deg(document: Document) -> tuple[F64Array, F64Array]:
    found: list[F64Array] = []
    count: int | None = None
    for key, most_deg in _ANGLES_DEG.items():
        value = document.values.get(key)
        if isinstance(value, list) and any(isinstance(entry, list) for entry in value):
            document.fail(
                key, "one angle per beam", "a list per column, as of a unit that does not spin"
            )
        expected = "angles in degrees" if count is None else f"{count} angles in degrees"
        angles = document.numbers(key, count, expected)
        if angles is None or not len(angles):
            document.fail(key, expected, "nothing")
        if np.abs(angles).max() > most_deg:
            expected = f"angles from -{most_deg:g} to {most_deg:g} degrees"
            document.fail(key, expected, str(angles[np.abs(angles).argmax()]))
        found.append(angles)
        count = len(angles)
    altitude_deg, azimuth_deg = found
    if altitude_deg[-1] > altitude_deg[0]:
        document.fail(
            "beam_altitude_angles",
            "angles that fall from the top beam to the lowest",
            f"{altitude_deg[0]:g} to {altitude_deg[-1]:g} degrees, as if their sign were turned",
        )
    field_deg = float(altitude_deg[0] - altitude_deg[-1])
    if 0 < field_deg < _LEAST_FIELD_DEG <= field_deg / RAD_PER_DEG:
        document.fail(
            "beam_altitude_angles",
            f"degrees, over a field of {_LEAST_FIELD_DEG:g} or more",
            f"{altitude_deg[0]:g} to {altitude_deg[-1]:g}, as if they were radians",
        )
    return altitude_deg, azimuth_deg


def _layout(document: Document, beams: int) -> PacketLayout:
    key = "pixels_per_column"
    stated = document.integer(key, 1, _U16)
    if stated is not None and stated != beams:
        document.fail(key, f"{beams}, the number of beam angles", stated)
    name = document.text("udp_profile_lidar") or LEGACY
    if name not in PROFILES:
        document.fail("udp_profile_lidar", f"one of {', '.join(PROFILES)}", name)
    columns = document.integer("columns_per_packet", 1, _U16) or _DEFAULT_COLUMNS_PER_PACKET
    layout = PacketLayout(PROFILES[name], beams, columns)
    if layout.packet_size > MAX_UDP_PAYLOAD:
        expected = f"packets up to {MAX_UDP_PAYLOAD} bytes"
        document.fail("columns_per_packet", expected, f"{layout.packet_size} bytes")
    return layout


def _frame(document: Document, columns_per_packet: int) -> tuple[int, str]:
    """Columns per frame and the lidar mode ("" if unknown)."""
    mode = document.text("lidar_mode")
    match = re.search(r"(\d{1,5})x\d+", mode)
    columns = document.integer("columns_per_frame", 1, _U16)
    if columns is None:
        columns = int(match[1]) if match else None
    if not columns:
        expected = "columns x rate such as 1024x10, as columns_per_frame is absent"
        document.fail("lidar_mode", expected, mode)
    if columns % columns_per_packet:
        expected = f"a multiple of columns_per_packet, {columns_per_packet}"
        document.fail("columns_per_frame", expected, columns)
    return columns, match[0] if match else mode


def _header(document: Document, layout: PacketLayout) -> str:
    header = document.text("header_type") or layout.profile.header
    if header not in HEADER_TYPES:
        document.fail("header_type", " or ".join(HEADER_TYPES), header)
    return header


def _window(document: Document, columns_per_frame: int) -> tuple[int, int]:
    key = "column_window"
    last = columns_per_frame - 1
    expected = f"first and last column, 0 to {last}"
    window = document.numbers(key, 2, expected)
    if window is None:
        return 0, last
    if (window != np.floor(window)).any() or window.min() < 0 or window.max() > last:
        document.fail(key, expected, document.values[key])
    return int(window[0]), int(window[1])


def _serial(document: Document) -> int:
    key = "prod_sn"
    if isinstance(document.values.get(key), int):
        return document.integer(key, 0, 2**40 - 1) or 0
    text = document.text(key).strip()
    if not text:
        return 0
    if not (text.isascii() and text.isdigit() and len(text) <= 13 and int(text) < 2**40):
        document.fail(key, "a serial number in digits, below 2^40", text)
    return int(text)


def _beam_offset_m(document: Document) -> tuple[float, float]:
    beam_to_lidar_mm = document.pose("beam_to_lidar_transform", MAX_ORIGIN_M * MM_PER_M, "mm")
    if beam_to_lidar_mm is not None:
        away_mm = math.hypot(beam_to_lidar_mm[0, 3], beam_to_lidar_mm[2, 3])
        document.refuse_metres("beam_to_lidar_transform", away_mm)
        return float(beam_to_lidar_mm[0, 3]) / MM_PER_M, float(beam_to_lidar_mm[2, 3]) / MM_PER_M
    key = "lidar_origin_to_beam_origin_mm"
    offset_mm = document.number(key)
    if offset_mm is None:
        offset_mm = _default_offset_mm(document)
    if abs(offset_mm) > MAX_ORIGIN_M * MM_PER_M:
        document.fail(key, f"at most {MAX_ORIGIN_M * MM_PER_M:g} mm", f"{offset_mm:g} mm")
    document.refuse_metres(key, offset_mm)
    return offset_mm / MM_PER_M, 0.0


def _refuse_far_beams(
    document: Document, beam_offset_m: tuple[float, float], lidar_to_sensor: F64Array
) -> None:
    """Raise RigError if beams leave too far from the origin of the sensor frame."""
    away_m = math.hypot(*beam_offset_m) + math.hypot(*lidar_to_sensor[:3, 3])
    if away_m > MAX_BEAM_M:
        document.fail(
            "lidar_to_sensor_transform",
            f"beams that leave within {MAX_BEAM_M:g} m of the origin of the sensor",
            f"{away_m:g} m with their own offset",
        )


def _default_offset_mm(document: Document) -> float:
    product = document.text("prod_line")
    return next(mm for prefix, mm in _DEFAULT_OFFSET_MM if product.startswith(prefix))


def _extrinsics(document: Document) -> F64Array | None:
    """Pose in the body frame; None for the identity, which tools write if they know no pose."""
    pose = document.pose("extrinsic", MAX_POSE_M, "m")
    return None if pose is None or np.array_equal(pose, np.eye(4)) else pose


def _notes(document: Document, altitude_deg: F64Array) -> Iterator[str]:
    """Notes for the user on unusual metadata."""
    beams = len(altitude_deg)
    rises = np.flatnonzero(np.diff(altitude_deg) > _RISE_DEG)
    if len(rises):
        above, below = altitude_deg[rises[0] : rises[0] + 2]
        yield (
            f"{document.path}: Ouster metadata, beam_altitude_angles: expected angles that fall "
            f"from beam to beam, found {below:g} after {above:g} degrees; {REMEDY}"
        )
    product = re.match(r"OS-\w+-(\d+)", document.text("prod_line"))
    if product and int(product[1]) != beams:
        # Firmware before 1.14 has 64 angles and 64-beam packets for units of 16 and 32 beams.
        yield f"{document.text('prod_line')} has {beams} beam angles: packets of {beams} beams"
    addresses = [document.values.get(key) for key in ("udp_dest", "udp_ip")]
    if document.values.get("udp_port_lidar") == 0 or ("" in addresses and not any(addresses)):
        yield "lidar output is off according to the metadata"
    origin = ("beam_to_lidar_transform", "lidar_origin_to_beam_origin_mm")
    if all(document.values.get(key) is None for key in origin):
        offset_m = _default_offset_mm(document) * M_PER_MM
        yield f"beam origin offset not in the metadata: assumed {offset_m:.6f} m"
