"""`mlbatch merge`: the folders of all shards to the output of one run.

Nothing is read but the folders. Every shard has made the account of the whole recording: all must
be the same. Each has the points of its own scans, whose sum completes the report.
"""

from __future__ import annotations

import contextlib
import heapq
import os
import resource
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mlbatch.errors import ExportError, RecordingError, UsageError
from mlbatch.pipeline import resume
from mlbatch.pipeline.job_identity import difference
from mlbatch.pipeline.point_notes import point_notes, refuse_all_removed
from mlbatch.pipeline.shard_part import Account, ShardScan, read_account
from mlbatch.pipeline.state_file import State, StateFile, state_path
from mlbatch.report.ledger import PointCounts
from mlbatch.report.report import (
    RunReport,
    SensorReport,
    Timing,
    Warned,
    fill_totals,
    imbalances,
    report_text,
)
from mlbatch.report.scan_table import ScanTable
from mlbatch.types import Summary
from mlbatch.writers import (
    REPORT_JSON,
    ScanWriter,
    WriterOptions,
    check_name,
    choose_format,
    discard,
    export_errors,
    open_writer,
    write_text,
)
from mlbatch.writers.scan_folder import FolderWriter, checksum_of

_KB_PER_MB = 1024


@dataclass(frozen=True, slots=True)
class Part:
    """The folder of a shard and its account."""

    folder: Path
    account: Account


def read_parts(folders: Sequence[Path]) -> list[Part]:
    """The parts of one conversion, by number; UsageError unless each is there once."""
    parts = [Part(folder, read_account(folder)) for folder in folders]
    first = parts[0]
    count = first.account.shard.count
    for part in parts[1:]:
        if part.account.shard.count != count:
            raise UsageError(
                f"{part.folder}: expected one of {count} shards as {first.folder}, found shard "
                f"{part.account.shard}; name the parts of one conversion"
            )
        changed = difference(first.account.identity, part.account.identity)
        if changed:
            raise UsageError(
                f"{part.folder}: expected the job of {first.folder}, found {changed}; name the "
                "parts of one conversion"
            )
    by_number: dict[int, Part] = {}
    for part in parts:
        number = part.account.shard.number
        if number in by_number:
            raise UsageError(
                f"{part.folder}: expected every shard once, found {part.account.shard} also in "
                f"{by_number[number].folder}; leave one of them out"
            )
        by_number[number] = part
    missing = [f"{number}/{count}" for number in range(1, count + 1) if number not in by_number]
    if missing:
        more = f" and {len(missing) - 8} more" if len(missing) > 8 else ""
        raise UsageError(
            f"expected all {count} shards, found {len(parts)}: {', '.join(missing[:8])}{more} "
            "missing; name the folders of all"
        )
    ordered = [by_number[number] for number in sorted(by_number)]
    _check_same(ordered)
    return ordered


def _check_same(parts: Sequence[Part]) -> None:
    """Raise RecordingError unless all shards have read and batched the same."""
    expected = parts[0].account.shared()
    for part in parts[1:]:
        found = _first_difference("", expected, part.account.shared())
        if found:
            raise RecordingError(
                f"{part.folder}: expected the account of {parts[0].folder}, found another: "
                f"{found}; a recording was changed: convert both shards again"
            )
    slices = parts[0].account.info.slices
    for part in parts:
        shard = part.account.shard
        if not all(shard.has(scan.index, scan.slice, slices) for scan in part.account.scans):
            raise RecordingError(
                f"{part.folder}: expected the scans of shard {shard}, found others; convert this "
                "shard again with --overwrite"
            )
    total = parts[0].account.total
    numbers = [scan.number for _, scan in _merged_scans(parts)]
    if numbers != list(range(total)):
        raise RecordingError(
            f"expected the {total} scans of the recording in {len(parts)} shards, found "
            f"{len(numbers)}; convert all shards again"
        )


def _first_difference(where: str, expected: Any, found: Any) -> str:
    """The first difference of JSON values, as text; "" if they are equal. NaN equals NaN."""
    if isinstance(expected, Mapping) and isinstance(found, Mapping):
        keys = list(dict.fromkeys([*expected, *found]))
        pairs = [(f"{where}.{key}", expected.get(key), found.get(key)) for key in keys]
    elif isinstance(expected, list) and isinstance(found, list):
        if len(expected) != len(found):
            return f"{where.lstrip('.')}: {len(found)} instead of {len(expected)} values"
        both = enumerate(zip(expected, found, strict=True))
        pairs = [(f"{where}[{number}]", one, other) for number, (one, other) in both]
    else:
        is_same = expected == found or repr(expected) == repr(found)
        return "" if is_same else f"{where.lstrip('.')} {found!r} instead of {expected!r}"
    differences = (_first_difference(*pair) for pair in pairs)
    return next((one for one in differences if one), "")


