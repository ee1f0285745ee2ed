"""Python values of options to a `Job`, whose fields are those of the command line."""

from __future__ import annotations

import atexit
import difflib
import inspect
import json
import math
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from fractions import Fraction
from numbers import Integral, Real
from os import PathLike, fspath
from pathlib import Path
from typing import Any, Literal, TypeAlias, TypedDict, TypeVar

import numpy as np

from mlbatch.discovery.discover import SensorSelection
from mlbatch.errors import UsageError
from mlbatch.options import CONVERT, INSTANTS, NUMBER, WHOLE, Option
from mlbatch.pipeline.job import (
    Job,
    check_batching,
    check_deskew,
    check_ranges_m,
    check_sort,
    wait_ns,
)
from mlbatch.pipeline.output import OutputRequest
from mlbatch.readers.inputs import expand
from mlbatch.rig.convert_keys import POSE_MODELS
from mlbatch.sensors.options import check_options
from mlbatch.units import parse_rate
from mlbatch.writers.threads import parse_jobs

AnyPath: TypeAlias = "str | PathLike[str]"
# One path or several: a text is one, never an iterable of its letters.
Paths: TypeAlias = "AnyPath | Iterable[AnyPath]"
Names: TypeAlias = "str | Iterable[str]"
Rate: TypeAlias = int | float | str | Fraction
# A document instead of its file.
Document: TypeAlias = "AnyPath | Mapping[str, Any]"
# By name, or without names.
Documents: TypeAlias = "Paths | Mapping[str, Mapping[str, Any]] | Iterable[Document]"
# Nanoseconds of the common clock; or a text as on the command line: ISO time, epoch seconds, +S.
Moment: TypeAlias = int | str
Box: TypeAlias = "tuple[float, float, float, float, float, float]"

F = TypeVar("F", bound=Callable[..., Any])

_BOX_VALUES = 6
# Of rigs: keys of files.
_PATH_KEYS = ("metadata", "file", "deskew")


def paths_of(what: str, values: Paths) -> tuple[Path, ...]:
    """One or several paths as a tuple."""
    if isinstance(values, str | PathLike):
        return (_path(what, values),)
    if not isinstance(values, Iterable):
        raise _no_path(what, values)
    return tuple(_path(what, value) for value in values)


def recordings_of(recordings: Paths | tuple[Paths, ...]) -> tuple[Path, ...]:
    """The recordings of a session, at least one; patterns and folders are expanded."""
    several = recordings if isinstance(recordings, tuple) else (recordings,)
    found = expand(path for one in several for path in paths_of("recording", one))
    if not found:
        raise UsageError("recording: expected at least one path, found none; name a recording")
    return found


def path_of(what: str, value: AnyPath | None) -> Path | None:
    """A path, or None."""
    return None if value is None else _path(what, value)


def rig_path(value: Document | None) -> Path | None:
    """The rig file; one that is given as a mapping is written first."""
    return (
        _written("rig", "rig.yaml", value) if isinstance(value, Mapping) else path_of("rig", value)
    )


def metadata_paths(values: Documents | None) -> tuple[Path, ...]:
    """Files of metadata; those given as mappings, alone or by name, are written first."""
    if values is None:
        return ()
    if isinstance(values, Mapping):
        return tuple(_written("metadata", f"{name}.json", one) for name, one in values.items())
    if isinstance(values, str | PathLike) or not isinstance(values, Iterable):
        return paths_of("metadata", values)
    return tuple(
        _written("metadata", f"metadata{number}.json", one)
        if isinstance(one, Mapping)
        else _path("metadata", one)
        for number, one in enumerate(values)
    )


