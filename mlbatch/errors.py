"""Errors for users: one line each, with what, where, expected, found and the remedy."""

from __future__ import annotations

import errno

# Messages may quote untrusted files: longer lines lose their middle.
_MOST_CHARACTERS = 1600
_FIRST_CHARACTERS = 1000
_LAST_CHARACTERS = 500

_REMEDIES = {
    errno.ENOSPC: "free space on this disk or choose another output",
    errno.EDQUOT: "free space in your quota or choose another output",
    errno.EFBIG: "raise the limit of file sizes or choose another disk",
    errno.EACCES: "choose an output where you may write",
    errno.EPERM: "choose an output where you may write",
    errno.EROFS: "choose an output on a disk that is not read-only",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.EMFILE: "raise the limit of open files (ulimit -n)",
}


class MlbatchError(Exception):
    """Root of all errors that mlbatch raises."""

    def __str__(self) -> str:
        """The message, as one line of bounded length."""
        return one_line(super().__str__())


class UsageError(MlbatchError):
    """Options with impossible values, or that contradict each other (exit code 2)."""


class RigError(MlbatchError):
    """An unusable rig file, calibration file or set of extrinsics."""


class RecordingError(MlbatchError):
    """An unreadable recording, or one without usable packets."""


class NoScanError(RecordingError):
    """A run that made no scan, with the reason."""


class ClockError(RecordingError):
    """Sensor clocks that cannot be compared, or that were reset during the recording."""


class ClockJump(ClockError):
    """A sensor clock that jumped; host_ns: receive time of the first packet after the jump."""

    def __init__(self, message: str, host_ns: int) -> None:
        super().__init__(message)
        self.host_ns = host_ns


class PacketError(MlbatchError):
    """A rejected packet, with `--strict`."""


class ExportError(MlbatchError):
    """An output that cannot be written."""


class DiskFullError(ExportError):
    """A disk without space for an output that can be resumed; every other output fails there."""


class Interrupted(MlbatchError):
    """An interrupted run that `--resume` can continue (exit code 130)."""


def install_extra(extra: str) -> str:
    """Return the command that installs an extra; also right after an installation from a clone."""
    return f"pip install 'mlbatch-lidar[{extra}]'"


def write_error(path: object, err: OSError) -> ExportError:
    """The error for a fault of the system while a path is written."""
    remedy = _REMEDIES.get(err.errno or 0, "check the disk and the name of the output")
    found = err.strerror or str(err)
    return ExportError(f"{path}: expected to write it, found {found!r}; {remedy}")


def system_error(err: OSError) -> MlbatchError:
    """The error for a fault of the system that nobody has worded.

    Those of files have their path, or are worded where the file is written.
    """
    remedy = _REMEDIES.get(err.errno or 0, "check the path and the disk")
    # Not all have a number.
    found = err.strerror or str(err) or type(err).__name__
    place = err.filename or "standard output or another stream"
    return MlbatchError(f"{place}: expected to read or write it, found {found!r}; {remedy}")


def one_line(text: str) -> str:
    """Return untrusted text as one line of bounded length, safe for a terminal.

    Line breaks, escape sequences, direction marks and others that cannot be printed become codes.
    """
    if not text.isprintable():
        text = "".join(char if char.isprintable() else _code(char) for char in text)
    if len(text) > _MOST_CHARACTERS:
        text = f"{text[:_FIRST_CHARACTERS]} ... {text[-_LAST_CHARACTERS:]}"
    return text


def _code(char: str) -> str:
    return char.encode("unicode_escape").decode("ascii")
