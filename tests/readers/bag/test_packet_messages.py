"""Payloads in messages: rosbags writes them, the facts say what has to come out."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from typing import cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mlbatch.arrays import U8Array
from mlbatch.errors import RecordingError
from mlbatch.readers.bag.packet_messages import PacketsFound, Unpacker
from mlbatch.ros.definitions import definition_text
from mlbatch.ros.encoding import MessageError
from mlbatch.ros.packet_types import PACKET_TYPES
from mlbatch.types import Topic
from tests.builders.bags import Body, found_in

S = 1_000_000_000
STAMP_NS, LOG_NS = 1_700_000_000 * S + 123_456_789, 1_700_000_001 * S
HEADER = "std_msgs/Header header\n"
# Texts of docs/sources/messages.md, section 1: the packet's own fields, and the type around it.
OWN = {
    "ouster_ros/PacketMsg": "uint8[] buf",
    "ouster_msgs/PacketMsg": "uint8[] buf",
    "ouster_sensor_msgs/PacketMsg": "uint8[] buf",
    "velodyne_msgs/VelodynePacket": "time stamp\nuint8[1206] data",
    "hesai_lidar/PandarPacket": "time stamp\nuint8[] data\nuint32 size",
    "pandar_msgs/PandarPacket": "time stamp\nuint8[1500] data\nuint32 size",
    "pandar_msgs/PandarJumboPacket": "time stamp\nuint8[] data\nuint32 size",
    "hesai_ros_driver/UdpPacket": "time stamp\nuint8[] data\nuint32 size",
    "nebula_msgs/NebulaPacket": "time stamp\nuint8[] data",
    "rslidar_msg/RslidarPacket": HEADER + "uint8 is_difop\nuint8 is_frame_begin\nuint8[] data",
    "rslidar_msgs/rslidarPacket": "time stamp\nuint8[1248] data",
    "robosense_msgs/RobosensePacket": "time stamp\nuint8[1248] data",
    "udp_msgs/UdpPacket": HEADER + "string address\nuint16 src_port\nuint8[] data",
}
AROUND = {
    "velodyne_msgs/VelodyneScan": "velodyne_msgs/VelodynePacket",
    "hesai_lidar/PandarScan": "hesai_lidar/PandarPacket",
    "pandar_msgs/PandarScan": "pandar_msgs/PandarPacket",
    "hesai_ros_driver/UdpFrame": "hesai_ros_driver/UdpPacket",
    "nebula_msgs/NebulaPackets": "nebula_msgs/NebulaPacket",
    "rslidar_msgs/rslidarScan": "rslidar_msgs/rslidarPacket",
    "robosense_msgs/RobosenseScan": "robosense_msgs/RobosensePacket",
}
INFO = "robosense_msgs/RobosenseInfoPacket"
ROBOSENSE_SCAN = "robosense_msgs/RobosenseScan"
# Types whose packets carry their receive time (section 3); pandar_msgs does only in ROS 2.
STAMPED = {name for name, text in OWN.items() if text.startswith("time")} | {*AROUND, INFO}
FIXED = {"velodyne": 1206, "pandar_msgs/PandarS": 1500, "pandar_msgs/PandarP": 1500}
FIXED |= {"rslidar_msgs": 1248, "robosense": 1248}
RANDOM = np.random.default_rng(5)


def texts_of(name: str) -> dict[str, str]:
    """The .msg texts of a type and of what it is made of."""
    texts = {key: text for key, text in OWN.items() if key == name}
    if name in AROUND:
        texts = {name: f"{HEADER}{AROUND[name]}[] packets", AROUND[name]: OWN[AROUND[name]]}
    if name == INFO:
        inner = "robosense_msgs/RobosensePacket"
        texts = {name: f"string lidar_model\n{inner} packet", inner: OWN[inner]}
    return texts


def capacity(name: str) -> int | None:
    """Bytes of a payload field of fixed length."""
    return next((size for key, size in FIXED.items() if name.startswith(key)), None)


def serialised(name: str, encoding: str, packets: list[bytes], stamp_ns: int = STAMP_NS) -> bytes:
    """A message with packets, by rosbags; packet i has a stamp i ms later."""
    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
    for key, text in texts_of(name).items():
        if encoding == "cdr":
            text = text.replace("time ", "builtin_interfaces/Time ")
        store.register(get_types_from_msg(text, key.replace("/", "/msg/")))
    types = cast("Mapping[str, Callable[..., object]]", store.types)
    time = types["builtin_interfaces/msg/Time"]

    def stamp(number: int) -> object:
        at_ns = stamp_ns + number * 1_000_000 if stamp_ns else 0
        return time(sec=at_ns // S, nanosec=at_ns % S)

    def header() -> object:
        parts = {"seq": 1} if encoding == "ros1" else {}
        return types["std_msgs/msg/Header"](**parts, stamp=stamp(500), frame_id="lidar")

    def one(key: str, number: int, payload: bytes) -> object:
        room = capacity(key) or len(payload)
        data = np.frombuffer(payload.ljust(room, b"\0"), np.uint8)
        values = {
            **{"buf": data, "data": data, "size": len(payload), "stamp": stamp(number)},
            **{"header": header(), "is_difop": 0, "is_frame_begin": 0},
            **{"address": "10.0.0.1", "src_port": 2368},
        }
        names = [line.split()[1] for line in OWN[key].splitlines()]
        return types[key.replace("/", "/msg/")](**{word: values[word] for word in names})

    kind = types[name.replace("/", "/msg/")]
    if name in AROUND:
        inner = [one(AROUND[name], number, payload) for number, payload in enumerate(packets)]
        message = kind(header=header(), packets=inner)
    elif name == INFO:
        inner_name = "robosense_msgs/RobosensePacket"
        message = kind(lidar_model="helios", packet=one(inner_name, 0, packets[0]))
    else:
        message = one(name, 0, packets[0])
    serialise = store.serialize_ros1 if encoding == "ros1" else store.serialize_cdr
    return bytes(serialise(message, name.replace("/", "/msg/")))


def payloads(name: str, count: int) -> list[bytes]:
    """Random packets; one length in fields of fixed length that name no valid bytes."""
    room = capacity(name)
    sizes = RANDOM.integers(500, 1200, count)
    if room is not None and room != 1500:
        sizes[:] = room
    return [RANDOM.bytes(size) for size in sizes.tolist()]


def find(topic: Topic, data: bytes, pad: int = 0) -> tuple[PacketsFound, list[bytes]]:
    """What is found in a message that begins at byte `pad` of an array, and the payloads."""
    array: U8Array = np.frombuffer(bytes(pad) + data + bytes(3), np.uint8)
    found = found_in(topic, array, pad, pad + len(data), LOG_NS)
    return found, cut(array, found)


def cut(data: U8Array, found: PacketsFound) -> list[bytes]:
    """The payloads."""
    places = zip(found.start.tolist(), found.size.tolist(), strict=True)
    return [data[start : start + size].tobytes() for start, size in places]


def test_the_types_of_the_sheet_are_known() -> None:
    assert set(PACKET_TYPES) == {*OWN, *AROUND, INFO}


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
@pytest.mark.parametrize("name", sorted(PACKET_TYPES))
def test_payloads_of_every_type_come_out_whole(name: str, encoding: str) -> None:
    """At their own stamps, or at the log time where they have none."""
    many = name in AROUND
    for count in (0, 1, 2, 5) if many else (1,):
        for stamp_ns in (STAMP_NS, 0):
            sent = payloads(name, count)
            data = serialised(name, encoding, sent, stamp_ns)
            found, read_back = find(Topic("/t", name, encoding), data, pad=count)
            assert read_back == sent
            is_stamped = name in STAMPED and not (name.startswith("pandar") and encoding == "ros1")
            own = is_stamped and stamp_ns > 0
            stamps = [STAMP_NS + i * 1_000_000 if own else LOG_NS for i in range(count)]
            assert found.host_ns.tolist() == stamps
            assert found.untimed == (many and count > 0 and not own)


@pytest.mark.parametrize(("stated", "expected"), [(568, 568), (1500, 1500), (4_000_000_000, 1500)])
def test_the_size_field_of_a_pandar_packet_limits_its_bytes(stated: int, expected: int) -> None:
    body = Body("cdr").header(0).put("I", 1).time(STAMP_NS).raw(bytes(1500)).put("I", stated)
    _, read_back = find(Topic("/t", "pandar_msgs/PandarScan", "cdr"), body.done())
    assert read_back == [bytes(expected)]


def test_a_packet_of_no_bytes_is_counted_apart() -> None:
    body = Body("cdr").header(0).put("I", 1).time(STAMP_NS).raw(bytes(1500)).put("I", 0)
    found, read_back = find(Topic("/t", "pandar_msgs/PandarScan", "cdr"), body.done())
    assert (read_back, found.empty) == ([], 1)


def test_the_embedded_definition_wins() -> None:
    """pandar_msgs/PandarPacket of the ROS 1 driver has an array of any length (section 1)."""
    text = (
        f"Header header\nPandarPacket[] packets\n{'=' * 80}\nMSG: std_msgs/Header\n"
        f"uint32 seq\ntime stamp\nstring frame_id\n{'=' * 80}\nMSG: pandar_msgs/PandarPacket\n"
        "# a comment\ntime stamp\nuint8 LIMIT=3 # a constant\nuint8[] data\nuint32 size\n"
    )
    body = Body("ros1").header(0, "f").put("I", 2)
    for payload in (b"first one", b"second"):
        body.time(STAMP_NS).blob(payload).put("I", len(payload))
    topic = Topic("/t", "pandar_msgs/PandarScan", "ros1", text, "ros1msg")
    assert find(topic, body.done())[1] == [b"first one", b"second"]


ROBOSENSE_HEADS = {
    "point": b"\x55\xaa\x05\x5a" + b"\1" * 1244,
    "device": b"\xa5\xff\x00\x5a" + b"\2" * 1244,
}
LONG_ROBOSENSE = (
    "std_msgs/Header header\nrobosense_msgs/RobosensePacket[] packets\n"
    f"{'=' * 80}\nMSG: robosense_msgs/RobosensePacket\n"
    "builtin_interfaces/Time stamp\nuint8 is_difop\nuint8[1500] data\nuint32 size\n"
)


def long_robosense(count: int, frame: str = "lidar") -> tuple[bytes, list[bytes]]:
    """A scan of a branch of Nebula, the last of its packets a DIFOP; and the payloads."""
    kinds = ["point"] * (count - 1) + ["device"] * min(count, 1)
    body = Body("cdr").header(STAMP_NS, frame).put("I", count)
    for number, kind in enumerate(kinds):
        payload = ROBOSENSE_HEADS[kind]
        body.time(STAMP_NS + number).put("B", kind == "device")
        body.raw(payload.ljust(1500, b"\x99")).put("I", len(payload))
    return body.done(), [ROBOSENSE_HEADS[kind] for kind in kinds]


@pytest.mark.parametrize("stored", ["", LONG_ROBOSENSE, definition_text(ROBOSENSE_SCAN)])
@pytest.mark.parametrize("frame", ["", "a", "ab", "abc"])
@pytest.mark.parametrize("count", [0, 1, 2, 151])
def test_robosense_scans_with_sized_packets(count: int, frame: str, stored: str) -> None:
    """Also without a definition, and with the one that is assumed for bags without any."""
    topic = Topic("/t", ROBOSENSE_SCAN, "cdr", stored, "ros2msg" if stored else "")
    data, sent = long_robosense(count, frame)
    found, read_back = find(topic, data, pad=count % 4)
    assert read_back == sent
    assert found.host_ns.tolist() == [STAMP_NS + number for number in range(count)]


def test_both_forms_of_robosense_scans_on_a_topic_without_definition() -> None:
    short = [payload[:1248] for payload in ROBOSENSE_HEADS.values()] * 3
    long, sent = long_robosense(7)
    data = [
        serialised(ROBOSENSE_SCAN, "cdr", short),
        long,
        serialised(ROBOSENSE_SCAN, "cdr", short),
    ]
    end = np.cumsum([len(message) for message in data])
    array: U8Array = np.frombuffer(b"".join(data), np.uint8)
    topic = Topic("/t", ROBOSENSE_SCAN, "cdr")
    found = Unpacker(topic).find_many(array, end - [len(one) for one in data], end, end * 0)
    assert not found.faults
    assert cut(array, found) == short + sent + short


@pytest.mark.parametrize("stored", ["", LONG_ROBOSENSE])
@pytest.mark.parametrize("lost", [1, 3, 1400, 3000])
def test_a_robosense_scan_that_is_cut_off_is_a_fault(lost: int, stored: str) -> None:
    """Read in the other form, it would have enough bytes for all packets."""
    data, _ = long_robosense(9)
    with pytest.raises(RecordingError, match=r"expected .* it was cut off, or is of another type"):
        find(Topic("/t", ROBOSENSE_SCAN, "cdr", stored, "ros2msg"), data[:-lost])


IDL = f"""\
{"=" * 80}
IDL: pandar_msgs/msg/PandarScan
// generated from rosidl_adapter
#include "pandar_msgs/msg/PandarPacket.idl"
module pandar_msgs {{
  module msg {{
    module PandarScan_Constants {{
      @verbatim (language="comment", text="{{ ; (sample) }}")
      const uint8 LIMIT = 3;
    }};
    struct PandarScan {{
      std_msgs::msg::Header header;