def _written(what: str, name: str, document: object) -> Path:
    """A file with a document, until the process ends; in it paths are absolute."""
    if not isinstance(document, Mapping) or Path(name).name != name:
        raise UsageError(
            f"{what}: expected a document by its name, found {document!r:.40} by {name!r}; give "
            "{'left': {...}}, or a list of documents"
        )
    try:
        text = json.dumps(_with_paths(document), allow_nan=False)
    except (TypeError, ValueError) as err:
        raise UsageError(f"{what}: expected values of JSON, found {err}; correct it") from err
    folder = tempfile.mkdtemp(prefix="mlbatch-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    path = Path(folder, name)
    path.write_text(text, encoding="utf-8")
    return path


def _with_paths(value: object, key: str = "") -> object:
    """The value with the paths of a rig from the current folder instead of that of its file."""
    if isinstance(value, Mapping):
        return {name: _with_paths(one, name) for name, one in value.items()}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [_with_paths(one, key) for one in value]
    if key in _PATH_KEYS and isinstance(value, str | PathLike) and value not in POSE_MODELS:
        return str(Path(fspath(value)).absolute())
    return value


def names_of(values: Names | None) -> tuple[str, ...]:
    """One or several names as a tuple."""
    return (values,) if isinstance(values, str) else tuple(values or ())


def _path(what: str, value: object) -> Path:
    if not isinstance(value, str | PathLike):
        raise _no_path(what, value)
    return Path(fspath(value))


def _no_path(what: str, value: object) -> UsageError:
    return UsageError(
        f"{what}: expected a path (str or Path) or several, found {type(value).__name__}; "
        "give the name of a file"
    )


def choice(option: str, value: str, known: Iterable[str]) -> str:
    """An option with a closed list of words."""
    words = tuple(known)
    if value not in words:
        raise UsageError(f"{option}: expected {' or '.join(words)}, found {value!r}; choose one")
    return value


class SessionOptions(TypedDict, total=False):
    """Options that select recordings and sensors, with the names of `mlbatch convert`."""

    rig: Document | None
    dataset: str | None  # a recipe of `mlbatch datasets`
    metadata: Documents | None
    only: Names | None
    ignore: Names | None
    identity_extrinsics: bool
    clock: str
    align_clocks: bool
    align_to: str
    decode: Mapping[str, str] | None
    strict: bool


class WindowOptions(TypedDict, total=False):
    """Options of windows and points but the rate; max_wait: s, ranges and boxes: m."""

    start: Moment | None
    end: Moment | None
    slices: int
    layout: str
    sort: str
    split: bool
    keep_partial: bool
    drop_incomplete: float  # percent
    max_wait: float | str  # as on the command line: a number, or inf
    min_range: float
    max_range: float
    exclude_boxes: Iterable[Box]
    keep_repeated: bool
    batching: str
    batching_times: str
    deskew: AnyPath | None  # "imu", "constant-velocity", or the path of a trajectory
    deskew_to: str | None
    no_pose_check: bool


class RatedOptions(WindowOptions, total=False):
    """Options of windows and points."""

    rate: Rate | None  # Hz


class ScanOptions(SessionOptions, RatedOptions, total=False):
    """Options of scans."""


class OutputOptions(TypedDict, total=False):
    """Options of an output."""

    copy_topics: Names | None
    stamp: str
    format: str | None
    point_layout: str
    compression: str
    ply_style: str
    max_bag_duration: float  # s of recording in a file of a bag; 0: all in one file
    accumulate: AnyPath | None  # a map; with output None, the map alone
    voxel: float | None  # m, of the map
    crs: str | None  # of the map, as EPSG:32633
    overwrite: bool
    fsync: bool  # wait until the output is on the disk
    report: AnyPath | None
    jobs: int | Literal["auto"]


class ConvertOptions(ScanOptions, OutputOptions, total=False):
    """Options of a conversion."""


def check_names(call: str, options: Mapping[str, object], *tables: type) -> None:
    """Raise UsageError for an option that a function does not have."""
    known = sorted(_names_of(tables))
    for name in options:
        if name == "engine":
            text = f"{call}: engine is ignored, since everything is compiled; leave it out"
            warnings.warn(text, DeprecationWarning, stacklevel=3)
            continue
        if name not in known:
            close = difflib.get_close_matches(name, known, 1)
            remedy = f"write {close[0]}, or see" if close else "see"
            raise UsageError(
                f"{call}: expected an option of this function, found {name!r}; "
                f"{remedy} docs/python.md"
            )


def documented(*tables: type) -> Callable[[F], F]:
    """Give the keywords of tables to `help` and to completion."""

    def with_signature(function: F) -> F:
        signature = inspect.signature(function)
        kept = [one for one in signature.parameters.values() if one.kind != one.VAR_KEYWORD]
        kept += [
            inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=...)
            for name in _names_of(tables)
        ]
        function.__signature__ = signature.replace(parameters=kept)  # type: ignore[attr-defined]
        return function

    return with_signature


def _names_of(tables: Iterable[type]) -> list[str]:
    return [name for table in tables for name in table.__annotations__]


def complete(options: Mapping[str, Any], shown: Callable[[str], str]) -> dict[str, Any]:
    """All options of the table with the values given, else their defaults.

    shown: the name of an option in errors. Raises UsageError for words that an option does not
    have, and for numbers beyond its bounds.
    """
    values: dict[str, Any] = {option.name: option.default for option in CONVERT}
    values |= options
    for option in CONVERT:
        value = values[option.name]
        if value is None and option.default is None:
            continue
        if option.words and not option.is_open:
            choice(shown(option.name), value, option.words)
        elif option.kind in (NUMBER, WHOLE):
            _check_number(option, value, shown(option.name))
    return values


def _check_number(option: Option, value: Any, shown: str) -> None:
    kind = Integral if option.kind == WHOLE else Real
    high = math.inf if option.high is None else option.high
    is_number = isinstance(value, kind) and not isinstance(value, bool)
    if not (is_number and (option.low or 0) <= value <= high):
        remedy = "correct it" if option.default is None else f"leave it out for {option.default:g}"
        raise UsageError(f"{shown}: expected {option.bounds}, found {value!r}; {remedy}")


