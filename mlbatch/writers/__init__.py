"""Outputs: one module a format, found by name; rules of CONTRACT.md, section 2."""

from __future__ import annotations

import importlib
import pkgutil
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, cast

from mlbatch.errors import UsageError
from mlbatch.writers import formats
from mlbatch.writers.atomic import (
    REPORT_JSON,
    SCANS_CSV,
    check_free_space,
    check_name,
    discard,
    discard_old,
    export_errors,
    is_report,
    is_taken,
    old_path,
    partial_path,
    side_path,
    write_text,
)
from mlbatch.writers.base import Safe, ScanWriter, WriterModule, WriterOptions

if TYPE_CHECKING:
    from pathlib import Path

    from mlbatch.types import RunInfo

__all__ = [
    "ReportPaths",
    "Safe",
    "ScanWriter",
    "WriterOptions",
    "check_compression",
    "check_free_space",
    "check_name",
    "check_target",
    "choose_format",
    "discard",
    "discard_old",
    "export_errors",
    "extras",
    "format_names",
    "is_report",
    "is_taken",
    "old_path",
    "open_writer",
    "partial_path",
    "plugin",
    "report_paths",
    "write_text",
]

DEFAULT_FORMAT = "npz"
# Announced in the contract; named here so that asking for one gets a straight answer.
LATER_FORMATS = ("pcd", "las", "kitti")
LATER_SUFFIXES = {
    ".pcd": "pcd",
    ".las": "las",
    ".laz": "las",
    ".bin": "kitti",
}


@lru_cache(maxsize=1)
def format_names() -> tuple[str, ...]:
    """Names of all formats, sorted; no plug-in is imported."""
    return tuple(sorted(module.name for module in pkgutil.iter_modules(formats.__path__)))


def plugin(name: str) -> WriterModule:
    """The module that writes the format called `name`."""
    if name not in format_names():
        later = " (not in this version)" if name in LATER_FORMATS else ""
        raise UsageError(
            f"--format: wanted one of {', '.join(format_names())}, got {name!r}{later}; choose one"
        )
    return cast(WriterModule, importlib.import_module(f"{formats.__name__}.{name}"))


def choose_format(target: Path, asked: str | None) -> str:
    """Format of the output `target`; `asked` is the value of `--format`, None if not given."""
    suffix = target.suffix.lower()
    _refuse_file_name(target, suffix)
    found = _of_suffix(suffix)
    if asked is None:
        return found or DEFAULT_FORMAT
    if found is not None and plugin(asked).SUFFIX is None:
        raise UsageError(
            f"-o {target}: wanted a folder for --format {asked}, got the name of a {found} file; "
            f"leave out {suffix} or the option"
        )
    if found is not None and found != asked:
        raise UsageError(
            f"-o {target}: wanted the name of a {plugin(asked).SUFFIX} file for --format {asked}, "
            f"got that of a {found} file; change {suffix} or leave out the option"
        )
    return plugin(asked).FORMAT


def _of_suffix(suffix: str) -> str | None:
    """The format whose files bear a suffix."""
    if not suffix:
        return None
    # Importing them all takes long: the one that is likely comes first.
    likely = sorted(format_names(), key=lambda name: name != suffix.removeprefix("."))
    suffixes = ((plugin(name).SUFFIX, name) for name in likely)
    return next((name for own, name in suffixes if own == suffix), None)


def open_writer(name: str, target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start the output `target` in the format called `name`."""
    check_compression(name, options)
    return plugin(name).open_writer(target, info, options)


@dataclass(frozen=True, slots=True)
class ReportPaths:
    """Where the report and the table of scans of an output lie."""

    report: Path
    scans_csv: Path


def report_paths(target: Path, name: str) -> ReportPaths:
    """Inside an output folder, beside an output file.

    A writer's `finish` has the report written and writes scans.csv, before the output is named.
    """
    if plugin(name).SUFFIX is None:
        return ReportPaths(target / REPORT_JSON, target / SCANS_CSV)
    return ReportPaths(side_path(target, REPORT_JSON), side_path(target, SCANS_CSV))


def extras(name: str, options: WriterOptions) -> frozenset[str]:
    """Those of `types.EXTRAS` that an output in the format called `name` holds."""
    return plugin(name).extras(options)


def check_compression(name: str, options: WriterOptions) -> None:
    """Refuse a compression that is none, or that the format called `name` has no place for."""
    # Imported here, since it knows the types that need numpy.
    from mlbatch.writers.mcap_container import compression_of, refuse_compression

    if plugin(name).COMPRESSES:
        compression_of(options.compression)
    else:
        refuse_compression(options.compression, name)


def check_target(name: str, target: Path, options: WriterOptions, layout: str) -> None:
    """Refuse at the start what could not be written at the end.

    The surest way to know that an output can be opened is to open it; what that made is removed.
    """
    # Imported here, since the types need numpy and naming formats must not.
    from mlbatch.types import RunInfo

    info = RunInfo((), "", "10", "unknown", layout=layout)
    open_writer(name, target, info, replace(options, split=False)).abandon()
    discard(target)


def _refuse_file_name(target: Path, suffix: str) -> None:
    """Refuse names of single files for outputs that are not single files."""
    name = suffix.removeprefix(".")
    if name in format_names() and plugin(name).SUFFIX is None:
        raise UsageError(
            f"-o {target}: wanted a folder, since {name} output is a file a scan, got a file "
            f"name; give -o {target.with_suffix('')} --format {name}"
        )
    if suffix == ".db3":
        raise UsageError(
            f"-o {target}: wanted a folder, since rosbag2 output is a folder with an MCAP file, "
            f"got a file name; give -o {target.with_suffix('')} --format rosbag2"
        )
    if suffix in LATER_SUFFIXES:
        raise UsageError(
            f"-o {target}: wanted a .mcap file, a .bag file or a folder, got {suffix} "
            f"({LATER_SUFFIXES[suffix]}, not in this version); choose another output"
        )
