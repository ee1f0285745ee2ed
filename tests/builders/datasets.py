"""Small look-alikes of public datasets, from the layouts that their pages publish.

Every lidar measures one place, (1, 0, 0) in its own frame, from START_NS on: sweeps of 100 ms with
a column each ms. So its points in the body are R (1, 0, 0) + t, by hand, at known times.
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from mlbatch.simulate.velodyne.encode import VelodyneSpec
from tests.builders.bags import Body, Recorded, transforms_message
from tests.builders.lidar_packets import even
from tests.builders.points import CLOUD, CUSTOM, Form, cloud_of, custom_message
from tests.builders.rosbag1 import write_rosbag1
from tests.builders.rosbag2 import write_folder
from tests.builders.sweeps import pcd

MS = 1_000_000
START_NS = 1_700_000_000_000_000_000
SWEEP = 100 * MS
COLUMNS = 98
RINGS = 4
SWEEPS = 6
LAST = (COLUMNS - 1) * MS
# Half of a right angle: the quaternion of a quarter about z is (0, 0, H, H).
H = 0.7071067811865476

Times = Callable[[Any, int], Any]
# The messages of a topic.
Topic = list[Recorded]

XYZ = {"x": "f4", "y": "f4", "z": "f4"}
XYZI = {**XYZ, "intensity": "f4"}
OUSTER = {**XYZI, "t": "u4", "reflectivity": "u2", "ring": "u2", "ambient": "u2"}
# The types that the manuals of NTU VIRAL and MCD publish.
NTU = {**XYZI, "t": "u4", "reflectivity": "u2", "ring": "u1", "noise": "u2", "range": "u4"}
MCD = {**XYZI, "t": "u4", "reflectivity": "u2", "ambient": "u2", "range": "u4", "ring": "u1"}
VELODYNE = {**XYZI, "ring": "u2", "time": "f4"}
HESAI = {**XYZI, "ring": "u2", "timestamp": "f8"}
LIVOX2 = {**XYZI, "tag": "u1", "line": "u1", "timestamp": "f8"}
_TIMES = ("t", "time", "timestamp", "offset_time", "time_offset_ns")

# Time of a column of a sweep that starts at a time, as a dataset has it.
after_start_ns: Times = lambda column, start_ns: column * MS  # noqa: E731
after_start_s: Times = lambda column, start_ns: column / 1000  # noqa: E731
before_end_s: Times = lambda column, start_ns: (column * MS - LAST) / 1e9  # noqa: E731
since_1970_s: Times = lambda column, start_ns: (start_ns + column * MS) / 1e9  # noqa: E731
since_1970_ns: Times = lambda column, start_ns: (start_ns + column * MS) * 1.0  # noqa: E731
since_1970_us: Times = lambda column, start_ns: start_ns // 1000 + column * 1000  # noqa: E731


def rows(fields: Mapping[str, str], time: Times, start_ns: int = 0) -> Any:
    """The points of a sweep as a structured array."""
    column = np.repeat(np.arange(COLUMNS), RINGS)
    found = np.zeros(COLUMNS * RINGS, [(name, f"<{kind}") for name, kind in fields.items()])
    found["x"] = 1.0
    for name in fields:
        if name in _TIMES:
            found[name] = time(column, start_ns)
        elif name in ("ring", "line", "line_index", "diode_index"):
            found[name] = np.tile(np.arange(RINGS), COLUMNS)
        elif name == "intensity":
            found[name] = 9
    return found


def starts(of: int = SWEEPS) -> list[int]:
    """When the sweeps start."""
    return [START_NS + number * SWEEP for number in range(of)]


def clouds(
    topic: str,
    fields: Mapping[str, str],
    time: Times,
    *,
    frame: str = "",
    header_ns: int = 0,
    clock_ns: int = 0,
) -> Topic:
    """Clouds of a topic; header_ns: after the start of the sweep; clock_ns: minus the true time."""
    form = Form("ros1", frame)
    return [
        Recorded(
            topic,
            CLOUD,
            start + SWEEP,
            cloud_of(rows(fields, time, start + clock_ns), start + header_ns + clock_ns, form),
        )
        for start in starts()
    ]


def customs(topic: str, clock_ns: int = 0) -> Topic:
    """Livox CustomMsg: ns after the start."""
    points = [(n * MS, 1.0, 0.0, 0.0, 9, 0, ring) for n in range(COLUMNS) for ring in range(RINGS)]
    return [
        Recorded(
            topic,
            CUSTOM,
            start + SWEEP,
            custom_message(points, start + clock_ns, start + clock_ns, "ros1"),
        )
        for start in starts()
    ]


# A VelodyneScan of so many packets, about a sixth of a revolution.
SCAN_PACKETS = 12
RAW = 60 * SCAN_PACKETS
HOUR_NS = 3600 * 10**9


def scans(topic: str, model: str, frame: str, encoding: str = "ros1") -> Topic:
    """Raw packets of a Velodyne at 10 Hz, all ranges alike."""
    hour, rest_ns = divmod(START_NS, HOUR_NS)
    sent = even(VelodyneSpec(model, hour=hour, start_us=rest_ns / 1000), RAW, 2000, 50)
    messages = []
    for at in range(0, RAW, SCAN_PACKETS):
        packets = sent[at : at + SCAN_PACKETS]
        last_ns = packets[-1][0]
        body = Body(encoding).header(last_ns, frame).put("I", len(packets))
        for stamp_ns, data in packets:
            body.time(stamp_ns).raw(data)
        scan = "velodyne_msgs/VelodyneScan"
        messages.append(Recorded(topic, scan, last_ns + MS, body.done()))
    return messages


def transforms(edges: Sequence[tuple[str, str, Sequence[float], Sequence[float]]]) -> Topic:
    """/tf_static: parent, child, translation and quaternion of each."""
    data = transforms_message("ros1", edges)
    return [Recorded("/tf_static", "tf2_msgs/TFMessage", START_NS, data, latched=True)]


def _in_order(topics: Sequence[Topic]) -> list[Recorded]:
    """The messages of topics by log time."""
    return sorted((one for topic in topics for one in topic), key=lambda one: one.log_ns)


def bag(name: str, *topics: Topic) -> None:
    """A ROS 1 bag."""
    Path(name).parent.mkdir(parents=True, exist_ok=True)
    write_rosbag1(Path(name), _in_order(topics))


def folder(name: str, *topics: Topic) -> None:
    """A ROS 2 bag."""
    write_folder(Path(name), [_in_order(topics)])


def text(name: str, content: str) -> None:
    """A file of a dataset."""
    Path(name).parent.mkdir(parents=True, exist_ok=True)
    Path(name).write_text(content)


def opencv(name: str, head: str = "%YAML:1.0\n---\n", **matrices: Sequence[float]) -> None:
    """A file of OpenCV matrices."""
    parts = [head]
    for key, values in matrices.items():
        data = ", ".join(map(repr, values))
        parts.append(f"{key}: !!opencv-matrix\n   rows: {len(values) // 4}\n   cols: 4\n   dt: d\n")
        parts.append(f"   data: [{data}]\n")
    text(name, "".join(parts))


def quarter(x: float, y: float, z: float) -> list[float]:
    """A quarter about z at a place, by rows: R (1, 0, 0) = (0, 1, 0)."""
    return [0.0, -1.0, 0.0, x, 1.0, 0.0, 0.0, y, 0.0, 0.0, 1.0, z, 0.0, 0.0, 0.0, 1.0]


def upright(x: float, y: float, z: float) -> list[float]:
    """No rotation at a place, by rows."""
    return [1.0, 0.0, 0.0, x, 0.0, 1.0, 0.0, y, 0.0, 0.0, 1.0, z, 0.0, 0.0, 0.0, 1.0]


def files(folder: str, name: str, data: Mapping[int, bytes] | bytes) -> None:
    """A file for each sweep; name: with ns, us, middle_us or number; data: by start, or of all."""
    Path(folder).mkdir(parents=True, exist_ok=True)
    for number, ns in enumerate(starts()):
        place = name.format(ns=ns, us=ns // 1000, middle_us=ns // 1000 + 50_000, number=number)
        (Path(folder) / place).write_bytes(data if isinstance(data, bytes) else data[ns])


# -- datasets -------------------------------------------------------------------------------------


def autoware() -> None:
    """VelodyneScan of three lidars, and the calibration of the sample sensor kit."""
    models = (("top", "VLS-128"), ("left", "VLP-16"), ("right", "VLP-16"))
    folder(
        "sample-rosbag",
        *(
            scans(f"/sensing/lidar/{place}/velodyne_packets", model, f"velodyne_{place}", "cdr")
            for place, model in models
        ),
    )
    zero = "roll: 0.0, pitch: 0.0, yaw: 0.0"
    text(
        "sensors_calibration.yaml",
        f"base_link:\n  sensor_kit_base_link: {{x: 0.9, y: 0.0, z: 2.0, {zero}}}\n"
        f"  velodyne_rear_base_link: {{x: -0.358, y: 0.0, z: 1.631, {zero}}}\n",
    )
    text(
        "sensor_kit_calibration.yaml",
        "sensor_kit_base_link:\n"
        f"  camera0/camera_link: {{x: 0.1, y: 0.5, z: -0.3, {zero}}}\n"
        "  velodyne_top_base_link: {x: 0.0, y: 0.0, z: 0.0, roll: 0.0, pitch: 0.0, "
        "yaw: 1.5707963267948966}\n"
        f"  velodyne_left_base_link: {{x: 0.0, y: 0.5, z: -0.3, {zero}}}\n"
        f"  velodyne_right_base_link: {{x: 0.0, y: -0.5, z: -0.3, {zero}}}\n",
    )


def subt_mrs() -> None:
    """Raw packets of one VLP-16."""
    bag("subt_mrs.bag", scans("/velodyne_packets", "VLP-16", "velodyne"))


FORD = {
    "red": (1.0, 0.5, 1.5),
    "yellow": (1.2, 0.4, 1.5),
    "blue": (1.0, -0.5, 1.5),
    "green": (1.2, -0.4, 1.5),
}


def ford_av() -> None:
    """Four HDL-32E, a TransformStamped each."""
    bag(
        "2017-08-04-V2-Log1.bag",
        *(scans(f"/lidar_{c}_scan", "HDL-32E", f"lidar_{c}") for c in FORD),
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
        *(
            scans(f"/hdl32e_{side}/velodyne_packets", "HDL-32E", f"velodyne_{side}")
            for side in ("left", "right")
        ),
    )


def ntu_viral() -> None:
    """Two OS1-16, header at the end of the sweep."""
    bag(
        "eee_01/eee_01.bag",
        *(
            clouds(f"/os1_cloud_node{n}/points", NTU, after_start_ns, header_ns=LAST)
            for n in (1, 2)
        ),
    )
    opencv("eee_01/lidar_horz.yaml", T_Body_Lidar=upright(-0.05, 0.0, 0.055))
    opencv("eee_01/lidar_vert.yaml", T_Body_Lidar=quarter(-0.55, 0.03, 0.05))


def mcd() -> None:
    """An Ouster, header at the end, and a Livox, header at the start; a bag each."""
    bag(
        "ntu_day_01/ntu_day_01_os1_128.bag",
        clouds("/os_cloud_node/points", MCD, after_start_ns, header_ns=LAST),
    )
    bag("ntu_day_01/ntu_day_01_mid70.bag", customs("/livox/lidar"))
    lines = ["body:\n"]
    for name, values in (("os_sensor", quarter(0.0, 0.1, 0.2)), ("livox", upright(0.0, -0.1, 0.2))):
        lines.append(f"  {name}:\n    T:\n")
        lines += [f"    - {values[row * 4 : row * 4 + 4]}\n" for row in range(4)]
    text("atv_calib.yaml", "".join(lines))


def hilti_2021() -> None:
    """An OS0-64 and a Livox, in one bag."""
    bag(
        "Construction_Site_1.bag",
        clouds("/os_cloud_node/points", OUSTER, after_start_ns),
        customs("/livox/lidar"),
        other("/imu_adis"),
    )


def other(topic: str) -> Topic:
    """A topic of another sensor."""
    return [Recorded(topic, "std_msgs/String", START_NS, Body("ros1").text("").done())]


def hilti_2022(name: str = "exp14_basement_2.bag") -> None:
    """A PandarXT-32 with times since 1970, and an IMU."""
    pandar = clouds("/hesai/pandar", HESAI, since_1970_s, frame="PandarXT-32")
    bag(name, pandar, other("/alphasense/imu"))


def hilti_2023() -> None:
    """The handheld of 2023."""
    hilti_2022("site1_handheld_4.bag")


def botanic_garden() -> None:
    """A VLP-16 and a Livox; matrices without a head, one of them twice."""
    velodyne = clouds("/velodyne_points", VELODYNE, before_end_s, header_ns=LAST)
    bag("1018_00.bag", velodyne, customs("/livox/lidar"), other("/imu/data"))
    opencv(
        "calib_chain.yaml",
        head="# VLP16 in Xsens coordinates\n",
        T_xsens_vlp16=quarter(0.06, 0.01, 0.17),
        T_vlp16_livox=upright(0.08, -0.01, -0.18),
    )
    path = Path("calib_chain.yaml")
    twice = "T_xsens_rgb0: !!opencv-matrix {rows: 1, cols: 1, dt: d, data: [1]}\n" * 2
    path.write_text(path.read_text() + twice)


def m3dgr() -> None:
    """Two Livox."""
    bag("Outdoor01.bag", customs("/livox/avia/lidar"), customs("/livox/mid360/lidar"))


# Rounded to four digits, as in cali/alpha_config.yaml.
ALPHA = np.array(
    (
        (0.9999, 0.0049, 0.0153, 0.0961),
        (-0.0050, 1.0000, 0.0021, -0.1338),
        (-0.0153, -0.0022, 0.9999, 0.3032),
        (0.0, 0.0, 0.0, 1.0),
    )
)


def geode() -> None:
    """A bag a device, each with a lidar; a calibration whose keys come twice, without a head."""
    camera = (
        'image_topic: "/imu/imu"\nmodel_type:   PINHOLE\ndistortion_parameters:\n   k1: -0.05\n'
    )
    noise = "gyro_std: 9.6690835928856730e-03\ngyro_std: 8.2887875865635737e-05\n"
    opencv(
        "cali/alpha_config.yaml",
        head=f"# Left\n{camera}# Right\n{camera}{noise}",
        T_IMU_LiDAR=ALPHA.reshape(-1).tolist(),
    )
    bag("Urban_alpha.bag", clouds("/velodyne_points", VELODYNE, before_end_s, header_ns=LAST))
    bag("Urban_beta.bag", clouds("/ouster/points", OUSTER, after_start_ns))


def grand_tour() -> None:
    """A bag a topic; transforms in another one; frames of the clouds' headers."""
    stem = "mission/2024-10-01-11-29-55"
    bag(f"{stem}_hesai.bag", clouds("/boxi/hesai/points", HESAI, since_1970_s, frame="hesai_lidar"))
    bag(
        f"{stem}_livox.bag",
        clouds("/boxi/livox/points", LIVOX2, since_1970_ns, frame="livox_lidar"),
    )
    bag(
        f"{stem}_tf_minimal.bag",
        transforms(
            [
                ("base", "box_base", (0.0, 0.0, 0.5), (0.0, 0.0, 0.0, 1.0)),
                ("box_base", "hesai_lidar", (0.1, 0.0, 0.3), (0.0, 0.0, H, H)),
                ("box_base", "livox_lidar", (0.2, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0)),
            ]
        ),
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
    topics = ("/velodyne_points", "/left/lslidar_point_cloud", "/right/velodyne_points")
    bag(
        "UrbanNav-HK_TST-20210517_sensors.bag",
        *(clouds(topic, VELODYNE, before_end_s, header_ns=LAST) for topic in topics),
    )
    camera = "LEFT_CAMERA_T_IMU:!!opencv-matrix (Left camera to IMU)\n rows: 4\n   cols: 4\n"
    opencv(
        "extrinsic.yaml",
        head=f"%YAML:1.0\n\n{camera}",
        CENTER_LiDAR_T_IMU=upright(0.0, 0.0, 0.28),
        LEFT_LiDAR_T_CENTER_LiDAR=quarter(-0.27, 0.0, -0.22),
        RIGHT_LiDAR_T_CENTER_LiDAR=upright(0.32, 0.0, -0.2),
    )


_AVIA = {**XYZ, "reflectivity": "u1", "tag": "u1", "line": "u1", "offset_time": "u4"}
_AEVA = {**XYZ, "reflectivity": "f4", "velocity": "f4", "time_offset_ns": "i4"}
HELIPR = {
    "Ouster": (OUSTER, after_start_ns),
    "Velodyne": (VELODYNE, after_start_s),
    "Avia": (_AVIA, after_start_ns),
    "Aeva": ({**_AEVA, "line_index": "u1", "intensity": "f4"}, after_start_ns),
}


def helipr() -> None:
    """A folder of raw points for each lidar."""
    for name, (fields, time) in HELIPR.items():
        files(f"Roundabout01/LiDAR/{name}", "{ns}.bin", rows(fields, time).tobytes())


VIEWS = ("frontcenter", "frontleft", "frontright", "sideleft", "sideright", "rearcenter")


def a2d2() -> None:
    """Points of the views of the cameras as numpy arrays, us since 1970."""
    for view in VIEWS:
        place = Path("camera_lidar/20180810_150607/lidar") / f"cam_{view}"
        place.mkdir(parents=True, exist_ok=True)
        for number, start in enumerate(starts(), 60):
            column = np.repeat(np.arange(COLUMNS), RINGS)
            arrays: dict[str, Any] = {
                "pcloud_points": np.tile((1.0, 0.0, 0.0), (len(column), 1)),
                "pcloud_attr.timestamp": since_1970_us(column, start),
                "pcloud_attr.reflectance": np.full(len(column), 9),
                "pcloud_attr.lidar_id": np.tile(np.arange(RINGS) % 2, COLUMNS),
            }
            np.savez(place / f"20180810150607_lidar_{view}_{number:09d}.npz", **arrays)


def boreas() -> None:
    """Six float32 a point; the name is the middle of the scan in us, times count from it."""
    fields = {**XYZI, "ring": "f4", "t": "f4"}
    data = rows(fields, lambda column, _: (column - 50) / 1000).tobytes()
    text("boreas-2021-09-02-11-42/applanix/lidar_poses.csv", "GPSTime,easting,northing\n")
    files("boreas-2021-09-02-11-42/lidar", "{middle_us}.bin", data)


_PLACES = ("LEFT", "RIGHT", "TOP_FRONT", "TOP_LEFT", "TOP_RIGHT", "REAR")
TRUCK = tuple(f"LIDAR_{place}" for place in _PLACES)


def truckscenes() -> None:
    """PCD with a uint64 time in us since 1970."""
    fields = {**XYZI, "timestamp": "u8"}
    data = {ns: pcd(fields, rows(fields, since_1970_us, ns).tolist()) for ns in starts()}
    for name in TRUCK:
        files(f"man-truckscenes/sweeps/{name}", name + "_{us}.pcd", data)


def zenseact() -> None:
    """A structured .npy; int64 us from the core time in the name, here the middle."""
    place = Path("sequences/000000/lidar_velodyne")
    place.mkdir(parents=True, exist_ok=True)
    fields = {**XYZ, "timestamp": "i8", "intensity": "u1", "diode_index": "u1"}
    for start in starts():
        middle = datetime.fromtimestamp((start + 50 * MS) / 1e9, timezone.utc)
        name = middle.strftime("000000_india_%Y-%m-%dT%H:%M:%S.%fZ.npy")
        np.save(place / name, rows(fields, lambda column, _: (column - 50) * 1000))


def nuscenes() -> None:
    """Five float32 a point, no time."""
    data = np.tile(np.array([1, 0, 0, 9, 1], "<f4"), 100).tobytes()
    name = "n015-2018-07-24-11-22-45+0800__LIDAR_TOP__{us}.pcd.bin"
    files("nuscenes/sweeps/LIDAR_TOP", name, data)


def complex_urban() -> None:
    """Raw points without times."""
    data = np.tile(np.array([1, 0, 0, 9], "<f4"), 100).tobytes()
    for side in ("left", "right"):
        files(f"urban08/sensor_data/VLP_{side}", "{ns}.bin", data)


def nuplan() -> None:
    """PCD files of merged lidars, without times."""
    fields = {**XYZI, "ring": "f4", "lidar_info": "f4"}
    data = pcd(fields, rows(fields, after_start_s).tolist())
    files("sensor_blobs/MergedPointCloud", "{us:016x}.pcd", data)


def lyft() -> None:
    """Raw points without times."""
    data = np.tile(np.array([1, 0, 0, 9, 1], "<f4"), 100).tobytes()
    files("v1.01-train/lidar", "host-a007_lidar1_{us}.bin", data)


def waymo() -> None:
    """Range images in TFRecords."""
    files("waymo", "segment-{ns}.tfrecord", bytes(100))


def argoverse2() -> None:
    """Tables of Arrow."""
    files("sensors/lidar", "{ns}.feather", b"ARROW1\0\0" + bytes(99))


def pandaset() -> None:
    """Pickles."""
    text("001/meta/timestamps.json", json.dumps([start / 1e9 for start in starts()]))
    files("001/lidar", "{number:02d}.pkl.gz", gzip.compress(b"\x80\x04]\x94."))
