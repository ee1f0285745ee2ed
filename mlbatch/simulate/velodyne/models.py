"""Every Velodyne model by docs/sources/velodyne.md, typed once more for the encoder.

Sections 1, 2 and 6. The HDL-64E has no beams of its own: `calibration_yaml` gives those of a unit
that does not exist, in which corrections have the usual size.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

EE = 0xEEFF
DD = 0xDDFF
CC = 0xCCFF
BB = 0xBBFF


@dataclass(frozen=True)
class Table:
    """A model; tuples are by laser id.

    product: byte 1205, None if the bytes are a status; firing_us: after the first firing of
    the sequence; time_scales: it changes with the time of the sequence; columns_per_row:
    sequences of one azimuth; flags: of the blocks of an azimuth, one return; returns_apart: all
    blocks of one return come first; azimuth_deg: clockwise, the manual's "azimuth offset".
    """

    product: int | None
    unit_m: float
    sequence_us: float
    firing_us: tuple[float, ...]
    elevation_deg: tuple[float, ...]
    azimuth_deg: tuple[float, ...]
    vertical_m: tuple[float, ...]
    horizontal_m: tuple[float, ...]
    dist_m: tuple[float, ...]
    columns_per_row: int = 1
    flags: tuple[int, ...] = (EE,)
    returns_apart: bool = False
    stamp_after_us: float = 0.0
    time_scales: bool = False


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(float(word) for word in text.replace(",", " ").split())


def _plain(
    product: int,
    unit_m: float,
    sequence_us: float,
    firing_us: Sequence[float],
    elevation_deg: Sequence[float],
    vertical_mm: Sequence[float],
    azimuth_deg: Sequence[float] = (),
) -> Table:
    """A model that a table describes completely."""
    nothing = (0.0,) * len(elevation_deg)
    return Table(
        product=product,
        unit_m=unit_m,
        sequence_us=sequence_us,
        firing_us=tuple(firing_us),
        elevation_deg=tuple(elevation_deg),
        azimuth_deg=tuple(azimuth_deg) or nothing,
        vertical_m=tuple(mm / 1000 for mm in vertical_mm),
        horizontal_m=nothing,
        dist_m=nothing,
    )


def _above_mm(focus_mm: float, elevation_deg: Sequence[float]) -> list[float]:
    return [focus_mm * math.tan(math.radians(-one)) for one in elevation_deg]


_VLP_16 = replace(
    _plain(
        0x22,
        0.002,
        55.296,
        [2.304 * laser for laser in range(16)],
        _numbers("-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15"),
        _numbers(
            "11.23, -0.73, 9.68, -2.20, 8.15, -3.67, 6.64, -5.15,"
            "5.15, -6.64, 3.67, -8.15, 2.20, -9.68, 0.73, -11.23"
        ),
    ),
    columns_per_row=2,
)
_HI_RES = replace(
    _VLP_16,
    product=0x24,
    elevation_deg=_numbers(
        "-10, 0.667, -8.667, 2, -7.333, 3.333, -6, 4.667,"
        "-4.667, 6, -3.333, 7.333, -2, 8.667, -0.667, 10"
    ),
    vertical_m=tuple(
        mm / 1000
        for mm in _numbers(
            "7.4, -0.9, 6.5, -1.8, 5.5, -2.7, 4.6, -3.7, 3.7, -4.6, 2.7, -5.5, 1.8, -6.5, 0.9, -7.4"
        )
    ),
)
_EVEN = _numbers(
    "-30.67, -29.33, -28, -26.67, -25.33, -24, -22.67, -21.33,"
    "-20, -18.67, -17.33, -16, -14.67, -13.33, -12, -10.67"
)
_ODD = _numbers(
    "-9.33, -8, -6.67, -5.33, -4, -2.67, -1.33, 0, 1.33, 2.67, 4, 5.33, 6.67, 8, 9.33, 10.67"
)
_HDL_32E = _plain(
    0x21,
    0.002,
    46.080,
    [1.152 * laser for laser in range(32)],
    [angle for pair in zip(_EVEN, _ODD, strict=True) for angle in pair],
    _numbers(
        "17.17, 4.76, 16.27, 4.07, 15.40, 3.38, 14.54, 2.70, 13.71, 2.02, 12.89, 1.35,"
        "12.09, 0.67, 11.31, 0, 10.54, -0.67, 9.78, -1.35, 9.04, -2.02, 8.30, -2.70, 7.58,"
        "-3.38, 6.86, -4.07, 6.15, -4.76, 5.45, -5.45"
    ),
)
_VLP_32C_ELEVATION = _numbers(
    "-25 -1 -1.667 -15.639 -11.31 0 -0.667 -8.843 -7.254 0.333 -0.333 -6.148 -5.333 1.333 0.667"
    " -4 -4.667 1.667 1 -3.667 -3.333 3.333 2.333 -2.667 -3 7 4.667 -2.333 -2 15 10.333 -1.333"
)
_VLP_32C = _plain(
    0x28,
    0.004,
    55.296,
    [2.304 * (laser // 2) for laser in range(32)],
    _VLP_32C_ELEVATION,
    _above_mm(42.4, _VLP_32C_ELEVATION),
    _numbers(
        "1.4 -4.2 1.4 -1.4 1.4 -1.4 4.2 -1.4 1.4 -4.2 1.4 -1.4 4.2 -1.4 4.2 -1.4"
        " 1.4 -4.2 1.4 -4.2 4.2 -1.4 1.4 -1.4 1.4 -1.4 1.4 -4.2 4.2 -1.4 1.4 -1.4"
    ),
)
_VLS_128_ELEVATION = _numbers(
    """
    -11.742 -1.99 3.4 -5.29 -0.78 4.61 -4.08 1.31 -6.5 -1.11 4.28 -4.41 0.1 6.48 -3.2 2.19
    -3.86 1.53 -9.244 -1.77 2.74 -5.95 -0.56 4.83 -2.98 2.41 -6.28 -0.89 3.62 -5.07 0.32 7.58
    -0.34 5.18 -3.64 1.75 -25 -2.43 2.96 -5.73 0.54 9.7 -2.76 2.63 -7.65 -1.55 3.84 -4.85
    3.18 -5.51 -0.12 5.73 -4.3 1.09 -16.042 -2.21 4.06 -4.63 0.76 15 -3.42 1.97 -6.85 -1.33
    -5.62 -0.23 5.43 -3.53 0.98 -19.582 -2.32 3.07 -4.74 0.65 11.75 -2.65 1.86 -7.15 -1.44 3.95
    -2.1 3.29 -5.4 -0.01 4.5 -4.19 1.2 -13.565 -1.22 4.17 -4.52 0.87 6.08 -3.31 2.08 -6.65
    1.42 -10.346 -1.88 3.51 -6.06 -0.67 4.72 -3.97 2.3 -6.39 -1 4.39 -5.18 0.21 6.98 -3.09
    4.98 -3.75 1.64 -8.352 -2.54 2.85 -5.84 -0.45 8.43 -2.87 2.52 -6.17 -1.66 3.73 -4.96 0.43
    """
)
# Of 20 slots the 9th is idle, and so are the last three.
_VLS_128 = replace(
    _plain(
        0xA1,
        0.004,
        55.277,
        [55.277 / 20 * (laser // 8 + (laser >= 64)) for laser in range(128)],
        _VLS_128_ELEVATION,
        _above_mm(58.63, _VLS_128_ELEVATION),
        _numbers("6.354, 4.548, 2.732, 0.911, -0.911, -2.732, -4.548, -6.354") * 16,
    ),
    flags=(EE, DD, CC, BB),
    stamp_after_us=8.7,
    time_scales=True,
)


def _hdl64(column_us: float, four_us: float, in_four_us: Sequence[float]) -> Table:
    """Both blocks fire together; the beams are those of no real unit."""
    firing_us = [four_us * (j // 4) + in_four_us[j % 4] for j in range(32)] * 2
    upper = [2.0 - j / 3 for j in range(32)]
    lower = [-8.83 - j / 2 for j in range(32)]
    return Table(
        product=None,
        unit_m=0.002,
        sequence_us=column_us,
        firing_us=tuple(firing_us),
        elevation_deg=tuple(round(angle, 6) for angle in upper + lower),
        azimuth_deg=tuple((1.5 - laser % 4) * 3.0 for laser in range(64)),
        vertical_m=(0.2,) * 32 + (0.13,) * 32,
        horizontal_m=(0.026, -0.026) * 32,
        dist_m=tuple(round(1.2 + 0.005 * laser, 6) for laser in range(64)),
        flags=(EE, DD),
        returns_apart=True,
    )


MODELS = {
    "VLP-16": _VLP_16,
    "Puck Hi-Res": _HI_RES,
    "HDL-32E": _HDL_32E,
    "VLP-32C": _VLP_32C,
    "VLS-128": _VLS_128,
    "HDL-64E S2": _hdl64(48.0, 6.0, (0, 1.26, 2.46, 3.66)),
    "HDL-64E S3": _hdl64(57.6, 7.2, (0, 1.3, 2.5, 3.7)),
}


def calibration_yaml(model: str) -> str:
    """The calibration of a model as ROS drivers write it, section 9."""
    table = MODELS[model]
    lines = ["lasers:"]
    for laser in range(len(table.elevation_deg)):
        lines += [
            f"- laser_id: {laser}",
            f"  rot_correction: {-math.radians(table.azimuth_deg[laser])!r}",
            f"  vert_correction: {math.radians(table.elevation_deg[laser])!r}",
            f"  dist_correction: {table.dist_m[laser]}",
            f"  vert_offset_correction: {table.vertical_m[laser]}",
            f"  horiz_offset_correction: {table.horizontal_m[laser]}",
        ]
    lines += [f"num_lasers: {len(table.elevation_deg)}", f"distance_resolution: {table.unit_m}"]
    return "\n".join(lines) + "\n"
