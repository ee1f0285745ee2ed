"""Messages with raw packets of lidars, as drivers write them: the counterpart of `packet_messages`.

Types: `packet_types`. A message is written field by field, by the definition of its topic.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from mlbatch.ros.definitions import PRIMITIVES, SEQUENCE, Field, definitions_of, type_key
from mlbatch.ros.encoding import Wire
from mlbatch.ros.packet_types import PACKET_TYPES, PADDED
from mlbatch.types import Message, Topic
from mlbatch.units import NS_PER_S

# Messages with many packets contain those of a tenth of a second.
GROUP_NS = NS_PER_S // 10
# Seconds of a stamp have 31 bits.
MOST_STAMP_NS = 2**31 * NS_PER_S
_DEVICE_FIELD = "is_difop"


class Stamped(NamedTuple):
    """A packet with its receive time."""

    host_ns: int
    payload: bytes


class PacketMessages:
    """Messages of one topic from packets in the order of their receive times."""

    def __init__(self, topic: Topic, frame: str, *, of_device: bool = False) -> None:
        """frame: of the headers; of_device: packets say what a lidar is, not what it measures."""
        self.topic = topic
        self._frame = frame
        self._of_device = of_device
        self._types = definitions_of(topic)
        self._root = type_key(topic.type)
        self._envelope = PACKET_TYPES[self._root]
        holder = {one.name: one for one in self._types[self._root]}.get(self._envelope.inside)
        self._has_many = holder is not None and holder.count is not None
        self._is_stamped = topic.encoding in self._envelope.stamped_by
        fields = self._types[self._root if holder is None else holder.type]
        room = next(one.count for one in fields if one.name == self._envelope.payload)
        self._room = None if room == SEQUENCE else room
        self._has_size = any(one.name == self._envelope.size for one in fields)
        self._waiting: list[Stamped] = []

    def fits(self, packet: Stamped) -> bool:
        """Return whether a reader finds the packet unchanged in a message, with its time."""
        if not 0 <= packet.host_ns < MOST_STAMP_NS:
            return False
        size = len(packet.payload)
        if self._room is None or size == self._room or (size < self._room and self._has_size):
            return True
        return self._envelope.padded and any(
            packet.payload.startswith(magic) and size == length < self._room
            for magic, length in PADDED
        )

    def add(self, packet: Stamped, *, is_timed: bool = True) -> Iterator[Message]:
        """Yield the messages that a packet completes, each of the time of its last packet.

        is_timed: False where the time is not that of the packet, but that of a message with many;
        then stamps are empty, so that readers know.
        """
        is_timed = is_timed and self._is_stamped
        if self._waiting and not is_timed and packet.host_ns != self._waiting[0].host_ns:
            yield from self.rest(is_timed=False)
        self._waiting.append(packet)
        if not self._has_many or (
            is_timed and packet.host_ns - self._waiting[0].host_ns >= GROUP_NS
        ):
            yield from self.rest()

    def rest(self, log_ns: int = 0, *, is_timed: bool = True) -> Iterator[Message]:
        """Yield a message with the packets that wait, if there are any.

        log_ns: of a message that is written later than its last packet was received.
        """
        if not self._waiting:
            return
        wire = Wire(self.topic.encoding)
        packets = self._waiting
        self._waiting = []
        if self._envelope.inside:
            self._put_all(wire, packets, is_timed=is_timed)
        else:
            self._put(wire, self._root, packets[0], is_timed=is_timed)
        yield Message(self.topic, max(packets[-1].host_ns, log_ns), bytes(wire.data))

    def _put_all(self, wire: Wire, packets: list[Stamped], *, is_timed: bool) -> None:
        """Append a message that contains packets as messages of their own."""
        for field in self._types[self._root]:
            if field.name != self._envelope.inside:
                self._put_empty(wire, field, packets[-1].host_ns)
                continue
            if field.count == SEQUENCE:
                wire.put("I", len(packets))
            for packet in packets:
                self._put(wire, field.type, packet, is_timed=is_timed)

    def _put(self, wire: Wire, type_name: str, packet: Stamped, *, is_timed: bool) -> None:
        for field in self._types[type_name]:
            if field.name == self._envelope.payload:
                if field.count == SEQUENCE:
                    wire.put("I", len(packet.payload))
                wire.data += packet.payload
                wire.data += bytes(max(0, (self._room or 0) - len(packet.payload)))
            elif field.name == self._envelope.size:
                wire.put("I", len(packet.payload))
            elif field.name == self._envelope.stamp:
                wire.put("I", *divmod(packet.host_ns if is_timed else 0, NS_PER_S))
            else:
                self._put_empty(wire, field, packet.host_ns)

    def _put_empty(self, wire: Wire, field: Field, host_ns: int) -> None:
        """Append a field that says nothing about packets; headers have time and frame."""
        if field.count == SEQUENCE or field.type == "wstring":
            wire.put("I", 0)
            return
        for _ in range(1 if field.count is None else field.count):
            if field.type == "std_msgs/Header":
                wire.header(host_ns, self._frame)
            elif field.type == "string":
                wire.text("")
            elif field.type in PRIMITIVES:
                value = self._of_device and field.name == _DEVICE_FIELD
                for code in PRIMITIVES[field.type][2]:
                    wire.put(code, value)
            else:
                for inner in self._types[field.type]:
                    self._put_empty(wire, inner, host_ns)
