"""Velodyne models and packet layouts as tables: beams, firing times, units, offsets.

Source: docs/sources/velodyne.md sections 1, 2, 5 and 6. All tables are in the order of laser ids,
as in the packets; angles in degrees, as in the manuals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.lidar.geometry import BeamTable, spherical
from mlbatch.lidar.interface import Records
from mlbatch.sensors.velodyne.calibration import VelodyneFile
from mlbatch.units import M_PER_MM, NS_PER_US, RAD_PER_DEG

# A data packet: 12 x (2 + 2 + 32 x 3) + 4 + 2 = 1206 bytes.
PACKET_SIZE = 1206
BLOCKS = 12
STRIDE = 100
BLOCK_LASERS = 32
STAMP_AT = 1200
MODE_AT = 1204
_BLOCK_HEAD = 4
_READING = 3
# Packets may have this azimuth, which is that of 0.
CIRCLE_CDEG = 36000
# Block flags as numbers; a firing sequence has a block of each bank.
BANK_FLAGS = {1: (0xEEFF,), 2: (0xEEFF, 0xDDFF), 4: (0xEEFF, 0xDDFF, 0xCCFF, 0xBBFF)}
DUAL = "dual return"
UNSET_MODES = ("single return", DUAL)
MODES = {0x37: "strongest return", 0x38: "last return", 0x39: DUAL}
HDL_64E = "HDL-64E"
VLS_128 = "VLS-128"


@dataclass(frozen=True, slots=True)
class Model:
    """A model.

    reported_as: the model named in packets of this one.
    banks: blocks of a firing sequence.
    halves: firing sequences of a block.
    sequence_ns, slots: length of a firing sequence, and its time slots.
    slot: (lasers,) time slot of each laser.
    stamp_ns: first firing minus the packet's stamp.
    clockwise_deg, elevation_deg, height_mm: of each beam, empty if only a file has them.
    product: product byte of its packets, None if they have none.
    """

    name: str
    reported_as: str
    lasers: int
    # Distance counts in a metre.
    units_per_m: int
    sequence_ns: int
    slots: int
    slot: tuple[int, ...]
    elevation_deg: tuple[float, ...] = ()
    clockwise_deg: tuple[float, ...] = ()
    height_mm: tuple[float, ...] = ()
    banks: int = 1
    halves: int = 1
    stamp_ns: int = 0
    # The packet stamp may be that of the last firing (`packet_stamp=end`).
    stamp_may_end: bool = False
    product: int | None = None
    # Text for the table of `mlbatch sensors`.
    verified: str = "two sources"

    def firing_ns(self, sequence_ns: float) -> I64Array:
        """(1, lasers) times after the first firing of a sequence, to the nearest ns."""
        slot_ns = sequence_ns / self.slots
        return np.rint(np.array([self.slot], np.float64) * slot_ns).astype(np.int64)

    @property
    def block_us(self) -> float:
        """Time from block to block of one bank, with a single return."""
        return self.sequence_ns * BLOCK_LASERS / self.lasers / NS_PER_US

    @property
    def needs_file(self) -> bool:
        """Whether the beams differ from unit to unit."""
        return not self.elevation_deg


@dataclass(frozen=True, slots=True)
class Layout:
    """Columns of the packets of a model in a return mode.

    blocks: of a sequence with all its returns.
    sequences: groups of blocks with an azimuth each.
    first_byte: [return][bank] of a record.
    """

    blocks: int
    sequences: int
    columns: int
    records: Records
    first_byte: tuple[tuple[int, ...], ...]


def layout(model: Model, returns: int) -> Layout:
    """The layout of a model's packets with one or two returns."""
    blocks = model.banks * returns
    sequences = BLOCKS // blocks
    per_bank = model.lasers // model.banks
    size = STRIDE * (blocks - 1) + _READING * per_bank
    # VLS-128 pairs the returns of each bank, HDL-64E the banks of each return.
    bank_step, return_step = (returns, 1) if model.banks != 2 else (1, model.banks)
    first_byte = tuple(
        tuple(STRIDE * (which * return_step + bank * bank_step) for bank in range(model.banks))
        for which in range(returns)
    )
    step = _READING * BLOCK_LASERS // model.halves
    records = Records(_BLOCK_HEAD, STRIDE * blocks, size, model.halves, step)
    return Layout(blocks, sequences, sequences * model.halves, records, first_byte)


