"""Headers of packets, read by the compiled loops and literally."""

from __future__ import annotations

import numpy as np

from mlbatch.arrays import I64Array, U8Array
from mlbatch.lidar.headers import Headers, content_keys
from mlbatch.lidar.interface import Lidar
from mlbatch.simulate.ouster.encode import OusterSpec, encode_packets
from tests.builders.others import rows
from tests.builders.spinning import ouster_calibration
from tests.reference.headers import read


def ouster_packets(spec: OusterSpec, columns: int = 48) -> tuple[Lidar, U8Array]:
    """A lidar and whole packets of it, at the end of a frame and the start of the next."""
    lidar = ouster_calibration(spec).lidar({}, None)
    number = spec.columns_per_frame - columns // 3 + np.arange(columns)
    frame = 65535 + number // spec.columns_per_frame
    stamp_ns = 10**18 + 97_000 * np.arange(columns)
    packets = encode_packets(spec, stamp_ns, number % spec.columns_per_frame, frame % 65536, {})
    return lidar, rows(packets)


def check_headers(lidar: Lidar, packets: U8Array, host_ns: I64Array) -> Headers:
    """The loops read what the packets literally say; those begin at any byte of a buffer."""
    assert lidar.reader is not None
    size = packets.shape[1]
    buffer = np.concatenate([np.zeros(3, np.uint8), packets.reshape(-1)])
    found = lidar.reader.read(buffer, 3 + np.arange(len(packets)) * size, host_ns)
    hashes = content_keys(packets).tolist()
    for row, packet in enumerate(packets):
        seen = read(lidar.reader.table, packet.tobytes(), int(host_ns[row]))
        assert (bool(found.is_mine[row]), int(found.faults[row])) == (seen.is_mine, seen.fault)
        if not seen.is_mine or seen.fault:
            continue
        assert int(found.key[row]) == (hashes[row] if seen.key is None else seen.key)
        columns = found.columns
        arrays = (columns.stamp_ns, columns.encoder, columns.valid)
        assert list(zip(*(one[row].tolist() for one in arrays), strict=True)) == seen.columns
    return found
