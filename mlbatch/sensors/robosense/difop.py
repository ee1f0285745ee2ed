"""Properties of a ROBOSENSE unit: DIFOP (device) packets, csv of angles, first point packets.

Source: docs/sources/robosense.md sections 1 to 7. Point and device packets together define return
mode, distance unit and firing times.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mlbatch.arrays import F64Array, I64Array, U8Array, median
from mlbatch.errors import RigError
from mlbatch.lidar.interface import Evidence
from mlbatch.sensors.packet_bytes import has_bytes, most_common, number
from mlbatch.sensors.robosense.identify import (
    Identity,
    identify,
    is_difop,
    point_packets,
    returns_of,
    ruby_type,
)
from mlbatch.sensors.robosense.models import (
    AIRY_LAYOUT,
    HELIOS_16,
    HELIOS_32,
    HELIOS_LAYOUT,
    OTHER,
    ROWS,
    RS16,
    RS32,
    RUBY_PLUS_80,
    Model,
    ReturnMode,
)

_SIZE = 1248
_TAIL_AT = 1246
_TAIL = b"\x0f\xf0"
_PORTS_AT = 24
_PORTS = 4
_FIRMWARE = slice(41, 44)
_INSTALLATION_AT = 289
_SERIAL = slice(292, 298)
_MODE_AT = 300
_SYNC_AT = 302
_REVERSAL_AT = 337
_SYNC_STATES = {0: "not synchronised", 1: "GPS", 2: "PTP"}
# Channels of all models; a csv file has as many lines.
_CHANNELS = tuple(sorted({row.channels for row in ROWS}))
_MOST_DEG = 90.0


@dataclass(frozen=True, slots=True)
class Angles:
    """(channels,) elevations and clockwise azimuth corrections, degrees."""

    elevation_deg: F64Array
    azimuth_deg: F64Array


@dataclass(frozen=True, slots=True)
class Difop:
    """A device packet; mode: DIFOP byte 300; installation: of an Airy (0 normal, 1 side, 2 M).

    firmware: bytes 41 to 43, which are 0 in early units.
    sync: state in words.
    reversal: byte 337, not 0 if the rotor is set to reverse.
    """

    payload: U8Array
    serial: str
    mode: int
    sync: str
    installation: int
    reversal: int
    firmware: int

    def angles(self, model: Model) -> Angles | None:
        """Angles of the channels; None if the unit has none."""
        offsets = model.angles
        count = model.channels
        elevation = self._angles(offsets.elevation_at, count, signed=offsets.signed)
        azimuth: F64Array | None = np.zeros(count)
        if offsets.azimuth_at:
            azimuth = self._angles(offsets.azimuth_at, count, signed=True)
        if elevation is None or azimuth is None:
            return None
        elevation = elevation * offsets.unit_deg
        azimuth = azimuth * offsets.unit_deg
        if not offsets.signed:
            elevation[: count // 2] *= -1.0
        usable = (
            (np.abs(elevation) <= _MOST_DEG).all()
            and (np.abs(azimuth) <= 2 * _MOST_DEG).all()
            and len(np.unique(elevation)) > 1
        )
        return Angles(elevation, azimuth) if usable else None

    def _angles(self, at: int, count: int, *, signed: bool) -> F64Array | None:
        """(count,) three bytes each: sign and magnitude, or magnitude; None if one is unset."""
        fields = self.payload[at : at + 3 * count].reshape(count, 3)
        if not signed:
            return number(fields, 0, 3, ">").astype(np.float64)
        if (fields[:, 0] > 1).any():
            return None
        return np.where(fields[:, 0] == 1, -1.0, 1.0) * number(fields, 1, 2, ">")


def find_difop(evidence: Evidence) -> Difop | None:
    """Device packet of the unit that sent the point packets; RigError if several units fit.

    On topics it is among the point packets, else it has the same source and another port.
    """
    own = _whole(evidence.sample)
    for packets in (
        own,
        np.concatenate([own, *(_whole(one.sample) for one in evidence.neighbours)]),
    ):
        units = np.unique(packets[:, _SERIAL], axis=0)
        if len(units) > 1:
            packets = _of_port(packets, evidence.stream.port)
            units = np.unique(packets[:, _SERIAL], axis=0)
        if len(units) > 1:
            names = ", ".join(unit.tobytes().hex() for unit in units)
            raise RigError(
                f"{evidence.stream}: ROBOSENSE: expected device packets of one sensor from the "
                f"source of its point packets, found those of {len(units)} (serial numbers "
                f"{names}); give the sensor a csv of its angles as metadata"
            )
        if len(packets):
            return _difop(packets)
    return None


def _whole(packets: U8Array) -> U8Array:
    if packets.shape[1] < _SIZE:
        return np.empty((0, _SIZE), np.uint8)
    return packets[is_difop(packets) & has_bytes(packets, _TAIL, _TAIL_AT)][:, :_SIZE]


def _of_port(packets: U8Array, port: int) -> U8Array:
    """Packets of units that send to this port; all packets if there are none."""
    at = _PORTS_AT + 2 * np.arange(_PORTS)
    ports = packets[:, at].astype(np.int64) << 8 | packets[:, at + 1]
    named = (ports == port).any(axis=1)
    return packets[named] if named.any() else packets


def _difop(packets: U8Array) -> Difop:
    """Return the device packet whose bytes are medians over packets (k, 1248), against damage."""
    median_packet = np.sort(packets, axis=0)[len(packets) // 2]
    serial = median_packet[_SERIAL].tobytes()
    return Difop(
        payload=median_packet,
        serial=serial.hex() if any(serial) else "",
        mode=int(median_packet[_MODE_AT]),
        sync=_SYNC_STATES.get(int(median_packet[_SYNC_AT]), ""),
        installation=int(median_packet[_INSTALLATION_AT]),
        reversal=int(median_packet[_REVERSAL_AT]),
        firmware=int.from_bytes(median_packet[_FIRMWARE].tobytes(), "big"),
    )


def read_angles(path: Path, content: bytes) -> Angles | None:
    """Parse the vendor's csv of angles: "elevation,azimuth" in degrees, one line per channel.

    None if it is no table of two columns; RigError if its numbers are implausible.
    """
    lines = _lines(content)
    cells = [line.split(",") for line in lines]
    if not cells or any(len(row) != 2 for row in cells):
        return None
    if [cell.strip().lower()[:4] for cell in cells[0]] == ["elev", "azim"]:
        cells = cells[1:]
    pairs = [(_number(first), _number(second)) for first, second in cells]
    if not any(math.isfinite(value) for pair in pairs for value in pair):
        return None
    start = f"{path}: ROBOSENSE angles: expected "
    if len(pairs) not in _CHANNELS:
        raise RigError(
            f"{start}{', '.join(map(str, _CHANNELS[:-1]))} or {_CHANNELS[-1]} lines "
            f"`elevation,azimuth`, found {len(pairs)}; give a line for each channel of the sensor"
        )
    for line, (elevation, azimuth) in enumerate(pairs, start=1):
        if not (abs(elevation) <= _MOST_DEG and abs(azimuth) <= 2 * _MOST_DEG):
            raise RigError(
                f"{start}degrees up to 90 and 180 in line {line + len(lines) - len(pairs)}, "
                f"found {','.join(cells[line - 1])!r}; correct the file"
            )
    table = np.array(pairs)
    return Angles(table[:, 0].copy(), table[:, 1].copy())


def _lines(content: bytes) -> list[str]:
    """Non-empty lines of a short text; none if it is something else."""
    if len(content) > 100_000:
        return []
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return []
    return [line for line in text.splitlines() if line.strip()]


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


COUNTER_MODULUS = 1 << 32
_COUNTED_PACKETS = 16
# Helios: option and values in units per metre; byte that was 0 for 5 mm in early manuals.
RANGE_UNIT = "range_unit"
_UNITS_PER_M = {"2.5mm": 400, "5mm": 200}
_STEP_AT = 17
_PLUS_80V = 3


def identify_unit(evidence: Evidence) -> Identity | None:
    """Identify the point packets of a unit, by its return mode where they do not suffice."""
    found = identify(point_packets(evidence.sample))
    if found is None or found.other is not HELIOS_16:
        return found
    try:
        difop = find_difop(evidence)
    except RigError:
        return found
    stated = None if difop is None else HELIOS_32.modes.get(difop.mode)
    if stated is None:
        return found
    row = HELIOS_16 if stated.returns == 2 else HELIOS_32
    return Identity(row.name, row)


def return_mode(
    points: U8Array, row: Model, difop: Difop | None
) -> tuple[ReturnMode, tuple[str, ...]]:
    """Return mode: number of returns by point packets, type by the device packet; and notes."""
    stated = None if difop is None else row.modes.get(difop.mode)
    seen = returns_of(points, row)
    if stated is not None and seen in (0, stated.returns):
        return stated, ()
    if seen:
        return ReturnMode(seen, OTHER), ()
    note = "neither point nor DIFOP packets state the return mode: single return assumed"
    return ReturnMode(1, OTHER), (note,)


def units_per_m(points: U8Array, row: Model, chosen: str) -> tuple[int, tuple[str, ...]]:
    """Raw distance units in a metre; and notes. chosen: of the option `range_unit`, or ""."""
    if row.layout is not HELIOS_LAYOUT:
        return row.units_per_m, ()
    if chosen:
        return _UNITS_PER_M[chosen], ()
    if not len(points) or most_common(number(points, _STEP_AT, 1)):
        return row.units_per_m, ()
    note = (
        "byte 17 of its packets is 0: ranges count in 2.5 mm as in current manuals, in early ones "
        "in 5 mm; check a known distance, and give --decode range_unit=2.5mm or range_unit=5mm"
    )
    return row.units_per_m, (note,)


def firing_ns(points: U8Array, row: Model, difop: Difop | None) -> I64Array:
    """(1, channels) firing times after the column's timestamp."""
    chosen = 0
    if row.layout is AIRY_LAYOUT and difop is not None:
        chosen = difop.installation
    elif row is RUBY_PLUS_80 and len(points):
        chosen = int(ruby_type(points)[1] == _PLUS_80V)
    times_ns = row.firing_ns[chosen] if chosen < len(row.firing_ns) else row.firing_ns[0]
    return np.array([times_ns], np.int64) - min(times_ns)