# -- the output -------------------------------------------------------------------------------


def merge(
    parts: Sequence[Part], target: Path, *, command: str, overwrite: bool, fsync: bool
) -> RunReport:
    """Make the output of one run from all parts, which stay; returns its report.

    parts: of `read_parts`; command: for the report.
    """
    began_s = time.perf_counter(), time.process_time()
    _check_apart(parts, target)
    check_name(target)
    choose_format(target, parts[0].account.format)
    # A run that writes this output is an error; what an interrupted one left is replaced.
    resume.find(target)
    resume.forget(target)
    account = parts[0].account
    options = WriterOptions(
        overwrite=overwrite,
        split=account.is_split,
        ply_style=account.ply_style,
        fsync=fsync,
        max_bag_s=account.max_bag_s,
    )
    lock = StateFile(state_path(target), State({}, ""), is_new=True)
    try:
        writer = open_writer(account.format, target, account.info, options)
        if isinstance(writer, FolderWriter):
            _take_scans(parts, writer)
        else:
            _take_bag(parts, writer)
        table = ScanTable(account.info, account.columns_per_s)
        for _, figures in _merged_scans(parts):
            table.add(figures.scan(account.info), figures.checksum)
        report = _merged_report(parts, table, command)
        broken = imbalances(report) or _unequal_points(report)
        if broken:
            raise RecordingError(
                f"the ledger does not balance: {broken[0]}; a shard.json was changed: convert all "
                "shards again, and report it if this remains"
            )
        summary = Summary(
            report.t_init_ns,
            report_text(report, machine=False),
            table.text(),
            fill_totals(report),
        )

        def complete(partial: Path) -> None:
            nonlocal report
            report = report._replace(timing=_timing(parts, report, began_s))
            write_text(partial / REPORT_JSON, report_text(report), fsync)

        writer.finish(summary, complete)
    except BaseException:
        discard(target)
        raise
    finally:
        lock.remove()
    return report


def _check_apart(parts: Sequence[Part], target: Path) -> None:
    """Raise ExportError for an output that would replace or contain a part, or be in one."""
    place = target.resolve()
    for part in parts:
        own = part.folder.resolve()
        if place == own or own in place.parents or place in own.parents:
            raise ExportError(
                f"{target}: expected an output apart from the parts, found {part.folder}; choose "
                "another name"
            )


def _merged_scans(parts: Sequence[Part]) -> Iterator[tuple[Part, ShardScan]]:
    """All scans in order, each with the part that has it."""
    scans = (
        [(scan.number, number, scan) for scan in part.account.scans]
        for number, part in enumerate(parts)
    )
    for _, number, scan in heapq.merge(*scans, key=lambda one: one[:2]):
        yield parts[number], scan


def _take_scans(parts: Sequence[Part], writer: FolderWriter) -> None:
    """Have the files of all scans in the output."""
    info = parts[0].account.info
    for owner, figures in _merged_scans(parts):
        scan = figures.scan(info)
        sources: list[Path] = []
        for path in writer.files(scan, figures.only).values():
            name = path.relative_to(writer.folder)
            sources.append(owner.folder / name)
            _take(sources[-1], owner.account.files.get(name.as_posix()), path)
        _check_bytes(sources, figures.checksum)
        writer.skip(scan, figures.only).commit()


def _take_bag(parts: Sequence[Part], writer: ScanWriter) -> None:
    """Have the files of a bag in the output; RecordingError unless each is in one part."""
    from mlbatch.writers.bag_metadata import read_file
    from mlbatch.writers.bag_writer import BagWriter, number_of_file

    account = parts[0].account
    if not isinstance(writer, BagWriter):
        raise UsageError(f"{account.format}: expected a format with several files, found another")
    owners = [
        (number_of_file(name), part.folder / name, size, part.account.checksums.get(name))
        for part in parts
        for name, size in part.account.files.items()
    ]
    numbers = sorted(-1 if number is None else number for number, *_ in owners)
    if numbers != list(range(account.bag_files)):
        raise RecordingError(
            f"expected the {account.bag_files} files of the bag in {len(parts)} shards, found "
            f"{len(numbers)}; convert all shards again"
        )
    for number, source, size, checksum in owners:
        _take(source, size, writer.path_of_file(number or 0))
        _check_bytes([source], checksum)
        # An error names the part, not the output.
        read_file(source)
    writer.adopt_files(account.bag_files)


