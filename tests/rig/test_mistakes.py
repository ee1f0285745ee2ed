"""The exact one-line error of each mistake in a rig file."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.errors import RigError
from mlbatch.rig.rig import read_rig

VALID = """\
body_frame: base_link
rate_hz: 29.97
sensors:
  - name: left
    stream: {source_ip: 10.5.5.87, port: 7502}
    extrinsics: {translation_m: [0.1, 0.9, 2.8], rotation_rpy_deg: [0, 0, 90]}
    clock: {source: host, offset_s: -1.000000001}
  - name: rear
    extrinsics:
      matrix:
        - [0, -1, 0, -2]
        - [1, 0, 0, 0.5]
        - [0, 0, 1, 1e-1]
exclude_boxes_m: [[-3, -2, -1, 1, 2, 4]]
"""


def _answer(file: Path) -> str:
    """The error of the file; empty if it has none."""
    try:
        read_rig(file)
    except RigError as err:
        return str(err)
    return ""


def _fault(folder: Path, text: str) -> str:
    file = folder / "rig.yaml"
    file.write_bytes(text.encode())
    return _answer(file)


def one(line: str) -> str:
    """A rig of one sensor with `line` as its third line."""
    return f"sensors:\n  - name: left\n    {line}\n"


def two(first: str, second: str) -> str:
    """A rig of two sensors, on lines 2 and 3."""
    return f"sensors:\n- {{{first}}}\n- {{{second}}}\n"


S = "sensors[0]"
X = f"{S}.extrinsics"
SENSOR_KEYS = (
    "name, model, stream, metadata, extrinsics, clock, min_range_m, max_range_m, optional, "
    "decode, points"
)
STREAM_KEYS = "source_ip, port, topic, serial, frame_id, lidar_id"
X_KEYS = (
    "translation_m, rotation_rpy_deg, rotation_xyzw, matrix, frame, file, parent, key, direction, "
    "matrix_unit, sensor_in_frame"
)
NUMBER = "expected a finite number"
PLAIN_NUMBER = "write a decimal number, without quotes or unit"
NAME = "a name of at most 100 letters, digits and _, not a digit first"
FIX = "correct it or remove the key"

MISTAKES: list[tuple[str, str]] = [
    # The form of the file.
    ("", "1: expected a mapping with keys of body_frame, rate_hz, sensors, exclude_boxes_m, "
         "convert, dataset, found nothing; write `key: value`"),
    ("- name: left\n", "1: expected a mapping with keys of body_frame, rate_hz, sensors, "
                       "exclude_boxes_m, convert, dataset, found a list of 1; write `key: value`"),
    ("rate_hz: 10\n", "1: expected the key sensors, found none; add it"),
    ("sensors:\n  - name: a\n - name: b\n",
     "3: expected YAML, found a mistake (expected <block end>, but found '<block sequence "
     "start>'); "
     "check indentation, colons and brackets here and one line above"),
    ("sensors:\n\t- name: a\n",
     "2: expected YAML, found a mistake (found character '\\t' that cannot start any token); "
     "check indentation, colons and brackets here and one line above"),
    ("sensors: [\n", "2: expected YAML, found a mistake (expected the node content, but found "
                     "'<stream end>'); "
                     "check indentation, colons and brackets here and one line above"),
    ("rate_hz: 1\nbody_frame: a\x07\n",
     "2: expected YAML, found the control character 0x07; remove it"),
    ("sensors: [{name: a}]\n---\nsensors: []\n",
     "2: expected one document, found a second one; remove what follows `---`"),
    (one("? [a]\n    : b"),
     f"3: {S}: expected a word as key, found brackets; put the brackets after the colon"),
    # Features of YAML that rigs refuse.
    ("sensors: &all\n- name: a\n",
     "1: sensors: expected plain values, found an anchor or alias; write the value out"),
    (one("decode: {a: *b}"),
     f"3: {S}.decode.a: expected plain values, found an anchor or alias; write the value out"),
    (one("metadata: !!python/object/apply:os.system [ls]"),
     f"3: {S}.metadata: expected plain values, "
     "found the tag 'tag:yaml.org,2002:python/object/apply:os...'; remove it"),
    # Keys.
    (one("modle: VLP-16"),
     f"3: {S}.modle: expected a key of {SENSOR_KEYS}, found 'modle'; the nearest known key is "
     "model"),
    ("rate: 10\nsensors: [{name: a}]\n",
     "1: rate: expected a key of body_frame, rate_hz, sensors, exclude_boxes_m, convert, dataset, "
     "found 'rate'; the nearest known key is rate_hz"),
    (one("extrinsics: {rotation_rpy: [0, 0, 0]}"),
     f"3: {X}.rotation_rpy: expected a key of {X_KEYS}, found 'rotation_rpy'; "
     "the nearest known key is rotation_rpy_deg"),
    (one("stream:\n      ip: 10.0.0.1"),
     f"4: {S}.stream.ip: expected a key of {STREAM_KEYS}, found 'ip'; "
     "the nearest known key is source_ip"),
    (one("name: right"),
     f"3: {S}.name: expected each key once, found it again (first on line 2); remove one of "
     "the two"),
    ("sensors:\n  - model: auto\n", f"2: {S}: expected the key name, found none; add it"),
    # Types.
    ("sensors: []\n", "1: sensors: expected 1 to 256 sensors, found a list of 0; "
                      "list each sensor with `- name:`"),
    ("sensors: {left: 1}\n", "1: sensors: expected a list of sensors, found a mapping; "
                             "write [a, b] or lines with `- `"),
    ("sensors: [left]\n", f"1: {S}: expected a mapping with keys of {SENSOR_KEYS}, found 'left'; "
                          "write `key: value`"),
    ("sensors: [{name: front left}]\n", f"1: {S}.name: expected {NAME}, found 'front left'; {FIX}"),
    ("sensors: [{name: 1st}]\n", f"1: {S}.name: expected {NAME}, found '1st'; {FIX}"),
    (f"sensors: [{{name: {'a' * 101}}}]\n",
     f"1: {S}.name: expected {NAME}, found '{'a' * 40}...'; {FIX}"),
    ("sensors: [{name: [a]}]\n", f"1: {S}.name: expected {NAME}, found a list of 1; {FIX}"),
    ("sensors: [{name: null}]\n", f"1: {S}.name: expected {NAME}, found nothing; {FIX}"),
    (one("optional: maybe"), f"3: {S}.optional: expected true or false, found 'maybe'; "
                             "write one of the two, without quotes"),
    (one("min_range_m: 50 cm"), f"3: {S}.min_range_m: {NUMBER}, found '50 cm'; {PLAIN_NUMBER}"),
    (one("min_range_m: '0.5'"),
     f"3: {S}.min_range_m: {NUMBER}, found the text '0.5'; {PLAIN_NUMBER}"),
    (one("min_range_m:"), f"3: {S}.min_range_m: {NUMBER}, found nothing; {PLAIN_NUMBER}"),
    (one("min_range_m: -1"), f"3: {S}.min_range_m: expected a range of 0 m or more, found '-1'; "
                             "give metres from the sensor"),
    (one("min_range_m: 5\n    max_range_m: 4"),
     f"4: {S}.max_range_m: expected more than 5 m, found '4'; give the larger range as maximum"),
    (one("metadata: left.json"),
     f"3: {S}.metadata: expected an existing file, found none at 'FOLDER/left.json'; "
     "give its path relative to the rig file"),
    (one("decode: [crc]"), f"3: {S}.decode: expected a mapping of options, found a list of 1; "
                           "write {option: value}"),
    (one("decode: {crc: [a]}"), f"3: {S}.decode.crc: expected one word, found a list of 1; {FIX}"),
    (one("clock: host"), f"3: {S}.clock: expected a mapping with keys of source, epoch, offset_s, "
                         "found 'host'; write `key: value`"),
    (one("clock: {source: gps}"), f"3: {S}.clock.source: expected sensor or host, found 'gps'; "
                                  "use one of these words"),
    (one("clock: {offset_s: 1e18}"),
     f"3: {S}.clock.offset_s: expected at most 2147483648 s either way, found '1e18'; give "
     "seconds"),
    ("rate_hz: fast\nsensors: [{name: a}]\n",
     "1: rate_hz: expected a positive number of Hz (10, 29.97 or 10/3), found 'fast'; "
     "write a decimal number or a fraction"),
    ("rate_hz: 0.1\nsensors: [{name: a}]\n",
     "1: rate_hz: expected 0.25 to 1000000 Hz, found '0.1'; lidars run at 5 to 20 Hz"),
    ("body_frame: base-link\nsensors: [{name: a}]\n",
     "1: body_frame: expected a frame name of letters, digits, _ and / that does not start "
     "with a digit, "
     f"found 'base-link'; {FIX}"),
    # Clouds.
    (one("stream: {topic: /a}\n    points: {tme: t}"),
     f"4: {S}.points.tme: expected a key of time, unit, from, ring, glob, dtype, arrays, "
     "found 'tme'; the nearest known key is time"),
    (one("stream: {topic: /a}\n    points:\n      unit: min"),
     f"5: {S}.points.unit: expected s or ms or us or ns, found 'min'; use one of these words"),
    (one("stream: {topic: /a}\n    points: {from: middle}"),
     f"4: {S}.points.from: expected start or end or back or absolute, found "
     "'middle'; use one of these words"),
    (one("stream: {topic: /a}\n    points: {}"),
     f"4: {S}.points: expected at least one of time, unit, from, ring, glob, dtype, arrays, "
     "found none; add one of them"),
    (one("points: {unit: us}"),
     f"3: {S}.points: expected a sensor on a topic, found none; "
     "give the topic of its clouds as stream: {topic: ...}, files of sweeps as glob, or "
     "remove points"),
    (one("stream: {port: 1, frame_id: a}"),
     f"3: {S}.stream.frame_id: expected frame_id with topic, found no topic; add the topic"),
    (one("stream: {topic: /a, lidar_id: -1}"),
     f"3: {S}.stream.lidar_id: expected a whole number from 0 to 65535, found '-1'; "
     "correct it or remove the key"),
    # Streams.
    (one("stream: {}"), f"3: {S}.stream: expected at least one of {STREAM_KEYS}, "
                        "found none; add one of them"),
    (one("stream: {source_ip: 10.5.5}"), f"3: {S}.stream.source_ip: expected an IP address, "
                                         "found '10.5.5'; write it as 192.168.1.201"),
    (one("stream: {port: 70000}"), f"3: {S}.stream.port: expected a whole number from 1 to 65535, "
                                   f"found '70000'; {FIX}"),
    (one("stream: {port: 7502.5}"), f"3: {S}.stream.port: expected a whole number from 1 to 65535, "
                                    f"found '7502.5'; {FIX}"),
    (one("stream: {topic: /a, port: 1}"),
     f"3: {S}.stream.topic: expected topic without port, found port as well (line 3); "
     "keep one of the two"),
    (two("name: a", "name: a"),
     "3: sensors[1].name: expected a name of its own, found that of sensors[0].name (line 2) "
     "again; "
     "rename one of the two sensors"),
    (two("name: a", "name: base_link"),
     "3: sensors[1].name: expected a name that is not the body frame, found 'base_link'; "
     "rename the sensor"),
    # The same port, written in another way.
    (two("name: a, stream: {port: 7502}", "name: b, stream: {port: 7502.0}"),
     "3: sensors[1].stream: expected a stream of its own, "
     "found that of sensors[0].stream (line 2) again; "
     "give each sensor its own source_ip, port, topic, serial or glob"),
    # Extrinsics.
    (one("extrinsics: {}"), f"3: {X}: expected at least one of {X_KEYS}, found none; add one "
                            "of them"),
    (one("extrinsics: {translation_m: [1, 2]}"),
     f"3: {X}.translation_m: expected 3 numbers, found a list of 2; give all 3 and no more"),
    (one("extrinsics: {translation_m: 1}"), f"3: {X}.translation_m: expected a list of 3 numbers, "
                                            "found '1'; write [a, b] or lines with `- `"),
    (one("extrinsics:\n      translation_m:\n      - 1\n      - .nan\n      - 0"),
     f"6: {X}.translation_m[1]: {NUMBER}, found '.nan'; {PLAIN_NUMBER}"),
    (one("extrinsics: {translation_m: [0, 0, -.inf]}"),
     f"3: {X}.translation_m[2]: {NUMBER}, found '-.inf'; {PLAIN_NUMBER}"),
    (one("extrinsics: {translation_m: [0, 1e999, 0]}"),
     f"3: {X}.translation_m[1]: {NUMBER}, found '1e999'; give one within the range of float64"),
    (one("extrinsics: {translation_m: [691000, 0, 0]}"),
     f"3: {X}.translation_m[0]: expected at most 10000 m from the body origin, found '691000'; "
     "give metres in the body frame, not in the world"),
    (one("extrinsics:\n      rotation_rpy_deg: [0, 0, 0]\n      rotation_xyzw: [0, 0, 0, 1]"),
     f"5: {X}.rotation_xyzw: expected rotation_xyzw without rotation_rpy_deg, "
     "found rotation_rpy_deg as well (line 4); keep one of the two"),
    (one("extrinsics: {frame: os_left, translation_m: [0, 0, 1]}"),
     f"3: {X}.frame: expected frame without translation_m, found translation_m as well (line 3); "
     "keep one of the two"),
    (one("extrinsics: {rotation_xyzw: [1, 1, 0, 0]}"),
     f"3: {X}.rotation_xyzw: expected a quaternion of norm 1 within 0.001, found norm 1.41421; "
     "give x, y, z, w in this order, normalised"),
    (one("extrinsics: {matrix: [[1, 0, 0, 0], [0, 1, 0, 0]]}"),
     f"3: {X}.matrix: expected 4 rows (or 3, without 0, 0, 0, 1), found a list of 2; give all "
     "rows"),
    (one("extrinsics: {matrix: [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0]]}"),
     f"3: {X}.matrix: expected orthonormal axes within 0.001, found axes off by 3; "
     "give a rotation without scale or shear"),
    (one("extrinsics: {matrix: [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}"),
     f"3: {X}.matrix: expected a rotation (determinant 1), found a mirror image (determinant -1); "
     "check the signs of the axes"),
    (one("extrinsics: {matrix: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 2, 3, 1]]}"),
     f"3: {X}.matrix: expected 0, 0, 0, 1 as last row, found 1, 2, 3, 1; "
     "give the translation as last column, metres"),
    # Boxes.
    ("sensors: [{name: a}]\nexclude_boxes_m: [[0, 0, 0, 1, 1]]\n",
     "2: exclude_boxes_m[0]: expected 6 numbers, found a list of 5; give all 6 and no more"),
    ("sensors: [{name: a}]\nexclude_boxes_m:\n- [0, 0, 0, 1, 1, 1]\n- [0, 2, 0, 1, 1, 1]\n",
     "4: exclude_boxes_m[1]: expected y0 < y1 in metres (x0, y0, z0, x1, y1, z1), found 2 and 1; "
     "swap the corners"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "message"), MISTAKES)
def test_errors_of_mistakes(tmp_path: Path, text: str, message: str) -> None:
    expected = f"{tmp_path / 'rig.yaml'}:{message}".replace("FOLDER", str(tmp_path))
    assert _fault(tmp_path, text) == expected


def test_errors_of_files_without_text(tmp_path: Path) -> None:
    file = tmp_path / "rig.yaml"
    with pytest.raises(RigError) as caught:
        read_rig(file)
    assert str(caught.value) == (
        f"{file}: expected a readable file, found no such file or directory; check the path"
    )
    with pytest.raises(RigError) as caught:
        read_rig(tmp_path)
    assert str(caught.value).startswith(f"{tmp_path}: expected a readable file, found ")
    file.write_bytes(b"sensors:\n- name: \xff\n")
    with pytest.raises(RigError) as caught:
        read_rig(file)
    assert (
        str(caught.value) == f"{file}:2: expected UTF-8 text, found the byte 0xff; save it as UTF-8"
    )
    file.write_bytes(b"#" * 1_000_001)
    with pytest.raises(RigError) as caught:
        read_rig(file)
    assert str(caught.value) == (
        f"{file}: expected at most 300000 bytes, found more; "
        "check that this is a rig file and not a recording"
    )


@given(st.text(max_size=60), st.integers(min_value=0, max_value=len(VALID)))
def test_any_text_is_read_or_refused_in_one_line(
    tmp_path_factory: pytest.TempPathFactory, text: str, position: int
) -> None:
    file = tmp_path_factory.getbasetemp() / "noise.yaml"
    noisy = VALID[:position] + text + VALID[position:]
    for content in (text, noisy):
        file.write_bytes(content.encode("utf-8", "surrogatepass"))
        answer = _answer(file)
        assert "\n" not in answer
        assert answer == "" or answer.startswith(str(file))
