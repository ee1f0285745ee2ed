"""Packets of one sensor as its intake gets them, their headers read before."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mlbatch.arrays import I64Array
from mlbatch.batching.intake import Accepted, Arrival, Intake
from mlbatch.lidar.headers import Headers
from mlbatch.types import ColumnHeaders
from tests.reference.intake import FeedPacket

# A packet's place is its number times more than the width of any.
WIDEST = 64


def arrival_of(
    packets: Sequence[FeedPacket], width: int, position: I64Array, first: int
) -> Arrival:
    """Good packets; missing columns are invalid ones. first: number of the first of them."""
    count = len(packets)
    stamps = np.zeros((count, width), np.int64)
    valid = np.zeros((count, width), bool)
    for row, packet in enumerate(packets):
        stamps[row, : len(packet.stamps)] = packet.stamps
        valid[row, : len(packet.valid)] = packet.valid
    headers = Headers(
        np.ones(count, bool),
        np.zeros(count, np.uint8),
        np.array([packet.key for packet in packets], np.int64),
        ColumnHeaders(stamps, np.zeros_like(stamps), valid),
    )
    host_ns = np.array([packet.host_ns for packet in packets], np.int64)
    return Arrival(position, host_ns, (first + np.arange(count)) * WIDEST, headers)


def accepted_by(intake: Intake, arrival: Arrival) -> Accepted:
    """What an intake accepts of packets that no other sensor has."""
    return intake.accept(arrival, np.zeros(int(arrival.position.max(initial=-1)) + 1, bool))
