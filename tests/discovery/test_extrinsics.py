"""Extrinsics of the sensors of a session: order of trust, contradictions, refusals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.arrays import F64Array
from mlbatch.discovery.extrinsics import Extrinsics, ExtrinsicsSources, RigExtrinsics, Transform
from mlbatch.discovery.types import Note
from mlbatch.errors import RigError
from mlbatch.frames.naming import Candidate, candidates
from mlbatch.frames.transforms import compose, from_rpy_deg, quaternion
from mlbatch.rig.rig import UnknownExtrinsics
from tests.builders.sessions import Shell, Unit, write_session

Frames = Mapping[str, Sequence[Candidate]]
NO_ROTATION = (0.0, 0.0, 0.0, 1.0)
HALF_TURN_Z = (0.0, 0.0, 1.0, 0.0)
# Lidar frame of an Ouster: rotated by 180 degrees about z, 36 mm above its sensor frame.
LIDAR = from_rpy_deg((0.0, 0.0, 0.036), (0.0, 0.0, 180.0))
LEFT = "/left/ouster/lidar_packets"
RIGHT = "/right/ouster/lidar_packets"
PAIR: Frames = {
    "left": candidates("Ouster", [LEFT], alone=False, sensor_from_lidar=LIDAR),
    "right": candidates("Ouster", [RIGHT], alone=False, sensor_from_lidar=LIDAR),
}
SINGLE: Frames = {
    "ouster_1": candidates("Ouster", ["/ouster/lidar_packets"], alone=True, sensor_from_lidar=LIDAR)
}


def _at(parent: str, child: str, *xyz_m: float, xyzw: Sequence[float] = NO_ROTATION) -> Transform:
    return parent, child, xyz_m or (0.0, 0.0, 0.0), xyzw


def _urdf(parent: str, child: str, xyz: str, kind: str = "fixed") -> str:
    return (
        f'<robot><joint name="j" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}"/></joint></robot>'
    )


def _shifted(x_m: float) -> F64Array:
    return from_rpy_deg((x_m, 0.0, 0.0), (0.0, 0.0, 0.0))


SIDES = (_at("base_link", "left/os_sensor", 0, 1, 2), _at("base_link", "right/os_sensor", 0, -1, 2))
ROOF = (_at("roof", "os_left", 0, 1, 0), _at("roof", "os_right", 0, -1, 0))
SIDES_M = {"left": [0, 1, 2], "right": [0, -1, 2]}


@dataclass(frozen=True)
class Given:
    """Extrinsics in a session; static, tf: a transform a message."""

    frames: Frames = field(default_factory=lambda: PAIR)
    static: Sequence[Transform] = ()
    tf: Sequence[Transform] = ()
    urdf: Sequence[str] = ()
    rig: Mapping[str, RigExtrinsics] = field(default_factory=dict)
    metadata: Mapping[str, F64Array] = field(default_factory=dict)
    body: str | None = None
    identity: bool = False

    def resolve(self) -> Extrinsics:
        sources = ExtrinsicsSources()
        for transform in self.static:
            sources.add_transforms("tf_static", [transform])
        for transform in self.tf:
            sources.add_transforms("tf", [transform])
        for text in self.urdf:
            sources.add_urdf(text)
        return sources.resolve(
            self.frames, self.rig, self.metadata, self.body, identity_extrinsics=self.identity
        )

    def refusal(self) -> str:
        with pytest.raises(RigError) as caught:
            self.resolve()
        assert "\n" not in str(caught.value)
        return str(caught.value)


@dataclass(frozen=True)
class Found:
    """Expected: body frame, by sensor its position, its source and chain."""

    body_frame: str
    positions_m: Mapping[str, Sequence[float]]
    origins: Mapping[str, str] = field(default_factory=dict)
    notes: Sequence[tuple[str, str]] = ()


FOUND = {
    "two messages of /tf_static": (
        Given(static=SIDES),
        Found(
            "base_link",
            SIDES_M,
            {
                "left": "tf_static: base_link -> left/os_sensor",
                "right": "tf_static: base_link -> right/os_sensor",
            },
        ),
    ),
    # The drivers' own edges are below the sensor frame, in which points are.
    "chain through sensor and lidar frame": (
        Given(
            static=[
                *SIDES,
                _at("left/os_sensor", "left/os_lidar", 0, 0, 0.036, xyzw=HALF_TURN_Z),
                _at("right/os_sensor", "right/os_lidar", 0, 0, 0.036, xyzw=HALF_TURN_Z),
            ]
        ),
        Found("base_link", SIDES_M),
    ),
    # The lidar frame faces backwards, 36 mm above the sensor's, so that the sensor faces ahead.
    # The better frame of the left sensor is connected with nothing.
    "only the lidar frame is connected": (
        Given(
            static=[
                _at("base_link", "left/os_lidar", 0, 1, 2, xyzw=HALF_TURN_Z),
                _at("base_link", "right/os_lidar", 0, -1, 2, xyzw=HALF_TURN_Z),
                _at("left/os_sensor", "left/os_imu", 0, 0, 0),
            ]
        ),
        Found(
            "base_link",
            {"left": [0, 1, 1.964], "right": [0, -1, 1.964]},
            {"left": "tf_static: base_link -> left/os_lidar"},
        ),
    ),
    "the nearest common ancestor is the body": (
        Given(static=[_at("map", "car", 100, 0, 0), _at("car", "roof", 0, 0, 2), *ROOF]),
        Found("roof", {"left": [0, 1, 0], "right": [0, -1, 0]}),
    ),
    "base_link is the body, though not the nearest": (
        Given(static=[_at("base_link", "roof", 0, 0, 2), *ROOF]),
        Found("base_link", SIDES_M, {"right": "tf_static: base_link -> roof -> os_right"}),
    ),
    # base_link is below the sensor, and no ancestor.
    "one sensor is below the other": (
        Given(static=[_at("os_left", "os_right", 0, -2, 0), _at("os_left", "base_link", 0, 0, -2)]),
        Found("os_left", {"left": [0, 0, 0], "right": [0, -2, 0]}, {"left": "tf_static: os_left"}),
    ),
    "the rig names the body": (
        Given(static=[*SIDES, _at("car", "base_link", 5, 0, 0)], body="car"),
        Found("car", {"left": [5, 1, 2], "right": [5, -1, 2]}),
    ),
    "constant /tf is used as static": (
        Given(static=SIDES[:1], tf=[_at("/base_link", "/os_right", 0, -1, 2)] * 3),
        Found(
            "base_link",
            SIDES_M,
            {"right": "tf: base_link -> os_right"},
            [("constant_tf", "sensor right: /tf never changed base_link -> os_right in 3 mes")],
        ),
    ),
    "fixed joints complete transforms": (
        Given(static=ROOF, urdf=[_urdf("base_link", "roof", "0 0 2")]),
        Found("base_link", SIDES_M, {"left": "urdf: base_link -> roof -> os_left"}),
    ),
    "a contradicting joint": (
        Given(static=SIDES, urdf=[_urdf("base_link", "left/os_sensor", "0.003 1.004 2")]),
        Found(
            "base_link",
            SIDES_M,
            notes=[
                (
                    "extrinsics_contradict",
                    "sensor left: its extrinsics of tf_static and of urdf differ by",
                )
            ],
        ),
    ),
    "a contradiction within a chain of both sources": (
        Given(
            static=ROOF,
            urdf=[_urdf("base_link", "roof", "0 0 2"), _urdf("roof", "os_left", "0 1.5 0")],
        ),
        Found(
            "base_link",
            SIDES_M,
            notes=[
                (
                    "extrinsics_contradict",
                    "sensor left: its extrinsics of tf_static and of urdf differ by",
                )
            ],
        ),
    ),
    "an ambiguous URDF contradicts nothing": (
        Given(
            static=SIDES,
            urdf=[
                _urdf("base_link", "left/os_sensor", "9 9 9"),
                _urdf("roof", "left/os_sensor", "9 9 9"),
            ],
        ),
        Found("base_link", SIDES_M),
    ),
    "an unreadable URDF": (
        Given(static=SIDES, urdf=["<robot>"]),
        Found("base_link", SIDES_M, notes=[("urdf", "robot_description (URDF): ")]),
    ),
    "the rig is trusted most": (
        Given(static=SIDES, rig={"left": _shifted(7)}, body="base_link"),
        Found(
            "base_link",
            {"left": [7, 0, 0], "right": [0, -1, 2]},
            {"left": "rig", "right": "tf_static: base_link -> right/os_sensor"},
            [
                (
                    "extrinsics_contradict",
                    "sensor left: its extrinsics of rig and of tf_static differ by",
                )
            ],
        ),
    ),
    "metadata without a tree": (
        Given(metadata={"left": _shifted(1), "right": _shifted(2)}),
        Found(
            "base_link",
            {"left": [1, 0, 0], "right": [2, 0, 0]},
            {"left": "metadata", "right": "metadata"},
        ),
    ),
    "metadata and a tree": (
        Given(static=SIDES[:1], metadata={"right": np.eye(4)}),
        Found(
            "base_link",
            {"left": [0, 1, 2], "right": [0, 0, 0]},
            {"left": "tf_static: base_link -> left/os_sensor", "right": "metadata"},
            [
                (
                    "extrinsics_frame",
                    "sensor right: none of the recording's frames (base_link, left/",
                ),
                (
                    "extrinsics_mixed",
                    "sensor right: the extrinsics of its metadata are assumed to re",
                ),
            ],
        ),
    ),
    "identity on request": (
        Given(static=SIDES[:1], identity=True),
        Found(
            "base_link",
            {"left": [0, 1, 2], "right": [0, 0, 0]},
            {"left": "tf_static: base_link -> left/os_sensor", "right": "identity"},
            [
                ("extrinsics_frame", "sensor right: none of the recording's frames"),
                ("identity_extrinsics", "sensor right: expected extrinsics, found none"),
            ],
        ),
    ),
    "a single sensor keeps its own frame": (
        Given(SINGLE),
        Found("ouster_1", {"ouster_1": [0, 0, 0]}, {"ouster_1": "identity"}),
    ),
    "a single sensor with the edge of its driver": (
        Given(SINGLE, static=[_at("os_sensor", "os_lidar")]),
        Found("ouster_1", {"ouster_1": [0, 0, 0]}, {"ouster_1": "identity"}),
    ),
    "a single sensor below base_link": (
        Given(SINGLE, static=[_at("base_link", "os_sensor", 1, 0, 0)]),
        Found("base_link", {"ouster_1": [1, 0, 0]}),
    ),
    "two spellings at one place": (
        Given(static=[*SIDES, _at("left/os_sensor", "os_sensor_left")]),
        Found("base_link", SIDES_M),
    ),
    "the rig names frames": (
        Given(
            static=[_at("base_link", "lidar_a", 1, 0, 0), _at("base_link", "lidar_b", 2, 0, 0)],
            rig={"left": "/lidar_a", "right": "lidar_b"},
            body="base_link",
        ),
        Found(
            "base_link",
            {"left": [1, 0, 0], "right": [2, 0, 0]},
            {"left": "tf_static: base_link -> lidar_a", "right": "tf_static: base_link -> lidar_b"},
        ),
    ),
    "the rig names a lidar frame": (
        Given(
            SINGLE,
            static=[_at("base_link", "x/os_lidar", 0, 1, 2, xyzw=HALF_TURN_Z)],
            rig={"ouster_1": "x/os_lidar"},
            body="base_link",
        ),
        Found("base_link", {"ouster_1": [0, 1, 1.964]}),
    ),
    "faults of other frames": (
        Given(
            static=[
                *SIDES,
                _at("base_link", "wheel", float("nan"), 0, 0),
                _at("a", "b"),
                _at("b", "a"),
                _at("odom", "base_link"),
                _at("map", "base_link"),
                _at("arm", "arm"),
            ]
        ),
        Found("base_link", SIDES_M),
    ),
}


@pytest.mark.parametrize("name", FOUND)
def test_extrinsics(name: str) -> None:
    given_, expected = FOUND[name]
    found = given_.resolve()
    assert found.body_frame == expected.body_frame
    for sensor, pose in found.poses.items():
        # In all cases sensors are parallel to the body.
        assert np.allclose(pose.body_from_sensor[:3, :3], np.eye(3))
        position_m = pose.body_from_sensor[:3, 3].tolist()
        assert position_m == pytest.approx(expected.positions_m[sensor], abs=1e-12)
    assert {sensor: found.poses[sensor].describe() for sensor in expected.origins} == dict(
        expected.origins
    )
    assert len(found.notes) == len(expected.notes)
    for note, (code, start) in zip(found.notes, expected.notes, strict=True):
        assert note.code == code
        assert note.message.startswith(start)
        assert note.sensor == (start.split(":")[0].split()[1] if code != "urdf" else "")


@pytest.mark.parametrize(
    ("moved_m", "rotated_deg", "is_noted"),
    [
        (0.001, 0.0, False),
        (0.0011, 0.0, True),
        (0.0, 0.1, False),
        (0.0, 0.11, True),
        (0.0009, 0.09, False),
    ],
)
def test_where_a_contradiction_begins(moved_m: float, rotated_deg: float, is_noted: bool) -> None:
    other = from_rpy_deg((0.0, 1.0 + moved_m, 2.0), (0.0, 0.0, rotated_deg))
    found = Given(static=SIDES, metadata={"left": other}).resolve()
    assert [note.sensor for note in found.notes] == ["left"] * is_noted


@pytest.mark.parametrize(
    ("apart_m", "rotated_deg", "is_noted"),
    [
        (0.0, 0.0, True),
        (0.001, 0.0, True),
        (0.0011, 0.0, False),
        (0.0, 0.1, True),
        (0.0, 0.11, False),
        (0.0, 180.0, False),
    ],
)
@pytest.mark.parametrize("source", ["rig", "tf_static", "metadata"])
def test_where_two_sensors_share_a_pose(
    source: str, apart_m: float, rotated_deg: float, is_noted: bool
) -> None:
    poses = {
        "left": from_rpy_deg((0.0, 1.0, 2.0), (0.0, 0.0, 30.0)),
        "right": from_rpy_deg((0.0, 1.0 + apart_m, 2.0), (0.0, 0.0, 30.0 + rotated_deg)),
    }
    edges = [_transform("base_link", f"{name}/os_sensor", pose) for name, pose in poses.items()]
    given_ = {
        "rig": Given(rig=poses),
        "tf_static": Given(static=edges),
        "metadata": Given(metadata=poses),
    }[source]
    for identity in (False, True):
        found = replace(given_, identity=identity).resolve()
        text = (
            f"sensor right: expected a pose of its own, found that of left ({source}); correct its "
            "extrinsics, or leave out those of both and give --identity-extrinsics if their points "
            "are in the body frame already"
        )
        assert list(found.notes) == [Note("same_pose", "right", text)] * is_noted


def test_sensors_at_the_body_origin_by_request_share_no_pose() -> None:
    (note,) = Given(identity=True).resolve().notes
    assert (note.code, note.sensor) == ("identity_extrinsics", "")
    assert note.message.startswith("sensors left, right: expected extrinsics, found none")
    (note,) = Given(rig={"left": _shifted(0.0)}, identity=True).resolve().notes
    assert (note.code, note.sensor) == ("identity_extrinsics", "right")
    # A single sensor is in its own frame, whatever was asked for.
    assert Given(SINGLE, identity=True).resolve().notes == ()


@pytest.mark.parametrize(
    ("away_m", "text"),
    [
        ((12.0, 12.0, 10.0), ""),
        # 20 mm for 20 m would be no lever arm of a machine.
        ((12.0, 12.0, 11.0), "found 20.2237 m (rig): as millimetres this would be 0.02022 m"),
        ((1500.0, 900.0, 2000.0), "found 2657.07 m (rig): as millimetres this would be 2.657 m"),
    ],
)
def test_sensors_far_from_the_body(away_m: tuple[float, float, float], text: str) -> None:
    poses = {"left": _shifted(1.0), "right": from_rpy_deg(away_m, (0.0, 0.0, 0.0))}
    notes = Given(rig=poses).resolve().notes
    assert [(one.code, one.sensor) for one in notes] == [("far_pose", "right")] * bool(text)
    assert all(text in one.message for one in notes)


# Angles as given, and these as degrees if they were radians, or none: calibrations.
ANGLES = {
    "[0, 0, 0]": "",
    "[0, 0, 1.5708]": "0, 0, 90",
    "[0, -0.785, 3.14]": "0, -44.98, 179.9",
    "[0.35, -0.12, 1.57]": "20.05, -6.875, 89.95",
    "[1.5, 0.2, 3]": "",
    "[0.4, -0.6, 0.8]": "",
    # Near a quarter of a turn, not equal to the digits given.
    "[0.0312, -0.2241, 1.5731]": "",
    "[0, 22.0, 1.57]": "",
    "[0, 0, 90]": "",
}


@pytest.mark.parametrize("given_", ANGLES)
def test_angles_that_are_round_in_radians(shell: Shell, tmp_path: Path, given_: str) -> None:
    write_session(tmp_path, Unit())
    pose = f"{{translation_m: [0, 0, 1], rotation_rpy_deg: {given_}}}"
    (tmp_path / "rig.yaml").write_text(f"sensors:\n  - {{name: top, extrinsics: {pose}}}\n")
    outcome = shell("convert drive.pcap --rig rig.yaml --dry-run")
    turned = ANGLES[given_]
    assert (outcome.code, outcome.warnings) == (0, ["radians"] * bool(turned))
    assert f"[{turned}] degrees if it was meant as radians" in outcome.err or not turned


PLACE = UnknownExtrinsics("rig.yaml:7: sensors[1].extrinsics")
GIVE = (
    "give translation_m and a rotation (a guess is enough for `mlbatch calibrate`, which refines "
    "it)"
)


def test_unknown_in_the_rig_is_refused_with_its_place() -> None:
    one = Given(rig={"left": _shifted(1.0), "right": PLACE})
    start = (
        "rig.yaml:7: sensors[1].extrinsics: expected the pose of right, required for every sensor "
        "when there are two or more, found unknown; "
    )
    end = ", or accept the body origin with --identity-extrinsics"
    assert one.refusal() == f"{start}{GIVE}{end}"
    # Although another source knows it: the rig is the first source.
    other = replace(one, static=SIDES, body="base_link")
    found = "tf_static: base_link -> right/os_sensor"
    assert other.refusal() == f"{start}remove the key to use that of {found}{end}"
    placed = replace(one, identity=True).resolve()
    assert placed.poses["right"].source == "identity"
    placed = replace(other, identity=True).resolve()
    assert placed.poses["right"].describe() == found


@pytest.mark.parametrize("body", [None, "base_link"])
def test_a_single_sensor_of_unknown_pose_keeps_its_own_frame(body: str | None) -> None:
    single = Given(SINGLE, rig={"ouster_1": PLACE}, body=body)
    assert single.resolve().body_frame == "ouster_1"
    # The body origin, where the user says so.
    there = replace(single, identity=True).resolve().body_frame
    assert there == ("ouster_1" if body is None else body)


POSES = st.builds(
    from_rpy_deg, st.tuples(*[st.floats(-10, 10)] * 3), st.tuples(*[st.floats(-180, 180)] * 3)
)


def _transform(parent: str, child: str, matrix: F64Array) -> Transform:
    return parent, child, matrix[:3, 3].tolist(), list(quaternion(matrix))


@given(POSES, POSES)
def test_lidar_and_sensor_frame_give_the_same_pose(
    body_from_sensor: F64Array, sensor_from_lidar: F64Array
) -> None:
    frames = {
        "left": candidates("Ouster", [LEFT], alone=False, sensor_from_lidar=sensor_from_lidar)
    }
    lidar = compose(body_from_sensor, sensor_from_lidar)
    for edge in (
        _transform("base_link", "left/os_lidar", lidar),
        _transform("base_link", "left/os_sensor", body_from_sensor),
    ):
        found = Given(frames, static=[edge]).resolve().poses["left"].body_from_sensor
        assert np.allclose(found, body_from_sensor, atol=1e-9)


UNKNOWN = (
    "extrinsics unknown for left, right; required for every sensor when there are two or more; "
    "give them in a rig file (--rig), /tf_static or metadata (ouster-sdk extrinsic), measure them "
    "by mlbatch calibrate (without a guess: --from-motion), or accept the "
    "body origin with --identity-extrinsics"
)
RIGHT_UNKNOWN = UNKNOWN.replace("left, right", "right")
TURRET = (SIDES[0], _at("turret", "os_right"))
CHANGING = (_at("base_link", "turret", 0, 0, 1), _at("base_link", "turret", 0, 0, 1.5))
UNCONNECTED = "nothing connects the frames left/os_sensor and right/os_sensor"
UNNAMED = (
    "none of the recording's frames (base_link, lidar_a, lidar_b) is named as its driver would "
    "name it"
)
REMEDY = "correct it, or give translation_m and a rotation"
# The whole text, or parts of it after "...".
REFUSED = {
    "nothing is known": (Given(), UNKNOWN),
    "changing /tf": (
        Given(static=TURRET, tf=CHANGING),
        f"{RIGHT_UNKNOWN} (right: nothing connects frame os_right with base_link: /tf changes "
        "base_link -> turret during the recording)",
    ),
    "changing /tf, body of the rig": (
        Given(static=TURRET, tf=CHANGING, body="base_link"),
        f"{RIGHT_UNKNOWN} (right: nothing connects frame os_right with base_link: /tf changes "
        "base_link -> turret during the recording)",
    ),
    "a movable joint": (
        Given(
            static=[_at("base_link", "os_left"), _at("turret", "os_right")],
            urdf=[_urdf("base_link", "turret", "0 0 2", kind="revolute")],
            body="base_link",
        ),
        "...joint j (base_link -> turret) of the URDF is not fixed but revolute",
    ),
    "drivers' trees without a connection": (
        Given(
            static=[
                _at("left/os_sensor", "left/os_lidar"),
                _at("right/os_sensor", "right/os_lidar"),
            ]
        ),
        f"{UNKNOWN} (left: {UNCONNECTED}; right: {UNCONNECTED})",
    ),
    "two spellings at different places": (
        Given(static=[*SIDES, _at("base_link", "os_sensor_left", 0, 1, 3)]),
        UNKNOWN.replace("left, right", "left")
        + " (left: frames left/os_sensor and os_sensor_left could both be its own)",
    ),
    "one frame of two sensors": (
        Given(
            {"a": [Candidate("velodyne")], "b": [Candidate("velodyne")]},
            static=[_at("base_link", "velodyne")],
        ),
        "...(a: frame velodyne could be that of 2 sensors; b: frame velodyne could",
    ),
    "frames of unknown names": (
        Given(static=[_at("base_link", "lidar_a"), _at("base_link", "lidar_b")]),
        f"{UNKNOWN} (left: {UNNAMED}; right: {UNNAMED})",
    ),
    "frame of the rig in a capture": (
        Given(SINGLE, rig={"ouster_1": "os_left"}, body="base_link"),
        "sensor ouster_1: extrinsics by frame (os_left) need a recording with /tf_static, which "
        "captures do not have; give translation_m and a rotation",
    ),
    "misspelt frame of the rig": (
        Given(
            SINGLE,
            static=[_at("base_link", "os_left")],
            rig={"ouster_1": "os_lef"},
            body="base_link",
        ),
        f"...'os_lef'; did you mean os_left?; {REMEDY}",
    ),
    "unconnected frame of the rig": (
        Given(
            SINGLE,
            static=[_at("base_link", "a"), _at("turret", "os_left")],
            rig={"ouster_1": "os_left"},
            body="base_link",
        ),
        "sensor ouster_1: extrinsics by frame (os_left): nothing connects frame os_left with "
        f"base_link; {REMEDY}",
    ),
    "body frame that the recording lacks": (
        Given(static=SIDES, body="base_lnk"),
        "...'base_lnk'; did you mean base_link?",
    ),
    "a bad transform": (
        Given(
            static=[
                SIDES[0],
                _at("base_link", "right/os_sensor", xyzw=(0.0, 0.0, 0.0, 0.0)),
                _at("right/os_sensor", "right/os_lidar"),
            ],
            body="base_link",
        ),
        "...tf_static: transform base_link -> right/os_sensor: ...a quaternion of norm 1",
    ),
    # A person states the lidar frame, and so does the driver.
    "two parents": (
        Given(
            static=[
                _at("base_link", "left/os_lidar"),
                _at("left/os_sensor", "left/os_lidar"),
                SIDES[1],
            ],
            body="base_link",
        ),
        "...frame left/os_lidar: ...base_link and left/os_sensor",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refusals(name: str) -> None:
    given_, expected = REFUSED[name]
    text = given_.refusal()
    if expected.startswith("..."):
        assert all(part in text for part in expected.split("..."))
    else:
        assert text == expected


@pytest.mark.parametrize(
    "given",
    [
        Given(static=(_at("base_link", "left/os_sensor", 0, 1e4 + 1, 2), SIDES[1])),
        Given(frames=SINGLE, urdf=[_urdf("base_link", "os_sensor", "6e8 0 0")]),
        Given(metadata={"left": _shifted(-2e4), "right": _shifted(1.0)}),
    ],
    ids=["tf_static", "urdf", "metadata"],
)
def test_a_sensor_far_from_the_body_is_refused(given: Given) -> None:
    """float32 coordinates would be off by millimetres, or by more than verify accepts."""
    with pytest.raises(RigError, match=r"expected at most 10000 m from the body origin, found"):
        given.resolve()


def test_a_sensor_10_km_from_the_body_is_accepted() -> None:
    given = Given(static=(_at("base_link", "left/os_sensor", 0, 1e4, 2), SIDES[1]))
    assert given.resolve().poses["left"].body_from_sensor[1, 3] == 1e4
