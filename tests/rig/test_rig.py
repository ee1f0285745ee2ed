"""Rig files: meaning of their keys; written files are read back."""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.arrays import F64Array
from mlbatch.frames.transforms import from_quaternion, from_rpy_deg
from mlbatch.rig.rig import Rig, RigSensor, StreamSelector, UnknownExtrinsics, read_rig
from mlbatch.rig.write import write_rig
from mlbatch.ros.point_times import PointRule
from mlbatch.types import Stream

FULL = """\
body_frame: base_link
rate_hz: 29.97
sensors:
  - name: left
    model: auto                  # found from the packets
    stream: {source_ip: 10.5.5.87, port: 7502}
    metadata: calibration/left.json
    extrinsics: {translation_m: [0.1, 0.9, 2.8], rotation_rpy_deg: [0, 0, 90]}
    clock: {source: host, offset_s: -1.000000001}
    min_range_m: 0.5
    max_range_m: 1.2e2
    optional: true
    decode: {firing_azimuth: on, crc: check}
  - name: right
    model: VLP-16
    stream: {topic: /right/velodyne_packets}
    extrinsics: {rotation_xyzw: [0, 0, 1, 0]}
    clock: {offset_s: 37}
  - name: rear
    stream: {serial: 001234}
    extrinsics:
      matrix:
        - [0, -1, 0, -2]
        - [1, 0, 0, 0.5]
        - [0, 0, 1, 1e-1]
        - [0, 0, 0, 1]
  - name: top
    stream: {port: 2368}
    extrinsics: {frame: velodyne_top}
exclude_boxes_m: [[-3, -2, -1, 1, 2, 4]]
"""


def _read(folder: Path, text: str) -> Rig:
    file = folder / "rig.yaml"
    file.write_bytes(text.encode())
    return read_rig(file)


@pytest.fixture
def full(tmp_path: Path) -> Rig:
    (tmp_path / "calibration").mkdir()
    (tmp_path / "calibration" / "left.json").touch()
    return _read(tmp_path, FULL)


