"""Ouster metadata files: fields, defaults, notes, mistakes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mlbatch.errors import RigError
from mlbatch.sensors.ouster.metadata import Metadata
from mlbatch.sensors.ouster.sensor import OusterCalibration, read_calibration
from mlbatch.simulate.ouster.encode import JsonObject, OusterSpec, flat_json, metadata_json

PATH = Path("front.json")
SPEC = OusterSpec(beams=64, product="OS-1-64-AH", beam_offset_mm=(15.806, 0.0))


def read(document: JsonObject) -> OusterCalibration:
    found = read_calibration(PATH, json.dumps(document).encode())
    assert found is not None
    return found


def reduced(product: str = "", mode: str = "1024x10", beams: int = 64) -> JsonObject:
    document: JsonObject = {
        "lidar_mode": mode,
        "beam_altitude_angles": [-float(beam) / 4 for beam in range(beams)],
        "beam_azimuth_angles": [0.5] * beams,
    }
    return document | ({"prod_line": product} if product else {})


def same(one: Metadata, other: Metadata) -> bool:
    names = [name for name in Metadata._fields if name != "timestamp_mode"]
    pairs = [(getattr(one, name), getattr(other, name)) for name in names]
    return all(np.all(left == right) for left, right in pairs)


def test_nested_and_flat_files_say_the_same() -> None:
    nested, flat = read(metadata_json(SPEC)).metadata, read(flat_json(SPEC)).metadata
    assert same(nested, flat)
    assert nested.timestamp_mode == "TIME_FROM_INTERNAL_OSC"
    assert flat.timestamp_mode == ""
    assert nested.serial == SPEC.serial
    assert nested.init_id == SPEC.init_id


def test_a_reduced_file_is_filled_up_with_defaults() -> None:
    calibration = read(reduced())
    described, lidar = calibration.metadata, calibration.lidar({}, None)
    assert (lidar.packet_size, lidar.columns_per_packet, lidar.channels) == (12608, 16, 64)
    assert (described.lidar_port, described.imu_port, described.imu_profile) == (
        7502,
        7503,
        "LEGACY",
    )
    assert (described.columns_per_frame, described.column_window) == (1024, (0, 1023))
    np.testing.assert_allclose(described.beam_offset_m, (0.012163, 0.0), rtol=1e-15)
    rotated = np.diag([-1.0, -1.0, 1.0, 1.0])
    rotated[2, 3] = 0.03618
    np.testing.assert_array_equal(described.lidar_to_sensor, rotated)
    imu = np.eye(4)
    imu[:3, 3] = 0.006253, -0.011775, 0.007645
    np.testing.assert_array_equal(lidar.sensor_from_imu(), imu)
    assert (lidar.model, lidar.serial, lidar.mode) == ("Ouster 64-beam", "", "1024x10 LEGACY")
    assert (lidar.init_id, lidar.extrinsics, lidar.timestamp_mode) == (0, None, "")
    assert lidar.notes == ("beam origin offset not in the metadata: assumed 0.012163 m",)


@pytest.mark.parametrize(
    ("product", "offset_mm"),
    [
        ("OS-0-128", 27.67),
        ("OS-1-64", 15.806),
        ("OS-2-32", 13.762),
        ("OS-DOME-64", 12.163),
        ("", 12.163),
    ],
)
def test_the_beam_origin_by_product_line(product: str, offset_mm: float) -> None:
    offset_m = read(reduced(product)).metadata.beam_offset_m[0]
    assert offset_m == pytest.approx(offset_mm / 1000, abs=1e-15)


@pytest.mark.parametrize("mode", ["512x10", "512x20", "1024x10", "1024x20", "2048x10", "4096x5"])
def test_columns_per_frame_from_the_mode(mode: str) -> None:
    calibration = read(reduced(mode=mode))
    assert calibration.metadata.columns_per_frame == int(mode.split("x")[0])
    angle_rad = calibration.lidar({}, None).beams.angle_rad
    assert angle_rad is not None
    assert len(angle_rad) == int(mode.split("x")[0])


def test_error_texts_of_old_firmware_count_as_absent() -> None:
    document = reduced("OS-1-64")
    document["lidar_data_format"] = "error: Command not recognized"
    document["calibration_status"] = "error: Command not recognized"
    assert read(document).lidar({}, None).mode == "1024x10 LEGACY"


def test_altitudes_that_do_not_fall_are_noted() -> None:
    document = metadata_json(SPEC)
    angles = document["beam_intrinsics"]["beam_altitude_angles"]
    # Neighbours of a calibrated unit, and two that were exchanged.
    angles[5], angles[6] = angles[6] - 0.1, angles[6] + 0.1
    assert read(document).lidar({}, None).notes == ()
    angles[5], angles[25] = angles[25], angles[5]
    (note,) = read(document).lidar({}, None).notes
    assert "beam_altitude_angles: expected angles that fall from beam to beam, found" in note


def test_old_firmware_sends_64_beams_for_16() -> None:
    lidar = read(reduced("OS-1-16-A0")).lidar({}, None)
    assert (lidar.channels, lidar.packet_size) == (64, 12608)
    assert "OS-1-16-A0 has 64 beam angles: packets of 64 beams" in lidar.notes


def test_header_type_follows_the_profile_unless_stated() -> None:
    for profile, header in (
        ("FUSA_RNG15_RFL8_NIR8_DUAL", "FUSA"),
        ("RNG15_RFL8_NIR8_DUAL", "STANDARD"),
    ):
        document = metadata_json(OusterSpec(profile=profile, beams=64))
        del document["lidar_data_format"]["header_type"]
        assert read(document).metadata.header == header
    assert read(metadata_json(OusterSpec(beams=64, header="FUSA"))).metadata.header == "FUSA"


def test_extrinsics_are_metres_and_identity_means_none() -> None:
    pose = [0.0, -1.0, 0.0, 1.5, 1.0, 0.0, 0.0, -2.0, 0.0, 0.0, 1.0, 0.25, 0.0, 0.0, 0.0, 1.0]
    result = read(metadata_json(OusterSpec(beams=64, extrinsic_m=pose))).lidar({}, None)
    assert result.extrinsics is not None
    assert result.extrinsics.ravel().tolist() == pose
    unknown = OusterSpec(beams=64, extrinsic_m=np.eye(4).ravel().tolist())
    assert read(metadata_json(unknown)).lidar({}, None).extrinsics is None


def test_a_lidar_that_was_off_is_noted_and_the_file_stays_usable() -> None:
    for key, value in (("udp_port_lidar", 0), ("udp_dest", "")):
        document = metadata_json(SPEC)
        document["config_params"][key] = value
        assert read(document).lidar({}, None).notes == (
            "lidar output is off according to the metadata",
        )


def test_the_profile_off_has_no_packets() -> None:
    document = metadata_json(SPEC)
    document["lidar_data_format"]["udp_profile_lidar"] = "OFF"
    with pytest.raises(RigError, match=r"front\.json: .*udp_profile_lidar: expected .*found OFF"):
        read(document).lidar({}, None)


@pytest.mark.parametrize(
    ("order", "first"),
    [(None, "order"), ("STRONGEST_TO_WEAKEST", "order"), ("NEAREST_TO_FARTHEST", "")],
)
def test_the_order_of_two_returns(order: str | None, first: str) -> None:
    document = metadata_json(OusterSpec(profile="RNG19_RFL8_SIG16_NIR16_DUAL", beams=64))
    document["config_params"]["return_order"] = order
    lidar = read(document).lidar({}, None)
    assert (lidar.returns, lidar.typed_by) == (2, first)
    assert len(lidar.return_types) == 2
    single = read(metadata_json(SPEC)).lidar({}, None)
    assert (single.typed_by, single.return_types) == ("", (1,))


def test_beams_lifted_from_the_rotor_plane_and_a_turned_sensor() -> None:
    # Beam 1 looks along x of the lidar frame at column 0: axis (2, 0, 1) mm, so n = sqrt(5) mm.
    spec = OusterSpec(
        beams=2,
        columns_per_frame=512,
        altitude_deg=(90.0, 0.0),
        azimuth_deg=(0.0, 0.0),
        beam_offset_mm=(2.0, 1.0),
        # A rotation by 90 degrees about z, then 100 mm up.
        lidar_to_sensor_mm=[0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1, 100, 0, 0, 0, 1],
    )
    table = read(metadata_json(spec)).lidar({}, None).beams
    n_m = 5**0.5 / 1000
    assert table.reach_m.tolist() == [pytest.approx(-n_m, abs=1e-15)]
    assert table.angle_rad is not None
    angle = table.angle_rad[128]
    assert angle == pytest.approx(1.5 * np.pi)
    for column, level, up in (
        (0, (0.0, 1 - n_m + 0.002, 0.101), (0.0, 0.002, 0.101 + 1 - n_m)),
        # A quarter revolution later, clockwise: lidar -y, which is sensor x.
        (128, (1 - n_m + 0.002, 0.0, 0.101), (0.002, 0.0, 0.101 + 1 - n_m)),
    ):
        cosine, sine = np.cos(table.angle_rad[column]), np.sin(table.angle_rad[column])
        direction = cosine * table.direction[0] + sine * table.direction[1] + table.direction[2]
        origin = cosine * table.origin[0] + sine * table.origin[1] + table.origin[2]
        xyz = (1.0 + table.reach_m)[:, None] * direction + origin
        np.testing.assert_allclose(xyz, [up, level], atol=1e-12)


def test_a_serial_number_may_be_a_number_or_absent() -> None:
    for value, serial in ((122, "122"), ("122", "122"), ("", ""), (None, "")):
        assert read(reduced() | {"prod_sn": value}).serial == serial


def test_a_byte_order_mark_is_no_obstacle() -> None:
    content = b"\xef\xbb\xbf" + json.dumps(metadata_json(SPEC)).encode()
    assert read_calibration(PATH, content) is not None
