"""Shards: each of N runs makes every Nth file of an output (`--shard K/N`), `mlbatch merge` joins.

Every shard reads and batches the whole recording, since the first look, the first window, losses
and clocks depend on all of it. It decodes and writes its own files only, which is what costs most;
see `files.py`. Its folder is that of one run with a part of the files and of the rows of scans.csv.
Instead of report.json it has `files.jsonl` and shard.json: the account of the whole recording, with
the points of its own scans. `merge` reads nothing but these folders: all accounts must be the same,
the sums of points complete the report.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from isal.isal_zlib import crc32

import mlbatch
from mlbatch.bounded import parse_json, read_text
from mlbatch.errors import ExportError, RecordingError, UsageError
from mlbatch.pipeline.files import Files, records
from mlbatch.pipeline.job import Shard
from mlbatch.pipeline.job_identity import difference, identity_of_parts
from mlbatch.pipeline.run_report import point_notes, refuse_all_removed
from mlbatch.reports.json_records import from_json, to_json
from mlbatch.reports.ledger import PointCounts
from mlbatch.reports.report import (
    RunReport,
    SensorReport,
    Timing,
    Warned,
    imbalances,
    report_text,
)
from mlbatch.reports.scan_table import ScanStatistics, merged_table
from mlbatch.writers import choose_format, has_several_files
from mlbatch.writers.atomic import (
    FILES_JSONL,
    METADATA,
    REPORT_JSON,
    SCANS_CSV,
    SHARD_JSON,
    discard,
    export_errors,
    partial_path,
    prepare,
    write_text,
)
from mlbatch.writers.bag_writer import name_of_file, number_of_file, write_metadata
from mlbatch.writers.base import WriterOptions
from mlbatch.writers.formats import built_in_names
from mlbatch.writers.output_file import file_crc

SCHEMA = "mlbatch.shard/4"
_KB_PER_MB = 1024
_AGAIN = "copy the part again, or convert this shard again with --overwrite"


def check_format(name: str, options: WriterOptions) -> None:
    """Raise UsageError for a format whose scans are in one file."""
    if has_several_files(name, options):
        return
    if name == "rosbag2":
        raise UsageError(
            "--shard: expected --max-bag-duration for rosbag2, since a shard writes whole files of "
            "the bag, found none; give --max-bag-duration 60"
        )
    raise not_in_files(name)


def not_in_files(name: str) -> UsageError:
    """The error about a format that writes one file; name: of the format."""
    formats = [one for one in built_in_names() if has_several_files(one, WriterOptions())]
    return UsageError(
        f"--shard: expected a format with several files ({', '.join(formats)}; "
        f"rosbag2 with --max-bag-duration), found {name}, one file for all scans; give --format "
        "npz and a folder, or --format rosbag2 --max-bag-duration 60"
    )


@dataclass(frozen=True, slots=True)
class Account:
    """Content of shard.json.

    identity: what all shards share, see `identity_of_parts`; content: checksum of what was read;
    windows: as of `Files`; total: number of scans of all shards, scans: of this one; table:
    CRC-32 of scans.csv; lists: CRC-32 of files about all scans, by path in the folder;
    notes_before_points: warnings of the report that precede those about points.
    """

    shard: Shard
    identity: dict[str, str]
    content: int
    format: str
    windows: int
    is_strict: bool
    total: int
    scans: int
    table: int
    lists: dict[str, int]
    notes_before_points: int
    report: RunReport

    def shared(self) -> dict[str, Any]:
        """Values that must be equal in the accounts of all shards, as JSON."""
        found = _fields(to_json(self))
        for name in ("shard", "scans", "table"):
            del found[name]
        report = found["report"]
        for name in ("timing", "command"):
            del report[name]
        for one in report["inputs"]:
            one["path"] = Path(one["path"]).name
        for sensor in report["sensors"]:
            del sensor["ledger"]["points"]
        for name in ("points", "no_points", "empty_clouds"):
            del report["scans"][name]
        return found


def write_account(
    folder: Path, name: str, options: WriterOptions, files: Files, report: RunReport
) -> None:
    """Write shard.json into the folder of a shard; name: of the format."""
    run = files.run
    if run is None or run.job.shard is None or run.table is None:
        return
    with export_errors(folder):
        own = {one for _, record in records(folder / FILES_JSONL) for one in record.crcs}
        own |= {FILES_JSONL, SCANS_CSV, METADATA}
        paths = filter(Path.is_file, folder.rglob("*"))
        others = {path.relative_to(folder).as_posix() for path in paths} - own
        lists = {one: file_crc(folder / one) for one in sorted(others)}
    account = Account(
        shard=run.job.shard,
        identity=identity_of_parts(files.identity),
        content=files.content,
        format=name,
        windows=files.windows,
        is_strict=run.job.strict,
        total=files.total,
        scans=files.scans,
        table=crc32(run.table.text().encode(), 0),
        lists=lists,
        notes_before_points=run.notes_before_points,
        report=report,
    )
    head = {"schema": SCHEMA, "version": mlbatch.__version__}
    text = json.dumps(head | _fields(to_json(account)), separators=(",", ":"))
    write_text(folder / SHARD_JSON, text + "\n", options.fsync)


def read_account(part: Path) -> Account:
    """The account of a shard; UsageError if there is none, RecordingError if it is damaged."""
    path = part / SHARD_JSON
    try:
        content = _fields(parse_json(read_text(path), has_nan=True))
    except FileNotFoundError:
        raise UsageError(f"{part}: expected the folder of a shard, found {_found(part)}") from None
    except NotADirectoryError:
        raise UsageError(
            f"{part}: expected the folder of a shard, found a file; name what convert --shard wrote"
        ) from None
    except OSError as err:
        raise RecordingError(
            f"{path}: expected a readable file, found {err.strerror!r}; check the disk"
        ) from err
    except ValueError as err:
        raise _damaged(path, str(err)) from err
    schema = content.pop("schema", None)
    version = content.pop("version", None)
    if schema != SCHEMA:
        raise UsageError(
            f"{path}: expected schema {SCHEMA}, found {schema!r}; name what convert --shard wrote"
        )
    if version != mlbatch.__version__:
        raise UsageError(
            f"{path}: expected a shard of mlbatch {mlbatch.__version__}, found one of "
            f"{version}; merge with that version, or convert again"
        )
    try:
        account: Account = from_json(Account, content)
    except (ValueError, TypeError) as err:
        raise _damaged(path, str(err)) from err
    return account


def _damaged(path: Path, why: str) -> RecordingError:
    return RecordingError(
        f"{path}: expected the account of a shard, found damaged content ({why}); convert this "
        "shard again with --overwrite"
    )


def _found(part: Path) -> str:
    partial = partial_path(part)
    if partial.exists():
        return f"that of an interrupted run ({partial.name}); run this shard again with --resume"
    if part.is_dir():
        return f"a folder without {SHARD_JSON}; name what convert --shard wrote"
    return "nothing; run the conversion of this shard, or check the name"


def _fields(found: object) -> dict[str, Any]:
    if not isinstance(found, dict):
        raise ValueError("no JSON object")
    return found


# -- merge -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Part:
    """The folder of a shard, its account, and the CRC-32 of its files by name."""

    folder: Path
    account: Account
    crcs: dict[str, int]


def _read_part(folder: Path) -> Part:
    account = read_account(folder)
    path = folder / FILES_JSONL
    crcs: dict[str, int] = dict(account.lists)
    scans = 0
    with _readable(path):
        for _, record in records(path):
            if not account.shard.has(record.unit[0]):
                raise RecordingError(
                    f"{folder}: expected the scans of shard {account.shard}, found others; convert "
                    "this shard again with --overwrite"
                )
            crcs |= record.crcs
            scans += len(record.scans)
    if any(Path(name).is_absolute() or ".." in Path(name).parts for name in crcs):
        raise RecordingError(f"{path}: expected files in {folder}, found others; {_AGAIN}")
    if scans != account.scans:
        raise RecordingError(
            f"{path}: expected the files of {account.scans} scans, found those of {scans}; {_AGAIN}"
        )
    return Part(folder, account, crcs)


@contextlib.contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Convert an OSError while a file of a part is read to a RecordingError of one line."""
    try:
        yield
    except OSError as err:
        raise RecordingError(
            f"{path}: expected a file of a shard, found {err.strerror!r}; {_AGAIN}"
        ) from err