@lru_cache(maxsize=8)
def expected_flags(banks: int, returns: int) -> I64Array:
    """Flags of the used blocks of a packet, which may be fewer than 12.

    HDL-64E sends the second return after both banks of the first; VLS-128 bank by bank.
    """
    flags = np.array(BANK_FLAGS[banks], np.int64)
    group = flags.repeat(returns) if banks == 4 else np.tile(flags, returns)
    return np.tile(group, BLOCKS // len(group))


def beam_table(model: Model, file: VelodyneFile | None, *, raised: bool) -> BeamTable:
    """Beams in the sensor frame (x forward, y left); raised: apply vertical offsets."""
    if file is None:
        azimuth_rad = np.array(model.clockwise_deg) * RAD_PER_DEG
        elevation_rad = np.array(model.elevation_deg) * RAD_PER_DEG
        height_m = np.array(model.height_mm) * M_PER_MM
        side_m: F64Array = np.zeros(model.lasers)
        reach_m: F64Array = np.zeros(1)
    else:
        azimuth_rad = -file.azimuth_rad
        elevation_rad = file.elevation_rad
        height_m = file.vert_offset_m
        side_m = file.horiz_offset_m
        reach_m = file.dist_correction_m
    origin = np.zeros((3, model.lasers, 3))
    # Section 10: forward += h sin(alpha), right -= h cos(alpha), alpha = rotor + azimuth.
    sine = side_m * np.sin(azimuth_rad)
    cosine = side_m * np.cos(azimuth_rad)
    origin[0, :, 0] = sine
    origin[0, :, 1] = cosine
    origin[1, :, 0] = cosine
    origin[1, :, 1] = -sine
    if raised:
        origin[2, :, 2] = height_m
    return BeamTable(spherical(azimuth_rad, elevation_rad), origin, reach_m)


def ranks(elevation: F64Array) -> I64Array:
    """Rank of each beam, 0 for the lowest."""
    return np.argsort(np.argsort(elevation, kind="stable"))


def _focal(length_mm: float, elevation_deg: tuple[float, ...]) -> tuple[float, ...]:
    """Heights in mm of beams through a lens of this focal length (section 5)."""
    return tuple((length_mm * np.tan(-np.array(elevation_deg) * RAD_PER_DEG)).tolist())


def _woven(even: tuple[float, ...], odd: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(angle for pair in zip(even, odd, strict=True) for angle in pair)


# fmt: off
VLP_16 = Model(
    name="VLP-16", reported_as="VLP-16", lasers=16, units_per_m=500, sequence_ns=55_296, slots=24,
    slot=tuple(range(16)), halves=2, product=0x22, verified="real recording",
    elevation_deg=(-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15),
    clockwise_deg=(0.0,) * 16,
    height_mm=(11.23, -0.73, 9.68, -2.20, 8.15, -3.67, 6.64, -5.15,
               5.15, -6.64, 3.67, -8.15, 2.20, -9.68, 0.73, -11.23),
)
PUCK_LITE = replace(VLP_16, name="Puck LITE", verified="one source")
PUCK_HI_RES = replace(
    VLP_16, name="Puck Hi-Res", reported_as="Puck Hi-Res", product=0x24, verified="two sources",
    elevation_deg=(-10, 0.667, -8.667, 2, -7.333, 3.333, -6, 4.667,
                   -4.667, 6, -3.333, 7.333, -2, 8.667, -0.667, 10),
    height_mm=(7.4, -0.9, 6.5, -1.8, 5.5, -2.7, 4.6, -3.7,
               3.7, -4.6, 2.7, -5.5, 1.8, -6.5, 0.9, -7.4),
)
HDL_32E = Model(
    name="HDL-32E", reported_as="HDL-32E", lasers=32, units_per_m=500, sequence_ns=46_080, slots=40,
    slot=tuple(range(32)), stamp_may_end=True, product=0x21, verified="real recording",
    elevation_deg=_woven(
        (-30.67, -29.33, -28, -26.67, -25.33, -24, -22.67, -21.33,
         -20, -18.67, -17.33, -16, -14.67, -13.33, -12, -10.67),
        (-9.33, -8, -6.67, -5.33, -4, -2.67, -1.33, 0,
         1.33, 2.67, 4, 5.33, 6.67, 8, 9.33, 10.67)),
    clockwise_deg=(0.0,) * 32,
    height_mm=(17.17, 4.76, 16.27, 4.07, 15.40, 3.38, 14.54, 2.70,
               13.71, 2.02, 12.89, 1.35, 12.09, 0.67, 11.31, 0,
               10.54, -0.67, 9.78, -1.35, 9.04, -2.02, 8.30, -2.70,
               7.58, -3.38, 6.86, -4.07, 6.15, -4.76, 5.45, -5.45),
)
_VLP_32C_DEG = (
    -25, -1, -1.667, -15.639, -11.31, 0, -0.667, -8.843, -7.254, 0.333, -0.333, -6.148,
    -5.333, 1.333, 0.667, -4, -4.667, 1.667, 1, -3.667, -3.333, 3.333, 2.333, -2.667,
    -3, 7, 4.667, -2.333, -2, 15, 10.333, -1.333,
)
VLP_32C = Model(
    name="VLP-32C", reported_as="VLP-32C", lasers=32, units_per_m=250, sequence_ns=55_296, slots=24,
    slot=tuple(laser // 2 for laser in range(32)), product=0x28, verified="real recording",
    elevation_deg=_VLP_32C_DEG,
    clockwise_deg=(1.4, -4.2, 1.4, -1.4, 1.4, -1.4, 4.2, -1.4, 1.4, -4.2, 1.4, -1.4,
                   4.2, -1.4, 4.2, -1.4, 1.4, -4.2, 1.4, -4.2, 4.2, -1.4, 1.4, -1.4,
                   1.4, -1.4, 1.4, -4.2, 4.2, -1.4, 1.4, -1.4),
    height_mm=_focal(42.4, _VLP_32C_DEG),
)
_VLS_128_DEG = (
    -11.742, -1.99, 3.4, -5.29, -0.78, 4.61, -4.08, 1.31,
    -6.5, -1.11, 4.28, -4.41, 0.1, 6.48, -3.2, 2.19,
    -3.86, 1.53, -9.244, -1.77, 2.74, -5.95, -0.56, 4.83,
    -2.98, 2.41, -6.28, -0.89, 3.62, -5.07, 0.32, 7.58,
    -0.34, 5.18, -3.64, 1.75, -25, -2.43, 2.96, -5.73,
    0.54, 9.7, -2.76, 2.63, -7.65, -1.55, 3.84, -4.85,
    3.18, -5.51, -0.12, 5.73, -4.3, 1.09, -16.042, -2.21,
    4.06, -4.63, 0.76, 15, -3.42, 1.97, -6.85, -1.33,
    -5.62, -0.23, 5.43, -3.53, 0.98, -19.582, -2.32, 3.07,
    -4.74, 0.65, 11.75, -2.65, 1.86, -7.15, -1.44, 3.95,
    -2.1, 3.29, -5.4, -0.01, 4.5, -4.19, 1.2, -13.565,
    -1.22, 4.17, -4.52, 0.87, 6.08, -3.31, 2.08, -6.65,
    1.42, -10.346, -1.88, 3.51, -6.06, -0.67, 4.72, -3.97,
    2.3, -6.39, -1, 4.39, -5.18, 0.21, 6.98, -3.09,
    4.98, -3.75, 1.64, -8.352, -2.54, 2.85, -5.84, -0.45,
    8.43, -2.87, 2.52, -6.17, -1.66, 3.73, -4.96, 0.43,
)
# sequence_ns: measured on the only known recording; for each stream it is measured again. The stamp
# is that of the fourth group of eight lasers.
ALPHA_PRIME = Model(
    name="VLS-128", reported_as=VLS_128, lasers=128, units_per_m=250, sequence_ns=55_277, slots=20,
    slot=tuple(laser // 8 + (laser >= 64) for laser in range(128)), banks=4, stamp_ns=-8_700,
    verified="real recording",
    elevation_deg=_VLS_128_DEG,
    clockwise_deg=(6.354, 4.548, 2.732, 0.911, -0.911, -2.732, -4.548, -6.354) * 16,
    height_mm=_focal(58.63, _VLS_128_DEG),
)
HDL_64E_S2 = Model(
    name="HDL-64E S2", reported_as=HDL_64E, lasers=64, units_per_m=500, sequence_ns=48_000,
    slots=800,
    slot=tuple(100 * (laser % 32 // 4) + (0, 21, 41, 61)[laser % 4] for laser in range(64)),
    banks=2, verified="one source",
)
HDL_64E_S3 = replace(
    HDL_64E_S2, name="HDL-64E S3", sequence_ns=57_600, slots=576,
    slot=tuple(72 * (laser % 32 // 4) + (0, 13, 25, 37)[laser % 4] for laser in range(64)),
)
# fmt: on

# S3 before S2: a calibration file of 64 lasers is assumed to be of the first.
ALL = (VLP_16, PUCK_LITE, PUCK_HI_RES, HDL_32E, VLP_32C, ALPHA_PRIME, HDL_64E_S3, HDL_64E_S2)
