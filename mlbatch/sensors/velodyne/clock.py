"""Clock of a Velodyne from its first packets: hour, rotor speed, firing sequence.

Source: docs/sources/velodyne.md sections 2, 7 and 8. Data packets count microseconds from the top
of the hour; the hour comes from NMEA sentences in position packets, else from the receive times.
"""

from __future__ import annotations

import calendar
import re
from collections.abc import Sequence

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array, U8Array, median
from mlbatch.lidar.interface import Beside
from mlbatch.sensors.packet_bytes import has_bytes, most_common, number
from mlbatch.sensors.velodyne.models import CIRCLE_CDEG, STAMP_AT
from mlbatch.units import NS_PER_MS, NS_PER_S, NS_PER_US

HOUR_NS = 3600 * NS_PER_S
HOUR_US = HOUR_NS // NS_PER_US
# Position packet: offsets of its stamp, of the state of its pulse and of its NMEA sentence.
POSITION_SIZE = 512
_POSITION_STAMP_AT = 198
_PPS_AT = 202
_NMEA_AT = 206
_NMEA_SIZE = 128
_PPS = ("no PPS", "PPS synchronising", "PPS locked", "PPS error")
_SENTENCE = re.compile(rb"\$(G.RMC,[^*$]*)\*([0-9A-Fa-f]{2})")
_TIME = 1
_STATUS = 2
_DATE = 9
# Consecutive packets are this near: less than half a revolution.
_NEAR_NS = 15 * NS_PER_MS
_FAR_NS = 600 * NS_PER_MS
# VLS-128: range of all known firmware; a lost packet doubles the step.
_SEQUENCE_NS = (50_000, 62_000)
_ENOUGH_STEPS = 4
# Number of consecutive packets at the start of a sample; the rest is chosen by receive time.
_IN_A_ROW = 16


def top_of_hour_ns(packets: U8Array, at: int = STAMP_AT) -> I64Array:
    """(P,) ns since the top of the hour."""
    stamp_us = np.ascontiguousarray(packets[:, at : at + 4]).view("<u4")[:, 0]
    return stamp_us.astype(np.int64) * NS_PER_US


