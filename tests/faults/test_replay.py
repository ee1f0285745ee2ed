"""What each fault does to a few packets, by hand."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest

from mlbatch.arrays import I64Array
from mlbatch.errors import UsageError
from mlbatch.faults import FaultCount, FaultReplay, parse_fault
from mlbatch.types import Message, PacketBatch, Topic
from tests.faults.test_laws import BEGIN_NS, MS, One, S, owner, replayed
from tests.faults.test_laws import batches as batches_of

NAMES = ["left", "right"]


@pytest.mark.parametrize(
    ("sensor", "advice"), [("lft", "did you mean left?"), ("zoo", "write * for all of them")]
)
def test_a_fault_names_a_sensor_of_the_session(sensor: str, advice: str) -> None:
    with pytest.raises(UsageError, match=f"one of left, right, found '{sensor}'") as caught:
        FaultReplay([parse_fault(f"drop:{sensor}:5%")], 0, NAMES)
    assert str(caught.value).endswith(advice)


# -- packets ------------------------------------------------------------------------------------

# (receive time in ms after the first packet, index of the sensor, payload)
Seen = tuple[int, int, bytes]
FEED: list[Seen] = [
    (0, 0, b"a0"),
    (1, 1, b"b0"),
    (10, 0, b"a1"),
    (11, -1, b"c0"),
    (20, 0, b"a2"),
    (21, 1, b"b1"),
    (30, 0, b"a3"),
]


def session(feed: Sequence[Seen]) -> list[One]:
    """The packets of a feed."""
    return [One(BEGIN_NS + at_ms * MS, sensor, payload) for at_ms, sensor, payload in feed]


def batches(each: int) -> Iterator[PacketBatch]:
    """The feed in batches of `each` packets, in one buffer that is reused."""
    return batches_of(session(FEED), [len(FEED[at : at + each]) for at in range(0, 7, each)])


def replay(specs: str, each: int = 100) -> tuple[list[Seen], FaultReplay]:
    """The feed with faults (separated by blanks)."""
    faults = FaultReplay([parse_fault(spec) for spec in specs.split()], 0, NAMES)
    sizes = [len(FEED[at : at + each]) for at in range(0, len(FEED), each)]
    found = replayed(faults, session(FEED), sizes)
    return [((one.host_ns - BEGIN_NS) // MS, one.sensor, one.payload) for one in found], faults


def without(*payloads: bytes) -> list[Seen]:
    """The feed without some packets."""
    return [one for one in FEED if one[2] not in payloads]


@pytest.mark.parametrize("each", [1, 3, 100])
@pytest.mark.parametrize(
    ("specs", "gone"),
    [
        ("drop:right:100%", (b"b0", b"b1")),
        ("drop:*:100%", (b"a0", b"a1", b"a2", b"a3", b"b0", b"b1")),
        # The begin of a window is inside, its end is not.
        ("stall:left:10ms-30ms", (b"a1", b"a2")),
        ("late:left:10ms", (b"a0",)),
        ("early:left:10ms", (b"a1", b"a2", b"a3")),
        ("late:right:1s early:left:25ms", (b"b0", b"b1", b"a3")),
    ],
)
def test_removed_packets(specs: str, gone: tuple[bytes, ...], each: int) -> None:
    seen, faults = replay(specs, each)
    assert seen == without(*gone)
    assert sum(count.packets for count in faults.counts) == len(gone)
    assert sum(ledger.removed for ledger in faults.ledgers) == len(gone)


@pytest.mark.parametrize("fault", ["bitflip", "truncate"])
def test_hashes_of_damaged_payloads_are_not_known(fault: str) -> None:
    hashed = (replace(one, content_key=np.arange(len(one))) for one in batches(3))
    faults = FaultReplay([parse_fault(f"{fault}:left:100%")], 0, NAMES)
    assert [one.content_key for one in faults.batches(hashed, owner)] == [None] * 3


def test_messages_stay_in_their_batches_in_order() -> None:
    """Also where a batch has no packet left."""
    topic = Topic("/imu", "sensor_msgs/Imu", "cdr")
    source = []
    for number, batch in enumerate(batches(2)):
        batch.data = batch.data.copy()
        batch.messages = (Message(topic, number, b""), Message(topic, number, b"x"))
        source.append(batch)
    faults = FaultReplay([parse_fault("drop:*:100%")], 0, NAMES)
    given = list(faults.batches(iter(source), owner))
    assert [len(batch) for batch in given] == [0, 1, 0, 0]
    assert [(one.host_ns, one.data) for batch in given for one in batch.messages] == [
        (number, data) for number in range(4) for data in (b"", b"x")
    ]


def test_the_batch_of_the_reader_is_not_changed() -> None:
    batch = next(batches(100))
    batch.data.flags.writeable = False
    for array in (batch.start, batch.size, batch.stream, batch.host_ns):
        array.flags.writeable = False
    specs = ["bitflip:*:100%", "truncate:*:100%", "reorder:*:100%", "delay:*:5ms", "dup:*:100%"]
    faults = FaultReplay([parse_fault(spec) for spec in specs], 0, NAMES)
    assert sum(len(one) for one in faults.batches(iter([batch]), owner)) == 13


def test_times_count_from_the_first_packet_of_a_sensor() -> None:
    """Other packets, which a capture has and a bag has not, do not matter."""
    start, size, stream, host_ns = (np.array([one]) for one in (0, 8, -1, BEGIN_NS - 50 * MS))
    first = PacketBatch(np.zeros(8, np.uint8), start, size, stream, host_ns)
    faults = FaultReplay([parse_fault("late:left:10ms")], 0, NAMES)
    given = faults.batches(iter([first, *batches(100)]), owner)
    assert sum(len(batch) for batch in given) == 1 + 6
    assert faults.begin_ns == BEGIN_NS


# -- clocks -------------------------------------------------------------------------------------


def at_ms(*moments: int) -> I64Array:
    """Receive times."""
    return BEGIN_NS + MS * np.array(moments, np.int64)


def test_a_clock_step_shifts_later_packets() -> None:
    seen, faults = replay("jump:left:-37s@20ms")
    assert seen == FEED
    assert faults.shift_ns(0, at_ms(0, 19, 20, 21)).tolist() == [0, 0, -37 * S, -37 * S]
    assert faults.shift_ns(1, at_ms(0, 20)).tolist() == [0, 0]
    assert faults.counts == (FaultCount("jump:left:-37s@20ms", 2),)


def test_clock_steps_do_not_depend_on_the_delay() -> None:
    """The time of the step is that of the recording."""
    _, faults = replay("delay:left:60ms jump:left:1s@20ms")
    assert faults.shift_ns(0, at_ms(79, 80)).tolist() == [0, S]
