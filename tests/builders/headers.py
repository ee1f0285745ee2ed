"""Headers of packets, read by compiled loops and by numpy."""

from __future__ import annotations

import json
from pathlib import Path
from typing import cast

import numpy as np

from mlbatch.arrays import I64Array, U8Array
from mlbatch.batching.intake import rises
from mlbatch.decode.native_headers import HeaderLoops
from mlbatch.lidar.interface import Lidar
from mlbatch.sensors.ouster.sensor import read_calibration
from mlbatch.types import ColumnHeaders
from tests.builders.ouster import OusterSpec, encode_packets, metadata_json


def ouster_packets(spec: OusterSpec, columns: int = 48) -> tuple[Lidar, U8Array]:
    """A lidar and whole packets of it, at the end of a frame and the start of the next."""
    found = read_calibration(Path("sensor.json"), json.dumps(metadata_json(spec)).encode())
    assert found is not None
    lidar = cast(Lidar, found.lidar({}, None))
    number = spec.columns_per_frame - columns // 3 + np.arange(columns)
    frame = 65535 + number // spec.columns_per_frame
    stamp_ns = 10**18 + 97_000 * np.arange(columns)
    packets = encode_packets(spec, stamp_ns, number % spec.columns_per_frame, frame % 65536, {})
    return lidar, np.array([np.frombuffer(packet, np.uint8) for packet in packets])


def read_by_loops(
    lidar: Lidar, packets: U8Array, host_ns: I64Array
) -> tuple[ColumnHeaders, I64Array] | None:
    """What the loops read; packets begin at any byte of a buffer, and nothing follows them."""
    assert lidar.headers is not None
    size = packets.shape[1]
    buffer = np.concatenate([np.zeros(3, np.uint8), packets.reshape(-1)])
    start = 3 + np.arange(len(packets)) * size
    return HeaderLoops(lidar.headers).read(buffer, start, size, host_ns)


def same_as_numpy(lidar: Lidar, packets: U8Array, host_ns: I64Array) -> bool:
    """Whether the loops read these packets; if so, numpy has to read the same."""
    found = read_by_loops(lidar, packets, host_ns)
    if found is None:
        return False
    headers, key = found
    expected = lidar.column_headers(packets, host_ns)
    assert lidar.sent_by_me(packets).all()
    assert not lidar.faults(packets).any()
    assert rises(expected)
    np.testing.assert_array_equal(headers.stamp_ns, expected.stamp_ns)
    np.testing.assert_array_equal(headers.encoder, expected.encoder)
    np.testing.assert_array_equal(headers.valid, expected.valid)
    np.testing.assert_array_equal(key, lidar.sequence(packets))
    return True
