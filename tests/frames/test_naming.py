"""Frame names of drivers and of people, and topics of one driver."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from mlbatch.frames.naming import candidates, named_frame, nearest_topic, same_namespace
from mlbatch.frames.transforms import from_rpy_deg

LIDAR = from_rpy_deg((0.0, 0.0, 0.03618), (0.0, 0.0, 180.0))
LEFT = "/left/ouster/lidar_packets"


def _found(vendor: str, places: Sequence[str], alone: bool, frame: str) -> str:
    """What kind of candidate a frame is: `points`, `lidar`, `whole`, or `` for none."""
    for one in candidates(vendor, places, alone=alone, sensor_from_lidar=LIDAR):
        if one.frame == frame:
            if one.sensor_from_frame is not None:
                return "lidar"
            return "points" if one.rank < 8 else "whole"
    return ""


@pytest.mark.parametrize(
    ("vendor", "place", "alone", "frame", "kind"),
    [
        ("Ouster", LEFT, False, "left/os_sensor", "points"),
        ("Ouster", LEFT, False, "left_os_sensor", "points"),
        ("Ouster", LEFT, False, "os_sensor_left", "points"),
        ("Ouster", LEFT, False, "os_left/os_sensor", "points"),
        ("Ouster", LEFT, False, "left/ouster/os_sensor", "points"),
        ("Ouster", LEFT, False, "left/os_lidar", "lidar"),
        ("Ouster", LEFT, False, "os_lidar_left", "lidar"),
        ("Ouster", LEFT, False, "os_left", "whole"),
        ("Ouster", LEFT, False, "ouster_left", "whole"),
        ("Ouster", LEFT, False, "left", "whole"),
        # Plain names identify the sensor only if it is the only one.
        ("Ouster", LEFT, False, "os_sensor", ""),
        ("Ouster", LEFT, True, "os_sensor", "points"),
        ("Ouster", LEFT, True, "os_lidar", "lidar"),
        # It could be either of the two frames of an Ouster.
        ("Ouster", LEFT, True, "left_lidar", ""),
        ("Ouster", LEFT, True, "right/os_sensor", ""),
        ("Ouster", LEFT, True, "os_imu", ""),
        ("Ouster", "/os_left/lidar_packets", False, "left", "whole"),
        ("Ouster", "/os_left/lidar_packets", False, "os_left/os_sensor", "points"),
        ("Ouster", "/ouster/lidar_packets", False, "ouster/os_sensor", "points"),
        ("Ouster", "/lidar_packets", True, "os_sensor", "points"),
        ("Ouster", "/lidar_packets", False, "os_sensor", ""),
        ("Ouster", "/robot/left/ouster/lidar_packets", False, "robot/left/os_sensor", "points"),
        ("Ouster", "/robot/left/ouster/lidar_packets", False, "left/os_sensor", "points"),
        # The name in a rig.
        ("Ouster", "left", False, "os_left", "whole"),
        ("Velodyne", "/sensing/lidar/front/velodyne_packets", False, "velodyne_front", "points"),
        ("Velodyne", "/velodyne_packets", True, "velodyne", "points"),
        ("HESAI", "/front/pandar_packets", False, "front_lidar", "whole"),
        ("RoboSense", "/rslidar_packets", True, "rslidar", "points"),
        ("Someone", "/top/packets", False, "top_lidar", "points"),
    ],
)
def test_table_of_candidates(vendor: str, place: str, alone: bool, frame: str, kind: str) -> None:
    assert _found(vendor, [place], alone, frame) == kind


def test_the_most_certain_candidate_is_first() -> None:
    found = candidates("Ouster", [LEFT], alone=True, frame_id="/mine", sensor_from_lidar=LIDAR)
    order = [one.frame for one in found]
    frames = ["mine", "left/ouster/os_sensor", "left/os_sensor", "os_sensor", "left/os_lidar"]
    places = [order.index(frame) for frame in [*frames, "os_left"]]
    assert places == sorted(places)
    assert places[0] == 0
    assert len(set(order)) == len(order)


def test_spellings_of_one_place_have_equal_ranks() -> None:
    found = {one.frame: one.rank for one in candidates("Ouster", [LEFT], alone=False)}
    assert found["left/os_sensor"] == found["left_os_sensor"] == found["os_sensor_left"]
    assert not any("os_lidar" in frame for frame in found)


@pytest.mark.parametrize("frame", ["os_left/os_lidar", "/sensors/os_lidar", "os_lidar_1"])
def test_a_lidar_frame_of_the_rig_is_corrected(frame: str) -> None:
    among = candidates("Ouster", [LEFT], alone=False, sensor_from_lidar=LIDAR)
    assert named_frame(frame, among).sensor_from_frame is LIDAR
    assert named_frame(frame.replace("lidar", "sensor"), among).sensor_from_frame is None


@pytest.mark.parametrize(
    ("topic", "other", "same"),
    [
        ("/left/ouster/metadata", "/left/ouster/lidar_packets", True),
        ("/left/ouster/metadata", "/right/ouster/lidar_packets", False),
        ("/left/metadata", "/left/ouster/lidar_packets", False),
        ("left/metadata", "/left/lidar_packets", True),
        ("/metadata", "/lidar_packets", True),
    ],
)
def test_namespaces(topic: str, other: str, same: bool) -> None:
    assert same_namespace(topic, other) is same


@pytest.mark.parametrize(
    ("topic", "others", "nearest"),
    [
        (LEFT, ["/right/ouster/metadata", "/left/ouster/metadata"], "/left/ouster/metadata"),
        (LEFT, ["/left/metadata", "/right/ouster/metadata"], "/left/metadata"),
        (LEFT, ["/left/metadata", "/left/ouster/metadata"], "/left/ouster/metadata"),
        (LEFT, ["/left/ouster/a/metadata", "/left/ouster/metadata"], "/left/ouster/metadata"),
        # Two that are equally near, a sibling, and one that has nothing to do with it.
        (LEFT, ["/left/ouster/metadata", "/left/ouster/metadata2"], None),
        ("/sensing/lidar/left/lidar_packets", ["/sensing/lidar/right/metadata"], None),
        (LEFT, ["/metadata"], None),
        ("/lidar_packets", ["/metadata"], "/metadata"),
        (LEFT, [], None),
    ],
)
def test_the_nearest_topic(topic: str, others: list[str], nearest: str | None) -> None:
    assert nearest_topic(topic, others) == nearest
