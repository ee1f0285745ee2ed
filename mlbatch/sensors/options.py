"""Options of `--decode`: keys and values that any vendor accepts."""

from __future__ import annotations

from collections.abc import Mapping

from mlbatch.errors import UsageError

_SWITCH = ("on", "off")
# packet_stamp: whether a Velodyne HDL-32E stamps the start or the end of a packet
# (docs/sources/velodyne.md section 2). range_unit: of a ROBOSENSE Helios
# (docs/sources/robosense.md section 3).
DECODE_OPTIONS: Mapping[str, tuple[str, ...]] = {
    "crc": ("check",),
    "firing_azimuth": _SWITCH,
    "optical_centre": _SWITCH,
    "packet_stamp": ("start", "end"),
    "range_unit": ("2.5mm", "5mm"),
    "vertical_offset": _SWITCH,
}


def check_options(options: Mapping[str, str]) -> None:
    """Raise UsageError for keys and values that no vendor knows."""
    for key, value in options.items():
        if key not in DECODE_OPTIONS:
            known = ", ".join(DECODE_OPTIONS)
            raise UsageError(
                f"--decode: expected one of {known}, found {key!r}; write --decode crc=check"
            )
        choices = DECODE_OPTIONS[key]
        if value not in choices:
            raise UsageError(
                f"--decode {key}: expected {' or '.join(choices)}, found {value!r}; write --decode "
                f"{key}={choices[0]}"
            )
