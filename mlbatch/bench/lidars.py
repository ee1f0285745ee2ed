"""Packets of lidars that never stop: any number of them, from arrays, without a scene.

Source: facts/ouster.md sections 2 and 3, facts/velodyne.md sections 1 and 2, facts/hesai.md
sections 2 and 3. A turn is laid out once; later packets repeat its pixels and get their own stamps,
angles and counters. Ranges are waves with noise and holes: about a fifth of the shots find nothing,
as outdoors.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from mlbatch.arrays import I64Array, U8Array
from mlbatch.bench.recordings import FULL, INIT_ID, LOW, PANDAR64, VLP16
from mlbatch.units import NS_PER_MS, NS_PER_S, NS_PER_US

EPOCH_NS: Final = 1_700_000_000 * NS_PER_S
TURN_NS: Final = 100 * NS_PER_MS
# A packet arrives so long after its last shot.
_TRAVEL_NS: Final = 300 * NS_PER_US
_CDEG_PER_TURN: Final = 36_000
_SIGNAL_PEAK: Final = 2000


@dataclass(frozen=True, slots=True)
class Lidar:
    """Packets of one turn, (packets, bytes), how long one lasts, and what changes in the next.

    fill: writes stamps, angles and counters of packets (n,) with their first shots (n,), ns.
    """

    turn: U8Array
    packet_ns: int
    fill: Callable[[U8Array, I64Array, I64Array], None]

    @property
    def packet_bytes(self) -> int:
        """Bytes of a packet."""
        return int(self.turn.shape[1])

    def packets(self, numbers: I64Array, phase_ns: int) -> tuple[I64Array, U8Array]:
        """Arrival (n,) in ns and payloads (n, bytes) of these packets."""
        begin_ns = EPOCH_NS + phase_ns + numbers * self.packet_ns
        payloads = self.turn[numbers % len(self.turn)]
        self.fill(payloads, numbers, begin_ns)
        return begin_ns + self.packet_ns + _TRAVEL_NS, payloads


def seen(columns: int, channels: int) -> tuple[I64Array, I64Array]:
    """Ranges in mm, 0 for none, and levels 0 to 255 of a turn: (columns, channels) each."""
    chance = np.random.default_rng(columns * channels)
    column = np.arange(columns)[:, None] * (2 * np.pi / columns)
    channel = np.arange(channels) * (8 / channels)
    wave = np.sin(3 * column + channel) + 0.3 * np.sin(11 * column - channel)
    range_mm = np.rint(14_000 + 9_000 * wave + chance.normal(0, 15, wave.shape)).astype(np.int64)
    # Sky, and shots that miss here and there.
    range_mm[(np.cos(5 * column + 2 * channel) > 0.85) | (chance.random(wave.shape) < 0.03)] = 0
    level = np.rint(90 + 60 * wave + chance.normal(0, 10, wave.shape)).astype(np.int64)
    return range_mm, np.where(range_mm > 0, level.clip(1, 255), 0)


OUSTER_BEAMS, OUSTER_COLUMNS, OUSTER_PER_PACKET = 128, 1024, 16
_PIXEL: Final[Mapping[str, np.dtype[np.void]]] = {
    LOW: np.dtype([("range_8mm", "<u2"), ("reflectivity", "u1"), ("near_ir", "u1")]),
    FULL: np.dtype(
        [
            *(("range_mm", "<u4"), ("reflectivity", "u1"), ("unused", "u1")),
            *(("signal", "<u2"), ("near_ir", "<u2"), ("window", "<u2")),
        ]
    ),
}


def ouster(profile: str, serial: int) -> Lidar:
    """An OS-1-128 at 1024x10."""
    range_mm, level = seen(OUSTER_COLUMNS, OUSTER_BEAMS)
    pixel = np.zeros(range_mm.shape, _PIXEL[profile])
    values = {
        "range_8mm": range_mm // 8,
        "range_mm": range_mm,
        "reflectivity": level,
        "signal": np.where(range_mm > 0, _SIGNAL_PEAK * level // (1 + range_mm // 100), 0),
        "near_ir": 40 + level // 4,
    }
    for name in set(values) & set(pixel.dtype.names or ()):
        pixel[name] = values[name]
    column = np.dtype(
        [
            *(("stamp_ns", "<u8"), ("measurement_id", "<u2"), ("status", "<u2")),
            ("pixel", _PIXEL[profile], OUSTER_BEAMS),
        ]
    )
    packet = np.dtype(
        [
            *(("type", "<u2"), ("frame_id", "<u2"), ("init_id", "u1", 3), ("serial", "u1", 5)),
            *(("state", "u1", 20), ("column", column, OUSTER_PER_PACKET), ("footer", "u1", 32)),
        ]
    )
    turn = np.zeros(OUSTER_COLUMNS // OUSTER_PER_PACKET, packet)
    turn["type"] = 1
    turn["init_id"] = np.frombuffer(INIT_ID.to_bytes(3, "little"), np.uint8)
    turn["serial"] = np.frombuffer(serial.to_bytes(5, "little"), np.uint8)
    turn["column"]["status"] = 1
    turn["column"]["measurement_id"] = np.arange(OUSTER_COLUMNS).reshape(-1, OUSTER_PER_PACKET)
    turn["column"]["pixel"] = pixel.reshape(-1, OUSTER_PER_PACKET, OUSTER_BEAMS)

    def fill(payloads: U8Array, numbers: I64Array, begin_ns: I64Array) -> None:
        now = payloads.view(packet)[:, 0]
        now["frame_id"] = numbers // len(turn) % 2**16
        step = np.arange(OUSTER_PER_PACKET) * TURN_NS // OUSTER_COLUMNS
        now["column"]["stamp_ns"] = begin_ns[:, None] + step

    packet_ns = TURN_NS * OUSTER_PER_PACKET // OUSTER_COLUMNS
    return Lidar(turn.view(np.uint8).reshape(len(turn), -1), packet_ns, fill)


# A range in the makers' steps and a level, of both Velodyne and HESAI.
_READING: Final = np.dtype([("range", "<u2"), ("level", "u1")])
VLP16_CHANNELS, _VLP16_PER_BLOCK, _VLP16_BLOCKS = 16, 2, 12
# Two sequences of 55.296 us.
_VLP16_BLOCK_NS: Final = 110_592
_US_PER_HOUR: Final = 3_600_000_000


def vlp16(serial: int = 0) -> Lidar:
    """A VLP-16 at 600 rpm with one return; steps of 2 mm; its packets hold no serial number."""
    block = np.dtype(
        [
            *(("flag", "<u2"), ("azimuth_cdeg", "<u2")),
            ("reading", _READING, (_VLP16_PER_BLOCK, VLP16_CHANNELS)),
        ]
    )
    packet = np.dtype(
        [
            ("block", block, _VLP16_BLOCKS),
            *(("past_hour_us", "<u4"), ("mode", "u1"), ("product", "u1")),
        ]
    )
    packet_ns = _VLP16_BLOCK_NS * _VLP16_BLOCKS
    turn = np.zeros(TURN_NS // packet_ns, packet)
    turn["mode"], turn["product"] = 0x37, 0x22
    turn["block"]["flag"] = 0xEEFF
    columns = len(turn) * _VLP16_BLOCKS * _VLP16_PER_BLOCK
    for name, values in _steps(columns, VLP16_CHANNELS, 2).items():
        turn["block"]["reading"][name] = values.reshape(turn["block"]["reading"].shape)

    def fill(payloads: U8Array, numbers: I64Array, begin_ns: I64Array) -> None:
        now = payloads.view(packet)[:, 0]
        now["past_hour_us"] = begin_ns // NS_PER_US % _US_PER_HOUR
        shot_ns = begin_ns[:, None] + np.arange(_VLP16_BLOCKS) * _VLP16_BLOCK_NS
        now["block"]["azimuth_cdeg"] = _cdeg(shot_ns)

    return Lidar(turn.view(np.uint8).reshape(len(turn), -1), packet_ns, fill)


PANDAR64_CHANNELS, _PANDAR64_BLOCKS, _PANDAR64_BLOCK_NS = 64, 6, 55_560


def pandar64(serial: int = 0) -> Lidar:
    """A Pandar64 at 600 rpm with one return; steps of 4 mm; packets hold no serial number."""
    block = np.dtype([("azimuth_cdeg", "<u2"), ("reading", _READING, PANDAR64_CHANNELS)])
    packet = np.dtype(
        [
            *(("head", "u1", 8), ("block", block, _PANDAR64_BLOCKS), ("reserved", "u1", 8)),
            *(("speed_rpm", "<u2"), ("micros", "<u4"), ("mode", "u1"), ("factory", "u1")),
            *(("date", "u1", 6), ("sequence", "<u4")),
        ]
    )
    packet_ns = _PANDAR64_BLOCK_NS * _PANDAR64_BLOCKS
    turn = np.zeros(TURN_NS // packet_ns, packet)
    turn["head"] = [0xEE, 0xFF, PANDAR64_CHANNELS, _PANDAR64_BLOCKS, 0, 4, 0, 0]
    turn["speed_rpm"], turn["mode"], turn["factory"] = 600, 0x37, 0x42
    columns = len(turn) * _PANDAR64_BLOCKS
    for name, values in _steps(columns, PANDAR64_CHANNELS, 4).items():
        turn["block"]["reading"][name] = values.reshape(turn["block"]["reading"].shape)

    def fill(payloads: U8Array, numbers: I64Array, begin_ns: I64Array) -> None:
        now = payloads.view(packet)[:, 0]
        now["micros"] = begin_ns // NS_PER_US % (NS_PER_S // NS_PER_US)
        now["sequence"] = numbers
        shot_ns = begin_ns[:, None] + np.arange(_PANDAR64_BLOCKS) * _PANDAR64_BLOCK_NS
        now["block"]["azimuth_cdeg"] = _cdeg(shot_ns)
        second, which = np.unique(begin_ns // NS_PER_S, return_inverse=True)
        now["date"] = np.array([_date(one) for one in second.tolist()], np.uint8)[which]

    return Lidar(turn.view(np.uint8).reshape(len(turn), -1), packet_ns, fill)


def _steps(columns: int, channels: int, step_mm: int) -> dict[str, I64Array]:
    range_mm, level = seen(columns, channels)
    return {"range": range_mm // step_mm, "level": level}


def _cdeg(shot_ns: I64Array) -> I64Array:
    """Where the rotor is, 1/100 deg."""
    return shot_ns % TURN_NS * _CDEG_PER_TURN // TURN_NS


def _date(epoch_s: int) -> list[int]:
    """Year since 1900, month, day, hour, minute, second (UTC)."""
    now = time.gmtime(epoch_s)
    return [now.tm_year - 1900, now.tm_mon, now.tm_mday, now.tm_hour, now.tm_min, now.tm_sec]


# By kind of recordings.py; given the serial number, where packets carry one.
MAKERS: Final[Mapping[str, Callable[[int], Lidar]]] = {
    LOW: partial(ouster, LOW),
    FULL: partial(ouster, FULL),
    VLP16: vlp16,
    PANDAR64: pandar64,
}
