"""Velodyne calibration files: YAML and db.xml, damaged ones included."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest

from mlbatch.errors import RigError
from mlbatch.sensors.velodyne.calibration import MAX_BYTES, VelodyneFile, read_velodyne
from mlbatch.simulate.velodyne.models import MODELS, calibration_yaml
from tests.builders.velodyne_xml import entries, xml_of

PATH = Path("drive/unit.yaml")


def read(content: str | bytes, path: Path = PATH) -> VelodyneFile:
    data = content.encode() if isinstance(content, str) else content
    found = read_velodyne(path, data)
    assert found is not None
    return found


def fault(content: str | bytes, path: Path = PATH) -> str:
    with pytest.raises(RigError) as caught:
        read(content, path)
    message = str(caught.value)
    assert "\n" not in message
    assert re.fullmatch(rf"{path}: .*expected .+, found .+; .+", message)
    assert len(message) < 250
    return message


def yaml_of(lasers: Sequence[Mapping[str, object]], end: str = "") -> str:
    """A YAML in the flow form of old ROS drivers."""
    rows = (", ".join(f"{key}: {value}" for key, value in laser.items()) for laser in lasers)
    return "lasers:\n" + "".join(f"- {{{row}}}\n" for row in rows) + end


def sixteen(**changes: object) -> list[dict[str, object]]:
    """Lasers of a VLP-16; changes are to laser 3."""
    lasers: list[dict[str, object]] = [
        {"laser_id": laser, "vert_correction": 0.01 * laser} for laser in range(16)
    ]
    lasers[3].update(changes)
    return lasers


def test_lasers_are_ordered_by_id_and_missing_values_are_zero() -> None:
    file = read(yaml_of(sixteen(dist_correction="1e-1", rot_correction=-0.5)[::-1]))
    assert file.elevation_rad.tolist() == [0.01 * laser for laser in range(16)]
    assert file.dist_correction_m.tolist() == [0.0] * 3 + [0.1] + [0.0] * 12
    assert file.azimuth_rad[3] == -0.5
    assert not file.vert_offset_m.any()
    assert file.unit_m is None
    assert file.path == PATH


def test_unused_keys_and_orders_of_the_file_do_not_matter() -> None:
    lasers = sixteen(two_pt_correction_available="true", focal_slope=1.4)
    text = "# made by hand\ndistance_resolution: 0.007\nnum_lasers: 16\n" + yaml_of(lasers)
    # The 7 mm of VLS-128 files are for the decoder to weigh.
    assert read(b"\xef\xbb\xbf" + text.encode()).unit_m == 0.007
    assert read(text.replace("\n", "\r\n")).lasers == 16
    assert (
        read(
            "{"
            + "lasers: ["
            + ", ".join(f"{{laser_id: {n}, vert_correction: 0}}" for n in range(16))
            + "]}"
        ).lasers
        == 16
    )


@pytest.mark.parametrize("model", MODELS)
def test_files_of_the_encoder_are_read(model: str) -> None:
    table = MODELS[model]
    file = read(calibration_yaml(model))
    assert file.unit_m == table.unit_m
    degrees = [math.degrees(angle) for angle in file.elevation_rad]
    assert degrees == pytest.approx(table.elevation_deg)
    assert [-math.degrees(one) for one in file.azimuth_rad] == pytest.approx(table.azimuth_deg)
    assert tuple(file.dist_correction_m) == table.dist_m


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (yaml_of(sixteen()[:15]), "lasers: expected 16, 32, 64, 128 lasers, found 15"),
        (
            yaml_of([], "num_lasers: 16\nlaser_id: 1\n"),
            "lasers: expected a list of lasers, found none",
        ),
        ("num_lasers: 64\ndistance_resolution: 0.002\n", "lasers: expected a list of lasers"),
        ("lasers: many\nnum_lasers: 1\nlaser_id: 3", "lasers: expected a list of lasers"),
        ("[\nlasers: 16, laser_id: 3]\n", "lasers: expected a list of lasers, found none"),
        ("lasers:\n" + "- laser_id\n" * 16, "lasers[0]: expected a mapping with laser_id"),
        (
            yaml_of(sixteen(laser_id=16)),
            "lasers[3].laser_id: expected a laser id from 0 to 15, found 16",
        ),
        (yaml_of(sixteen(laser_id=-1)), "lasers[3].laser_id: expected a laser id from 0 to 15"),
        (yaml_of(sixteen(laser_id="x")), "lasers[3].laser_id: expected a laser id"),
        (yaml_of(sixteen(laser_id=2)), "lasers[3].laser_id: expected each id once, found 2 again"),
        (yaml_of(sixteen(vert_correction=".nan")), "lasers[3].vert_correction: expected a finite"),
        (yaml_of(sixteen(rot_correction=".inf")), "lasers[3].rot_correction: expected a finite"),
        (yaml_of(sixteen(rot_correction="nan")), "found nan"),
        (
            yaml_of(sixteen(vert_correction="")),
            "lasers[3].vert_correction: expected a finite number",
        ),
        (yaml_of(sixteen(vert_correction="[1]")), "found ['1']"),
        # Degrees instead of radians.
        (
            yaml_of(sixteen(vert_correction=-15)),
            "expected at most 1.5708 rad in absolute value, found -15",
        ),
        (yaml_of(sixteen(rot_correction=1.6)), "lasers[3].rot_correction: expected at most 1.5708"),
        # Centimetres instead of metres.
        (yaml_of(sixteen(dist_correction=130)), "lasers[3].dist_correction: expected at most 2 m"),
        (
            yaml_of(sixteen(vert_offset_correction=19.5)),
            "expected at most 1 m in absolute value, found 19.5",
        ),
        (yaml_of(sixteen(horiz_offset_correction=-2.6)), "expected at most 1 m in absolute value"),
        # Lasers that measure from places far apart; the second by corrections for near points.
        (
            yaml_of(sixteen(dist_correction=1.3)),
            "dist_correction: expected lasers that measure from places within 1 m of each other, "
            "found 1.3 m",
        ),
        (yaml_of(sixteen(dist_correction_x=-0.6, dist_correction_y=0.6)), "found 1.2 m"),
        (
            yaml_of(sixteen(vert_offset_correction=0.8, horiz_offset_correction=0.8)),
            "found 1.13 m, with the offsets of a laser",
        ),
        (
            yaml_of(sixteen(), "num_lasers: 32\n"),
            "num_lasers: expected 16, the lasers listed, found 32",
        ),
        (
            yaml_of(sixteen(), "distance_resolution: 2\n"),
            "distance_resolution: expected 0.0005 to 0.02 m",
        ),
        (
            yaml_of(sixteen(), "distance_resolution: fine\n"),
            "distance_resolution: expected a finite",
        ),
        (yaml_of(sixteen())[:-30], ": expected YAML, found did not find"),
        (
            yaml_of(sixteen(), "a: &a [1]\nb: *a\n"),
            "expected values written out, found the alias *a",
        ),
        (yaml_of(sixteen(), "a: " + "[" * 50_000), "expected at most 8 levels, found more"),
        (yaml_of(sixteen(), "a: \x07"), "expected YAML, found"),
        (yaml_of(sixteen(), "---\nb: 1\n"), "expected YAML, found"),
        (yaml_of(sixteen(), "#" * MAX_BYTES), f"expected at most {MAX_BYTES} bytes, found 100"),
        (yaml_of(sixteen()).encode() + b"# \xff", "expected UTF-8 text, found the byte 0xff"),
    ],
)
def test_broken_yaml(text: str | bytes, message: str) -> None:
    assert message in fault(text)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{}",
        b"\x00" * 100,
        b"\xff\xd8\xff\xe0lasers: vert_correction",
        b"Laser id,Elevation,Azimuth\n1,14.436,-1.042\n",
        b'{"beam_intrinsics": {"beam_altitude_angles": [1, 2]}, "lasers": 3}',
        b"rate: 10\nsensors:\n- name: top\n  model: VLP-16\n",
        b"lasers: 16\n",
        b"- lasers: 16\n- laser_id: 3\n",
        b"<robot name='a'><joint name='b'/></robot>",
        b"<boost_serialization><other>1</other></boost_serialization>",
        b"<a><rotCorrection_>1</rotCorrection_></a>",
        b"#ROSBAG V2.0\nlasers:\nlaser_id: 1\x00",
        "num_lasers: 16\nlaser_id: 3".encode("utf-16"),
    ],
)
def test_other_files_are_not_recognised(content: bytes) -> None:
    assert read_velodyne(PATH, content) is None


@pytest.mark.parametrize(
    "piece", [b'{"a": 1},\n', b"<a>\n", b"lasers 1, 2\n", b"\t {, \n", b"- [\n"]
)
def test_large_foreign_files_are_left_quickly(piece: bytes) -> None:
    content = piece * (16_000_000 // len(piece))
    begin = time.process_time()
    assert read_velodyne(PATH, content) is None
    assert time.process_time() - begin < 2.0


XML = Path("drive/db.xml")


def test_xml_gives_degrees_and_centimetres() -> None:
    changed = entries(
        64,
        vertCorrection_=-7.5,
        distCorrection_=151.95264,
        distCorrectionX_="1.55e+02",
        distCorrectionY_=152.5,
        vertOffsetCorrection_=19.5,
        horizOffsetCorrection_=-2.6,
        focalSlope_=1.4,
    )
    # A laser without a correction would be 1.5 m off.
    for entry in changed:
        entry.setdefault("distCorrection_", 150)
    file = read(xml_of(changed[::-1], [1] * 64), XML)
    assert (file.lasers, file.notes) == (64, ())
    assert file.unit_m == pytest.approx(0.002)
    assert math.degrees(file.elevation_rad[3]) == pytest.approx(-7.5)
    assert math.degrees(file.azimuth_rad[63]) == pytest.approx(-1.5)
    assert math.degrees(file.elevation_rad[63]) == pytest.approx(15.75)
    assert file.dist_correction_m[3] == pytest.approx(1.5195264)
    assert file.dist_correction_x_m[3] == pytest.approx(1.55)
    assert file.dist_correction_y_m[3] == pytest.approx(1.525)
    assert file.vert_offset_m[3] == pytest.approx(0.195)
    assert file.horiz_offset_m[3] == pytest.approx(-0.026)
    assert file.dist_correction_m[4] == pytest.approx(1.5)
    assert file.horiz_offset_m[4] == 0


def test_xml_of_32_lasers_lists_64() -> None:
    file = read(xml_of(entries(64), [1] * 32 + [0] * 32), XML)
    assert file.lasers == 32
    assert len(file.elevation_rad) == 32
    assert file.enabled.all()
    assert file.notes == ("32 of 64 lasers are enabled",)


def test_xml_with_a_laser_switched_off() -> None:
    file = read(xml_of(entries(64), [1] * 9 + [0] + [1] * 54), XML)
    assert file.lasers == 64
    assert (~file.enabled).nonzero()[0].tolist() == [9]
    assert file.notes == ("63 of 64 lasers are enabled",)


def test_xml_without_flags_has_all_lasers() -> None:
    file = read(xml_of(entries(16)).replace("<?xml", "\ufeff<?xml", 1), XML)
    assert file.lasers == 16
    assert file.enabled.all()


ENTITIES = '<!DOCTYPE boost_serialization [<!ENTITY a "1111111111"><!ENTITY b "&a;&a;&a;">]>'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            xml_of(entries(64, id_=64)),
            "DB.points_.item[3].id_: expected a laser id from 0 to 63, found 64",
        ),
        (
            xml_of(entries(64, id_=2)),
            "DB.points_.item[3].id_: expected each id once, found 2 again",
        ),
        (xml_of(entries(63)), "lasers: expected ids 0 to 63, found no laser 63"),
        (
            xml_of([]).replace("0.2<", "0.2<!-- rotCorrection_ --><"),
            "DB.points_: expected 1 to 128",
        ),
        (xml_of(entries(129)), "DB.points_: expected 1 to 128 lasers, found 129"),
        (
            xml_of(entries(64, vertCorrection_=91)),
            "vertCorrection_: expected at most 90 degrees",
        ),
        (
            xml_of(entries(64, rotCorrection_="nan")),
            "rotCorrection_: expected a finite number, found nan",
        ),
        (
            xml_of(entries(64, distCorrection_=1500)),
            "distCorrection_: expected at most 200 cm",
        ),
        (xml_of(entries(64), [0] * 64), "DB.enabled_: expected enabled lasers, found none"),
        (xml_of(entries(64), [2] * 64), "DB.enabled_: expected at most 128 items of 0 or 1"),
        (xml_of(entries(64), [1] * 200), "DB.enabled_: expected at most 128 items of 0 or 1"),
        (xml_of(entries(64), lsb_cm=20), "DB.distLSB_: expected 0.05 to 2 cm, found 20"),
        (xml_of(entries(64))[:-200], "expected XML, found"),
        (
            xml_of(entries(64), kind=ENTITIES),
            "expected XML without entities and definitions, found some",
        ),
        (
            xml_of(entries(64), kind='<!DOCTYPE boost_serialization SYSTEM "a.dtd">'),
            "expected XML without entities and definitions, found some",
        ),
        (xml_of(entries(64)) + " " * MAX_BYTES, "expected at most 1000000 bytes"),
    ],
)
def test_broken_xml(text: str, message: str) -> None:
    assert message in fault(text, XML)
