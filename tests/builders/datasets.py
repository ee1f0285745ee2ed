"""Small look-alikes of public datasets, by their published definitions (docs/datasets.md).

Every lidar measures one place, (1, 0, 0) in its own frame, from START_NS on: sweeps of 100 ms with
a column each ms. So its points in the body are R (1, 0, 0) + t, by hand, at known times.
"""

from __future__ import annotations

import gzip
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mlbatch.simulate.velodyne.encode import VelodyneSpec
from tests.builders.bags import Body, Recorded, transforms_message
from tests.builders.points import CLOUD, CUSTOM, Form, cloud_message, custom_message
from tests.builders.rosbag1 import write_rosbag1
from tests.builders.rosbag2 import write_folder
from tests.builders.sweeps import pcd, raw, write_sweeps
from tests.builders.vendor_sessions import lidar_payloads

MS = 1_000_000
START_NS = 1_700_000_000_000_000_000
SWEEP = 100 * MS
COLUMNS = 98
RINGS = 4
SWEEPS = 6
LAST = (COLUMNS - 1) * MS
# Half of a right angle: the quaternion of a quarter about z is (0, 0, H, H).
H = 0.7071067811865476
SCAN = "velodyne_msgs/VelodyneScan"
XYZI = {"x": "float32", "y": "float32", "z": "float32", "intensity": "float32"}
# Fields by driver, in their order.
OUSTER = {**XYZI, "t": "uint32", "reflectivity": "uint16", "ring": "uint16", "ambient": "uint16"}
MCD = {
    **XYZI,
    "t": "uint32",
    "reflectivity": "uint16",
    "ambient": "uint16",
    "range": "uint32",
    "ring": "uint8",
}
VELODYNE = {**XYZI, "ring": "uint16", "time": "float32"}
HESAI = {**XYZI, "ring": "uint16", "timestamp": "float64"}
LIVOX2 = {**XYZI, "tag": "uint8", "line": "uint8", "timestamp": "float64"}


def _points(
    fields: Sequence[str], time: Callable[[int, int], float], start_ns: int
) -> list[tuple[float, ...]]:
    """A sweep; time: of a column of one that starts at a time, as the dataset has it."""
    names = ("t", "time", "timestamp", "offset_time", "time_offset_ns")
    found = []
    for column in range(COLUMNS):
        for ring in range(RINGS):
            values = {"x": 1.0, "intensity": 9, "ring": ring, "line": ring, "line_index": ring}
            found.append(
                tuple(time(column, start_ns) if f in names else values.get(f, 0) for f in fields)
            )
    return found


def clouds(
    topic: str,
    fields: Mapping[str, str],
    time: Callable[[int, int], float],
    *,
    frame: str = "",
    header_ns: int = 0,
    clock_ns: int = 0,
    delay_ns: int = SWEEP,
) -> list[Recorded]:
    """Clouds of a ROS 1 topic; time: of a column of a sweep that starts at a time, ns.

    header_ns: stamp of the header after the start; clock_ns: of the lidar minus the true time;
    delay_ns: log time after the start.
    """
    found = []
    for number in range(SWEEPS):
        start_ns = START_NS + number * SWEEP
        points = _points(list(fields), time, start_ns + clock_ns)
        data = cloud_message(
            list(fields.items()),
            points,
            start_ns + header_ns + clock_ns,
            Form(encoding="ros1", frame=frame),
        )
        found.append(Recorded(topic, CLOUD, start_ns + delay_ns, data))
    return found


def after_start_ns(column: int, start_ns: int) -> float:
    """Ouster: ns after the start of the sweep."""
    return column * MS


def after_start_s(column: int, start_ns: int) -> float:
    """Velodyne in files: s after the start of the sweep."""
    return column / 1000


def before_end_s(column: int, start_ns: int) -> float:
    """Velodyne: s up to the header's stamp, that of the last point."""
    return (column * MS - LAST) / 1e9


def since_1970_s(column: int, start_ns: int) -> float:
    """HESAI: s since 1970."""
    return (start_ns + column * MS) / 1e9


def since_1970_ns(column: int, start_ns: int) -> float:
    """Livox clouds: ns since 1970."""
    return float(start_ns + column * MS)