def test_everything_is_read(full: Rig, tmp_path: Path) -> None:
    left, right, rear, top = full.sensors
    assert (full.body_frame, full.rate) == ("base_link", Fraction(2997, 100))
    np.testing.assert_array_equal(full.exclude_boxes_m, [[-3, -2, -1, 1, 2, 4]])
    assert [sensor.name for sensor in full.sensors] == ["left", "right", "rear", "top"]
    assert [sensor.model for sensor in full.sensors] == [None, "VLP-16", None, None]
    assert [sensor.stream for sensor in full.sensors] == [
        StreamSelector(source_ip="10.5.5.87", port=7502),
        StreamSelector(topic="/right/velodyne_packets"),
        StreamSelector(serial="001234"),
        StreamSelector(port=2368),
    ]
    assert left.metadata == tmp_path / "calibration" / "left.json"
    assert (left.clock, left.offset_ns) == ("host", -1_000_000_001)
    assert (right.clock, right.offset_ns) == (None, 37_000_000_000)
    assert (left.min_range_m, left.max_range_m, left.optional) == (0.5, 120.0, True)
    # `on` is a word here, unlike in YAML 1.1.
    assert left.decode == {"firing_azimuth": "on", "crc": "check"}
    assert top.extrinsics == "velodyne_top"
    expected = [[0, -1, 0, 0.1], [1, 0, 0, 0.9], [0, 0, 1, 2.8], [0, 0, 0, 1]]
    np.testing.assert_array_equal(left.extrinsics, expected)
    expected = [[-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    np.testing.assert_array_equal(right.extrinsics, expected)
    expected = [[0, -1, 0, -2], [1, 0, 0, 0.5], [0, 0, 1, 0.1], [0, 0, 0, 1]]
    np.testing.assert_array_equal(rear.extrinsics, expected)


def test_missing_keys_are_taken_from_the_recording(tmp_path: Path) -> None:
    rig = _read(tmp_path, "sensors:\n- name: a\n")
    (sensor,) = rig.sensors
    assert (rig.body_frame, rig.rate, rig.exclude_boxes_m.shape) == ("base_link", None, (0, 6))
    assert (sensor.model, sensor.stream, sensor.metadata, sensor.extrinsics) == (None,) * 4
    assert (sensor.clock, sensor.offset_ns, sensor.min_range_m, sensor.max_range_m) == (
        None,
        0,
        None,
        None,
    )
    assert (sensor.optional, sensor.decode) == (False, {})


@pytest.mark.parametrize(
    ("text", "rate"),
    [
        ("10", Fraction(10)),
        ("10/3", Fraction(10, 3)),
        ("'10/3'", Fraction(10, 3)),
        ("29.97", Fraction(2997, 100)),
        ("0.3", Fraction(3, 10)),
    ],
)
def test_rate_is_the_text_of_the_number(tmp_path: Path, text: str, rate: Fraction) -> None:
    assert _read(tmp_path, f"rate_hz: {text}\nsensors: [{{name: a}}]\n").rate == rate


@pytest.mark.parametrize(
    ("text", "offset_ns"),
    [
        ("0.1", 100_000_000),
        # A float64 of this would be off by 95 ns.
        ("1700000000.123456789", 1_700_000_000_123_456_789),
        ("-0.0000000014", -1),
        ("1e-9", 1),
    ],
)
def test_clock_offset_is_exact(tmp_path: Path, text: str, offset_ns: int) -> None:
    rig = _read(tmp_path, f"sensors: [{{name: a, clock: {{offset_s: {text}}}}}]\n")
    assert rig.sensors[0].offset_ns == offset_ns


def test_a_byte_order_mark_and_windows_line_ends_do_not_matter(tmp_path: Path) -> None:
    rig = _read(tmp_path, "\ufeffrate_hz: 5\r\nsensors:\r\n  - name: a\r\n")
    assert (rig.rate, rig.sensors[0].name) == (Fraction(5), "a")


def test_selector_selects_its_streams() -> None:
    stream = Stream(source_ip="10.0.0.1", port=2368)
    assert StreamSelector(source_ip="10.0.0.1").selects(stream)
    assert StreamSelector(port=2368).selects(stream)
    assert not StreamSelector(source_ip="10.0.0.1", port=2369).selects(stream)
    assert not StreamSelector(topic="/a").selects(stream)
    assert StreamSelector(topic="/a").selects(Stream(topic="/a"))
    assert str(StreamSelector(port=2368, serial="7")) == "port 2368, serial 7"


NAMES = st.from_regex(r"[A-Za-z_][A-Za-z0-9_]{0,8}", fullmatch=True).filter(
    lambda name: name != "base_link"
)
WORDS = st.text(st.characters(exclude_categories=["Z", "C"]), min_size=1, max_size=12)
ADDRESSES = st.ip_addresses().map(str)
STREAMS = st.one_of(
    st.builds(StreamSelector, source_ip=ADDRESSES, port=st.integers(0, 65535), serial=WORDS),
    st.builds(StreamSelector, topic=WORDS),
    st.builds(StreamSelector, serial=WORDS),
)
COORDINATES = st.tuples(*[st.floats(-1e4, 1e4)] * 3)
UNIT_QUATERNIONS = (
    st.tuples(*[st.floats(-1, 1)] * 4)
    .filter(lambda xyzw: math.hypot(*xyzw) > 0.01)
    .map(lambda xyzw: tuple(part / math.hypot(*xyzw) for part in xyzw))
)
EXTRINSICS: st.SearchStrategy[F64Array | str | UnknownExtrinsics | None] = st.one_of(
    st.none(),
    st.builds(UnknownExtrinsics),
    WORDS,
    st.builds(from_quaternion, COORDINATES, UNIT_QUATERNIONS),
    st.builds(from_rpy_deg, COORDINATES, st.tuples(*[st.integers(-180, 180)] * 3)),
)
SENSORS = st.builds(
    RigSensor,
    name=NAMES,
    model=st.none() | WORDS.filter(lambda word: word != "auto"),
    stream=st.none() | STREAMS,
    extrinsics=EXTRINSICS,
    clock=st.sampled_from([None, "sensor", "host"]),
    offset_ns=st.integers(-(2**31) * 10**9, 2**31 * 10**9),
    min_range_m=st.none() | st.floats(0, 10),
    max_range_m=st.none() | st.floats(11, 1e9),
    optional=st.booleans(),
    decode=st.dictionaries(WORDS, WORDS, max_size=3),
)
CORNERS = st.tuples(*[st.floats(-100, 0)] * 3, *[st.floats(1, 100)] * 3)
RIGS = st.builds(
    Rig,
    sensors=st.lists(
        SENSORS, min_size=1, max_size=4, unique_by=(lambda s: s.name, lambda s: s.stream)
    ).map(tuple),
    rate=st.none() | st.fractions(Fraction(1, 4), 1000, max_denominator=10**6),
    exclude_boxes_m=st.lists(CORNERS, max_size=3).map(lambda k: np.array(k).reshape(-1, 6)),
)


def _facts(rig: Rig) -> list[object]:
    """All fields of a rig, comparable to the last bit."""
    facts: list[object] = [rig.body_frame, rig.rate, rig.exclude_boxes_m.tobytes()]
    for s in rig.sensors:
        pose: object = s.extrinsics
        if isinstance(s.extrinsics, np.ndarray):
            pose = s.extrinsics.tobytes()
        elif isinstance(s.extrinsics, UnknownExtrinsics):
            pose = UnknownExtrinsics
        facts += [s.name, s.model, s.stream, s.metadata, pose, s.clock, s.offset_ns]
        facts += [s.min_range_m, s.max_range_m, s.optional, s.decode]
    return facts


@given(RIGS, st.text(max_size=30))
def test_written_rigs_are_read_back(
    tmp_path_factory: pytest.TempPathFactory, rig: Rig, note: str
) -> None:
    folder = tmp_path_factory.getbasetemp()
    text = write_rig(rig, folder, {rig.sensors[0].name: note})
    assert _facts(_read(folder, text)) == _facts(rig)


def test_metadata_is_written_relative_to_the_file(full: Rig, tmp_path: Path) -> None:
    text = write_rig(full, tmp_path)
    assert "metadata: calibration/left.json\n" in text
    assert _facts(_read(tmp_path, text)) == _facts(full)
    (tmp_path / "other").mkdir()
    text = write_rig(full, tmp_path / "other")
    assert "metadata: ../calibration/left.json\n" in text.replace('"', "")


def test_written_file_is_for_people(tmp_path: Path) -> None:
    sensors = (
        RigSensor("left", extrinsics=from_rpy_deg((0.1, 0.9, 2.8), (0.0, 35.0, 90.0))),
        RigSensor("right", stream=StreamSelector(source_ip="10.0.0.1", port=2368)),
    )
    text = write_rig(Rig(sensors), tmp_path, {"left": "OS1-128,\n640 packets/s"})
    assert (
        text[text.index("body_frame") :]
        == """\
body_frame: base_link
sensors:
  # OS1-128, 640 packets/s
  - name: left
    model: auto
    extrinsics: {translation_m: [0.1, 0.9, 2.8], rotation_rpy_deg: [0.0, 35.0, 90.0]}
  - name: right
    model: auto
    stream: {source_ip: "10.0.0.1", port: 2368}
    # extrinsics are not known: measure them and remove the # of the next line
    # extrinsics: {translation_m: [0.0, 0.0, 0.0], rotation_rpy_deg: [0.0, 0.0, 0.0]}
"""
    )


def test_points_and_lidars_of_a_topic_are_read_back(tmp_path: Path) -> None:
    text = """\
sensors:
  - name: front
    stream: {topic: /points, frame_id: /lidar_front}
    points: {time: t, unit: us, from: end, ring: line}
  - name: rear
    stream: {topic: /points, lidar_id: 0}
    points: {from: absolute}
"""
    rig = _read(tmp_path, text)
    front, rear = rig.sensors
    assert front.stream == StreamSelector(topic="/points", frame_id="lidar_front")
    assert rear.stream == StreamSelector(topic="/points", lidar_id=0)
    assert str(rear.stream) == "topic /points, lidar_id 0"
    assert front.points == PointRule(time="t", unit_ns=1000, origin="end", ring="line")
    assert rear.points == PointRule(origin="absolute")
    assert rear.stream.selects(Stream(topic="/points", lidar_id=0))
    assert not rear.stream.selects(Stream(topic="/points", lidar_id=1))
    again = _read(tmp_path, write_rig(rig, tmp_path))
    assert [(one.stream, one.points) for one in again.sensors] == [
        (one.stream, one.points) for one in rig.sensors
    ]
