"""Writing a rig file that `read_rig` reads back."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from mlbatch.arrays import F64Array
from mlbatch.frames.transforms import from_rpy_deg, rpy_deg
from mlbatch.rig.convert_keys import POSE_MODELS, RigOption
from mlbatch.rig.rig import STREAM_FIELDS, Rig, RigSensor, StreamSelector, UnknownExtrinsics
from mlbatch.units import NS_PER_S, rate_text

# Text that needs no quotes, for any reader of YAML.
_PLAIN = re.compile(r"[A-Za-z_/][A-Za-z0-9_./-]*", re.ASCII)
# Numbers and flags.
_SCALAR = re.compile(r"-?\d+(\.\d+)?|true|false", re.ASCII)
_RESERVED = ("null", "true", "false", "yes", "no", "on", "off", "y", "n")
_HEADER = """\
# Rig of mlbatch: which sensors there are and where they sit. Edit it, then
#   mlbatch convert RECORDING --rig THIS_FILE -o OUTPUT
# Lengths in metres, angles in degrees; extrinsics map the sensor frame into the body frame,
# rotations turn about the fixed axes x, y, z: R = Rz Ry Rx, as in URDF.
"""
_NO_EXTRINSICS = (
    "# extrinsics are not known: measure them and remove the # of the next line",
    "# extrinsics: {translation_m: [0.0, 0.0, 0.0], rotation_rpy_deg: [0.0, 0.0, 0.0]}",
)


def write_rig(rig: Rig, folder: Path, notes: Mapping[str, str] | None = None) -> str:
    """Return the text of a rig file in `folder`; notes: comments by sensor name."""
    lines = [f"body_frame: {_text(rig.body_frame)}"]
    if rig.rate is not None:
        lines.append(f"rate_hz: {rate_text(rig.rate)}")
    lines.append("sensors:")
    for sensor in rig.sensors:
        note = " ".join((notes or {}).get(sensor.name, "").split())
        if note:
            # YAML allows printable characters only, in comments too.
            lines.append(f"  # {''.join(filter(str.isprintable, note))}")
        first, *others = _sensor_lines(sensor, folder)
        lines.append(f"  - {first}")
        lines += [f"    {line}" for line in others]
    if len(rig.exclude_boxes_m):
        lines.append("exclude_boxes_m:")
        lines += [f"  - {_floats(box)}" for box in rig.exclude_boxes_m]
    if rig.options:
        lines.append("convert:")
        lines += [f"  {option.name}: {_option_text(option, folder)}" for option in rig.options]
    return _HEADER + "\n".join(lines) + "\n"


def _option_text(option: RigOption, folder: Path) -> str:
    if option.name == "decode":
        pairs = (value.partition("=") for value in option.values)
        return _braces({_text(key): _text(value) for key, _, value in pairs})
    if option.name == "deskew" and option.values[0] not in POSE_MODELS:
        return _text(_path_from(folder, Path(option.values[0])))
    texts = [value if _SCALAR.fullmatch(value) else _text(value) for value in option.values]
    return texts[0] if len(texts) == 1 else f"[{', '.join(texts)}]"


def _sensor_lines(sensor: RigSensor, folder: Path) -> Iterator[str]:
    yield f"name: {_text(sensor.name)}"
    yield f"model: {_text(sensor.model or 'auto')}"
    if sensor.stream is not None and sensor.sweeps is None:
        yield f"stream: {_stream_text(sensor.stream)}"
    if sensor.metadata is not None:
        yield f"metadata: {_text(_path_from(folder, sensor.metadata))}"
    yield from _extrinsics_lines(sensor.extrinsics)
    clock = {
        "source": sensor.clock or "",
        "epoch": sensor.epoch or "",
        "offset_s": _seconds(sensor.offset_ns),
    }
    if any(clock.values()):
        yield "clock: " + _braces(clock)
    if sensor.min_range_m is not None:
        yield f"min_range_m: {float(sensor.min_range_m)!r}"
    if sensor.max_range_m is not None:
        yield f"max_range_m: {float(sensor.max_range_m)!r}"
    if sensor.optional:
        yield "optional: true"
    if sensor.decode:
        yield "decode: " + _braces({_text(k): _text(v) for k, v in sensor.decode.items()})
    if sensor.points is not None:
        points = {key: _text(value) for key, value in sensor.points.keys().items() if value}
        if sensor.sweeps is not None:
            points["glob"] = _text(sensor.sweeps.glob)
            points["dtype"] = _fields_text(sensor.sweeps.fields)
            points["arrays"] = _fields_text(sensor.sweeps.arrays)
        yield "points: " + _braces(points)


def _fields_text(pairs: Sequence[tuple[str, str]]) -> str:
    fields = {_text(name): _text(kind) for name, kind in pairs}
    return _braces(fields) if fields else ""


def _stream_text(stream: StreamSelector) -> str:
    words = {name: getattr(stream, name) for name in ("source_ip", "topic", "serial", "frame_id")}
    numbers = {"port": stream.port or None, "lidar_id": stream.lidar_id}
    texts = {name: _text(word) for name, word in words.items() if word}
    texts |= {name: str(number) for name, number in numbers.items() if number is not None}
    return _braces({name: texts[name] for name in STREAM_FIELDS if name in texts})


def _extrinsics_lines(extrinsics: F64Array | str | UnknownExtrinsics | None) -> Iterator[str]:
    if extrinsics is None:
        yield from _NO_EXTRINSICS
        return
    if isinstance(extrinsics, UnknownExtrinsics):
        yield "extrinsics: unknown"
        return
    if isinstance(extrinsics, str):
        yield f"extrinsics: {{frame: {_text(extrinsics)}}}"
        return
    origin = extrinsics[:3, 3]
    # Adding 0.0 makes 0.0 of -0.0.
    angles = [round(angle, 9) + 0.0 for angle in rpy_deg(extrinsics)]
    pose = f"translation_m: {_floats(origin)}, rotation_rpy_deg: {_floats(angles)}"
    # Angles are easier to edit; written only if they give the same matrix to the last bit.
    if from_rpy_deg(origin.tolist(), angles).tobytes() == extrinsics.tobytes():
        yield f"extrinsics: {{{pose}}}"
        return
    yield "extrinsics:"
    yield f"  # about: {pose}"
    yield "  matrix:"
    for row in extrinsics:
        yield f"    - {_floats(row)}"


def _path_from(folder: Path, path: Path) -> str:
    """Return the path relative to `folder`, or absolute if it is on another drive."""
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:
        return str(path.absolute())


def _seconds(offset_ns: int) -> str:
    """Return seconds with nine decimals; empty for 0."""
    if not offset_ns:
        return ""
    sign = "-" if offset_ns < 0 else ""
    whole, rest = divmod(abs(offset_ns), NS_PER_S)
    return f"{sign}{whole}.{rest:09d}"


def _braces(pairs: Mapping[str, str]) -> str:
    """Return a mapping on one line, without empty values."""
    return "{" + ", ".join(f"{key}: {value}" for key, value in pairs.items() if value) + "}"


def _floats(numbers: F64Array | list[float]) -> str:
    return "[" + ", ".join(repr(float(number)) for number in numbers) + "]"


def _text(text: str) -> str:
    """Return text as a YAML scalar, in quotes unless it is a plain word."""
    if _PLAIN.fullmatch(text) and text.lower() not in _RESERVED:
        return text
    escaped = (
        char if char.isprintable() and char not in '"\\' else f"\\U{ord(char):08x}" for char in text
    )
    return '"' + "".join(escaped) + '"'
