"""Loss on real recordings: none as they are, and of what is taken out of them exactly that.

No packet is known to be missing (recordings/MANIFEST.md): counts continue without a
gap, the Pandar40P's and the Velodynes' packets follow at their pace, and the silence of the VLP-32C
for half of each revolution "is normal, not loss".
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from mlbatch.discovery.calibrations import find_calibrations
from mlbatch.discovery.first_seconds import FirstSeconds
from mlbatch.discovery.match import match
from mlbatch.discovery.sampler import split_by_kind
from mlbatch.readers import merge, open_recording
from mlbatch.types import ColumnHeaders, StreamTable
from tests.builders.loss import Came
from tests.recordings import RECORDINGS
from tests.recordings.test_clocks import CASES, Case

# Fewer give no pace.
FEWEST = 17
every_case = pytest.mark.parametrize(
    ("vendor", "case"), CASES, ids=lambda value: getattr(value, "path", value)
)
every_long_case = pytest.mark.parametrize(
    ("vendor", "case"),
    [(vendor, case) for vendor, case in CASES if case.packets >= FEWEST],
    ids=lambda value: getattr(value, "path", value),
)


@lru_cache(maxsize=2)
def _read(vendor: str, path: str) -> Came:
    """The packets of a recording of one lidar, found as the program finds them."""
    place = RECORDINGS / vendor / path
    if place.is_dir():
        (place,) = place.glob("*.db3")
    table = StreamTable()
    recordings = [open_recording(place, table)]
    first = FirstSeconds(recordings, table)
    calibrations, _ = find_calibrations([place], ())
    (sensor,) = match(first.sampler, [*calibrations, *first.metadata.calibrations()], {}).sensors
    lidar, payloads, hosts = sensor.lidar, [], []
    for batch in merge(recordings):
        for kind, index in split_by_kind(batch):
            if kind in sensor.kinds:
                payloads.append(batch.data[batch.start[index, None] + np.arange(kind.size)])
                hosts.append(batch.host_ns[index])
    packets, host_ns = np.concatenate(payloads), np.concatenate(hosts)
    assert (lidar.faults(packets) == 0).all()
    return Came(lidar, lidar.sequence(packets), lidar.column_headers(packets, host_ns), host_ns)


@every_case
def test_nothing_is_lost(vendor: str, case: Case) -> None:
    packets = _read(vendor, case.path)
    assert len(packets.host_ns) == case.packets
    assert packets.counted() == (0, 0)


@every_long_case
@pytest.mark.parametrize("share", [0.01, 0.2, 0.4])
@pytest.mark.parametrize("seed", range(3))
def test_what_is_taken_out_is_what_is_lost(
    vendor: str, case: Case, share: float, seed: int
) -> None:
    """All but the first and the last packet: the packets before are unknown."""
    came = np.random.default_rng(seed).random(case.packets) >= share
    came[[0, -1]] = True
    packets, missing = _read(vendor, case.path), int(np.count_nonzero(~came))
    assert packets.counted(came) == (missing, 0)
    assert packets.counted(came, size=7) == (missing, 0)


@every_long_case
def test_packets_lost_in_a_row(vendor: str, case: Case) -> None:
    """A quarter of the recording, from its middle on."""
    silent = case.packets // 4
    came = np.ones(case.packets, bool)
    came[case.packets // 2 : case.packets // 2 + silent] = False
    assert _read(vendor, case.path).counted(came) == (silent, 0)


@every_long_case
def test_packets_that_cross_are_not_lost(vendor: str, case: Case) -> None:
    packets = _read(vendor, case.path)
    order = np.arange(case.packets)
    order[4:-4:10], order[5:-3:10] = order[5:-3:10].copy(), order[4:-4:10].copy()
    headers = packets.headers
    crossed = Came(
        packets.lidar,
        packets.sequence[order],
        ColumnHeaders(headers.stamp_ns[order], headers.encoder[order], headers.valid[order]),
        packets.host_ns,
    )
    assert crossed.counted() == (0, len(order[4:-4:10]))
