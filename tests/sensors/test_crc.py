"""Checksums against their published check values, CRC-64/XZ also bit by bit."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mlbatch.sensors.crc import crc32, crc64


def bitwise(message: bytes) -> int:
    """The definition: one bit at a time, lowest first."""
    register = 2**64 - 1
    for byte in message:
        for bit in range(8):
            lowest = (register ^ (byte >> bit)) & 1
            register = (register >> 1) ^ (0xC96C5795D7870F42 if lowest else 0)
    return register ^ (2**64 - 1)


def test_check_values_of_the_catalogue() -> None:
    """Of "123456789", in the catalogue of parametrised checksums; CRC-32 is CRC-32/MPEG-2."""
    messages = np.stack([np.frombuffer(b"123456789", np.uint8)] * 300)
    assert crc64(messages).tolist() == [0x995DC9BBDF1939FA] * 300
    assert crc32(messages).tolist() == [0x0376E6E7] * 300


@settings(max_examples=60)
@given(st.integers(8, 200).flatmap(lambda size: st.lists(st.binary(min_size=size, max_size=size))))
def test_any_messages_equal_the_definition(messages: list[bytes]) -> None:
    if not messages:
        return
    rows = np.array([np.frombuffer(message, np.uint8) for message in messages[:3]])
    assert crc64(rows).tolist() == [bitwise(message) for message in messages[:3]]
