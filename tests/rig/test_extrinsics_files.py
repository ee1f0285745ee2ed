"""Extrinsics in files of other programs: poses by hand calculation, errors in one line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.arrays import F64Array
from mlbatch.errors import RigError
from mlbatch.rig.rig import read_rig

# Halves of a right angle.
H = 0.7071067811865476
HALF_PI = "1.5707963267948966"

# As in the calibration folder of Ford AV: one transform a file.
STAMPED = f"""\
header:
  seq: 0
  stamp: {{secs: 0, nsecs: 0}}
  frame_id: body
child_frame_id: lidar_red
transform:
  translation: {{x: 1.0, y: 2.0, z: 3.0}}
  rotation: {{x: 0.0, y: 0.0, z: {H}, w: {H}}}
"""
KIT = f"""\
base_link:
  sensor_kit_base_link: {{x: 0.9, y: 0.0, z: 2.0, roll: 0.0, pitch: 0.0, yaw: {HALF_PI}}}
"""
SENSORS = f"""\
sensor_kit_base_link:
  camera0/camera_link: {{x: 0.1, y: 0.5, z: -0.2, roll: -0.025, pitch: 0.315, yaw: 1.035}}
  velodyne_top_base_link: {{x: 1.0, y: 0.0, z: 0.0, roll: 0.0, pitch: {HALF_PI}, yaw: 0.0}}
"""
OUSTER = json.dumps(
    {
        "transforms": [
            {"destination_frame": "world", "source_frame": "992313000353",
             "p_x": 0.5, "p_y": 0.0, "p_z": 1.5, "q_x": 1.0, "q_y": 0.0, "q_z": 0.0, "q_w": 0.0},
            {"destination_frame": "world", "source_frame": "122150000150",
             "p_x": -2.0, "p_y": 0.0, "p_z": 0.0, "q_x": 0.0, "q_y": 0.0, "q_z": 0.0, "q_w": 1.0},
        ]
    },
    indent=2,
)  # fmt: skip
# With a head that is no YAML, a repeated key and a matrix cut off, as in published files.
OPENCV = """\
%YAML:1.0
---
# lidar in body coordinates
body_T_lidar: !!opencv-matrix
   rows: 4
   cols: 4
   dt: d
   data: [ 0., -1, 0, 0.25,
           1,  0.,  0, -0.5,
           0,  0,  1, -0.28,
           0., 0., 0., 1 ]
body_T_other: !!opencv-matrix
   rows: 3
   cols: 4
   dt: f
   data: [ 1, 0, 0, 2.0, 0, 1, 0, 0, 0, 0, 1, 0 ]
turn: !!opencv-matrix {rows: 3, cols: 3, dt: d, data: [0, -1, 0, 1, 0, 0, 0, 0, 1]}
shift: !!opencv-matrix {rows: 3, cols: 1, dt: d, data: [1, 2, 3]}
twice: !!opencv-matrix {rows: 3, cols: 1, dt: d, data: [1, 2, 3]}
twice: !!opencv-matrix {rows: 3, cols: 1, dt: d, data: [1, 2, 4]}
short: !!opencv-matrix {rows: 4, cols: 4, dt: d, data: [1, 2, 3]}
"""
PLAIN = """\
body:
  os_sensor:
    T: [[0, -1, 0, 0.25], [1, 0, 0, -0.5], [0, 0, 1, -0.28], [0, 0, 0, 1]]
    flat: [0, -1, 0, 0.25, 1, 0, 0, -0.5, 0, 0, 1, -0.28]
