"""What faults leave alone: batches, messages, the reader's arrays; and names of sensors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from mlbatch.errors import UsageError
from mlbatch.faults import FaultReplay, parse_fault
from mlbatch.types import Message, PacketBatch, Topic
from tests.faults.test_laws import BEGIN_NS, MS, One, owner
from tests.faults.test_laws import batches as batches_of

NAMES = ["left", "right"]


@pytest.mark.parametrize(
    ("sensor", "advice"), [("lft", "did you mean left?"), ("zoo", "write * for all of them")]
)
def test_a_fault_names_a_sensor_of_the_session(sensor: str, advice: str) -> None:
    with pytest.raises(UsageError, match=f"one of left, right, found '{sensor}'") as caught:
        FaultReplay([parse_fault(f"drop:{sensor}:5%")], 0, NAMES)
    assert str(caught.value).endswith(advice)


SESSION = [
    One(BEGIN_NS + number * 10 * MS, sensor, b"packet")
    for number, sensor in enumerate((0, 1, 0, -1, 0, 1, 0))
]


def batches(each: int) -> Iterator[PacketBatch]:
    """The session in batches of `each` packets, in one buffer that is reused."""
    return batches_of(SESSION, [len(SESSION[at : at + each]) for at in range(0, 7, each)])


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
