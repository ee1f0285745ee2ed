"""Where the sensors of a recording sit: whose word counts, and what is refused."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.arrays import F64Array
from mlbatch.discovery.extrinsics import Knowledge, Mounting, Stated
from mlbatch.errors import RigError
from mlbatch.frames.naming import Candidate, candidates
from mlbatch.frames.transforms import compose, from_rpy_deg, quaternion

NO_TURN = (0.0, 0.0, 0.0, 1.0)
# An Ouster's lidar frame: turned by half a turn about z, 36 mm above its sensor frame.
LIDAR = from_rpy_deg((0.0, 0.0, 0.036), (0.0, 0.0, 180.0))
LEFT, RIGHT = "/left/ouster/lidar_packets", "/right/ouster/lidar_packets"


def _at(parent: str, child: str, *xyz_m: float, turn: Sequence[float] = NO_TURN) -> Stated:
    return parent, child, xyz_m or (0.0, 0.0, 0.0), turn


def _pair() -> dict[str, Sequence[Candidate]]:
    return {
        "left": candidates("Ouster", [LEFT], alone=False, sensor_from_lidar=LIDAR),
        "right": candidates("Ouster", [RIGHT], alone=False, sensor_from_lidar=LIDAR),
    }


def _single() -> dict[str, Sequence[Candidate]]:
    topic = "/ouster/lidar_packets"
    return {"ouster_1": candidates("Ouster", [topic], alone=True, sensor_from_lidar=LIDAR)}


def _static(*edges: Stated) -> Knowledge:
    knowledge = Knowledge()
    knowledge.add_transforms("tf_static", edges)
    return knowledge


def _mount(
    knowledge: Knowledge,
    frames: Mapping[str, Sequence[Candidate]],
    rig: Mapping[str, F64Array | str] | None = None,
    metadata: Mapping[str, F64Array] | None = None,
    body: str | None = None,
    identity: bool = False,
) -> Mounting:
    return knowledge.mount(frames, rig or {}, metadata or {}, body, identity_extrinsics=identity)


def _refusal(
    knowledge: Knowledge,
    frames: Mapping[str, Sequence[Candidate]],
    rig: Mapping[str, F64Array | str] | None = None,
    body: str | None = None,
) -> str:
    with pytest.raises(RigError) as caught:
        _mount(knowledge, frames, rig, body=body)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def _place(mounting: Mounting, name: str) -> list[float]:
    place: list[float] = mounting.mounts[name].body_from_sensor[:3, 3].tolist()
    return place


def _urdf(parent: str, child: str, xyz: str, kind: str = "fixed") -> str:
    return (
        f'<robot><joint name="j" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}"/></joint></robot>'
    )


SIDES = (_at("base_link", "left/os_sensor", 0, 1, 2), _at("base_link", "right/os_sensor", 0, -1, 2))
UNKNOWN = (
    "extrinsics unknown for left, right; wanted for every sensor when there are two or more; "
    "give them in a rig file (--rig), /tf_static or metadata (ouster-sdk extrinsic), or accept the "
    "body origin with --identity-extrinsics"
)


def test_two_sensors_from_tf_static_in_two_messages() -> None:
    knowledge = Knowledge()
    for edge in SIDES:
        knowledge.add_transforms("tf_static", [edge])
    mounting = _mount(knowledge, _pair())
    assert mounting.body_frame == "base_link"
    assert _place(mounting, "left") == [0, 1, 2]
    assert _place(mounting, "right") == [0, -1, 2]
    assert [mount.source for mount in mounting.mounts.values()] == ["tf_static"] * 2
    assert mounting.mounts["left"].chain == "base_link -> left/os_sensor"
    assert mounting.findings == ()


def test_a_chain_through_the_sensor_and_lidar_frames_is_applied_once() -> None:
    # The driver's own edges hang below: points are in os_sensor, so the chain ends there.
    drivers = [
        (f"{side}/os_sensor", f"{side}/os_lidar", LIDAR[:3, 3].tolist(), (0.0, 0.0, 1.0, 0.0))
        for side in ("left", "right")
    ]
    mounting = _mount(_static(*SIDES, *drivers), _pair())
    assert _place(mounting, "left") == [0, 1, 2]
    assert np.array_equal(mounting.mounts["left"].body_from_sensor[:3, :3], np.eye(3))


def test_only_the_lidar_frame_is_connected() -> None:
    # The lidar frame looks backwards, 36 mm above the sensor's, so the sensor looks ahead.
    turned = (0.0, 0.0, 1.0, 0.0)
    mounting = _mount(
        _static(
            _at("base_link", "left/os_lidar", 0, 1, 2, turn=turned),
            _at("base_link", "right/os_lidar", 0, -1, 2, turn=turned),
            # Connected with nothing: of no use, though it is the better frame.
            _at("left/os_sensor", "left/os_imu", 0, 0, 0),
        ),
        _pair(),
    )
    assert _place(mounting, "left") == pytest.approx([0, 1, 1.964])
    assert np.allclose(mounting.mounts["left"].body_from_sensor[:3, :3], np.eye(3))
    assert mounting.mounts["left"].chain == "base_link -> left/os_lidar"


POSES = st.builds(
    from_rpy_deg,
    st.tuples(*[st.floats(-10, 10)] * 3),
    st.tuples(*[st.floats(-180, 180)] * 3),
)


def _stated(parent: str, child: str, matrix: F64Array) -> Stated:
    return parent, child, matrix[:3, 3].tolist(), quaternion(matrix).tolist()


@given(POSES, POSES)
def test_the_lidar_frame_says_the_same_as_the_sensor_frame(
    body_from_sensor: F64Array, sensor_from_lidar: F64Array
) -> None:
    frames = {
        "left": candidates("Ouster", [LEFT], alone=False, sensor_from_lidar=sensor_from_lidar)
    }
    lidar = compose(body_from_sensor, sensor_from_lidar)
    for edge in (
        _stated("base_link", "left/os_lidar", lidar),
        _stated("base_link", "left/os_sensor", body_from_sensor),
    ):
        found = _mount(_static(edge), frames).mounts["left"].body_from_sensor
        assert np.allclose(found, body_from_sensor, atol=1e-9)


def test_the_body_is_the_nearest_common_ancestor() -> None:
    mounting = _mount(
        _static(
            _at("map", "car", 100, 0, 0),
            _at("car", "roof", 0, 0, 2),
            _at("roof", "os_left", 0, 1, 0),
            _at("roof", "os_right", 0, -1, 0),
        ),
        _pair(),
    )
    assert mounting.body_frame == "roof"
    assert _place(mounting, "left") == [0, 1, 0]


def test_base_link_is_the_body_though_not_the_nearest() -> None:
    roof = [_at("base_link", "roof", 0, 0, 2), _at("roof", "os_left"), _at("roof", "os_right")]
    mounting = _mount(_static(*roof), _pair())
    assert mounting.body_frame == "base_link"
    assert mounting.mounts["right"].chain == "base_link -> roof -> os_right"


def test_one_sensor_may_hang_on_the_other() -> None:
    # base_link is known, but hangs below: not an ancestor.
    mounting = _mount(
        _static(_at("os_left", "os_right", 0, -2, 0), _at("os_left", "base_link", 0, 0, -2)),
        _pair(),
    )
    assert mounting.body_frame == "os_left"
    assert _place(mounting, "left") == [0, 0, 0]
    assert _place(mounting, "right") == [0, -2, 0]
    assert mounting.mounts["left"].source == "tf_static"


def test_the_rig_names_the_body() -> None:
    mounting = _mount(_static(*SIDES, _at("car", "base_link", 5, 0, 0)), _pair(), body="car")
    assert mounting.body_frame == "car"
    assert _place(mounting, "left") == [5, 1, 2]


def test_constant_tf_counts_as_static_and_says_so() -> None:
    knowledge = _static(SIDES[0])
    for _ in range(3):
        knowledge.add_transforms("tf", [_at("/base_link", "/os_right", 0, -1, 2)])
    mounting = _mount(knowledge, _pair())
    assert mounting.mounts["right"].source == "tf"
    (finding,) = mounting.findings
    assert (finding.code, finding.sensor) == ("constant_tf", "right")
    assert finding.message == (
        "/tf never changed base_link -> os_right in 3 message(s): taken as static"
    )


def test_changing_tf_is_not_used() -> None:
    knowledge = _static(SIDES[0], _at("turret", "os_right"))
    knowledge.add_transforms("tf", [_at("base_link", "turret", 0, 0, 1)])
    knowledge.add_transforms("tf", [_at("base_link", "turret", 0, 0, 1.5)])
    for body in (None, "base_link"):
        text = _refusal(knowledge, _pair(), body=body)
        assert text.startswith("extrinsics unknown for right; wanted for every sensor")
        assert text.endswith(
            "(right: nothing connects frame os_right with base_link: "
            "/tf changes base_link -> turret during the recording)"
        )


def test_fixed_joints_fill_what_transforms_leave_open() -> None:
    knowledge = _static(_at("roof", "os_left", 0, 1, 0), _at("roof", "os_right", 0, -1, 0))
    knowledge.add_urdf(_urdf("base_link", "roof", "0 0 2"))
    mounting = _mount(knowledge, _pair())
    assert mounting.body_frame == "base_link"
    assert _place(mounting, "left") == [0, 1, 2]
    assert mounting.mounts["left"].source == "urdf"
    assert mounting.findings == ()


def test_a_movable_joint_is_told_to_those_who_need_it() -> None:
    knowledge = _static(_at("base_link", "os_left"), _at("turret", "os_right"))
    knowledge.add_urdf(_urdf("base_link", "turret", "0 0 2", kind="revolute"))
    text = _refusal(knowledge, _pair(), body="base_link")
    assert "joint j (base_link -> turret) of the URDF is not fixed but revolute" in text


def test_a_urdf_that_contradicts_is_told_with_both_names() -> None:
    knowledge = _static(*SIDES)
    knowledge.add_urdf(_urdf("base_link", "left/os_sensor", "0.003 1.004 2"))
    mounting = _mount(knowledge, _pair())
    assert _place(mounting, "left") == [0, 1, 2]
    (finding,) = mounting.findings
    assert (finding.code, finding.sensor) == ("extrinsics_contradict", "left")
    assert finding.message == (
        "its extrinsics of tf_static and of urdf differ by 5.0 mm and 0.00 degrees "
        "(base_link -> left/os_sensor); tf_static is used, correct the wrong one"
    )


def test_a_contradiction_within_a_chain_of_both_sources_is_told() -> None:
    knowledge = _static(_at("roof", "os_left", 0, 1, 0), _at("roof", "os_right", 0, -1, 0))
    joints = (_urdf("base_link", "roof", "0 0 2"), _urdf("roof", "os_left", "0 1.5 0"))
    for text in joints:
        knowledge.add_urdf(text)
    mounting = _mount(knowledge, _pair())
    assert _place(mounting, "left") == [0, 1, 2]
    (finding,) = mounting.findings
    assert finding.message.startswith(
        "its extrinsics of tf_static and of urdf differ by 500.0 mm and 0.00 degrees"
    )


@pytest.mark.parametrize(
    ("moved_m", "turned_deg", "is_told"),
    [
        (0.001, 0.0, False),
        (0.0011, 0.0, True),
        (0.0, 0.1, False),
        (0.0, 0.11, True),
        (0.0009, 0.09, False),
    ],
)
def test_where_a_contradiction_begins(moved_m: float, turned_deg: float, is_told: bool) -> None:
    other = from_rpy_deg((0.0, 1.0 + moved_m, 2.0), (0.0, 0.0, turned_deg))
    mounting = _mount(_static(*SIDES), _pair(), metadata={"left": other})
    assert [finding.sensor for finding in mounting.findings] == ["left"] * is_told


def test_the_rig_comes_before_all_others() -> None:
    mine = from_rpy_deg((7.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    mounting = _mount(_static(*SIDES), _pair(), rig={"left": mine}, body="base_link")
    assert mounting.mounts["left"].source == "rig"
    assert _place(mounting, "left") == [7, 0, 0]
    assert mounting.mounts["right"].source == "tf_static"
    (finding,) = mounting.findings
    assert finding.message.startswith("its extrinsics of rig and of tf_static differ by")
    assert finding.message.endswith("; rig is used, correct the wrong one")


def test_metadata_where_no_tree_is() -> None:
    told = {name: from_rpy_deg((x, 0.0, 0.0), (0, 0, 0)) for name, x in (("left", 1), ("right", 2))}
    mounting = _mount(Knowledge(), _pair(), metadata=told)
    assert mounting.body_frame == "base_link"
    assert [mount.source for mount in mounting.mounts.values()] == ["metadata"] * 2
    assert _place(mounting, "right") == [2, 0, 0]
    assert mounting.findings == ()


def test_metadata_beside_a_tree_are_told() -> None:
    mounting = _mount(_static(SIDES[0]), _pair(), metadata={"right": np.eye(4)})
    assert mounting.body_frame == "base_link"
    assert [mount.source for mount in mounting.mounts.values()] == ["tf_static", "metadata"]
    codes = {(finding.code, finding.sensor) for finding in mounting.findings}
    assert ("extrinsics_mixed", "right") in codes


def test_two_sensors_of_unknown_place_are_refused() -> None:
    assert _refusal(Knowledge(), _pair()) == UNKNOWN


def test_drivers_own_trees_that_nothing_connects() -> None:
    text = _refusal(
        _static(_at("left/os_sensor", "left/os_lidar"), _at("right/os_sensor", "right/os_lidar")),
        _pair(),
    )
    reason = "nothing connects the frames left/os_sensor and right/os_sensor"
    assert text == f"{UNKNOWN} (left: {reason}; right: {reason})"


def test_identity_on_request() -> None:
    mounting = _mount(_static(SIDES[0]), _pair(), identity=True)
    assert mounting.mounts["right"].source == "identity"
    assert np.array_equal(mounting.mounts["right"].body_from_sensor, np.eye(4))
    assert mounting.mounts["left"].source == "tf_static"


def test_a_single_sensor_keeps_its_own_frame() -> None:
    for knowledge in (Knowledge(), _static(_at("os_sensor", "os_lidar"))):
        mounting = _mount(knowledge, _single())
        assert mounting.body_frame == "ouster_1"
        assert mounting.mounts["ouster_1"].source == "identity"
        assert mounting.findings == ()


def test_a_single_sensor_on_base_link() -> None:
    mounting = _mount(_static(_at("base_link", "os_sensor", 1, 0, 0)), _single())
    assert mounting.body_frame == "base_link"
    assert _place(mounting, "ouster_1") == [1, 0, 0]


def test_spellings_at_different_places_are_no_ones() -> None:
    knowledge = _static(*SIDES, _at("base_link", "os_sensor_left", 0, 1, 3))
    text = _refusal(knowledge, _pair())
    assert text.startswith("extrinsics unknown for left; ")
    assert text.endswith("(left: frames left/os_sensor and os_sensor_left could both be its own)")


def test_spellings_at_one_place_are_fine() -> None:
    knowledge = _static(*SIDES, _at("left/os_sensor", "os_sensor_left"))
    assert _place(_mount(knowledge, _pair()), "left") == [0, 1, 2]


def test_a_frame_belongs_to_one_sensor() -> None:
    frames: dict[str, Sequence[Candidate]] = {
        "a": [Candidate("velodyne")],
        "b": [Candidate("velodyne")],
    }
    text = _refusal(_static(_at("base_link", "velodyne")), frames)
    assert "(a: frame velodyne could be that of 2 sensors; b: frame velodyne could" in text


def test_frames_under_unknown_names_are_listed() -> None:
    text = _refusal(_static(_at("base_link", "lidar_a"), _at("base_link", "lidar_b")), _pair())
    reason = "none of the recording's frames (base_link, lidar_a, lidar_b) can be told as its own"
    assert text == f"{UNKNOWN} (left: {reason}; right: {reason})"


def test_the_rig_names_frames() -> None:
    knowledge = _static(_at("base_link", "lidar_a", 1, 0, 0), _at("base_link", "lidar_b", 2, 0, 0))
    rig = {"left": "/lidar_a", "right": "lidar_b"}
    mounting = _mount(knowledge, _pair(), rig=rig, body="base_link")
    assert _place(mounting, "right") == [2, 0, 0]
    assert mounting.mounts["right"].source == "tf_static"
    assert mounting.mounts["left"].chain == "base_link -> lidar_a"


def test_the_rig_names_a_lidar_frame() -> None:
    turned = _at("base_link", "x/os_lidar", 0, 1, 2, turn=(0.0, 0.0, 1.0, 0.0))
    mounting = _mount(_static(turned), _single(), rig={"ouster_1": "x/os_lidar"}, body="base_link")
    assert _place(mounting, "ouster_1") == pytest.approx([0, 1, 1.964])


@pytest.mark.parametrize(
    ("edges", "frame", "message"),
    [
        (
            (),
            "os_left",
            "need a recording with /tf_static, which captures do not have; give translation_m "
            "and a rotation",
        ),
        (
            (_at("base_link", "os_left"),),
            "os_lef",
            ": expected a frame of the recording's transforms, found 'os_lef'; did you mean "
            "os_left?; correct it, or give translation_m and a rotation",
        ),
        (
            (_at("base_link", "a"), _at("turret", "os_left")),
            "os_left",
            ": nothing connects frame os_left with base_link; correct it, or give translation_m "
            "and a rotation",
        ),
    ],
)
def test_frames_of_the_rig_that_lead_nowhere(
    edges: tuple[Stated, ...], frame: str, message: str
) -> None:
    text = _refusal(_static(*edges), _single(), rig={"ouster_1": frame}, body="base_link")
    space = "" if message.startswith(":") else " "
    assert text == f"sensor ouster_1: extrinsics by frame ({frame}){space}{message}"


def test_a_body_frame_that_the_recording_lacks() -> None:
    text = _refusal(_static(*SIDES), _pair(), body="base_lnk")
    assert "found 'base_lnk'; did you mean base_link?" in text


def test_what_is_wrong_elsewhere_does_not_matter() -> None:
    mounting = _mount(
        _static(
            *SIDES,
            _at("base_link", "wheel", float("nan"), 0, 0),
            _at("a", "b"),
            _at("b", "a"),
            _at("odom", "base_link"),
            _at("map", "base_link"),
            _at("arm", "arm"),
        ),
        _pair(),
    )
    assert mounting.body_frame == "base_link"
    assert mounting.findings == ()


def test_a_bad_transform_of_a_sensor_is_the_reason_told() -> None:
    bad = _at("base_link", "right/os_sensor", turn=(0.0, 0.0, 0.0, 0.0))
    driver = _at("right/os_sensor", "right/os_lidar")
    text = _refusal(_static(SIDES[0], bad, driver), _pair(), body="base_link")
    assert (
        "tf_static: transform base_link -> right/os_sensor: expected a quaternion of norm 1" in text
    )


def test_two_parents_of_a_sensor_are_the_reason_told() -> None:
    # A person states the lidar frame, and so does the driver.
    edges = (_at("base_link", "left/os_lidar"), _at("left/os_sensor", "left/os_lidar"))
    text = _refusal(_static(*edges, SIDES[1]), _pair(), body="base_link")
    assert "frame left/os_lidar: expected one parent, found base_link and left/os_sensor" in text


def test_a_urdf_that_cannot_be_read_is_a_finding() -> None:
    knowledge = _static(*SIDES)
    knowledge.add_urdf("<robot>")
    (finding,) = _mount(knowledge, _pair()).findings
    assert (finding.code, finding.sensor) == ("urdf", "")
    assert finding.message.startswith("robot_description (URDF): expected an XML document")


def test_a_urdf_that_is_unclear_contradicts_nobody() -> None:
    knowledge = _static(*SIDES)
    knowledge.add_urdf(_urdf("base_link", "left/os_sensor", "9 9 9"))
    knowledge.add_urdf(_urdf("roof", "left/os_sensor", "9 9 9"))
    mounting = _mount(knowledge, _pair())
    assert _place(mounting, "left") == [0, 1, 2]
    assert mounting.findings == ()