"""
FILES = {
    "red.yaml": STAMPED,
    "kit.yaml": KIT,
    "sensors.yaml": SENSORS,
    "extrinsic_parameters.json": OUSTER,
    "opencv.yaml": OPENCV,
    "plain.yaml": PLAIN,
    "list.yaml": "- " + STAMPED.rstrip().replace("\n", "\n  ") + "\n",
    "message.yaml": "transforms:\n- " + STAMPED.rstrip().replace("\n", "\n  ") + "\n",
    "slash.yaml": STAMPED.replace("body", "/body").replace("lidar_red", "/lidar_red"),
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    return tmp_path


def _pose(folder: Path, extrinsics: str, head: str = "", sensor: str = "") -> F64Array:
    rig = folder / "rig.yaml"
    rig.write_text(f"{head}sensors:\n- name: a\n{sensor}  extrinsics: {extrinsics}\n")
    (one,) = read_rig(rig).sensors
    assert isinstance(one.extrinsics, np.ndarray)
    return one.extrinsics


def _rows(*rows: tuple[float, ...]) -> F64Array:
    return np.array([*rows, (0, 0, 0, 1)], np.float64)


# A quarter about z at (1, 2, 3): x of the sensor is y of the body.
RED = _rows((0, -1, 0, 1), (1, 0, 0, 2), (0, 0, 1, 3))
LIDAR = _rows((0, -1, 0, 0.25), (1, 0, 0, -0.5), (0, 0, 1, -0.28))


@pytest.mark.parametrize("name", ["red.yaml", "list.yaml", "message.yaml", "slash.yaml"])
def test_transform_stamped_maps_the_child_into_the_parent(folder: Path, name: str) -> None:
    pose = _pose(folder, f"{{file: {name}}}", "body_frame: body\n")
    np.testing.assert_allclose(pose, RED, atol=1e-15)
    # A point 1 m in front of the sensor is at (1, 2 + 1, 3).
    np.testing.assert_allclose(pose @ (1, 0, 0, 1), (1, 3, 3, 1), atol=1e-15)


def test_the_frame_of_the_file_may_have_another_name_than_the_body(folder: Path) -> None:
    pose = _pose(folder, "{file: red.yaml, parent: body}")
    np.testing.assert_allclose(pose, RED, atol=1e-15)


def test_the_inverse_is_used_where_the_body_is_the_child(folder: Path) -> None:
    """From lidar_red to body: R' p - R' t, with R' a quarter back."""
    pose = _pose(folder, "{file: red.yaml, parent: lidar_red, frame: body}")
    np.testing.assert_allclose(pose, _rows((0, 1, 0, -2), (-1, 0, 0, 1), (0, 0, 1, -3)), atol=1e-15)


def test_autoware_files_are_a_chain_in_radians(folder: Path) -> None:
    """The kit is at (0.9, 0, 2) and a quarter about z; in it the lidar at (1, 0, 0), nose down.

    The lidar's base is 1 m along x of the kit, which is y of the body: (0.9, 1, 2). Its z, along
    which the points' frame is 0.0377 m higher, is x of the kit and y of the body: (0.9, 1.0377, 2).
    Its x is down, its y is minus x of the body.
    """
    text = (
        "{file: [kit.yaml, sensors.yaml], frame: velodyne_top_base_link, "
        "sensor_in_frame: {translation_m: [0, 0, 0.0377]}}"
    )
    expected = _rows((0, -1, 0, 0.9), (0, 0, 1, 1.0377), (-1, 0, 0, 2))
    np.testing.assert_allclose(_pose(folder, text), expected, atol=1e-15)


def test_autoware_angles_turn_about_fixed_axes(folder: Path) -> None:
    """Of x: roll leaves it, pitch of a quarter turns it down, and no yaw can change that."""
    text = KIT.replace("roll: 0.0, pitch: 0.0", f"roll: {HALF_PI}, pitch: {HALF_PI}")
    (folder / "kit.yaml").write_text(text)
    pose = _pose(
        folder,
        "{file: kit.yaml, frame: sensor_kit_base_link, "
        "sensor_in_frame: {rotation_rpy_deg: [0, 0, 0]}}",
    )
    np.testing.assert_allclose(pose[:3, 0], (0, 0, -1), atol=1e-15)
    # y: to z by the roll, to x by the pitch, to y by the yaw.
    np.testing.assert_allclose(pose[:3, 1], (0, 1, 0), atol=1e-15)


def test_ouster_transforms_are_found_by_the_serial_number(folder: Path) -> None:
    """Half a revolution about x: y and z change their signs."""
    name = "extrinsic_parameters.json"
    expected = _rows((1, 0, 0, 0.5), (0, -1, 0, 0), (0, 0, -1, 1.5))
    by_serial = _pose(
        folder, f"{{file: {name}, parent: world}}", sensor='  stream: {serial: "992313000353"}\n'
    )
    by_name = _pose(folder, f"{{file: {name}, parent: world, frame: 992313000353}}")
    np.testing.assert_allclose(by_serial, expected, atol=1e-15)
    np.testing.assert_allclose(by_name, expected, atol=1e-15)


