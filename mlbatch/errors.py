"""Errors that users see: each message says what, where, wanted, got and what to do, on one line."""

from __future__ import annotations

# The longest line: what a file said may be quoted in it, and files say anything.
_LINE_CHARACTERS, _CUT_FROM, _CUT_TO = 1600, 1000, -500


class MlbatchError(Exception):
    """Root of all errors that mlbatch raises on purpose."""

    def __str__(self) -> str:
        """The message, as one line of bounded length."""
        return one_line(super().__str__())


class UsageError(MlbatchError):
    """Options that do not fit each other or have impossible values (exit code 2)."""


class RigError(MlbatchError):
    """A rig file, calibration file or set of extrinsics that cannot be used."""


class RecordingError(MlbatchError):
    """A recording that cannot be read, or in which nothing usable was found."""


class NoScanError(RecordingError):
    """A recording of which no scan came out, with the reason."""


class ClockError(RecordingError):
    """Sensor clocks that cannot be compared, or that were reset within the recording."""


class ClockJump(ClockError):
    """A sensor's clock that jumped within the recording; host_ns: arrival of the first packet."""

    def __init__(self, message: str, host_ns: int) -> None:
        super().__init__(message)
        self.host_ns = host_ns


class PacketError(MlbatchError):
    """A packet that had to be rejected while `--strict` was given."""


class ExportError(MlbatchError):
    """An output that cannot be written."""


class Interrupted(MlbatchError):
    """A run that was interrupted, and left what another can go on with (exit code 130)."""


def one_line(text: str) -> str:
    """Text that may quote untrusted words, fit for a terminal: on one line and not too long.

    What is not printable (line breaks, escape sequences, marks of direction) is shown by its code.
    """
    if not text.isprintable():
        text = "".join(char if char.isprintable() else _code(char) for char in text)
    if len(text) > _LINE_CHARACTERS:
        text = f"{text[:_CUT_FROM]} ... {text[_CUT_TO:]}"
    return text


def _code(char: str) -> str:
    return char.encode("unicode_escape").decode("ascii")
