"""Options of `--decode`: what they may be, whatever makers a recording holds."""

from __future__ import annotations

from collections.abc import Mapping

from mlbatch.errors import UsageError

_SWITCH = ("on", "off")
# CONTRACT.md section 2. `packet_stamp`: what a Velodyne HDL-32E stamps (facts/velodyne.md, 2).
DECODE_OPTIONS: Mapping[str, tuple[str, ...]] = {
    "crc": ("check",),
    "firing_azimuth": _SWITCH,
    "optical_centre": _SWITCH,
    "packet_stamp": ("start", "end"),
    "vertical_offset": _SWITCH,
}


def check_options(options: Mapping[str, str]) -> None:
    """Refuse keys and values that no maker knows."""
    for key, value in options.items():
        if key not in DECODE_OPTIONS:
            known = ", ".join(DECODE_OPTIONS)
            raise UsageError(f"--decode {key}={value}: expected one of {known}, found {key}")
        if value not in DECODE_OPTIONS[key]:
            expected = " or ".join(f"{key}={choice}" for choice in DECODE_OPTIONS[key])
            raise UsageError(f"--decode {key}={value}: expected {expected}, found {value}")