@pytest.mark.parametrize(
    "text",
    [
        "{file: opencv.yaml, key: body_T_lidar, direction: body_from_sensor}",
        "{file: plain.yaml, key: body.os_sensor.T, direction: body_from_sensor}",
        "{file: plain.yaml, key: body.os_sensor.flat, direction: body_from_sensor}",
    ],
)
def test_a_matrix_is_used_as_it_is(folder: Path, text: str) -> None:
    np.testing.assert_array_equal(_pose(folder, text), LIDAR)


def test_a_matrix_from_body_to_sensor_is_inverted(folder: Path) -> None:
    """R' is a quarter back; -R' t: of (0.25, -0.5, -0.28) it is (0.5, 0.25, 0.28)."""
    pose = _pose(folder, "{file: opencv.yaml, key: body_T_lidar, direction: sensor_from_body}")
    expected = _rows((0, 1, 0, 0.5), (-1, 0, 0, 0.25), (0, 0, 1, 0.28))
    np.testing.assert_allclose(pose, expected, atol=1e-15)


def test_matrices_are_multiplied_in_the_order_of_the_keys(folder: Path) -> None:
    """2 m along x of the lidar are 2 m along y of the body: (0.25, 1.5, -0.28)."""
    text = "{file: opencv.yaml, key: [body_T_lidar, body_T_other], direction: body_from_sensor}"
    expected = _rows((0, -1, 0, 0.25), (1, 0, 0, 1.5), (0, 0, 1, -0.28))
    np.testing.assert_allclose(_pose(folder, text), expected, atol=1e-15)


def test_a_translation_and_a_rotation_are_p_equals_r_q_plus_t(folder: Path) -> None:
    text = "{file: opencv.yaml, key: [shift, turn], direction: body_from_sensor}"
    np.testing.assert_array_equal(_pose(folder, text), RED)


# As published: a text after the tag, and a line with too little indentation.
BROKEN_ELSEWHERE = """\
%YAML:1.0

# extrinsics of a camera
CAMERA_T_IMU:!!opencv-matrix (Left camera to IMU)
 rows: 4
   cols: 4
   dt: d
   data:   [ 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0., 0., 0., 1. ]
################## Center Lidar to IMU##################
LIDAR_T_IMU: !!opencv-matrix
   rows: 4
   cols: 4
   dt: d
   data: [ 1, 0, 0, 0,
           0, 1, 0, 0,
           0, 0, 1, 0.28,
           0, 0, 0, 1]
"""


def test_a_mistake_elsewhere_in_the_file_does_not_matter(folder: Path) -> None:
    (folder / "broken.yaml").write_text(BROKEN_ELSEWHERE)
    pose = _pose(folder, "{file: broken.yaml, key: LIDAR_T_IMU, direction: body_from_sensor}")
    np.testing.assert_array_equal(pose, _rows((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0.28)))
    with pytest.raises(RigError) as caught:
        _pose(folder, "{file: broken.yaml, key: CAMERA_T_IMU, direction: body_from_sensor}")
    assert str(caught.value).startswith(f"{folder / 'broken.yaml'}:4: CAMERA_T_IMU: expected a ")
    assert "found a mistake in YAML; " in str(caught.value)


