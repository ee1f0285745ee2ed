"""A page for a run: one HTML file without references to other files, see docs/page.md."""

from __future__ import annotations

import contextlib
from pathlib import Path

from mlbatch.bounded import open_file
from mlbatch.errors import ExportError, write_error
from mlbatch.page.document import page_text
from mlbatch.page.source import Source, find_source, shown_scans, source_of_text

__all__ = [
    "Source",
    "check_page",
    "find_source",
    "shown_scans",
    "source_of_text",
    "write_page",
    "write_text_page",
]

# First bytes of a page; only files that begin with them are replaced.
MARK = b"<!DOCTYPE html>\n<!-- mlbatch page -->"


def check_page(path: Path, *, overwrite: bool) -> None:
    """Raise ExportError if a page cannot be written to a path."""
    if not path.parent.is_dir():
        raise ExportError(
            f"{path}: expected a page in an existing folder, found none at {path.parent}; "
            "create it (mkdir -p) or choose another"
        )
    if path.is_dir():
        raise ExportError(f"{path}: expected a file for the page, found a folder; add a name")
    if not path.exists():
        return
    try:
        with open_file(path) as file:
            is_page = file.read(len(MARK)) == MARK
    except OSError as err:
        raise ExportError(
            f"{path}: expected a new file or an earlier page, found {err.strerror}; choose another "
            "name for the page"
        ) from err
    if not is_page:
        raise ExportError(
            f"{path}: expected a new file or an earlier page, found another file; choose another "
            "name for the page"
        )
    if not overwrite:
        raise ExportError(
            f"{path}: expected a new file, found an earlier page; replace it with --overwrite"
        )


def write_page(path: Path, source: Source) -> None:
    """Write the page of a run; the file appears complete or not at all."""
    write_text_page(path, page_text(source))


def write_text_page(path: Path, text: str) -> None:
    """Write a page given as text; the file appears complete or not at all."""
    # Names in a report may contain bytes that are not UTF-8.
    data = text.encode("utf-8", "backslashreplace")
    partial = path.with_name(f"{path.name}.partial")
    try:
        partial.write_bytes(data)
        partial.replace(path)
    except OSError as err:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        raise write_error(path, err) from err
