"""Errors for users: one line each, with what, where, expected, found and the remedy."""

from __future__ import annotations

# Messages may quote untrusted files: longer lines lose their middle.
_MOST_CHARACTERS = 1600
_FIRST_CHARACTERS = 1000
_LAST_CHARACTERS = 500


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


class Interrupted(MlbatchError):
    """An interrupted run that `--resume` can continue (exit code 130)."""


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