def customs(topic: str, clock_ns: int = 0) -> list[Recorded]:
    """Livox CustomMsg: ns after the start."""
    found = []
    for number in range(SWEEPS):
        start_ns = START_NS + number * SWEEP
        points = [
            (column * MS, 1.0, 0.0, 0.0, 9, 0, line)
            for column in range(COLUMNS)
            for line in range(RINGS)
        ]
        stamp_ns = start_ns + clock_ns
        data = custom_message(points, stamp_ns, stamp_ns, "ros1")
        found.append(Recorded(topic, CUSTOM, start_ns + SWEEP, data))
    return found


# A VelodyneScan of so many packets, about a sixth of a revolution.
SCAN_PACKETS = 12
SCANS = 60
HOUR_NS = 3600 * 10**9


def velodyne_scans(topic: str, model: str, encoding: str, frame: str) -> list[Recorded]:
    """Raw packets of a Velodyne in scans."""
    spec = VelodyneSpec(model, hour=START_NS // HOUR_NS, start_us=START_NS % HOUR_NS / 1000)
    payloads = lidar_payloads(spec, SCAN_PACKETS * SCANS)
    found = []
    for number in range(SCANS):
        part = payloads[number * SCAN_PACKETS : (number + 1) * SCAN_PACKETS]
        body = Body(encoding).header(part[0][0], frame).put("I", len(part))
        for host_ns, payload in part:
            if body.cdr:
                body.raw(bytes(-len(body.data) % 4))
            body.time(host_ns).raw(payload)
        found.append(Recorded(topic, SCAN, part[-1][0] + MS, body.done()))
    return found


def bag(name: str, *topics: Sequence[Recorded]) -> None:
    """A ROS 1 bag in the order of log times."""
    messages = sorted((one for topic in topics for one in topic), key=lambda one: one.log_ns)
    Path(name).parent.mkdir(parents=True, exist_ok=True)
    write_rosbag1(Path(name), messages, chunk_bytes=1_000_000)


def text(name: str, content: str) -> None:
    """A file of a dataset."""
    Path(name).parent.mkdir(parents=True, exist_ok=True)
    Path(name).write_text(content)


def opencv(name: str, **matrices: Sequence[float]) -> None:
    """A file of OpenCV matrices."""
    parts = ["%YAML:1.0\n---\n"]
    for key, values in matrices.items():
        rows = len(values) // 4
        data = ", ".join(map(repr, values))
        parts.append(
            f"{key}: !!opencv-matrix\n   rows: {rows}\n   cols: 4\n   dt: d\n   data: [{data}]\n"
        )
    text(name, "".join(parts))


# A quarter about z at a place, and no rotation at a place, by rows.
def quarter(x: float, y: float, z: float) -> list[float]:
    """R (1, 0, 0) = (0, 1, 0)."""
    return [0.0, -1.0, 0.0, x, 1.0, 0.0, 0.0, y, 0.0, 0.0, 1.0, z, 0.0, 0.0, 0.0, 1.0]


def upright(x: float, y: float, z: float) -> list[float]:
    """R (1, 0, 0) = (1, 0, 0)."""
    return [1.0, 0.0, 0.0, x, 0.0, 1.0, 0.0, y, 0.0, 0.0, 1.0, z, 0.0, 0.0, 0.0, 1.0]


# -- datasets -------------------------------------------------------------------------------------


def autoware() -> None:
    """VelodyneScan of three lidars, and the calibration of the sample sensor kit."""
    messages = [
        message
        for place, model in (("top", "VLS-128"), ("left", "VLP-16"), ("right", "VLP-16"))
        for message in velodyne_scans(
            f"/sensing/lidar/{place}/velodyne_packets", model, "cdr", f"velodyne_{place}"
        )
    ]
    messages.sort(key=lambda one: one.log_ns)
    write_folder(Path("sample-rosbag"), [messages])
    zero = "roll: 0.0, pitch: 0.0, yaw: 0.0"
    quarter_rad = "roll: 0.0, pitch: 0.0, yaw: 1.5707963267948966"
    text(
        "sensors_calibration.yaml",
        f"base_link:\n  sensor_kit_base_link: {{x: 0.9, y: 0.0, z: 2.0, {zero}}}\n"
        f"  velodyne_rear_base_link: {{x: -0.358, y: 0.0, z: 1.631, {zero}}}\n",
    )
    text(
        "sensor_kit_calibration.yaml",
        "sensor_kit_base_link:\n"
        f"  camera0/camera_link: {{x: 0.1, y: 0.5, z: -0.3, {zero}}}\n"
        f"  velodyne_top_base_link: {{x: 0.0, y: 0.0, z: 0.0, {quarter_rad}}}\n"
        f"  velodyne_left_base_link: {{x: 0.0, y: 0.5, z: -0.3, {zero}}}\n"
        f"  velodyne_right_base_link: {{x: 0.0, y: -0.5, z: -0.3, {zero}}}\n",
    )


def subt_mrs() -> None:
    """Raw packets of one VLP-16."""
    bag("subt_mrs.bag", velodyne_scans("/velodyne_packets", "VLP-16", "ros1", "velodyne"))


FORD = {"red": (1.0, 0.5, 1.5), "yellow": (1.2, 0.4, 1.5), "blue": (1.0, -0.5, 1.5),
        "green": (1.2, -0.4, 1.5)}  # fmt: skip


def ford_av() -> None:
    """Four HDL-32E, a TransformStamped each."""
    bag(
        "2017-08-04-V2-Log1.bag",
        *(velodyne_scans(f"/lidar_{c}_scan", "HDL-32E", "ros1", f"lidar_{c}") for c in FORD),
    )
    for colour, (x, y, z) in FORD.items():
        text(
            f"calibration/lidar_{colour}_body.yaml",
            "header:\n  seq: 0\n  stamp: {secs: 0, nsecs: 0}\n  frame_id: body\n"
            f"child_frame_id: lidar_{colour}\ntransform:\n"
            f"  translation: {{x: {x}, y: {y}, z: {z}}}\n"
            f"  rotation: {{x: 0.0, y: 0.0, z: {H}, w: {H}}}\n",
        )


def utbm() -> None:
    """Two HDL-32E."""
    bag(
        "utbm_robocar_dataset_20180719.bag",
        velodyne_scans("/hdl32e_left/velodyne_packets", "HDL-32E", "ros1", "velodyne_left"),
        velodyne_scans("/hdl32e_right/velodyne_packets", "HDL-32E", "ros1", "velodyne_right"),
    )


def ntu_viral() -> None:
    """Two OS1-16, header at the end of the sweep."""
    bag(
        "eee_01/eee_01.bag",
        clouds("/os1_cloud_node1/points", OUSTER, after_start_ns, header_ns=LAST),
        clouds("/os1_cloud_node2/points", OUSTER, after_start_ns, header_ns=LAST),
    )
    opencv("eee_01/lidar_horz.yaml", T_Body_Lidar=upright(-0.05, 0.0, 0.055))
    opencv("eee_01/lidar_vert.yaml", T_Body_Lidar=quarter(-0.55, 0.03, 0.05))


def mcd() -> None:
    """An Ouster, header at the end, and a Livox, header at the start; a bag each."""
    bag(
        "ntu_day_01/ntu_day_01_os1.bag",
        clouds("/os_cloud_node/points", MCD, after_start_ns, header_ns=LAST),
    )
    bag("ntu_day_01/ntu_day_01_mid70.bag", customs("/livox/lidar"))
    rows = {"os_sensor": quarter(0.0, 0.1, 0.2), "livox": upright(0.0, -0.1, 0.2)}
    lines = ["body:\n"]
    for name, values in rows.items():
        lines.append(f"  {name}:\n    T:\n")
        lines += [f"    - {values[row * 4 : row * 4 + 4]}\n" for row in range(4)]
    text("ntu_day_01/calibration.yaml", "".join(lines))


def hilti_2021() -> None:
    """An OS0-64 and a Livox, in one bag."""
    bag(
        "Construction_Site_1.bag",
        clouds("/os_cloud_node/points", OUSTER, after_start_ns),
        customs("/livox/lidar"),
    )


def botanic_garden() -> None:
    """A VLP-16 and a Livox; matrices without a head, one of them twice."""
    bag(
        "1018_00.bag",
        clouds("/velodyne_points", VELODYNE, before_end_s, header_ns=LAST),
        customs("/livox/lidar"),
    )
    opencv(
        "calib_chain.yaml",
        T_xsens_vlp16=quarter(0.06, 0.01, 0.17),
        T_vlp16_livox=upright(0.08, -0.01, -0.18),
    )
    path = Path("calib_chain.yaml")
    matrix = path.read_text().split("---\n")[1]
    twice = "T_xsens_rgb0: !!opencv-matrix {rows: 1, cols: 1, dt: d, data: [1]}\n" * 2
    path.write_text(f"# VLP16 in Xsens coordinates\n{matrix}{twice}")


def m3dgr() -> None:
    """Two Livox."""
    bag("Outdoor01.bag", customs("/livox/avia/lidar"), customs("/livox/mid360/lidar"))


def geode() -> None:
    """A bag a device, each with a lidar; a calibration whose keys come twice, without a head."""
    opencv("cali/alpha_config.yaml", T_IMU_LiDAR=upright(0.0961, -0.1338, 0.3032))
    path = Path("cali/alpha_config.yaml")
    matrix = path.read_text().split("---\n")[1]
    camera = (
        'image_topic: "/imu/imu"\nmodel_type:   PINHOLE\ndistortion_parameters:\n   k1: -0.05\n'
    )
    noise = "gyro_std: 9.6690835928856730e-03\ngyro_std: 8.2887875865635737e-05\n"
    path.write_text(f"# Left camera\n{camera}# Right camera\n{camera}{noise}{matrix}")
    bag("Urban_alpha.bag", clouds("/velodyne_points", VELODYNE, before_end_s, header_ns=LAST))
    bag("Urban_beta.bag", clouds("/ouster/points", OUSTER, after_start_ns))


def grand_tour() -> None:
    """A bag a topic; transforms in another one; frames of the clouds' headers."""
    stem = "mission/2024-10-01-11-29-55"
    bag(
        f"{stem}_hesai.bag",
        clouds("/boxi/hesai/points", HESAI, since_1970_s, frame="hesai_lidar"),
    )
    bag(
        f"{stem}_livox.bag",
        clouds("/boxi/livox/points", LIVOX2, since_1970_ns, frame="livox_lidar"),
    )
    edges = [
        ("base", "box_base", (0.0, 0.0, 0.5), (0.0, 0.0, 0.0, 1.0)),
        ("box_base", "hesai_lidar", (0.1, 0.0, 0.3), (0.0, 0.0, H, H)),
        ("box_base", "livox_lidar", (0.2, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0)),
    ]
    message = transforms_message("ros1", edges)
    bag(
        f"{stem}_tf_minimal.bag",
        [Recorded("/tf_static", "tf2_msgs/TFMessage", START_NS, message, latched=True)],
    )


# The lidars of TIERS: two count from power-on.
BEHIND_NS = -1_699_999_500 * 10**9


def tiers() -> None:
    """Mixed clocks."""
    bag(
        "indoor02.bag",
        clouds("/os_cloud_node/points", OUSTER, after_start_ns, clock_ns=BEHIND_NS),
        clouds("/os_cloud_nodee/points", OUSTER, after_start_ns, clock_ns=BEHIND_NS),
        clouds("/velodyne_points", VELODYNE, before_end_s, header_ns=LAST),
        customs("/avia/livox/lidar"),
        # Sweeps of two lidars do not begin in the same nanosecond.
        customs("/livox/lidar", clock_ns=2),
    )


def urban_nav() -> None:
    """An HDL-32E, a VLP-16 and an LSLIDAR; a file with a mistake elsewhere."""
    bag(
        "UrbanNav-HK_TST-20210517_sensors.bag",
        *(
            clouds(topic, VELODYNE, before_end_s, header_ns=LAST)
            for topic in ("/velodyne_points", "/left/lslidar_point_cloud", "/right/velodyne_points")
        ),
    )
    opencv(
        "extrinsic.yaml",
        CENTER_LiDAR_T_IMU=upright(0.0, 0.0, 0.28),
        LEFT_LiDAR_T_CENTER_LiDAR=quarter(-0.27, 0.0, -0.22),
        RIGHT_LiDAR_T_CENTER_LiDAR=upright(0.32, 0.0, -0.2),
    )
    path = Path("extrinsic.yaml")
    matrices = path.read_text().split("---\n")[1]
    camera = "LEFT_CAMERA_T_IMU:!!opencv-matrix (Left camera to IMU)\n rows: 4\n   cols: 4\n"
    path.write_text(f"%YAML:1.0\n\n{camera}{matrices}")


HELIPR = {
    "Ouster": ({"x": "f4", "y": "f4", "z": "f4", "intensity": "f4", "t": "u4",
                "reflectivity": "u2", "ring": "u2", "ambient": "u2"}, after_start_ns),
    "Velodyne": ({"x": "f4", "y": "f4", "z": "f4", "intensity": "f4", "ring": "u2",
                  "time": "f4"}, after_start_s),
    "Avia": ({"x": "f4", "y": "f4", "z": "f4", "reflectivity": "u1", "tag": "u1", "line": "u1",
              "offset_time": "u4"}, after_start_ns),
    "Aeva": ({"x": "f4", "y": "f4", "z": "f4", "reflectivity": "f4", "velocity": "f4",
              "time_offset_ns": "i4", "line_index": "u1", "intensity": "f4"}, after_start_ns),
}  # fmt: skip


def helipr() -> None:
    """A folder of raw points for each lidar."""
    for name, (fields, time) in HELIPR.items():
        points = _points(list(fields), time, 0)
        data = raw(fields, points)
        names = {f"{START_NS + number * SWEEP}.bin": data for number in range(SWEEPS)}
        write_sweeps(Path("Roundabout01/LiDAR") / name, names)


def a2d2() -> None:
    """Points of the views of two cameras as numpy arrays, us since 1970."""
    for view in ("front_center", "front_left"):
        folder = Path("camera_lidar") / f"cam_{view}"
        folder.mkdir(parents=True, exist_ok=True)
        for number in range(SWEEPS):
            start_us = (START_NS + number * SWEEP) // 1000
            column = np.repeat(np.arange(COLUMNS), RINGS)
            xyz = np.zeros((len(column), 3))
            xyz[:, 0] = 1.0
            arrays: dict[str, Any] = {
                "pcloud_points": xyz,
                "pcloud_attr.timestamp": start_us + column * 1000,
                "pcloud_attr.reflectance": np.full(len(column), 9),
                "pcloud_attr.lidar_id": np.tile(np.arange(RINGS) % 2, COLUMNS),
            }
            np.savez(folder / f"20180810150607_lidar_{view}_{number:09d}.npz", **arrays)


XYZ_ONLY = {"x": "f4", "y": "f4", "z": "f4", "intensity": "f4"}


def complex_urban() -> None:
    """Raw points without times."""
    data = raw(XYZ_ONLY, [(1.0, 0.0, 0.0, 9.0)] * 100)
    names = {f"{START_NS + number * SWEEP}.bin": data for number in range(SWEEPS)}
    write_sweeps(Path("urban08/sensor_data/VLP_left"), names)


def nuplan() -> None:
    """PCD files of merged lidars, without times."""
    fields = {**XYZ_ONLY, "ring": "f4", "lidar_info": "f4"}
    data = pcd(fields, [(1.0, 0.0, 0.0, 9.0, 1.0, 2.0)] * 100)
    names = {f"{START_NS // 1000 + number * 50_000}.pcd": data for number in range(SWEEPS)}
    write_sweeps(Path("sensor_blobs/MergedPointCloud"), names)


def lyft() -> None:
    """Raw points without times."""
    data = raw({**XYZ_ONLY, "ring": "f4"}, [(1.0, 0.0, 0.0, 9.0, 1.0)] * 100)
    names = {f"{START_NS // 1000 + number * 100_000}.bin": data for number in range(SWEEPS)}
    write_sweeps(Path("v1.01-train/lidar"), names)


def waymo() -> None:
    """Range images in TFRecords."""
    write_sweeps(Path("waymo"), {"segment-10017090168044687777.tfrecord": bytes(100)})


def argoverse2() -> None:
    """Tables of Arrow."""
    write_sweeps(Path("sensors/lidar"), {"315967376959822000.feather": b"ARROW1\0\0" + bytes(99)})


def pandaset() -> None:
    """Pickles."""
    write_sweeps(Path("001/lidar"), {"00.pkl.gz": gzip.compress(b"\x80\x04]\x94.")})