def test_millimetres_are_refused_unless_stated(folder: Path) -> None:
    """As T_CamL_CamR of GEODE: 188 mm, which were 188 m."""
    (folder / "mm.yaml").write_text(
        "%YAML:1.0\n---\nT: !!opencv-matrix\n   rows: 4\n   cols: 4\n   dt: d\n   data: "
        "[1, 0, 0, -188.276, 0, 1, 0, -1.343, 0, 0, 1, -1.381, 0, 0, 0, 1]\n"
        "far: !!opencv-matrix {rows: 3, cols: 1, dt: d, data: [12, 16, 0]}\n"
    )
    text = "{file: mm.yaml, key: T, direction: body_from_sensor%s}"
    with pytest.raises(RigError) as caught:
        _pose(folder, text % "")
    assert str(caught.value) == (
        f"{folder / 'mm.yaml'}:3: T: expected a translation in metres, at most 20 m on a vehicle, "
        f"found one of 188.286; write `matrix_unit: mm` next to `key` ({folder / 'rig.yaml'}:3: "
        f"{X}) if the file has millimetres, or `matrix_unit: m`"
    )
    np.testing.assert_allclose(
        _pose(folder, text % ", matrix_unit: mm")[:3, 3], [-0.188276, -0.001343, -0.001381]
    )
    assert _pose(folder, text % ", matrix_unit: m")[0, 3] == -188.276
    # 20 m are near.
    assert _pose(folder, (text % "").replace("key: T", "key: far"))[0, 3] == 12.0


QUARTER = "0, -1, 0, {}, 1, 0, 0, {}, 0, 0, 1, {}, 0, 0, 0, 1"
PARALLEL = "1, 0, 0, {}, 0, 1, 0, {}, 0, 0, 1, {}, 0, 0, 0, 1"


@pytest.mark.parametrize(
    ("form", "translation", "is_refused"),
    [
        (QUARTER, (1.2, -0.9, 2.0), True),  # m: 2.5
        (QUARTER, (5.0, 6.0, 0.0), True),  # m: 7.81, as on a truck; mm: too near for two devices
        (PARALLEL, (0.0, 0.0, 1.5), True),
        (PARALLEL, (6.253, -11.775, 7.645), False),  # the IMU of an Ouster, mm
        (PARALLEL, (0.0, 4.0, 4.0), False),
        (QUARTER, (8.0, 8.0, 0.0), False),
        (QUARTER, (0.0, 0.0, 0.0), False),  # a rotation alone has no unit
    ],
)
def test_metres_stated_as_millimetres_are_refused(
    folder: Path, form: str, translation: tuple[float, ...], is_refused: bool
) -> None:
    values = form.format(*translation)
    (folder / "m.yaml").write_text(
        f"%YAML:1.0\n---\nT: !!opencv-matrix\n   rows: 4\n   cols: 4\n   data: [{values}]\n"
    )
    text = "{file: m.yaml, key: T, direction: sensor_from_body, matrix_unit: mm}"
    if not is_refused:
        np.testing.assert_allclose(
            np.linalg.norm(_pose(folder, text)[:3, 3]), np.linalg.norm(translation) / 1000
        )
        return
    with pytest.raises(RigError) as caught:
        _pose(folder, text)
    size = f"{np.linalg.norm(translation):.4g}"
    least = "5" if form is PARALLEL else "10"
    assert str(caught.value) == (
        f"{folder / 'm.yaml'}:3: T: expected translations in millimetres, of {least} mm or more "
        f"between body and sensor, found {size} mm, {size} m if the file has metres; write "
        f"`matrix_unit: m` next to `key` ({folder / 'rig.yaml'}:3: {X}), or give such a pose as "
        "translation_m with a rotation"
    )


X = "sensors[0].extrinsics"


@given(
    st.sampled_from(["red.yaml", "kit.yaml", "extrinsic_parameters.json", "opencv.yaml"]),
    st.text(max_size=20),
    st.integers(min_value=0, max_value=400),
    st.sampled_from(["", "key: body_T_lidar, direction: body_from_sensor", "parent: body"]),
)
def test_any_text_is_read_or_refused_in_one_line(
    tmp_path_factory: pytest.TempPathFactory, name: str, noise: str, position: int, keys: str
) -> None:
    folder = tmp_path_factory.getbasetemp()
    text = FILES[name]
    noisy = text[:position] + noise + text[position:]
    (folder / name).write_bytes(noisy.encode("utf-8", "surrogatepass"))
    answer, pose = _answer(folder, f"{{file: {name}, {keys}}}")
    assert "\n" not in answer
    assert pose is None or np.isfinite(pose).all()


def _answer(folder: Path, text: str) -> tuple[str, F64Array | None]:
    """The error of a rig, or its pose."""
    try:
        return "", _pose(folder, text)
    except RigError as err:
        return str(err), None
