"""Shards: each of N runs makes every Nth file of an output (`--shard K/N`), `mlbatch merge` joins.

Every shard reads and batches the whole recording, since the first look, the first window, losses
and clocks depend on all of it. It decodes and writes its own files only, which is what costs most;
see `files.py`. Its folder is that of one run with a part of the files and of the rows of scans.csv.
Instead of report.json it has `files.jsonl` and shard.json: the account of the whole recording, with
the points of its own scans. From those of all shards the report follows.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from isal.isal_zlib import crc32

import mlbatch
from mlbatch.bounded import parse_json, read_text
from mlbatch.errors import RecordingError, UsageError
from mlbatch.pipeline.files import Files, records
from mlbatch.pipeline.job import Shard
from mlbatch.pipeline.job_identity import identity_of_parts
from mlbatch.reports.json_records import from_json, to_json
from mlbatch.reports.report import RunReport
from mlbatch.writers import has_several_files
from mlbatch.writers.atomic import (
    FILES_JSONL,
    METADATA,
    SCANS_CSV,
    SHARD_JSON,
    export_errors,
    partial_path,
    write_text,
)
from mlbatch.writers.base import WriterOptions
from mlbatch.writers.formats import built_in_names
from mlbatch.writers.output_file import file_crc

SCHEMA = "mlbatch.shard/4"


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