def read_parts(folders: Sequence[Path]) -> list[Part]:
    """The parts of one conversion, by number; UsageError unless each is there once."""
    parts = [_read_part(folder if folder.name else folder.resolve()) for folder in folders]
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
    total = parts[0].account.total
    scans = sum(part.account.scans for part in parts)
    if scans != total:
        raise RecordingError(
            f"expected the {total} scans of the recording in {len(parts)} shards, found {scans}; "
            "convert all shards again"
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
    choose_format(target, parts[0].account.format)
    output = prepare(target, overwrite, folder=True, fsync=fsync)
    try:
        for part in parts:
            _take_files(part, output.partial, target.name)
        if parts[0].account.format == "rosbag2":
            _describe_bag(parts, output.partial, target.name)
        table = merged_table([_table(part) for part in parts])
        report = _merged_report(parts, command)
        broken = imbalances(report) or _unequal_points(report)
        if broken:
            raise RecordingError(
                f"the ledger does not balance: {broken[0]}; a shard.json was changed: convert all "
                "shards again, and report it if this remains"
            )
        write_text(output.partial / SCANS_CSV, table)
        output.sync()
        report = report._replace(timing=_timing(parts, report, began_s))
        write_text(output.partial / REPORT_JSON, report_text(report), fsync)
        output.publish()
    except BaseException:
        output.close()
        discard(target)
        raise
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


def _take_files(part: Part, folder: Path, stem: str) -> None:
    """Have the files of a part in a folder as well; stem: what those of a bag begin with.

    They are linked, or copied to another file system.
    """
    for name, crc in part.crcs.items():
        source = part.folder / name
        number = number_of_file(name) if part.account.windows else None
        path = folder / (name if number is None else name_of_file(stem, number))
        with _readable(source):
            found = file_crc(source)
        if found != crc:
            raise RecordingError(
                f"{source}: expected the bytes that the shard has written, found others; {_AGAIN}"
            )
        if path.exists():
            # A list of all scans, which every part has.
            continue
        with export_errors(path):
            path.parent.mkdir(exist_ok=True)
            with contextlib.suppress(OSError):
                # A link to what a symbolic link names: the output is whole without the part.
                os.link(source.resolve(), path)
                continue
            shutil.copyfile(source, path)


def _describe_bag(parts: Sequence[Part], folder: Path, stem: str) -> None:
    """Write metadata.yaml of a bag; RecordingError unless each of its files is in one part."""
    numbers = sorted(number_of_file(name) or 0 for part in parts for name in part.crcs)
    if numbers != list(range(len(numbers))):
        raise RecordingError(
            f"expected the files of a bag from 0 to {len(numbers) - 1} in {len(parts)} shards, "
            f"found {', '.join(map(str, numbers))}; convert all shards again"
        )
    with export_errors(folder):
        write_metadata(folder, stem, numbers)


def _table(part: Part) -> str:
    """The scans.csv of a part."""
    path = part.folder / SCANS_CSV
    with _readable(path):
        data = path.read_bytes()
    if crc32(data, 0) != part.account.table:
        raise RecordingError(
            f"{path}: expected the bytes that the shard has written, found others; {_AGAIN}"
        )
    return data.decode()


# -- the report -------------------------------------------------------------------------------


def _merged_report(parts: Sequence[Part], command: str) -> RunReport:
    """The report of one run, without timings."""
    account = parts[0].account
    earlier = account.report
    scans = _merged_scans(parts)
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


def _merged_scans(parts: Sequence[Part]) -> ScanStatistics:
    """The figures of all scans: those about points are sums of all shards."""
    each = [part.account.report.scans for part in parts]
    names = [sensor.name for sensor in parts[0].account.report.sensors]
    no_points = {name: sum(scans.no_points.get(name, 0) for scans in each) for name in names}
    return each[0]._replace(
        no_points={name: count for name, count in no_points.items() if count},
        empty_clouds=sum(scans.empty_clouds for scans in each),
        points=sum(scans.points for scans in each),
    )


def _merged_sensor(parts: Sequence[Part], number: int) -> SensorReport:
    """The report of a sensor with the points of all shards."""
    points = PointCounts()
    for part in parts:
        points.add(part.account.report.sensors[number].ledger.points.counters)
    sensor = parts[0].account.report.sensors[number]
    return sensor._replace(ledger=replace(sensor.ledger, points=points))


def _unequal_points(report: RunReport) -> list[str]:
    """Imbalance between points of scans and points of sensors, as a line."""
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
    )
