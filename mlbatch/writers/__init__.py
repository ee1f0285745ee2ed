"""Outputs: formats found by their place in `writers/formats/`, and atomic files."""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING, NamedTuple

from mlbatch.errors import UsageError
from mlbatch.options import PLY_STYLES
from mlbatch.writers.atomic import REPORT_JSON, SCANS_CSV, discard, side_path
from mlbatch.writers.base import NO_COMPRESSION, ScanWriter, WriterModule, WriterOptions
from mlbatch.writers.formats import (
    built_in_names,
    format_module,
    format_names,
    format_of_files,
    is_format,
    other_names,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from mlbatch.types import RecordLayout, RunInfo

DEFAULT_FORMAT = "npz"
# Formats with one file per scan that may be an output alone.
ONE_FILE = ("npz", "ply", "pcd", "las", "laz")
# Formats without a header.
ROWS = ("kitti", "nuscenes")


def plugin(name: str) -> WriterModule:
    """Return the module of a format, UsageError for an unknown one."""
    if not is_format(name):
        raise UsageError(
            f"--format: expected one of {', '.join(format_names())}, found {name!r}; choose one"
        )
    return format_module(name)


def choose_format(target: Path | None, asked: str | None) -> str:
    """Return the format of the output `target`; asked: value of `--format`, None if not given.

    A dry run without an output decodes what a .mcap would contain.
    """
    if target is None:
        return plugin(asked or "mcap").FORMAT
    suffix = target.suffix.lower()
    found = _format_of_suffix(suffix)
    if found is None:
        _refuse_file_name(target, suffix)
    if asked is None:
        return found or DEFAULT_FORMAT
    if found is not None and plugin(asked).SUFFIX is None:
        raise UsageError(
            f"-o {target}: expected a folder for --format {asked}, found the name of a {found} "
            f"file; leave out {suffix} or the option"
        )
    if found is not None and found != asked:
        raise UsageError(
            f"-o {target}: expected the name of a {plugin(asked).SUFFIX} file for --format "
            f"{asked}, found that of a {found} file; change {suffix} or leave out the option"
        )
    return plugin(asked).FORMAT


def one_file_format(target: Path, asked: str | None) -> str:
    """Return the format of an output that is the file of one scan, as `scan.ply`; else ""."""
    name = target.suffix.lower().removeprefix(".")
    return name if name in ONE_FILE and asked in (None, name) else ""


def _format_of_suffix(suffix: str) -> str | None:
    """Return the format with this file suffix."""
    if not suffix:
        return None
    # Importing all formats is slow: the likely one comes first.
    likely = sorted(built_in_names(), key=lambda name: name != suffix.removeprefix("."))
    for name in likely:
        if _has_suffix(name, suffix):
            return name
    return next((name for name in other_names() if _has_suffix(name, suffix)), None)


def _has_suffix(name: str, suffix: str) -> bool:
    return suffix == plugin(name).SUFFIX


def _refuse_file_name(target: Path, suffix: str) -> None:
    """Refuse names of files for outputs that are folders."""
    name = format_of_files(suffix.removeprefix("."))
    if name is not None:
        raise UsageError(
            f"-o {target}: expected a folder, since {name} output is a folder of files, found a "
            f"file name; give -o {target.with_suffix('')} --format {name}"
        )
    # A folder may have any name, but a word that is nearly a suffix is one with a mistake.
    known = [f".{one}" for one in (*ONE_FILE, "mcap", "bag")]
    near = difflib.get_close_matches(suffix, known, n=1, cutoff=0.75)
    if near:
        raise UsageError(
            f"-o {target}: expected the suffix of an output, found {suffix!r}; the nearest is "
            f"{near[0]}, and a folder has none"
        )
    if suffix == ".db3":
        raise UsageError(
            f"-o {target}: expected a folder, since rosbag2 output is a folder with an MCAP file, "
            f"found a file name; give -o {target.with_suffix('')} --format rosbag2"
        )


def open_writer(name: str, target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start the output `target` in a format."""
    check_options(name, options)
    return plugin(name).open_writer(target, info, options)


class ReportPaths(NamedTuple):
    """Paths of the report and the table of scans of an output."""

    report: Path
    scans_csv: Path


def report_paths(target: Path, name: str) -> ReportPaths:
    """Return the paths inside an output folder, or next to an output file.

    A writer's `finish` has the report written, then scans.csv, before it moves the output.
    """
    if plugin(name).SUFFIX is None:
        return ReportPaths(target / REPORT_JSON, target / SCANS_CSV)
    return ReportPaths(side_path(target, REPORT_JSON), side_path(target, SCANS_CSV))


def extras(name: str, options: WriterOptions) -> frozenset[str]:
    """Return the optional contents of an output, see `WriterModule.extras`."""
    return plugin(name).extras(options)


def record_layout(name: str, options: WriterOptions) -> RecordLayout | None:
    """Return the records that a writer takes packed, see `WriterModule`; None: arrays."""
    layout_of: Callable[[WriterOptions], RecordLayout | None] | None
    layout_of = getattr(plugin(name), "record_layout", None)
    return None if layout_of is None else layout_of(options)


def has_several_files(name: str, options: WriterOptions) -> bool:
    """Return whether an output consists of files that several runs may make."""
    return plugin(name).SUFFIX is None and (name != "rosbag2" or options.max_bag_s > 0)


def check_options(name: str, options: WriterOptions) -> None:
    """Refuse options that the format does not have, or unknown values of them."""
    check_compression(name, options)
    style = options.ply_style
    if style not in PLY_STYLES:
        raise UsageError(
            f"--ply-style: expected {', '.join(PLY_STYLES)}, found {style!r}; choose one"
        )
    if style != PLY_STYLES[0] and name != "ply":
        raise UsageError(
            f"--ply-style: expected {PLY_STYLES[0]} for {name}, found {style!r}; leave it out, or "
            "give --format ply"
        )
    if options.max_bag_s and name != "rosbag2":
        raise UsageError(
            f"--max-bag-duration: expected --format rosbag2, a folder of several files, found "
            f"{name}; leave it out, or give --format rosbag2 and a folder"
        )


def check_variants(name: str, variants: Sequence[tuple[str, str]]) -> None:
    """Refuse options that the format cannot store; variants: as of `RunInfo`."""
    given = dict(variants)
    is_file = plugin(name).SUFFIX is not None
    if "stamp" in given and not is_file and name != "rosbag2":
        raise UsageError(
            f"--stamp: expected start for {name}, whose scans have their start and end, found "
            f"{given['stamp']!r}; leave it out, or write messages (mcap, rosbag1, rosbag2)"
        )
    if "batching" in given and name in ROWS:
        raise UsageError(
            f"--batching: expected window for {name}, whose scans have no start and end, found "
            f"{given['batching']!r}; write another format"
        )


def check_compression(name: str, options: WriterOptions) -> None:
    """Refuse an unknown compression, or any for a format without."""
    text = options.compression
    if text == NO_COMPRESSION:
        return
    # Imported here: it loads numpy and the MCAP library.
    from mlbatch.writers.mcap_container import compression_of

    compression_of(text)
    if not plugin(name).COMPRESSES:
        raise UsageError(
            f"--compression: expected {NO_COMPRESSION} for {name}, found {text!r}; leave it out, "
            "or write a .mcap or rosbag2 output"
        )


def check_target(name: str, target: Path, options: WriterOptions, layout: str) -> None:
    """Refuse an output that could not be written; opens it and removes what that created."""
    # Imported here: it loads numpy.
    from mlbatch.types import RunInfo

    info = RunInfo((), "", "10", "unknown", layout=layout)
    open_writer(name, target, info, options._replace(split=False, files=None)).abandon()
    discard(target)
