"""The one way to read a file as a whole: a regular file, up to a limit; and JSON without NaN.

Devices never end, and a pipe waits for a writer. What is found instead is the text of an OSError or
a ValueError, so that callers word it like a fault of the system.
"""

from __future__ import annotations

import errno
import json
import math
import os
import stat
from io import FileIO
from pathlib import Path
from typing import Any, NoReturn

# Of a report, a golden file, the account of a shard, a trajectory.
MOST_BYTES = 1 << 28
# Of files that grow with the recording or the scan: scans.csv, points.
MOST_TABLE_BYTES = 1 << 32

_OTHERS = (
    (stat.S_ISDIR, errno.EISDIR, "a folder"),
    (stat.S_ISFIFO, errno.EINVAL, "a pipe"),
    (stat.S_ISSOCK, errno.EINVAL, "a socket"),
    (stat.S_ISCHR, errno.EINVAL, "a device"),
    (stat.S_ISBLK, errno.EINVAL, "a device"),
)


def open_file(path: Path) -> FileIO:
    """Open a regular file to read; OSError for anything else, without waiting for a writer."""
    try:
        mode = path.stat().st_mode
        for is_kind, number, found in _OTHERS:
            if is_kind(mode):
                raise OSError(number, found, str(path))
        return FileIO(path)
    except ValueError as err:
        # A zero byte in the name.
        raise OSError(errno.EINVAL, str(err), str(path)) from err


def read_bytes(path: Path, most: int = MOST_BYTES) -> bytes:
    """The bytes of a regular file; OSError for other files, and for more than `most` bytes."""
    with open_file(path) as file:
        if os.fstat(file.fileno()).st_size > most:
            raise OSError(errno.EFBIG, f"more than {most} bytes", str(path))
        return file.readall()


def read_text(path: Path, most: int = MOST_BYTES, encoding: str = "utf-8") -> str:
    """The text of a regular file, with line breaks as they are; UnicodeDecodeError for others."""
    return read_bytes(path, most).decode(encoding)


def parse_json(text: str | bytes, *, has_nan: bool = False) -> Any:
    """The value of a JSON text; ValueError also for NaN, infinity and text nested too deeply.

    has_nan: of a file of mlbatch itself that has NaN where a number is unknown.
    """
    try:
        return json.loads(text, parse_constant=float if has_nan else _refuse, parse_float=_finite)
    except RecursionError as err:
        raise ValueError("brackets nested too deeply") from err


def _finite(text: str) -> float:
    value = float(text)
    if math.isinf(value):
        _refuse(text)
    return value


def _refuse(name: str) -> NoReturn:
    raise ValueError(f"{name}, which is no number of JSON")
