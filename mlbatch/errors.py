"""Errors that users see: each message says what, where, wanted, got and what to do, on one line."""

from __future__ import annotations


class MlbatchError(Exception):
    """Root of all errors that mlbatch raises on purpose."""


class UsageError(MlbatchError):
    """Options that do not fit each other or have impossible values (exit code 2)."""


class RigError(MlbatchError):
    """A rig file, calibration file or set of extrinsics that cannot be used."""


class RecordingError(MlbatchError):
    """A recording that cannot be read, or in which nothing usable was found."""


class ClockError(RecordingError):
    """Sensor clocks that cannot be compared, or that were reset within the recording."""


class PacketError(MlbatchError):
    """A packet that had to be rejected while `--strict` was given."""


class ExportError(MlbatchError):
    """An output that cannot be written."""
