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
from numbers import Real
from os import PathLike, fspath
from pathlib import Path
from typing import Any, Literal, TypeAlias, TypedDict, TypeVar

import numpy as np

from mlbatch.discovery.discover import SensorSelection
from mlbatch.errors import UsageError
from mlbatch.options import ALIGN_TO, CLOCKS, INSTANTS, LAYOUTS
from mlbatch.pipeline.job import (
    Job,
    check_batching,
    check_deskew,
    check_ranges_m,
    check_slices,
    check_sort,
    wait_ns,
)
from mlbatch.readers.inputs import expand
from mlbatch.rig.convert_keys import POSE_MODELS
from mlbatch.units import parse_rate

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


def metadata_paths(values: Documents) -> tuple[Path, ...]:
    """Files of metadata; those given as mappings, alone or by name, are written first."""
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


def names_of(values: Names) -> tuple[str, ...]:
    """One or several names as a tuple."""
    return (values,) if isinstance(values, str) else tuple(values)


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
    metadata: Documents
    only: Names
    ignore: Names
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

    copy_topics: Names
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
                f"{call}: expected an option of `mlbatch convert` that it has, found {name!r}; "
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


def _as_in_python(name: str) -> str:
    return name


def session_job(
    recordings: Paths | tuple[Paths, ...],
    options: SessionOptions,
    shown: Callable[[str], str] = _as_in_python,
) -> Job:
    """The options that select recordings and sensors; those of windows have their defaults.

    shown: the name of an option in errors.
    """
    clock = choice(shown("clock"), options.get("clock", "sensor"), CLOCKS)
    align_to = choice(shown("align_to"), options.get("align_to", "host"), ALIGN_TO)
    aligned = options.get("align_clocks", False)
    rig = rig_path(options.get("rig"))
    if options.get("dataset") is not None:
        # Few runs have it.
        from mlbatch.rig.recipes import rig_of

        rig = rig_of(rig, options["dataset"], shown("dataset"))
    return Job(
        recordings=recordings_of(recordings),
        selection=SensorSelection(
            rig=rig,
            metadata=metadata_paths(options.get("metadata", ())),
            only=names_of(options.get("only", ())),
            ignore=names_of(options.get("ignore", ())),
            identity_extrinsics=options.get("identity_extrinsics", False),
            host_clock=clock == "host",
            aligned=aligned,
            decode=dict(options.get("decode") or {}),
        ),
        align_clocks_to=align_to if aligned else "",
        strict=options.get("strict", False),
    )


def window_job(job: Job, options: RatedOptions, shown: Callable[[str], str] = _as_in_python) -> Job:
    """A job with the options of windows and points; shown: the name of an option in errors."""
    layout = choice(shown("layout"), options.get("layout", "dense"), LAYOUTS)
    rate = options.get("rate")
    deskew_to = options.get("deskew_to")
    low = _number(shown("min_range"), options.get("min_range", 0.0))
    high = _number(shown("max_range"), options.get("max_range", math.inf))
    check_ranges_m(shown("min_range"), low, shown("max_range"), high)
    drop_incomplete = _number(shown("drop_incomplete"), options.get("drop_incomplete", 0.0))
    if not 0 <= drop_incomplete <= 100:
        raise UsageError(
            f"{shown('drop_incomplete')}: expected a share from 0 to 100 %, found "
            f"{drop_incomplete:g}; correct it"
        )
    first, last = options.get("start"), options.get("end")
    start, end, are_dates = None, None, False
    if first is not None or last is not None:
        # Not loaded for whole recordings.
        from mlbatch.pipeline.time_limits import limits_of

        start, end, are_dates = limits_of(shown("start"), first, shown("end"), last)
    job = replace(
        job,
        # By the text of a float: 29.97 means 2997/100, not the nearest binary number.
        rate=None if rate is None else parse_rate(str(rate)),
        slices=check_slices(shown("slices"), options.get("slices", 1)),
        layout=layout,
        sort=check_sort(shown("sort"), options.get("sort", "columns"), layout),
        split=options.get("split", False),
        keep_partial=options.get("keep_partial", False),
        keep_repeated=options.get("keep_repeated", False),
        drop_incomplete=drop_incomplete,
        max_wait_ns=read_wait_ns(shown("max_wait"), options.get("max_wait", 1.0)),
        start=start,
        end=end,
        limits_are_dates=are_dates,
        min_range_m=low,
        max_range_m=high,
        boxes_m=tuple(_box(box) for box in options.get("exclude_boxes", ())),
        batching=options.get("batching", "window"),
        batching_times=options.get("batching_times", "common"),
        deskew=str(path_of("deskew", options.get("deskew")) or ""),
        checks_poses=not options.get("no_pose_check", False),
        deskew_to=choice(shown("deskew_to"), deskew_to or INSTANTS[0], INSTANTS),
    )
    return check_deskew(check_batching(job), deskew_to is not None)


def read_wait_ns(option: str, given: float | str) -> int | None:
    """`--max-wait`: seconds, or inf; None: infinite."""
    try:
        seconds = float(given)
    except (TypeError, ValueError):
        seconds = math.nan
    return wait_ns(option, seconds, given)


def _number(option: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, Real):
        raise UsageError(f"{option}: expected a number, found {value!r}; correct it")
    return float(value)


def _box(values: Box) -> tuple[float, ...]:
    try:
        box = tuple(map(float, values)) if isinstance(values, Iterable) else ()
    except (TypeError, ValueError):
        box = ()
    if len(box) != _BOX_VALUES or not all(a < b for a, b in zip(box[:3], box[3:], strict=True)):
        raise UsageError(
            "exclude_boxes: expected (x0, y0, z0, x1, y1, z1) in metres with x0 < x1, y0 < y1, "
            f"z0 < z1, found {values!r}; correct it"
        )
    return box
