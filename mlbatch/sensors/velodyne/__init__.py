"""Velodyne lidars; `sensor.py` is the plug-in."""

from __future__ import annotations

from mlbatch.arrays import U8Array

# Position packets, data packets, look-alikes.
_SIZES = (512, 1206, 1212)
# Keys of the YAML and of db.xml; a file has at least one.
_KEYS = (
    *(b"laser_id", b"vert_correction", b"distance_resolution"),
    *(b"rotCorrection_", b"vertCorrection_", b"distLSB_"),
)


def may_send(size: int, packets: U8Array) -> bool:
    """Packets have one of three sizes."""
    return size in _SIZES


def may_calibrate(content: bytes) -> bool:
    """Calibration files have known keys."""
    return any(key in content for key in _KEYS)
