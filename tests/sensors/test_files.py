"""Calibration files: a broken one is refused in one line, that of another vendor left alone.

A row of a table is what a file contains and the line that it gives.
"""

from __future__ import annotations

import copy
import hashlib
import json
import math
import re
import struct
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from mlbatch import sensors
from mlbatch.errors import RigError
from mlbatch.sensors.hesai.angles import HesaiAngles, read_angles, read_at128
from mlbatch.sensors.velodyne.calibration import MAX_BYTES, VelodyneFile, read_velodyne
from mlbatch.simulate.ouster.encode import OusterSpec, metadata_json
from mlbatch.simulate.robosense.encode import RobosenseSpec, angles_csv
from mlbatch.simulate.velodyne.models import MODELS, calibration_yaml
from tests.builders.spinning import best_of, from_file, stream_of
from tests.builders.velodyne_xml import entries, xml_of

# -- what files contain ---------------------------------------------------------------------------


def velodyne_yaml(lasers: Sequence[Mapping[str, object]], end: str = "") -> str:
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


def hesai_lines() -> list[str]:
    """Lines of a good file; channel c has elevation c / 2 and azimuth -c deg."""
    return ["Laser id,Elevation,Azimuth", *(f"{c},{c / 2},{-c}" for c in range(1, 17))]


def text_of(lines: Sequence[str], end: str = "\n") -> bytes:
    """Lines as a file."""
    return "".join(line + end for line in lines).encode()