def _take(source: Path, size: int | None, path: Path) -> None:
    """Have a file of a part in the output as well: linked, or copied to another file system."""
    try:
        found = source.stat().st_size
    except OSError as err:
        raise RecordingError(
            f"{source}: expected a file of a scan, found {err.strerror!r}; copy the part again, or "
            "convert this shard again with --overwrite"
        ) from err
    if found != size:
        raise RecordingError(
            f"{source}: expected {size} bytes, found {found}; copy the part again, or convert this "
            "shard again with --overwrite"
        )
    with export_errors(path):
        with contextlib.suppress(OSError):
            # A link to what a symbolic link names: the output is whole without the part.
            os.link(source.resolve(), path)
            return
        shutil.copyfile(source, path)


def _check_bytes(sources: Sequence[Path], checksum: int | None) -> None:
    """Compare files of a part with their checksum."""
    if checksum_of(sources) != checksum:
        raise RecordingError(
            f"{sources[0]}: expected the bytes that the shard has written, found others; copy the "
            "part again, or convert this shard again with --overwrite"
        )


# -- the report -------------------------------------------------------------------------------


def _merged_report(parts: Sequence[Part], table: ScanTable, command: str) -> RunReport:
    """The report of one run, without timings."""
    account = parts[0].account
    earlier = account.report
    scans = table.statistics(earlier.scans.empty, earlier.scans.dropped_incomplete)
    sensors = tuple(_merged_sensor(parts, number) for number in range(len(earlier.sensors)))
    where = ", ".join(one.path for one in earlier.inputs)
    refuse_all_removed(where, [one.ledger.points for one in sensors])
    notes = tuple(
        Warned(note.code, note.sensor, note.message)
        for note in point_notes([(one.name, one.ledger.points) for one in sensors], scans)
    )
    if notes and account.is_strict:
        raise RecordingError(f"{notes[0].message} ({notes[0].code}, an error because of --strict)")
    before = account.notes_before_points
    warnings = (*earlier.warnings[:before], *notes, *earlier.warnings[before:])
    commands = [part.account.report.command for part in parts]
    return earlier._replace(
        sensors=sensors,
        scans=scans,
        warnings=warnings,
        timing=None,
        command=" && ".join([*commands, command]),
        identity=account.identity,
    )


def _merged_sensor(parts: Sequence[Part], number: int) -> SensorReport:
    """The report of a sensor with the points of all shards."""
    points = PointCounts()
    for part in parts:
        points.add(part.account.report.sensors[number].ledger.points.counters)
    sensor = parts[0].account.report.sensors[number]
    return sensor._replace(ledger=replace(sensor.ledger, points=points))


def _unequal_points(report: RunReport) -> list[str]:
    """Points of the scans that are not those of the sensors, as a line."""
    written = sum(sensor.ledger.points.written for sensor in report.sensors)
    if written == report.scans.points:
        return []
    return [f"points: expected {report.scans.points} of all scans, found {written} of all sensors"]


def _timing(parts: Sequence[Part], report: RunReport, began_s: tuple[float, float]) -> Timing:
    """Costs of all shards and of the merge; the time is that of the longest shard and the merge."""
    shards = [part.account.report.timing for part in parts]
    known = [timing for timing in shards if timing is not None]
    own_s = time.perf_counter() - began_s[0]
    wall_s = max(timing.wall_s for timing in known) + own_s
    engines = dict.fromkeys(timing.engine for timing in known)
    own_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / _KB_PER_MB
    return Timing(
        wall_s=wall_s,
        cpu_s=sum(timing.cpu_s for timing in known) + time.process_time() - began_s[1],
        read_s=sum(timing.read_s for timing in known),
        decode_s=sum(timing.decode_s for timing in known),
        merge_s=sum(timing.merge_s for timing in known),
        write_s=sum(timing.write_s for timing in known) + own_s,
        recorded_s=known[0].recorded_s,
        points_per_s=report.scans.points / wall_s if wall_s > 0 else 0.0,
        peak_rss_mb=max(own_mb, *(timing.peak_rss_mb for timing in known)),
        engine=", ".join(engines),
    )
