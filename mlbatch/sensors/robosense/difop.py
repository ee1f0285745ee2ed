"""What ROBOSENSE units say of themselves beyond their model: DIFOP (device) packets, csv of angles.

Source: facts/robosense.md sections 1 to 7. What both kinds of packets say together: mode, steps,
firing times, notes_on_model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mlbatch.errors import RigError
from mlbatch.lidar import Evidence
from mlbatch.median import median
from mlbatch.sensors.packet_bytes import has_bytes, most_common, number
from mlbatch.sensors.robosense.identify import identify, is_difop, returns_of
from mlbatch.sensors.robosense.models import (
    AIRY_LAYOUT,
    HELIOS_LAYOUT,
    OTHER,
    ROWS,
    RS16,
    RS32,
    RUBY_PLUS_80,
    Model,
    ReturnMode,
)
from mlbatch.types import F64Array, I64Array, U8Array

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
_REVERSED_AT = 337
_SYNC_STATES = {0: "not synchronised", 1: "GPS", 2: "PTP"}
# What the counts of channels of all models are; a csv file has as many lines.
_CHANNELS = tuple(sorted({row.channels for row in ROWS}))
_MOST_DEG = 90.0


@dataclass(frozen=True, slots=True)
class Angles:
    """Of each channel, degrees: elevation, and azimuth correction, clockwise; (channels,) each."""

    elevation_deg: F64Array
    azimuth_deg: F64Array


@dataclass(frozen=True, slots=True)
class Difop:
    """A device packet; mode: DIFOP byte 300; installation: of an Airy (0 normal, 1 side, 2 M).

    firmware: bytes 41 to 43, which are 0 in the first years' units; sync: state in words.
    """

    payload: U8Array
    serial: str
    mode: int
    sync: str
    installation: int
    is_reversed: bool
    firmware: int

    def angles(self, model: Model) -> Angles | None:
        """Angles of the channels, or None where the unit was never given any."""
        places = model.angles
        count = model.channels
        elevation = self._angles(places.elevation_at, count, signed=places.signed)
        azimuth: F64Array | None = np.zeros(count)
        if places.azimuth_at:
            azimuth = self._angles(places.azimuth_at, count, signed=True)
        if elevation is None or azimuth is None:
            return None
        elevation = elevation * places.unit_deg
        azimuth = azimuth * places.unit_deg
        if not places.signed:
            elevation[: count // 2] *= -1.0
        usable = (np.abs(elevation) <= _MOST_DEG).all() and len(np.unique(elevation)) > 1
        return Angles(elevation, azimuth) if usable else None

    def _angles(self, at: int, count: int, *, signed: bool) -> F64Array | None:
        """Three bytes a channel: sign and size, or size alone; None where one is not written."""
        fields = self.payload[at : at + 3 * count].reshape(count, 3)
        if not signed:
            return number(fields, 0, 3, ">").astype(np.float64)
        if (fields[:, 0] > 1).any():
            return None
        return np.where(fields[:, 0] == 1, -1.0, 1.0) * number(fields, 1, 2, ">")


def find_difop(evidence: Evidence) -> Difop | None:
    """The device packet of the unit that sent the point packets; RigError if several may be.

    On topics it comes between the point packets, else from the same source to another port.
    """
    own = _whole(evidence.sample)
    for packets in (own, np.concatenate([own, *(_whole(one.sample) for one in evidence.beside)])):
        units = np.unique(packets[:, _SERIAL], axis=0)
        if len(units) > 1:
            packets = _of_port(packets, evidence.stream.port)
            units = np.unique(packets[:, _SERIAL], axis=0)
        if len(units) > 1:
            names = ", ".join(unit.tobytes().hex() for unit in units)
            raise RigError(
                f"{evidence.stream}: ROBOSENSE: expected the device packets of one sensor beside "
                f"its point packets, found those of {len(units)} (serial numbers {names}); give "
                "the sensor a csv of its angles as metadata"
            )
        if len(packets):
            return _difop(packets)
    return None


def _whole(packets: U8Array) -> U8Array:
    if packets.shape[1] < _SIZE:
        return np.empty((0, _SIZE), np.uint8)
    return packets[is_difop(packets) & has_bytes(packets, _TAIL, _TAIL_AT)][:, :_SIZE]


def _of_port(packets: U8Array, port: int) -> U8Array:
    """Those of units that send to this port, if that is what tells units apart."""
    at = _PORTS_AT + 2 * np.arange(_PORTS)
    ports = packets[:, at].astype(np.int64) << 8 | packets[:, at + 1]
    named = (ports == port).any(axis=1)
    return packets[named] if named.any() else packets


def _difop(packets: U8Array) -> Difop:
    """What most of the packets (k, 1248) say: damage of a few does no harm."""
    said = np.sort(packets, axis=0)[len(packets) // 2]
    serial = said[_SERIAL].tobytes()
    return Difop(
        payload=said,
        serial=serial.hex() if any(serial) else "",
        mode=int(said[_MODE_AT]),
        sync=_SYNC_STATES.get(int(said[_SYNC_AT]), ""),
        installation=int(said[_INSTALLATION_AT]),
        is_reversed=bool(said[_REVERSED_AT] == 1),
        firmware=int.from_bytes(said[_FIRMWARE].tobytes(), "big"),
    )


def read_angles(path: Path, content: bytes) -> Angles | None:
    """The maker's csv of angles: "elevation,azimuth" in degrees, a line a channel.

    None if it is no table of two columns; RigError if its numbers cannot be a lidar's.
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
    expected = f"{path}: ROBOSENSE angles: expected "
    if len(pairs) not in _CHANNELS:
        raise RigError(
            f"{expected}{', '.join(map(str, _CHANNELS[:-1]))} or {_CHANNELS[-1]} lines "
            f"`elevation,azimuth`, found {len(pairs)}; give a line for each channel of the sensor"
        )
    for line, (elevation, azimuth) in enumerate(pairs, start=1):
        if not (abs(elevation) <= _MOST_DEG and abs(azimuth) <= 2 * _MOST_DEG):
            raise RigError(
                f"{expected}degrees up to 90 and 180 in line {line + len(lines) - len(pairs)}, found "
                f"{','.join(cells[line - 1])!r}; correct the file"
            )
    table = np.array(pairs)
    return Angles(table[:, 0].copy(), table[:, 1].copy())


