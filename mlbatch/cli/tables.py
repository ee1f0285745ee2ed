"""Plain text tables; cells may quote recordings, and hold nothing that a terminal obeys."""

from __future__ import annotations

from collections.abc import Sequence

from mlbatch.errors import one_line


def columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows as lines, cells padded to the width of their column."""
    rows = [[one_line(cell) for cell in row] for row in rows]
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
