"""Messages that describe sensors, and definitions of messages: rosbags is the witness."""

from __future__ import annotations

import pytest
from rosbags.typesys import get_types_from_msg

from mlbatch.errors import RecordingError
from mlbatch.ros.definitions import definition as full_definition
from mlbatch.ros.definitions import definition_text, definitions_of, is_known
from mlbatch.ros.messages import decode_bytes, decode_string, decode_transforms
from mlbatch.ros.packet_types import PACKET_TYPES
from mlbatch.types import Topic
from tests.builders.bags import Body, definition, transforms_message


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_knowledge_is_decoded(encoding: str) -> None:
    for embedded in (True, False):

        def topic(name: str, *, stored: bool = embedded) -> Topic:
            return Topic("/t", name, encoding, definition(name, encoding) if stored else "")

        text = Body(encoding).text("ångström {}").done()
        assert decode_string(topic("std_msgs/String"), text) == "ångström {}"
        layout = Body(encoding).put("I", 1).text("rows").put("I", 5, 5, 0).blob(b"bytes")
        assert decode_bytes(topic("std_msgs/UInt8MultiArray"), layout.done()) == b"bytes"
        edges = [("/map", "/a", (1, 2, 3), (0, 0, 0, 1)), ("a", "bc", (-1, 0.5, 0), (1, 0, 0, 0))]
        expected = [
            (parent.lstrip("/"), child.lstrip("/"), *rest) for parent, child, *rest in edges
        ]
        data = transforms_message(encoding, edges)
        assert decode_transforms(topic("tf2_msgs/TFMessage"), data) == expected
    assert decode_transforms(Topic("/t", "tf/tfMessage", encoding), data) == expected


def test_a_cut_off_message_is_reported_in_one_line() -> None:
    data = transforms_message("cdr", [("a", "b", (1, 2, 3), (0, 0, 0, 1))])
    with pytest.raises(RecordingError, match=r"^/tf: expected \d+ bytes at byte \d+") as caught:
        decode_transforms(Topic("/tf", "tf2_msgs/TFMessage", "cdr"), data[:-1])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["tf2_msgs/TFMessage", "sensor_msgs/Imu", *sorted(PACKET_TYPES)])
def test_our_own_texts_are_whole_definitions(name: str) -> None:
    """rosbags reads them, and they say what we read without them."""
    text = definition_text(name)
    types = get_types_from_msg(text, name.replace("/", "/msg/"))
    assert name.replace("/", "/msg/") in types
    own = definitions_of(Topic("/t", name, "cdr"))
    stored = definitions_of(Topic("/t", name, "cdr", text, "ros2msg"))
    assert {key: own[key] for key in own} == {key: stored[key] for key in own}


def test_definitions_that_we_lack_are_those_of_rosbags() -> None:
    text = full_definition("nav_msgs/Odometry")
    assert "nav_msgs/msg/Odometry" in get_types_from_msg(text, "nav_msgs/msg/Odometry")
    assert "MSG: geometry_msgs/Pose" in text
    assert is_known("nav_msgs/Odometry")
    assert not is_known("nobody_msgs/Nothing")
    assert full_definition("nobody_msgs/Nothing") == ""