def _lines(content: bytes) -> list[str]:
    """Lines of a short text that are not empty; none if it is something else."""
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
# Helios, byte 17: step of distances, here as steps in a metre.
_STEP_AT = 17
_STEPS_PER_M = {0: 200, 1: 400}
# Ruby Plus 80: the model byte, which sources put at either place.
_VARIANT_BYTES = (31, 32)
_PLUS_80V = 3


def return_mode(
    points: U8Array, row: Model, difop: Difop | None
) -> tuple[ReturnMode, tuple[str, ...]]:
    """Return mode: how many returns by the point packets, which one by the device packet."""
    told = None if difop is None else row.modes.get(difop.mode)
    seen = returns_of(points, row)
    if told is not None and seen in (0, told.returns):
        return told, ()
    if seen:
        return ReturnMode(seen, OTHER), ()
    note = "neither point nor DIFOP packets tell the return mode: single return is taken"
    return ReturnMode(1, OTHER), (note,)


def units_per_m(points: U8Array, row: Model) -> tuple[int, tuple[str, ...]]:
    """Steps of a raw distance in a metre."""
    if row.layout is not HELIOS_LAYOUT or not len(points):
        return row.units_per_m, ()
    code = most_common(number(points, _STEP_AT, 1))
    found = _STEPS_PER_M.get(code, row.units_per_m)
    if found == row.units_per_m:
        return found, ()
    note = "byte 17 of its packets says that distances count in 5 mm, other units send 2.5 mm"
    return found, (note,)


def firing_ns(points: U8Array, row: Model, difop: Difop | None) -> I64Array:
    """(1, channels) firing times after the column's stamp."""
    chosen = 0
    if row.layout is AIRY_LAYOUT and difop is not None:
        chosen = difop.installation
    elif row is RUBY_PLUS_80 and len(points):
        chosen = int(_PLUS_80V in {most_common(number(points, at, 1)) for at in _VARIANT_BYTES})
    known = row.firing_ns[chosen] if chosen < len(row.firing_ns) else row.firing_ns[0]
    return np.array([known], np.int64) - min(known)


def is_counted(points: U8Array, row: Model) -> bool:
    """Whether packets have a count that goes up by one; not all firmware fills it in."""
    if not row.counter_at:
        return False
    count = number(points[:_COUNTED_PACKETS], row.counter_at, 4, ">")
    steps = np.diff(count) % COUNTER_MODULUS
    return len(steps) > 0 and median(steps) == 1.0


def notes_on_model(
    points: U8Array, row: Model, difop: Difop | None, *, is_named: bool
) -> tuple[str, ...]:
    """What the packets leave open and the user may know, or has said: is_named."""
    texts = []
    found = identify(points)
    if found is not None and found.other is not None and not is_named:
        texts.append(
            f"packets do not surely tell {found.name} apart: decoded as {row.name}; name the "
            "sensor's model in the rig if it is the other (times differ by up to 34 us)"
        )
    if row in (RS16, RS32) and difop is not None and difop.firmware == 0:
        texts.append(
            "DIFOP names no firmware: that of the first years counted distances in 1 cm, "
            "not in 5 mm as decoded here; check a known distance"
        )
    return tuple(texts)