def absolute_ns(toh_ns: I64Array, near_ns: I64Array) -> I64Array:
    """Times at this offset from the top of an hour, nearest to `near_ns`."""
    return toh_ns + (near_ns - toh_ns + HOUR_NS // 2) // HOUR_NS * HOUR_NS


def clock_offset_ns(packets: U8Array, host_ns: I64Array, beside: Sequence[Beside]) -> int:
    """True time minus receive time, which makes receive times define the hour of all packets.

    Constant for a run, so that all packets near a difference of half an hour get the same hour.
    """
    if not len(packets):
        return 0
    away_ns = top_of_hour_ns(packets) - host_ns
    # Differences are modulo one hour.
    spread_ns = (away_ns - away_ns[0] + HOUR_NS // 2) % HOUR_NS - HOUR_NS // 2
    offset_ns = int(away_ns[0]) + round(median(spread_ns))
    offset_ns = (offset_ns + HOUR_NS // 2) % HOUR_NS - HOUR_NS // 2
    known_ns = [value for one in beside for value in _position_offsets_ns(one)]
    if known_ns:
        target_ns = round(median(np.array(known_ns)))
        offset_ns += (target_ns - offset_ns + HOUR_NS // 2) // HOUR_NS * HOUR_NS
    if int(host_ns.min()) + offset_ns < 0:
        offset_ns += HOUR_NS
    return offset_ns


def pulse(beside: Sequence[Beside]) -> str:
    """State of the pulse per second in position packets; "" without any."""
    rows = [_positions(one)[0] for one in beside]
    states = np.concatenate([np.zeros(0, np.int64), *(row[:, _PPS_AT] for row in rows if len(row))])
    return _PPS[most_common(states)] if len(states) else ""


def rmc_ns(text: bytes) -> int | None:
    """UTC of an RMC sentence, ns since 1970; None if it is invalid or incomplete."""
    found = _SENTENCE.search(text)
    if found is None:
        return None
    body = found[1]
    fields = found[1].split(b",")
    checksum = int(np.bitwise_xor.reduce(np.frombuffer(body, np.uint8)))
    if checksum != int(found[2], 16) or len(fields) <= _DATE or fields[_STATUS] != b"A":
        return None
    time = re.fullmatch(rb"(\d\d)(\d\d)(\d\d)(?:\.(\d{1,9}))?\d*", fields[_TIME])
    date = re.fullmatch(rb"(\d\d)(\d\d)(\d\d)", fields[_DATE])
    if time is None or date is None:
        return None
    hour, minute, second = (int(part) for part in time.groups()[:3])
    day, month, year = (int(part) for part in date.groups())
    if not (1 <= month <= 12 and 1 <= day <= 31 and hour < 24 and minute < 60 and second <= 60):
        return None
    seconds = calendar.timegm((2000 + year, month, day, hour, minute, second))
    return seconds * NS_PER_S + int((time[4] or b"").ljust(9, b"0"))


def rotor_speed(stamp_ns: I64Array, azimuth: I64Array, rough: float | None) -> float | None:
    """Mean rotor speed in 0.01 degree/ns from first azimuths; None if the rotor rests.

    rough: the speed within packets, if known; stamps are within the hour.
    """
    step_ns = np.diff(stamp_ns) % HOUR_NS
    turned = (np.diff(azimuth) % CIRCLE_CDEG).astype(np.float64)
    near = (step_ns > 0) & (step_ns < _NEAR_NS)
    if near.any():
        rough = median(turned[near] / step_ns[near])
    if not rough or rough < 0:
        return None
    # The rough speed gives whole revolutions between packets; rounding cancels in the total.
    far = (step_ns > 0) & (step_ns < _FAR_NS)
    if not far.any():
        return rough
    step_ns = step_ns[far]
    turned = turned[far]
    whole: F64Array = np.rint((rough * step_ns - turned) / CIRCLE_CDEG) * CIRCLE_CDEG
    return float((turned + whole).sum() / step_ns.sum())


def measured_sequence_ns(stamp_ns: I64Array, sequences: int) -> float | None:
    """Firing sequence of a VLS-128 by the steps between its packets; None if there are too few.

    Prefers the first packets: they are consecutive, so that rounding of stamps to us cancels, and
    their choice does not depend on receive times.
    """
    low, high = (limit * sequences for limit in _SEQUENCE_NS)
    for count in (_IN_A_ROW, len(stamp_ns)):
        step_ns = np.diff(stamp_ns[:count]) % HOUR_NS
        good = step_ns[(step_ns > low) & (step_ns < high)]
        if len(good) >= _ENOUGH_STEPS:
            return float(good.mean()) / sequences
    return None


def are_positions(packets: U8Array) -> BoolArray:
    """(k,) whether packets (k, 512) have an NMEA sentence, or none yet, and a valid stamp."""
    nmea = packets[:, _NMEA_AT : _NMEA_AT + _NMEA_SIZE]
    stamp_us = number(packets, _POSITION_STAMP_AT, 4)
    silent = (nmea == 0).all(axis=1) & (packets[:, :14] == 0).all(axis=1) & (stamp_us > 0)
    good = (has_bytes(packets, b"$GP", _NMEA_AT) | silent) & (stamp_us < HOUR_US)
    return np.asarray(good & (packets[:, _PPS_AT] <= 3))


def _positions(one: Beside) -> tuple[U8Array, I64Array]:
    if one.size != POSITION_SIZE:
        return one.sample[:0], one.host_ns[:0]
    good = are_positions(one.sample)
    return one.sample[good], one.host_ns[good]


def _position_offsets_ns(one: Beside) -> list[int]:
    packets, host_ns = _positions(one)
    if not len(packets):
        return []
    toh_ns = top_of_hour_ns(packets, _POSITION_STAMP_AT)
    times = [rmc_ns(packet[_NMEA_AT : _NMEA_AT + _NMEA_SIZE].tobytes()) for packet in packets]
    good = [row for row, value in enumerate(times) if value is not None]
    utc_ns = np.array([value for value in times if value is not None], np.int64)
    offsets: list[int] = (absolute_ns(toh_ns[good], utc_ns) - host_ns[good]).tolist()
    return offsets