def is_counted(points: U8Array, row: Model) -> bool:
    """Whether packets have a counter with steps of one; not all firmware sets it."""
    if not row.counter_at:
        return False
    count = number(points[:_COUNTED_PACKETS], row.counter_at, 4, ">")
    steps = np.diff(count) % COUNTER_MODULUS
    return len(steps) > 0 and median(steps) == 1.0


def notes_on_model(
    found: Identity | None, row: Model, difop: Difop | None, *, is_named: bool
) -> tuple[str, ...]:
    """Notes on what packets leave open.

    found: identity of the packets; is_named: the rig names the model.
    """
    texts = []
    if found is not None and found.model and found.other and not is_named:
        names = " or ".join(sorted((found.model.name, found.other.name)))
        texts.append(
            f"packets fit {names}: decoded as {row.name}; name the sensor's model in the rig if it "
            f"is the other ({found.doubt})"
        )
    if row in (RS16, RS32) and difop is not None and difop.firmware == 0:
        texts.append(
            "DIFOP states no firmware: early firmware counted distances in 1 cm, not in 5 mm as "
            "decoded here; check a known distance"
        )
    if row.mirrors and difop is not None and difop.reversal > 1:
        texts.append(
            f"expected DIFOP byte 337 to be 0 or 1, found {difop.reversal}: azimuths are mirrored "
            "as for a reversed rotor, as rs_driver does; check left and right"
        )
    return tuple(texts)
