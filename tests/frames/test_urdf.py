"""Joints of robot descriptions, with poses worked out by hand."""

from __future__ import annotations

import pytest

from mlbatch.errors import RigError
from mlbatch.frames import urdf
from mlbatch.frames.urdf import joints

REMEDY = "; give the extrinsics in a rig file (--rig)"


def _robot(*elements: str) -> str:
    return f'<?xml version="1.0" ?>\n<robot name="car">{"".join(elements)}</robot>'


def _joint(inner: str, kind: str = "fixed", name: str = "mount") -> str:
    return f'<joint name="{name}" type="{kind}">{inner}</joint>'


LINKS = '<parent link="base_link"/><child link="os_left"/>'


def test_a_fixed_joint_by_hand() -> None:
    # Yaw of 90 degrees: the sensor looks to the left of the car, its left is the car's back.
    text = _robot(_joint(LINKS + '<origin xyz="1 2 3" rpy="0 0 1.5707963267948966"/>'))
    (joint,) = joints(text)
    assert (joint.parent, joint.child, joint.is_fixed) == ("base_link", "os_left", True)
    expected = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    assert joint.matrix.tolist() == expected


def test_roll_comes_before_pitch_and_yaw() -> None:
    # About fixed axes: roll takes y to z; then yaw leaves z and takes x to y.
    text = _robot(_joint(LINKS + '<origin rpy="1.5707963267948966 0 1.5707963267948966"/>'))
    matrix = joints(text)[0].matrix
    assert matrix[:3, :3].tolist() == [[0, 0, 1], [1, 0, 0], [0, 1, 0]]


@pytest.mark.parametrize(
    ("origin", "place"),
    [
        ("", [0, 0, 0]),
        ("<origin/>", [0, 0, 0]),
        ('<origin rpy="0 0 0"/>', [0, 0, 0]),
        ('<origin xyz=" 1e-1\n2\t-3.5 "/>', [0.1, 2, -3.5]),
    ],
)
def test_missing_parts_of_an_origin_are_zero(origin: str, place: list[float]) -> None:
    matrix = joints(_robot(_joint(LINKS + origin)))[0].matrix
    assert matrix[:3, 3].tolist() == place
    assert matrix[:3, :3].tolist() == [[1, 0, 0], [0, 1, 0], [0, 0, 1]]


@pytest.mark.parametrize("kind", ["revolute", "continuous", "prismatic", "floating", "planar", ""])
def test_moving_joints_are_not_fixed(kind: str) -> None:
    text = _robot(_joint(LINKS, kind, "turret"))
    (joint,) = joints(text)
    assert (joint.name, joint.kind, joint.is_fixed) == ("turret", kind, False)
    assert (joint.parent, joint.child) == ("base_link", "os_left")


def test_other_elements_named_joint_are_none() -> None:
    text = _robot(
        "<link name='base_link'><joint type='fixed'/></link>",
        "<transmission><joint name='wheel'><hardware/></joint></transmission>",
        _joint(LINKS),
        "<gazebo><joint name='x' type='fixed'><parent>a</parent></joint></gazebo>",
    )
    assert [(joint.parent, joint.child) for joint in joints(text)] == [("base_link", "os_left")]


def test_a_default_name_space_changes_nothing() -> None:
    text = f'<robot xmlns="http://example.org/urdf">{_joint(LINKS)}</robot>'
    assert len(joints(text)) == 1


def test_an_empty_robot_has_no_joints() -> None:
    assert joints("<robot/>") == []


BOMB = '<!DOCTYPE robot [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]><robot name="&b;"/>'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (BOMB, ": expected a document without a document type, found <!DOCTYPE robot"),
        (
            '<!DOCTYPE robot SYSTEM "file:///etc/passwd"><robot/>',
            ": expected a document without a document type, found <!DOCTYPE robot",
        ),
        ("<sdf/>", ": expected the element <robot> first, found <sdf>"),
        ("", ": expected an XML document, found no element found: line 1, column 0"),
        ("base_link", ": expected an XML document, found syntax error: line 1, column 0"),
        ("<robot>", ": expected an XML document, found no element found: line 1, column 7"),
        (
            "<robot>&x;</robot>",
            ": expected an XML document, found undefined entity: line 1, column 7",
        ),
        (
            _robot(_joint('<parent link="a"/>')),
            ", joint mount: expected a parent link and a child link, found none",
        ),
        (
            _robot(_joint(LINKS + '<origin xyz="1 2"/>')),
            ", joint mount, origin xyz: expected 3 numbers of at most 1e+09, found 1 2",
        ),
        (
            _robot(_joint(LINKS + '<origin rpy="0 0 ${pi/2}"/>')),
            ", joint mount, origin rpy: expected 3 numbers of at most 1e+09, found 0 0 ${pi/2}",
        ),
        (
            _robot(_joint(LINKS + '<origin xyz="0 0 nan"/>', name="")),
            ", joint (no name), origin xyz: expected 3 numbers of at most 1e+09, found 0 0 nan",
        ),
    ],
)
def test_descriptions_that_cannot_be_used(text: str, message: str) -> None:
    with pytest.raises(RigError) as caught:
        joints(text)
    assert str(caught.value) == f"robot_description (URDF){message}{REMEDY}"


def test_errors_for_halves_of_characters_are_one_line() -> None:
    with pytest.raises(RigError, match="expected an XML document") as caught:
        joints("<robot name='\ud800'/>")
    assert "\n" not in str(caught.value)


def test_too_large_documents_are_not_parsed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(urdf, "MAX_BYTES", 20)
    assert joints("<robot name='1234'/>") == []
    with pytest.raises(RigError, match="expected at most 20 bytes, found more"):
        joints("<robot name='12345'/>")
    # Bytes, not characters, are counted.
    with pytest.raises(RigError, match="expected at most 20 bytes, found more"):
        joints("<robot name='123\xe9'/>")
