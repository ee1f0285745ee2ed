"""Ouster metadata that cannot be used: every mistake is told in one line."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mlbatch.errors import RigError
from mlbatch.sensors.ouster.sensor import OusterCalibration, read_calibration
from tests.builders.ouster import JsonObject, OusterSpec, metadata_json

PATH = Path("front.json")
SPEC = OusterSpec(beams=64, product="OS-1-64-AH")


def read(document: JsonObject) -> OusterCalibration:
    found = read_calibration(PATH, json.dumps(document).encode())
    assert found is not None
    return found


def _set(*path: str) -> Callable[[JsonObject, object], None]:
    def change(document: JsonObject, value: object) -> None:
        for key in path[:-1]:
            document = document[key]
        document[path[-1]] = value

    return change


BEAMS = ("beam_intrinsics", "beam_altitude_angles")
AZIMUTHS = ("beam_intrinsics", "beam_azimuth_angles")
FORMAT = "lidar_data_format"
MISTAKES: list[tuple[tuple[str, ...], object, str]] = [
    (BEAMS, None, "beam_altitude_angles: expected angles in degrees, found nothing"),
    (BEAMS, [], "beam_altitude_angles: expected angles in degrees, found nothing"),
    (BEAMS, "many", "beam_altitude_angles: expected angles in degrees, found many"),
    (BEAMS, [1.0] * 63 + ["2"], "beam_altitude_angles: expected angles in degrees, found 2"),
    (BEAMS, [1.0] * 63 + [True], "beam_altitude_angles: expected angles in degrees, found true"),
    (BEAMS, [1.0] * 63 + [float("nan")], "beam_altitude_angles: expected angles .*, found nan"),
    (BEAMS, [1.0] * 63 + [float("-inf")], "beam_altitude_angles: expected angles .*, found -inf"),
    (BEAMS, [1.0] * 63 + [10**400], "beam_altitude_angles: .*found a number too large for a float"),
    (BEAMS, [1.0] * 63 + [1e5], "beam_altitude_angles: expected angles in degrees, found 100000"),
    (BEAMS, [[1.0] * 64] * 4, "beam_altitude_angles: .*a unit that does not spin"),
    (AZIMUTHS, [1.0] * 63, "beam_azimuth_angles: expected 64 angles in degrees, found 63 entries"),
    (AZIMUTHS, None, "beam_azimuth_angles: expected 64 angles in degrees, found nothing"),
    ((FORMAT, "pixels_per_column"), 128, "pixels_per_column: expected 64, .*, found 128"),
    ((FORMAT, "columns_per_packet"), 0, "columns_per_packet: expected a whole number .*, found 0"),
    (
        (FORMAT, "columns_per_packet"),
        1024,
        "columns_per_packet: expected packets up to 65507 bytes",
    ),
    ((FORMAT, "columns_per_packet"), 15, "columns_per_frame: expected a multiple .*, found 1024"),
    (
        (FORMAT, "columns_per_frame"),
        "1024",
        "columns_per_frame: expected a whole number .*found 1024",
    ),
    (
        (FORMAT, "columns_per_frame"),
        10.5,
        "columns_per_frame: expected a whole number .*, found 10.5",
    ),
    (
        (FORMAT, "columns_per_frame"),
        True,
        "columns_per_frame: expected a whole number .*, found true",
    ),
    ((FORMAT, "columns_per_frame"), float("nan"), "columns_per_frame: .*found NaN"),
    (
        (FORMAT, "column_window"),
        [0, 1024],
        r"column_window: expected .*0 to 1023, found \[0, 1024\]",
    ),
    ((FORMAT, "column_window"), [0], "column_window: expected .*, found 1 entries"),
    ((FORMAT, "column_window"), [0.5, 9], "column_window: expected"),
    ((FORMAT, "udp_profile_lidar"), "RNG99", "udp_profile_lidar: expected one of LEGACY, .*RNG99"),
    ((FORMAT, "udp_profile_lidar"), 7, "udp_profile_lidar: expected a text, found 7"),
    ((FORMAT, "header_type"), "ODD", "header_type: expected STANDARD or FUSA, found ODD"),
    (("sensor_info", "prod_sn"), "12x4", "prod_sn: expected a serial number in digits"),
    (("sensor_info", "prod_sn"), "9" * 13, "prod_sn: expected a serial number in digits"),
    (("sensor_info", "initialization_id"), -1, "initialization_id: expected .*, found -1"),
    (("config_params", "udp_port_lidar"), 70000, "udp_port_lidar: expected .*65535, found 70000"),
    (
        ("lidar_intrinsics", "lidar_to_sensor_transform"),
        [0.0] * 16,
        "lidar_to_sensor_transform: expected 16 finite numbers, a rigid transform",
    ),
    (
        ("lidar_intrinsics", "lidar_to_sensor_transform"),
        np.diag([1.0, 1.0, -1.0, 1.0]).ravel().tolist(),
        "lidar_to_sensor_transform: expected 16 finite numbers, a rigid transform",
    ),
    (
        ("lidar_intrinsics", "lidar_to_sensor_transform"),
        [1.0] * 15,
        "lidar_to_sensor_transform: expected 16 .*, found 15 entries",
    ),
    (
        ("beam_intrinsics", "beam_to_lidar_transform"),
        {"x": 1},
        "beam_to_lidar_transform: expected 16 finite numbers, found",
    ),
    (("ouster-sdk",), {"extrinsic": [2.0] * 16}, "extrinsic: expected 16 finite numbers, a rigid"),
]


@pytest.mark.parametrize(("path", "value", "message"), MISTAKES)
def test_mistakes_are_told_in_one_line(path: tuple[str, ...], value: object, message: str) -> None:
    document = copy.deepcopy(metadata_json(SPEC))
    _set(*path)(document, value)
    with pytest.raises(RigError, match=message) as caught:
        read(document)
    text = str(caught.value)
    assert text.startswith("front.json: Ouster metadata, ")
    assert text.endswith("; save the metadata from the sensor again")
    assert "\n" not in text
    assert len(text) < 500


def test_a_mode_is_needed_where_the_columns_are_not_told() -> None:
    for mode in ("", "fast", None):
        document: JsonObject = {"lidar_mode": mode}
        document |= {key: [1.0] * 64 for key in ("beam_altitude_angles", "beam_azimuth_angles")}
        with pytest.raises(RigError, match="lidar_mode: expected columns x rate such as 1024x10"):
            read(document)


def test_a_file_cut_off_is_ours_but_unusable() -> None:
    content = json.dumps(metadata_json(SPEC)).encode()[:-40]
    with pytest.raises(RigError, match=r"front\.json: Ouster metadata: expected a JSON document"):
        read_calibration(PATH, content)


def test_a_byte_order_mark_is_no_obstacle() -> None:
    content = b"\xef\xbb\xbf" + json.dumps(metadata_json(SPEC)).encode()
    assert read_calibration(PATH, content) is not None
