"""The rig file: which sensors a vehicle carries, where they sit and how they are told apart.

Format: CONTRACT.md section 5. Every mistake is told with file, line, key path, what was wanted and
what was got; all user units are converted here.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.errors import RigError
from mlbatch.rig import schema as values
from mlbatch.rig.yaml_tree import Node
from mlbatch.types import Stream

DEFAULT_BODY_FRAME = "base_link"
# `lidar_id` is a uint8.
MAX_SENSORS = 256

RIG_KEYS = ("body_frame", "rate_hz", "sensors", "exclude_boxes_m")
SENSOR_KEYS = (
    *("name", "model", "stream", "metadata", "extrinsics", "clock"),
    *("min_range_m", "max_range_m", "optional", "decode"),
)
STREAM_KEYS = ("source_ip", "port", "topic", "serial")
CLOCK_KEYS = ("source", "epoch", "offset_s")


@dataclass(frozen=True, slots=True)
class StreamSelector:
    """Which packets are a sensor's; what is empty or 0 may be anything."""

    source_ip: str = ""
    port: int = 0
    topic: str = ""
    serial: str = ""

    def selects(self, stream: Stream) -> bool:
        """Whether a stream fits, as far as can be told without its packets' serial numbers."""
        pairs = zip(
            (self.source_ip, self.port, self.topic),
            (stream.source_ip, stream.port, stream.topic),
            strict=True,
        )
        return all(not wanted or wanted == got for wanted, got in pairs)

    def __str__(self) -> str:
        parts = {key: getattr(self, key) for key in STREAM_KEYS}
        return ", ".join(f"{key} {value}" for key, value in parts.items() if value)


@dataclass(frozen=True, slots=True, eq=False)
class RigSensor:
    """One sensor of the rig; None where the file leaves it to the recording.

    extrinsics: (4, 4) float64 body_from_sensor in metres, or the name of a frame of the recording;
    clock: sensor or host; epoch: what the sensor's clock counts (utc, tai or gps); offset_ns is
    added to the stamps; decode: options as for `--decode`.
    """

    name: str
    model: str | None = None
    stream: StreamSelector | None = None
    metadata: Path | None = None
    extrinsics: F64Array | str | None = None
    clock: str | None = None
    epoch: str | None = None
    offset_ns: int = 0
    min_range_m: float | None = None
    max_range_m: float | None = None
    optional: bool = False
    decode: dict[str, str] = field(default_factory=dict)


def _no_boxes() -> F64Array:
    return np.zeros((0, 6))


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """The sensors in the order of `lidar_id`, and what they share.

    exclude_boxes_m: (k, 6) float64, x0, y0, z0, x1, y1, z1 in the body frame.
    """

    sensors: tuple[RigSensor, ...]
    body_frame: str = DEFAULT_BODY_FRAME
    rate: Fraction | None = None
    exclude_boxes_m: F64Array = field(default_factory=_no_boxes)


def read_rig(path: Path) -> Rig:
    """Read a rig file; RigError names file, line and key of the first thing that is wrong."""
    # Most runs have no rig, and need no parser.
    from mlbatch.rig.yaml_tree import read_yaml

    root = read_yaml(Path(path))
    fields = root.fields(RIG_KEYS, required=("sensors",))
    rig = Rig(
        body_frame=values.take(fields, "body_frame", values.frame_name, DEFAULT_BODY_FRAME),
        rate=values.take(fields, "rate_hz", values.rate, None),
        sensors=_sensors(fields["sensors"]),
        exclude_boxes_m=values.take(fields, "exclude_boxes_m", values.boxes, _no_boxes()),
    )
    _check_distinct(fields["sensors"], rig)
    return rig


def _sensors(node: Node) -> tuple[RigSensor, ...]:
    items = node.elements("sensors")
    if not 1 <= len(items) <= MAX_SENSORS:
        raise node.error(
            f"1 to {MAX_SENSORS} sensors", node.shown, "list each sensor with `- name:`"
        )
    return tuple(_sensor(item) for item in items)


def _sensor(node: Node) -> RigSensor:
    fields = node.fields(SENSOR_KEYS, required=("name",))
    clock = fields["clock"].fields(CLOCK_KEYS) if "clock" in fields else {}
    sensor = RigSensor(
        name=values.sensor_name(fields["name"]),
        model=values.take(fields, "model", values.model, None),
        stream=values.take(fields, "stream", _stream, None),
        metadata=values.take(fields, "metadata", values.existing_file, None),
        extrinsics=values.take(fields, "extrinsics", values.extrinsics, None),
        clock=values.take(clock, "source", values.clock_source, None),
        epoch=values.take(clock, "epoch", values.clock_epoch, None),
        offset_ns=values.take(clock, "offset_s", values.offset_ns, 0),
        min_range_m=values.take(fields, "min_range_m", values.range_m, None),
        max_range_m=values.take(fields, "max_range_m", values.range_m, None),
        optional=values.take(fields, "optional", Node.flag, False),
        decode=values.take(fields, "decode", values.options, {}),
    )
    low, high = sensor.min_range_m or 0.0, sensor.max_range_m
    if high is not None and high <= low:
        place = fields["max_range_m"]
        raise place.error(f"more than {low:g} m", place.shown, "give the larger range as maximum")
    return sensor


def _check_distinct(node: Node, rig: Rig) -> None:
    """Refuse two sensors of one name or one stream; frames must form a tree."""
    seen: dict[str | StreamSelector, Node] = {}
    for item, sensor in zip(node.items, rig.sensors, strict=True):
        name = item.entries["name"]
        if sensor.name == rig.body_frame:
            raise name.error("another name than the body frame's", name.shown, "rename the sensor")
        if sensor.name in seen:
            raise _twice(name, "a name", seen[sensor.name], "rename one of the two sensors")
        seen[sensor.name] = name
        if sensor.stream is not None:
            stream = item.entries["stream"]
            if sensor.stream in seen:
                remedy = "give each sensor its own source_ip, port, topic or serial"
                raise _twice(stream, "a stream", seen[sensor.stream], remedy)
            seen[sensor.stream] = stream


def _twice(node: Node, what: str, first: Node, remedy: str) -> RigError:
    got = f"the one of {first.path} (line {first.line}) again"
    return node.error(f"{what} of its own", got, remedy)


def _stream(node: Node) -> StreamSelector:
    fields = node.fields(STREAM_KEYS)
    if not fields:
        raise node.error(f"at least one of {', '.join(STREAM_KEYS)}", "none", "add one of them")
    values.check_exclusive(fields)
    return StreamSelector(
        source_ip=values.take(fields, "source_ip", values.ip_address, ""),
        port=values.take(fields, "port", values.port, 0),
        topic=values.take(fields, "topic", values.topic, ""),
        serial=values.take(fields, "serial", values.serial, ""),
    )
