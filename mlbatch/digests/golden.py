"""A golden file: an output described in JSON, a line a scan."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import mlbatch
from mlbatch.bounded import parse_json, read_text
from mlbatch.digests.fields import COLUMN_FIELDS, describe, fields_of
from mlbatch.digests.run import describe_run
from mlbatch.digests.values import Json, values
from mlbatch.errors import RecordingError
from mlbatch.outputs.read import read
from mlbatch.outputs.run_files import RunFiles
from mlbatch.outputs.scan import Scan
from mlbatch.outputs.table import read_table

SCHEMA = "mlbatch.digest/3"
# Schema 1 has no version; 1 and 2 have `four` for `samples`; the rest is the same.
_EARLIER = ("mlbatch.digest/1", "mlbatch.digest/2")
_STAMPS = ("first_stamp_ns", "last_stamp_ns")


def golden_of(output: Path) -> dict[str, Json]:
    """Describe an output; RecordingError where it is damaged."""
    report, table = RunFiles.of(output).texts()
    about: dict[str, Json] = {}
    scans: list[dict[str, Json]] = []
    stamps = _stamps(output, table)
    for scan in read(output):
        if not about:
            about = {"frame_id": scan.frame_id, "layout": scan.info.layout}
        scans.append(_scan(scan, stamps))
    if not scans:
        raise RecordingError(
            f"{output}: expected scans to describe, found none; see `mlbatch verify`"
        )
    return {"schema": SCHEMA, **about, "run": describe_run(output, report), "scans": [*scans]}


def _stamps(output: Path, table: str | None) -> dict[tuple[int, int], dict[str, Json]]:
    """First and last stamp of the scans by index and slice, from scans.csv."""
    if table is None:
        return {}
    rows = read_table(table, f"{output}: scans.csv")
    return {
        (int(row["index"]), int(row["slice"])): {name: int(row[name]) for name in _STAMPS}
        for row in rows
    }


def _scan(scan: Scan, stamps: dict[tuple[int, int], dict[str, Json]]) -> dict[str, Json]:
    is_organized = scan.info.layout == "organized"
    valid = scan.is_valid if is_organized else None
    fields: dict[str, Json] = {
        name: describe(array, None if name in COLUMN_FIELDS else valid)
        for name, array in fields_of(scan)
    }
    return {
        "index": scan.index,
        "slice": scan.slice,
        **({"sensor": scan.sensor} if scan.sensor else {}),
        "start_ns": scan.start_ns,
        "end_ns": scan.end_ns,
        "complete": scan.complete,
        "points": scan.point_count,
        "columns": list(scan.columns_per_sensor),
        "max_gap_ns": list(scan.max_gap_ns),
        "fill": values(scan.fill),
        **stamps.get((scan.index, scan.slice), {}),
        "fields": fields,
    }


# -- as a file --------------------------------------------------------------------------------


def golden_text(golden: dict[str, Json]) -> str:
    """A golden file: with the version that made it, and a line for each scan, for reviews."""
    head = {"schema": golden["schema"], "version": mlbatch.__version__}
    head |= {key: value for key, value in golden.items() if key != "scans"}
    text = json.dumps(head, indent=1, ensure_ascii=False, allow_nan=False)
    return text.removesuffix("\n}") + ',\n "scans": [\n' + ",\n".join(_lines(golden)) + "\n ]\n}\n"


def _lines(golden: dict[str, Json]) -> Iterator[str]:
    scans = golden["scans"]
    for scan in scans if isinstance(scans, list) else ():
        yield "  " + json.dumps(scan, ensure_ascii=False, allow_nan=False)


def read_golden(path: Path) -> dict[str, Json]:
    """Read a golden file; RecordingError for another file."""
    try:
        golden = parse_json(read_text(path))
    except (OSError, ValueError) as err:
        found = getattr(err, "strerror", None) or f"{type(err).__name__}: {err}"
        raise RecordingError(
            f"{path}: expected a golden file (JSON), found {found}; write one with "
            "`mlbatch digest OUTPUT -o FILE`"
        ) from err
    schema = golden.get("schema") if isinstance(golden, dict) else None
    if schema not in (SCHEMA, *_EARLIER) or not isinstance(golden.get("scans"), list):
        raise RecordingError(
            f"{path}: expected a golden file of the schema {SCHEMA}, found {schema!r}; write one "
            "with `mlbatch digest OUTPUT -o FILE`"
        )
    found_golden: dict[str, Json] = golden
    if schema in _EARLIER:
        _rename_samples(found_golden)
    return found_golden


def _rename_samples(golden: dict[str, Json]) -> None:
    scans = golden["scans"]
    for scan in scans if isinstance(scans, list) else ():
        fields = scan.get("fields") if isinstance(scan, dict) else None
        for field in fields.values() if isinstance(fields, dict) else ():
            if isinstance(field, dict) and "four" in field:
                field["samples"] = field.pop("four")
