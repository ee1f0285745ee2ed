"""A zip without compression, made in memory as parts (PKWARE APPNOTE 6.3, sections 4.3 and 4.4).

The `zipfile` of the standard library would write each part on its own and go back for checksums.
What comes out is the same, byte for byte; tests compare the two.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence

from mlbatch.errors import ExportError
from mlbatch.writers.output_file import Bytes, crc32

# Signature, version needed, flags, method, time, date, CRC, size stored and real, length of the
# name and of further fields.
_LOCAL = struct.Struct("<4s5HIIIHH")
# Signature, version and system that made it, and the same as above; length of a comment, disk,
# attributes inside and outside, place of the local head.
_CENTRAL = struct.Struct("<4s6HIII5HII")
# Signature, disks, entries here and in all, size and place of the central directory, comment.
_END = struct.Struct("<4s4HIIH")
_VERSION, _UNIX = 20, 3
# 1 January 1980, the earliest date a zip can hold: files must not depend on when they were written.
_TIME, _DATE = 0, (1 << 5) + 1
# Readable and writable by the owner.
_ATTRIBUTES = 0o600 << 16
# Sizes and places of a zip are 32 bits wide.
_LARGEST_BYTES = (1 << 32) - 1


def stored_zip(members: Iterable[tuple[str, Sequence[Bytes]]]) -> list[Bytes]:
    """The parts of a zip whose members have these names (ASCII) and bytes."""
    parts: list[Bytes] = []
    central, at, count = b"", 0, 0
    for name, content in members:
        crc, size = 0, sum(map(len, content))
        for part in content:
            crc = crc32(part, crc)
        if at + size > _LARGEST_BYTES:
            raise ExportError(
                f"{name}: wanted a scan of at most 4 GiB for an npz, got more; write a .mcap, or "
                "cut scans by --slices"
            )
        same = (_VERSION, 0, 0, _TIME, _DATE, crc, size, size, len(name), 0)
        local = _LOCAL.pack(b"PK\3\4", *same) + name.encode()
        made = _VERSION | _UNIX << 8
        central += _CENTRAL.pack(b"PK\1\2", made, *same, 0, 0, 0, _ATTRIBUTES, at)
        central += name.encode()
        parts += [local, *content]
        at += len(local) + size
        count += 1
    end = _END.pack(b"PK\5\6", 0, 0, count, count, len(central), at, 0)
    return [*parts, central, end]
