"""`convert:` of a rig file: options of `mlbatch convert` that are kept with the rig.

Named as on the command line, with _ for -. What is of one run alone (paths, --dry-run, --resume,
--overwrite) and what the rig has keys for (--rate, --metadata, --exclude-box) is not among them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from mlbatch.rig.keys import (
    FLAG,
    OPTIONS,
    RANGE_M,
    TEXT,
    Form,
    Key,
    choice_form,
    mapping_form,
    names,
    whole_form,
)
from mlbatch.rig.yaml_tree import Node

_TEXT = re.compile(r"\S(.*\S)?")
# Values of `deskew` that are no files.
POSE_MODELS = ("imu", "constant-velocity")
_MOST_JOBS = 64
_MOST_SLICES = 10_000
_FULL_PERCENT = 100

Values = tuple[str, ...]


@dataclass(frozen=True, slots=True)
class RigOption:
    """An option in a rig; values: as on the command line; place: file, line and key path."""

    name: str
    values: Values
    place: str = field(default="", compare=False)


def _text(node: Node) -> Values:
    return (node.word("text", _TEXT),)


def _poses(node: Node) -> Values:
    """Where poses come from; files relative to the rig file, as all paths in it."""
    text = node.word("text", _TEXT)
    return (text if text in POSE_MODELS else str(node.file.parent / text),)


def _texts(node: Node) -> Values:
    """One text, or a list of them."""
    items = node.items if node.kind == "list" else (node,)
    return tuple(item.word("text, or a list of texts", _TEXT) for item in items)


def _pairs(node: Node) -> Values:
    """A mapping of options as KEY=VALUE."""
    if node.kind != "mapping":
        raise node.error("a mapping of options", node.shown, "write {option: value}")
    return tuple(f"{name}={value.word('one word', _TEXT)}" for name, value in node.entries.items())


def _flag(node: Node) -> Values:
    return ("true" if node.flag() else "false",)


def _range_m(node: Node) -> Values:
    if node.number() < 0:
        raise node.error("a range of 0 m or more", node.shown, "give metres")
    return (node.text,)


def _duration_s(node: Node) -> Values:
    if node.number() < 0:
        raise node.error("a duration above 0 s", node.shown, "give seconds")
    return (node.text,)


def _percent(node: Node) -> Values:
    if not 0 <= node.number() <= _FULL_PERCENT:
        raise node.error("a share from 0 to 100 %", node.shown, "correct it")
    return (node.text,)


def _whole(low: int, high: int) -> Callable[[Node], Values]:
    return lambda node: (str(node.whole(low, high)),)


def _jobs(node: Node) -> Values:
    return ("auto",) if node.text == "auto" else (str(node.whole(1, _MOST_JOBS)),)


def _choice(*words: str) -> Callable[[Node], Values]:
    return lambda node: (node.choice(words),)


def _flag_key(name: str, about: str) -> Key[Values]:
    return Key(name, _flag, (), FLAG, about)


def _text_key(name: str, about: str, form: Form = TEXT) -> Key[Values]:
    return Key(name, _text, (), form, about)


def _texts_key(name: str, about: str) -> Key[Values]:
    form = {"anyOf": [TEXT, {"type": "array", "items": TEXT}]}
    return Key(name, _texts, (), form, about)


def _choice_key(name: str, about: str, *words: str) -> Key[Values]:
    return Key(name, _choice(*words), (), choice_form(*words), about)


_PERCENT: Form = {"type": "number", "minimum": 0, "maximum": _FULL_PERCENT}
_JOBS: Form = {"anyOf": [choice_form("auto"), whole_form(1, _MOST_JOBS)]}

CONVERT: tuple[Key[Values], ...] = (
    _text_key("format", "format of the output"),
    _choice_key("layout", "valid points only, or slots x columns", "dense", "organized"),
    _choice_key("sort", "order of the points of a scan", "columns", "points"),
    _text_key("point_layout", "fields of a PointCloud2 point (preset)"),
    _text_key("ply_style", "properties of PLY files"),
    _text_key("compression", "of MCAP chunks"),
    Key(
        *("max_bag_duration", _duration_s, (), {"type": "number", "minimum": 0}),
        "recording in a file of a ROS 2 bag, s; 0: all in one file",
    ),
    _choice_key(
        *("stamp", "instant of the window that messages are stamped with"),
        *("start", "middle", "end"),
    ),
    _choice_key(
        *("batching", "windows, or a policy of frame-level fusion"),
        *("window", "latest", "approximate", "collate"),
    ),
    Key(
        *("deskew", _poses, (), TEXT),
        about="where poses come from: imu, constant-velocity, or a trajectory (relative to the rig "
        "file)",
    ),
    _choice_key("deskew_to", "instant to move points to", "start", "middle", "end"),
    _choice_key("batching_times", "times of points in fused sweeps", "common", "own"),
    Key(
        *("slices", _whole(1, _MOST_SLICES), (), whole_form(1, _MOST_SLICES)),
        about="sub-scans a window",
    ),
    _flag_key("split", "one scan a sensor instead of merged ones"),
    _flag_key("keep_partial", "also write the first and last, partial window"),
    Key("drop_incomplete", _percent, (), _PERCENT, "leave out scans with fewer columns, %"),
    _text_key("max_wait", "idle-source timeout, s or inf"),
    _text_key("start", "first window starts at or after"),
    _text_key("end", "windows start before"),
    _choice_key("clock", "timestamps of packets, or their receive times", "sensor", "host"),
    _flag_key("align_clocks", "map all clocks onto one"),
    _choice_key("align_to", "clock to map onto", "host", "first"),
    _choice_key("on_jump", "at a clock step: error, or one output a part", "error", "split"),
    Key("min_range", _range_m, (), RANGE_M, "drop nearer points, m"),
    Key("max_range", _range_m, (), RANGE_M, "drop farther points, m"),
    _flag_key("keep_repeated", "keep the second of two equal returns"),
    _flag_key("identity_extrinsics", "sensors without extrinsics are at 0, 0, 0"),
    Key("decode", _pairs, (), OPTIONS, "options of all decoders"),
    _texts_key("only", "use only these sensors"),
    _texts_key("ignore", "leave out these sensors"),
    _texts_key("pass", "topics to copy"),
    _texts_key("fault", "faults to inject"),
    Key("fault_seed", _whole(0, 2**31), (), whole_form(0, 2**31), "seed of random faults"),
    Key("jobs", _jobs, (), _JOBS, "scans made in parallel, auto: by cores and format"),
    _choice_key("engine", "ignored", "auto", "numpy", "native"),
    _flag_key("strict", "the first rejected packet or warning is an error"),
    _texts_key("fail_on", "limits beyond which the exit code is 3"),
    _flag_key("no_fsync", "do not wait until the output is on the disk"),
    _flag_key("quiet", "no summary, no progress"),
    _flag_key("verbose", "also print what was found and chosen"),
)
FORM: Form = mapping_form(CONVERT)


def read_options(node: Node) -> tuple[RigOption, ...]:
    """Return the options of a `convert:` section."""
    fields: Mapping[str, Node] = node.fields(names(CONVERT))
    return tuple(
        RigOption(key.name, key.read(fields[key.name]), fields[key.name].place)
        for key in CONVERT
        if key.name in fields
    )