def at128(resolution: int = 2, changes: Mapping[int, int] | None = None) -> bytes:
    """Frames at 20, 140, 260 deg, 120 deg wide; azimuth 1 deg, elevation channel / 10 deg, from 0.

    Adjust of channel 1 at 4 deg: azimuth 0.06, elevation -0.02 deg; elsewhere 0. changes: after
    the digest was taken.
    """
    per_deg = 25600 // resolution
    adjust = bytearray(2 * 128 * 180)
    adjust[180 + 2], adjust[128 * 180 + 180 + 2] = 6 // resolution, 256 - 2 // resolution
    body = b"\xee\xff\x01\x05\x80\x03\x03" + bytes(8) + bytes([resolution])
    body += struct.pack("<6I", *(deg * per_deg for deg in (20, 140, 260, 140, 260, 20)))
    body += struct.pack("<128i", *([per_deg] * 128))
    body += struct.pack("<128i", *(per_deg * channel // 10 for channel in range(128)))
    body += bytes(adjust)
    content = bytearray(body + hashlib.sha256(body).digest())
    for at, value in (changes or {}).items():
        content[at] = value
    return bytes(content)


DIGEST = hashlib.sha256(text_of(hesai_lines(), "\r\n")).hexdigest()
OUSTER = metadata_json(OusterSpec(beams=64, product="OS-1-64-AH"))


def ouster(path: tuple[str, ...], value: object) -> bytes:
    """Metadata with a changed value."""
    whole = part = copy.deepcopy(OUSTER)
    for key in path[:-1]:
        part = part.setdefault(key, {})
    part[path[-1]] = value
    return json.dumps(whole).encode()


def moved(x: float, scale: float = 1.0) -> list[float]:
    """A transform row by row: no rotation, x as translation."""
    return [scale, 0, 0, x, 0, scale, 0, 0, 0, 0, scale, 0, 0, 0, 0, 1]


# -- broken files ---------------------------------------------------------------------------------

# Changes to laser 3 of a YAML.
VELODYNE_LASER: list[tuple[dict[str, object], str]] = [
    ({"laser_id": 16}, "lasers[3].laser_id: expected a laser id from 0 to 15, found 16"),
    ({"laser_id": 2}, "lasers[3].laser_id: expected each id once, found 2 again"),
    ({"vert_correction": ".nan"}, "lasers[3].vert_correction: expected a finite"),
    ({"rot_correction": ".inf"}, "lasers[3].rot_correction: expected a finite"),
    # Degrees instead of radians.
    ({"vert_correction": -15}, "expected at most 1.5708 rad in absolute value, found -15"),
    # Centimetres instead of metres.
    ({"dist_correction": 130}, "lasers[3].dist_correction: expected at most 2 m"),
    ({"vert_offset_correction": 19.5}, "expected at most 1 m in absolute value, found 19.5"),
    # Lasers that measure from places far apart; the second by corrections for near points.
    (
        {"dist_correction": 1.3},
        "dist_correction: expected lasers that measure from places within 1 m of each other, "
        "found 1.3 m",
    ),
    (
        {"vert_offset_correction": 0.8, "horiz_offset_correction": 0.8},
        "found 1.13 m, with the offsets of a laser",
    ),
]
# What follows the lasers of a YAML.
VELODYNE_END = [
    ("num_lasers: 32\n", "num_lasers: expected 16, the lasers listed, found 32"),
    ("distance_resolution: 2\n", "distance_resolution: expected 0.0005 to 0.02 m"),
    ("a: &a [1]\nb: *a\n", "expected values written out, found the alias *a"),
    ("a: " + "[" * 50_000, "expected at most 8 levels, found more"),
    ("a: \x07", "expected YAML, found"),
    ("#" * MAX_BYTES, f"expected at most {MAX_BYTES} bytes, found 100"),
]
ODD = [
    {"laser_id": laser, "vert_correction": angle_rad}
    for laser, angle_rad in enumerate(np.radians(np.linspace(-60, 60, 16)).tolist())
]
NO_LASERS = "lasers: expected a list of lasers"
VELODYNE_YAML: list[tuple[str | bytes, str]] = [
    *((velodyne_yaml(sixteen(**changes)), text) for changes, text in VELODYNE_LASER),
    *((velodyne_yaml(sixteen(), end), text) for end, text in VELODYNE_END),
    (velodyne_yaml(sixteen()[:15]), "lasers: expected 16, 32, 64, 128 lasers, found 15"),
    (velodyne_yaml([], "num_lasers: 16\nlaser_id: 1\n"), f"{NO_LASERS}, found none"),
    ("num_lasers: 64\ndistance_resolution: 0.002\n", NO_LASERS),
    ("lasers:\n" + "- laser_id\n" * 16, "lasers[0]: expected a mapping with laser_id"),
    (velodyne_yaml(sixteen())[:-30], ": expected YAML, found did not find"),
    (velodyne_yaml(sixteen()).encode() + b"# \xff", "expected UTF-8 text, found the byte 0xff"),
    (velodyne_yaml(ODD), "expected vertical angles of "),
]
# Changes to point 3 of a db.xml.
VELODYNE_POINT: list[tuple[dict[str, object], str]] = [
    ({"id_": 64}, "DB.points_.item[3].id_: expected a laser id from 0 to 63, found 64"),
    ({"id_": 2}, "DB.points_.item[3].id_: expected each id once, found 2 again"),
    ({"rotCorrection_": "nan"}, "rotCorrection_: expected a finite number, found nan"),
]
DOCTYPE = "<!DOCTYPE boost_serialization"
ENTITIES = '[<!ENTITY a "1111111111"><!ENTITY b "&a;&a;&a;">]'
NO_ENTITIES = "expected XML without entities and definitions, found some"
VELODYNE_XML: list[tuple[str | bytes, str]] = [
    *((xml_of(entries(64, **changes)), text) for changes, text in VELODYNE_POINT),
    (xml_of(entries(63)), "lasers: expected ids 0 to 63, found no laser 63"),
    (xml_of([]).replace("0.2<", "0.2<!-- rotCorrection_ --><"), "DB.points_: expected 1 to 128"),
    (xml_of(entries(64), [2] * 64), "DB.enabled_: expected at most 128 items of 0 or 1"),
    (xml_of(entries(64), [0] * 64), "DB.enabled_: expected enabled lasers, found none"),
    (xml_of(entries(64), lsb_cm=20), "DB.distLSB_: expected 0.05 to 2 cm, found 20"),
    (xml_of(entries(64))[:-200], "expected XML, found"),
    (xml_of(entries(64), kind=f"{DOCTYPE} {ENTITIES}>"), NO_ENTITIES),
    (xml_of(entries(64), kind=f'{DOCTYPE} SYSTEM "a.dtd">'), NO_ENTITIES),
    (xml_of(entries(64)) + " " * MAX_BYTES, "expected at most 1000000 bytes"),
]
# A line of a HESAI csv, by its number from 0, what is there instead, and what follows the path.
HESAI_LINE: list[tuple[int, list[str], str]] = [
    (2, ["1,0,0"], "line 3: expected every channel once, found channel 1 again"),
    (9, [], "line 16: expected channels 1 to 16, found no channel 9"),
    (4, ["4,abc,0"], "line 5: expected elevation from -90 to 90 deg, found abc"),
    (4, ["4,nan,0"], "line 5: expected elevation from -90 to 90 deg, found nan"),
    (4, ["4,0,-361"], "line 5: expected azimuth from -360 to 360 deg, found -361"),
    (1, ["129,0,0"], "line 2: expected a channel from 1 to 128, found 129"),
    (16, ["16,8.0"], "line 17: expected channel, elevation, azimuth, found 16, 8.0"),
    (1, ["1" + "x" * 99], "line 2: expected channel, elevation, azimuth, found 1" + "x" * 56),
]
CHANNELS = "16, 20, 32, 40, 64, 90 or 128 channels in all"
HESAI: list[tuple[str | bytes, str]] = [
    *(
        (text_of([*hesai_lines()[:at], *lines, *hesai_lines()[at + 1 :]]), f"HESAI angles, {text}")
        for at, lines, text in HESAI_LINE
    ),
    (text_of(hesai_lines()[:12]), f"HESAI angles, line 12: expected {CHANNELS}, found 11;"),
    (
        text_of([*hesai_lines(), f"{DIGEST},,"]).replace(b"3,1.5,-3", b"3,1.6,-3"),
        "HESAI angles, line 18: expected lines that match this SHA-256, found changed lines;",
    ),
    *(
        (at128(changes={at: value}), f"HESAI AT128 angles: expected {text};")
        for at, value, text in (
            (3, 3, "version 1.5, found 1.3"),
            (5, 4, "mirrors 3, found 4"),
            (15, 0, "a resolution from 1 to 8, found 0"),
            (9000, 1, "content that matches its SHA-256, found changed content"),
        )
    ),
    (at128()[:400], "HESAI AT128 angles: expected 47176 bytes, found 400 bytes"),
]
LINE = b"1.0,2.0\n"
DEGREES = "expected degrees up to 90 and 180"
ROBOSENSE: list[tuple[str | bytes, str]] = [
    (content, f"ROBOSENSE angles: {text}")
    for content, text in (
        (LINE * 31, "expected 16, 32, 48, 80, 96 or 128 lines `elevation,azimuth`, found 31"),
        (LINE * 15 + b"95,0\n", f"{DEGREES} in line 16, found '95,0'"),
        (b"elevation,azimuth\n" + LINE * 15 + b"1,x\n", f"{DEGREES} in line 17, found '1,x'"),
        (LINE * 15 + b"nan,0\n", f"{DEGREES} in line 16, found 'nan,0'"),
    )
]
BEAMS = ("beam_intrinsics", "beam_altitude_angles")
AZIMUTHS = ("beam_intrinsics", "beam_azimuth_angles")
BEAM_TO_LIDAR = ("beam_intrinsics", "beam_to_lidar_transform")
LIDAR_TO_SENSOR = ("lidar_intrinsics", "lidar_to_sensor_transform")
IMU_TO_SENSOR = ("imu_intrinsics", "imu_to_sensor_transform")
FORMAT = "lidar_data_format"
PER_PACKET, PER_FRAME = (FORMAT, "columns_per_packet"), (FORMAT, "columns_per_frame")
EXTRINSIC = ("ouster-sdk", "extrinsic")
FAR = " at most 1000 mm, found"
# A key of Ouster metadata, its value, and a pattern of what follows its name.
OUSTER_KEY: list[tuple[tuple[str, ...], object, str]] = [
    (BEAMS, None, "expected angles in degrees, found nothing"),
    (BEAMS, [1.0] * 63 + [True], "expected angles in degrees, found true"),
    (BEAMS, [1.0] * 63 + [float("nan")], "expected angles .*, found nan"),
    (BEAMS, [1.0] * 63 + [10**400], ".*found a number too large for a float"),
    (BEAMS, [90.5] + [1.0] * 63, "expected angles from -90 to 90 degrees, found 90.5"),
    (
        BEAMS,
        np.linspace(-16.0, 16.0, 64).tolist(),
        "expected angles that fall .*, found -16 to 16 degrees, as if their sign were turned",
    ),
    (
        BEAMS,
        np.radians(np.linspace(16.0, -16.0, 64)).tolist(),
        "expected degrees, over a field of 5 or more, found 0.279253 to -0.279253, as if they "
        "were radians",
    ),
    (BEAMS, [[1.0] * 64] * 4, ".*a unit that does not spin"),
    (AZIMUTHS, [1.0] * 63, "expected 64 angles in degrees, found 63 entries"),
    ((FORMAT, "pixels_per_column"), 128, "expected 64, .*, found 128"),
    (PER_PACKET, 0, "expected a whole number .*, found 0"),
    (PER_PACKET, 1024, "expected packets up to 65507 bytes"),
    (PER_FRAME, 10.5, "expected a whole number .*, found 10.5"),
    ((FORMAT, "column_window"), [0, 1024], r"expected .*0 to 1023, found \[0, 1024\]"),
    ((FORMAT, "column_window"), [0], "expected .*, found 1 entries"),
    ((FORMAT, "udp_profile_lidar"), "RNG99", "expected one of LEGACY, .*RNG99"),
    ((FORMAT, "udp_profile_lidar"), 7, "expected a text, found 7"),
    ((FORMAT, "header_type"), "ODD", "expected STANDARD or FUSA, found ODD"),
    (("sensor_info", "prod_sn"), "12x4", "expected a serial number in digits"),
    (("config_params", "udp_port_lidar"), 70000, "expected .*65535, found 70000"),
    (LIDAR_TO_SENSOR, [1.0] * 15, "expected 16 .*, found 15 entries"),
    # Metres.
    (
        LIDAR_TO_SENSOR,
        moved(0.03618),
        "expected millimetres, found 0.03618 mm, 36.18 mm if the file has metres",
    ),
    # Numbers as in files with damaged bytes: 6e15 m, and others that no lidar can have.
    (BEAM_TO_LIDAR, moved(6e18), f".*{FAR} 6e"),
    (BEAM_TO_LIDAR, moved(0.0, scale=1.1), "expected .* rigid"),
    (LIDAR_TO_SENSOR, moved(math.nan), "expected .*, found nan"),
    (
        LIDAR_TO_SENSOR,
        moved(495.0),
        "expected beams that leave within 0.5 m of the origin of the sensor, found 0.5",
    ),
    (IMU_TO_SENSOR, moved(-1500.0), f".*{FAR} 1500 mm"),
    (EXTRINSIC, moved(101.0), ".* at most 100 m, found 101 m"),
]
BROKEN = [
    *(("unit.yaml", content, text) for content, text in VELODYNE_YAML),
    *(("db.xml", content, text) for content, text in VELODYNE_XML),
    *(("unit.csv", content, f"unit.csv: {text}") for content, text in (*HESAI, *ROBOSENSE)),
]


def refusal(name: str, content: str | bytes) -> str:
    """The line that a file gives."""
    data = content.encode() if isinstance(content, str) else content
    with pytest.raises(RigError) as caught:
        sensors.parse_calibration(Path(name), data)
    line = str(caught.value)
    assert re.fullmatch(rf"{re.escape(name)}: .*expected .+, found .+; .+", line)
    return line


@pytest.mark.parametrize(("name", "content", "text"), BROKEN)
def test_a_broken_file_is_refused_in_one_line(name: str, content: str | bytes, text: str) -> None:
    line = refusal(name, content)
    assert text in line
    assert len(line) < 250


@pytest.mark.parametrize(
    ("path", "value", "text"),
    [*OUSTER_KEY, (PER_PACKET, 15, "columns_per_frame: expected a multiple .*, found 1024")],
)
def test_broken_metadata_of_an_ouster_are_refused(
    path: tuple[str, ...], value: object, text: str
) -> None:
    line = refusal("front.json", ouster(path, value))
    key = "" if path == PER_PACKET and value == 15 else f"{path[-1]}: "
    assert re.search(f"^front.json: Ouster metadata, .*{key}{text}", line)
    assert line.endswith("; save the metadata from the sensor again")
    assert len(line) < 500


@pytest.mark.parametrize("mode", ["", "fast", None])
def test_a_mode_is_needed_where_the_columns_are_not_stated(mode: str | None) -> None:
    angles = {key: [1.0] * 64 for key in ("beam_altitude_angles", "beam_azimuth_angles")}
    line = refusal("front.json", json.dumps({"lidar_mode": mode, **angles}))
    assert "lidar_mode: expected columns x rate such as 1024x10" in line


def test_metadata_cut_off_are_recognised_but_unusable() -> None:
    line = refusal("front.json", json.dumps(OUSTER)[:-40])
    assert line.startswith("front.json: Ouster metadata: expected a JSON document")


# -- files of others ------------------------------------------------------------------------------

FOREIGN: list[bytes] = [
    *(b"", b"{}", b"{ broken", b"[1, 2]", b"\x00" * 100, b"\xff\xfe\x00\x01", b"1\n" * 32),
    *(b'{"transforms": []}', b'{"packet_hash": {}}', b'{"sensor_info": {"maker": "another"}}'),
    b"\xff\xd8\xff\xe0lasers: vert_correction",
    b"rate: 10\nsensors:\n- name: top\n  model: VLP-16\n",
    *(b"lasers: 16\n", b"- lasers: 16\n- laser_id: 3\n", b"#ROSBAG V2.0\nlasers:\nlaser_id: 1\x00"),
    "num_lasers: 16\nlaser_id: 3".encode("utf-16"),
    b"<robot name='a'><joint name='b'/></robot>",
    b"<boost_serialization><other>1</other></boost_serialization>",
    b"<a><rotCorrection_>1</rotCorrection_></a>",
    *(b"index,start_ns,end_ns\n0,1,2\n", b"Laser id\n1\n"),
    b"EEFF,1,1\nChannel,fire time(us),Channel,fire time(us)\n1,0,2,1\n",
    b"beam,elevation,azimuth\n1,2,3\n",
    b"Channel,Azimuth,Azimuth\n1,2,3\n",
    *("körper: größe\n".encode("latin-1"), b"name,value\nleft,right\n", b"\xee\xff", bytes(47176)),
    b"x,y,z\n" * 40 + text_of(hesai_lines()),
    *(b"{" * 100_000, b"a,b\n" * 200_000),
]
HELIOS = RobosenseSpec("Helios 32").angles
OWNED = {
    "Ouster": [json.dumps(OUSTER).encode()],
    "Velodyne": [calibration_yaml("VLP-16").encode(), xml_of(entries(64)).encode()],
    "HESAI": [text_of(hesai_lines()), at128(), b"\xee\xff\x01\x05\x80" + bytes(300)],
    "ROBOSENSE": [
        angles_csv(HELIOS).encode(),
        b"elevation,azimuth\n1.0,2.0\n",
        LINE + b"13.0,2.0\n",
        # Its files have no title of their own.
        b"Channel,fire time(us)\n1,2.31\n",
    ],
    "Livox": [],
}


@pytest.mark.parametrize("plugin", sensors.plugins(), ids=lambda plugin: plugin.VENDOR)
def test_files_of_others_are_left_alone(plugin: sensors.Plugin) -> None:
    for content in FOREIGN:
        assert plugin.read_calibration(Path("unit"), content) is None, content[:40]
    for vendor, contents in OWNED.items():
        for content in contents if vendor != plugin.VENDOR else []:
            assert plugin.read_calibration(Path("unit"), content) is None, (vendor, content[:40])


@pytest.mark.parametrize(
    "piece", [b'{"a": 1},\n', b"<a>\n", b"lasers 1, 2\n", b"\t {, \n", b"- [\n"]
)
def test_large_foreign_files_are_left_quickly(piece: bytes) -> None:
    content = piece * (16_000_000 // len(piece))
    begin = time.process_time()
    assert read_velodyne(Path("large"), content) is None
    assert time.process_time() - begin < 2.0


# -- good files -----------------------------------------------------------------------------------


def read(content: str | bytes, name: str = "unit.yaml") -> VelodyneFile:
    """A file of a Velodyne."""
    found = read_velodyne(Path(name), content.encode() if isinstance(content, str) else content)
    assert found is not None
    return found


def test_a_yaml_is_ordered_by_id_and_missing_values_are_zero() -> None:
    file = read(velodyne_yaml(sixteen(dist_correction="1e-1", rot_correction=-0.5)[::-1]))
    assert file.elevation_rad.tolist() == [0.01 * laser for laser in range(16)]
    assert file.dist_correction_m.tolist() == [0.0] * 3 + [0.1] + [0.0] * 12
    assert file.azimuth_rad[3] == -0.5
    assert not file.vert_offset_m.any()
    assert (file.unit_m, file.path) == (None, Path("unit.yaml"))


def test_unused_keys_and_orders_of_a_yaml_do_not_matter() -> None:
    lasers = velodyne_yaml(sixteen(two_pt_correction_available="true", focal_slope=1.4))
    text = f"# made by hand\ndistance_resolution: 0.007\nnum_lasers: 16\n{lasers}"
    # The 7 mm of VLS-128 files are for the decoder to weigh.
    assert read(b"\xef\xbb\xbf" + text.encode()).unit_m == 0.007
    assert read(text.replace("\n", "\r\n")).lasers == 16
    rows = ", ".join(f"{{laser_id: {n}, vert_correction: 0}}" for n in range(16))
    assert read(f"{{lasers: [{rows}]}}").lasers == 16


@pytest.mark.parametrize("model", MODELS)
def test_files_of_the_encoder_are_read(model: str) -> None:
    table = MODELS[model]
    file = read(calibration_yaml(model))
    assert file.unit_m == table.unit_m
    assert np.degrees(file.elevation_rad) == pytest.approx(table.elevation_deg)
    assert -np.degrees(file.azimuth_rad) == pytest.approx(table.azimuth_deg)
    assert tuple(file.dist_correction_m) == table.dist_m
    # The model is the first of those with the nearest angles.
    found = from_file(calibration_yaml(model), "a.yaml")
    expected = {"Puck LITE": "VLP-16", "HDL-64E S2": "HDL-64E S3"}.get(model, model)
    assert (found.model, found.is_shared) == (expected, True)
    assert (found.serial, found.path) == ("", Path("a.yaml"))


def test_xml_gives_degrees_and_centimetres() -> None:
    values: dict[str, object] = {"vertCorrection_": -7.5, "distCorrection_": 151.95264}
    values |= {"distCorrectionX_": "1.55e+02", "distCorrectionY_": 152.5, "focalSlope_": 1.4}
    values |= {"vertOffsetCorrection_": 19.5, "horizOffsetCorrection_": -2.6}
    changed = entries(64, **values)
    # A laser without a correction would be 1.5 m off.
    for entry in changed:
        entry.setdefault("distCorrection_", 150)
    file = read(xml_of(changed[::-1], [1] * 64))
    assert (file.lasers, file.notes) == (64, ())
    assert file.unit_m == pytest.approx(0.002)
    assert np.degrees(file.elevation_rad[[3, 63]]) == pytest.approx([-7.5, 15.75])
    assert math.degrees(file.azimuth_rad[63]) == pytest.approx(-1.5)
    assert file.dist_correction_m[[3, 4]] == pytest.approx([1.5195264, 1.5])
    assert file.dist_correction_x_m[3] == pytest.approx(1.55)
    assert file.dist_correction_y_m[3] == pytest.approx(1.525)
    assert file.vert_offset_m[3] == pytest.approx(0.195)
    assert file.horiz_offset_m[[3, 4]] == pytest.approx([-0.026, 0])


@pytest.mark.parametrize(
    ("listed", "flags", "lasers", "dark", "notes"),
    [
        (64, [1] * 32 + [0] * 32, 32, [], ("32 of 64 lasers are enabled",)),
        (64, [1] * 9 + [0] + [1] * 54, 64, [9], ("63 of 64 lasers are enabled",)),
        (16, [], 16, [], ()),
    ],
)
def test_lasers_that_an_xml_enables(
    listed: int, flags: list[int], lasers: int, dark: list[int], notes: tuple[str, ...]
) -> None:
    text = xml_of(entries(listed), flags)
    for content in (text, text.replace("<?xml", "\ufeff<?xml", 1)):
        file = read(content, "db.xml")
        assert (file.lasers, len(file.elevation_rad), file.notes) == (lasers, lasers, notes)
        assert (~file.enabled).nonzero()[0].tolist() == dark


def hesai_angles(content: bytes) -> HesaiAngles:
    """A csv of a HESAI."""
    found = read_angles(Path("unit.csv"), content)
    assert found is not None
    return found


TITLE, *ROWS = hesai_lines()
# Another order of columns, and lines around the rows.
SWAPPED = ["Channel,Azimuth,Elevation", *(f"{c},{-c},{c / 2}" for c in range(1, 17))]
DRESSED = ["\ufeffEEFF,1,1", "# angles of a unit", TITLE, "", ROWS[1], "# 2 before 1", ROWS[0]]
DRESSED += [*(line + ",," for line in ROWS[2:]), ",,"]


@pytest.mark.parametrize(
    "lines",
    [
        *([title, *ROWS] for title in (TITLE, "Channel,Elevation,Azimuth")),
        *(
            [title, *ROWS]
            for title in ("LaserID,Elevation,Azimuth", "laser id, elevation, azimuth,,")
        ),
        *(SWAPPED, DRESSED, [TITLE, *ROWS, f"{DIGEST},,"]),
        # The digest is taken over lines with CRLF ends, whatever they are, without a mark.
        [f"\ufeff{TITLE}", *ROWS, f"{DIGEST},,"],
    ],
)
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_angles_of_a_hesai_are_in_rad_by_channel(lines: list[str], end: str) -> None:
    found = hesai_angles(text_of(lines, end))
    np.testing.assert_allclose(found.elevation_rad, np.radians(np.arange(1, 17) / 2), rtol=1e-15)
    np.testing.assert_allclose(found.azimuth_rad, np.radians(-np.arange(1, 17)), rtol=1e-15)
    own = from_file(text_of(lines, end))
    assert (own.serial, own.is_shared, own.path) == ("", False, Path("unit.csv"))


@pytest.mark.parametrize("resolution", [1, 2])
def test_units_of_an_at128(resolution: int) -> None:
    content = at128(resolution)
    assert len(content) == 47176
    found = read_at128(Path("at.dat"), content)
    assert found is not None
    assert np.degrees(found.start_rad) == pytest.approx([20, 140, 260])
    assert np.degrees(found.azimuth_rad) == pytest.approx(np.ones(128))
    assert math.degrees(found.elevation_rad[120]) == pytest.approx(12)
    assert math.degrees(found.azimuth_adjust_rad[1, 2]) == pytest.approx(0.06)
    assert math.degrees(found.elevation_adjust_rad[1, 2]) == pytest.approx(-0.02)
    assert np.count_nonzero(found.azimuth_adjust_rad) == 1
    own = from_file(content)
    assert (own.model, own.is_shared) == ("AT128", False)


def test_a_csv_of_a_robosense_has_the_angles_of_its_device_packets() -> None:
    stream = stream_of(RobosenseSpec("Helios 32"), 8)
    expected = best_of(stream.evidence).lidar({}, stream.evidence)
    plain = angles_csv(HELIOS)
    titled = "\ufeff" + f"elevation,azimuth\n{plain}".replace("\n", "\r\n")
    for content in (plain, titled):
        file = from_file(content, "folder/a.csv")
        assert not file.is_shared
        lidar = file.lidar({}, stream.evidence)
        assert lidar.calibration == "folder/a.csv"
        np.testing.assert_allclose(lidar.beams.direction, expected.beams.direction, atol=1e-9)