def session_job(
    recordings: Paths | tuple[Paths, ...],
    options: SessionOptions,
    shown: Callable[[str], str] = str,
) -> Job:
    """The options that select recordings and sensors; those of windows have their defaults.

    shown: the name of an option in errors.
    """
    values = complete(options, shown)
    rig = rig_path(values["rig"])
    if values["dataset"] is not None:
        # Few runs have it.
        from mlbatch.rig.recipes import rig_of

        rig = rig_of(rig, values["dataset"], shown("dataset"))
    aligned = values["align_clocks"]
    return Job(
        recordings=recordings_of(recordings),
        selection=SensorSelection(
            rig=rig,
            metadata=metadata_paths(values["metadata"]),
            only=names_of(values["only"]),
            ignore=names_of(values["ignore"]),
            identity_extrinsics=values["identity_extrinsics"],
            host_clock=values["clock"] == "host",
            aligned=aligned,
            decode=_decode(values["decode"] or ()),
        ),
        align_clocks_to=values["align_to"] if aligned else "",
        strict=values["strict"],
    )


def window_job(job: Job, options: RatedOptions, shown: Callable[[str], str] = str) -> Job:
    """A job with the options of windows and points; shown: the name of an option in errors."""
    values = complete(options, shown)
    rate, deskew_to = values["rate"], values["deskew_to"]
    low, high = float(values["min_range"]), float(values["max_range"])
    check_ranges_m(shown("min_range"), low, shown("max_range"), high)
    first, last = values["start"], values["end"]
    start, end, are_dates = None, None, False
    if first is not None or last is not None:
        # Not loaded for whole recordings.
        from mlbatch.pipeline.time_limits import limits_of

        start, end, are_dates = limits_of(shown("start"), first, shown("end"), last)
    # Python has a list of boxes; the command line repeats one.
    boxes = "exclude_boxes" if "exclude_boxes" in values else "exclude_box"
    job = replace(
        job,
        # By the text of a float: 29.97 means 2997/100, not the nearest binary number.
        rate=None if rate is None else parse_rate(str(rate), shown("rate")),
        slices=int(values["slices"]),
        layout=values["layout"],
        sort=check_sort(shown("sort"), values["sort"], values["layout"]),
        split=values["split"],
        keep_partial=values["keep_partial"],
        keep_repeated=values["keep_repeated"],
        drop_incomplete=float(values["drop_incomplete"]),
        max_wait_ns=wait_ns(shown("max_wait"), values["max_wait"]),
        start=start,
        end=end,
        limits_are_dates=are_dates,
        min_range_m=low,
        max_range_m=high,
        boxes_m=tuple(box_m(shown(boxes), box) for box in values[boxes] or ()),
        batching=values["batching"],
        batching_times=values["batching_times"],
        deskew=str(path_of("deskew", values["deskew"] or None) or ""),
        checks_poses=not values["no_pose_check"],
        deskew_to=deskew_to or INSTANTS[0],
    )
    return check_deskew(check_batching(job), deskew_to is not None)


def output_job(job: Job, options: OutputOptions, shown: Callable[[str], str] = str) -> Job:
    """A job with the options of messages and files; shown: the name of an option in errors."""
    values = complete(options, shown)
    return replace(
        job,
        passed=names_of(values.get("copy_topics", values["pass"])),
        stamp=values["stamp"],
        max_bag_s=float(values["max_bag_duration"]),
    )


def output_request(
    path: Path | None, options: OutputOptions, shown: Callable[[str], str] = str
) -> OutputRequest:
    """Where a result goes, and how it is stored; shown: the name of an option in errors."""
    values = complete(options, shown)
    same = ("format", "point_layout", "compression", "ply_style", "voxel", "crs", "overwrite")
    return OutputRequest(
        path,
        **{name: values[name] for name in (*same, "dry_run", "resume")},
        jobs=parse_jobs(shown("jobs"), str(values["jobs"])),
        report=path_of("report", values["report"]),
        accumulate=path_of("accumulate", values["accumulate"]),
        fsync=values.get("fsync", not values["no_fsync"]),
    )


def _decode(given: Mapping[str, str] | Iterable[str]) -> dict[str, str]:
    """Options of decoders: by their names, or as texts KEY=VALUE."""
    if not isinstance(given, Mapping):
        given = dict(text.partition("=")[::2] for text in given)
    check_options(given)
    return dict(given)


def box_m(option: str, values: Box | str) -> tuple[float, ...]:
    """An excluded box, m: numbers, or a text with commas between them; option: for errors."""
    numbers = values.split(",") if isinstance(values, str) else values
    try:
        box = tuple(map(float, numbers)) if isinstance(numbers, Iterable) else ()
    except (TypeError, ValueError):
        box = ()
    if len(box) != _BOX_VALUES or not all(a < b for a, b in zip(box[:3], box[3:], strict=True)):
        raise UsageError(
            f"{option}: expected x0,y0,z0,x1,y1,z1 in metres with x0 < x1, y0 < y1, z0 < z1, "
            f"found {values!r}; write -1,-1,0,1,1,2"
        )
    return box