      @verbatim (language="comment", text="packets" "of a turn")
      sequence<pandar_msgs::msg::PandarPacket> packets;
    }};
  }};
}};

{"=" * 80}
IDL: pandar_msgs/msg/PandarPacket
module pandar_msgs {{ module msg {{
    typedef uint8 uint8__600[600];
    @verbatim (language="comment", text="one")
    struct PandarPacket {{
      builtin_interfaces::msg::Time stamp;
      @unit (value="byte")
      uint8__600 data;
      unsigned long size;
    }};
}}; }};
"""


def test_definitions_in_idl_are_read() -> None:
    body = Body("cdr").header(0, "f").put("I", 3)
    for number in range(3):
        body.time(STAMP_NS).raw(bytes([number]) * 600).put("I", 500 + number)
    topic = Topic("/t", "pandar_msgs/PandarScan", "cdr", IDL, "ros2idl")
    assert find(topic, body.done())[1] == [b"\0" * 500, b"\1" * 501, b"\2" * 502]


def test_the_calibration_among_hesai_packets_is_kept_apart() -> None:
    """Section 2: bytes 47 74 05 00, big-endian length, text; `size` counts the text alone."""
    text = b"Laser id,Elevation,Azimuth\n1,15.0,-1.042\n"
    pseudo = b"\x47\x74\x05\x00" + struct.pack(">I", len(text)) + text
    body = Body("ros1").header(0).put("I", 2)
    body.time(STAMP_NS).blob(b"\xff\xee" + bytes(98)).put("I", 100)
    body.time(0).blob(pseudo).put("I", len(text))
    found, read_back = find(Topic("/t", "hesai_lidar/PandarScan", "ros1"), body.done())
    assert read_back == [b"\xff\xee" + bytes(98)]
    assert found.corrections == ((0, text),)


@pytest.mark.parametrize(
    ("payload", "expected"),
    [
        (b"\x55\xaa\x5a\xa5" + b"\1" * 1206, 1210),
        (b"\xa5\xff\x00\x5a" + b"\1" * 252, 256),
        (b"\xa5\xff\x00\x5a" + b"\1" * 252 + bytes(990) + b"\x0f\xf0", 1248),
        (b"\x55\xaa\x05\x0a\x5a\xa5\x50\xa0" + bytes(1240), 1248),
    ],
)
def test_short_robosense_packets_lose_their_padding(payload: bytes, expected: int) -> None:
    body = Body("cdr").time(STAMP_NS).raw(payload.ljust(1248, b"\0"))
    _, read_back = find(Topic("/t", "rslidar_msgs/rslidarPacket", "cdr"), body.done())
    assert read_back == [payload.ljust(1248, b"\0")[:expected]]


def test_many_messages_give_what_they_give_one_by_one() -> None:
    name = "hesai_ros_driver/UdpFrame"
    messages = [serialised(name, "cdr", payloads(name, count)) for count in (3, 1, 0, 3, 2)]
    messages += [messages[0], messages[3][:-9], b"", *messages]
    data = np.frombuffer(b"".join(messages), np.uint8)
    end = np.cumsum([len(message) for message in messages])
    begin = end - [len(message) for message in messages]
    log_ns = np.arange(len(messages)) + LOG_NS
    topic = Topic("/t", name, "cdr")
    together = Unpacker(topic).find_many(data, begin, end, log_ns)
    assert [number for number, _ in together.faults] == [6, 7]
    expected = []
    for number in range(len(messages)):
        if number not in (6, 7):
            places = int(begin[number]), int(end[number]), int(log_ns[number])
            one = found_in(topic, data, *places)
            rows = zip(one.start.tolist(), one.size.tolist(), one.host_ns.tolist(), strict=True)
            expected += [(number, *row) for row in rows]
    columns = (together.message, together.start, together.size, together.host_ns)
    assert list(zip(*(column.tolist() for column in columns), strict=True)) == expected


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(sorted(PACKET_TYPES)), st.sampled_from(["cdr", "ros1"]), st.data())
def test_lengths_that_lie_never_read_beyond_the_message(
    name: str, encoding: str, draw: st.DataObject
) -> None:
    whole = bytearray(SAMPLES[name, encoding])
    for _ in range(draw.draw(st.integers(0, 4))):
        at = draw.draw(st.integers(4, min(len(whole) - 4, 60)))
        whole[at : at + 4] = draw.draw(st.binary(min_size=4, max_size=4))
    size = draw.draw(st.integers(0, len(whole)))
    data = np.frombuffer(bytes(whole) + b"\x77" * 64, np.uint8)
    one = (np.array([value]) for value in (0, size, LOG_NS))
    found = Unpacker(Topic("/t", name, encoding)).find_many(data, *one)
    assert (found.start >= 0).all()
    assert (found.start + found.size <= size).all()
    assert all("expected" in why and "\n" not in why for _, why in found.faults)


SAMPLES = {
    (name, encoding): serialised(name, encoding, payloads(name, 2))
    for name in PACKET_TYPES
    for encoding in ("cdr", "ros1")
}


def test_big_endian_messages_are_refused_in_one_line() -> None:
    data = b"\x00\x00\x00\x00" + struct.pack(">I", 4) + b"abcd"
    with pytest.raises(
        RecordingError, match=r"^/t: expected .* little-endian .* found 00 00 00 00; "
    ):
        find(Topic("/t", "ouster_ros/PacketMsg", "cdr"), data)


@pytest.mark.parametrize(
    ("topic", "message"),
    [
        (Topic("/t", "ouster_ros/PacketMsg", "protobuf"), "messages encoded as cdr or ros1"),
        (
            Topic("/t", "velodyne_msgs/VelodyneScan", "cdr", "uint8 other\n", "ros2msg"),
            "expected packets in the field packets.data of velodyne_msgs/VelodyneScan, found a "
            "definition with other",
        ),
        (
            Topic("/t", "ouster_ros/PacketMsg", "cdr", "string[] buf\n", "ros2msg"),
            "expected packets in the field buf",
        ),
    ],
)
def test_variants_that_are_not_known_are_refused(topic: Topic, message: str) -> None:
    with pytest.raises(MessageError, match=message):
        Unpacker(topic)
