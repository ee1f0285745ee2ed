"""Packets of real bags in all other containers."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from mlbatch.discovery.discover import SensorSelection
from mlbatch.pipeline.job import Job
from mlbatch.readers import open_recording
from mlbatch.types import StreamTable
from tests.builders.run import in_memory, prints
from tests.matrix.containers import CONTAINERS
from tests.matrix.lidars import Sent
from tests.recordings import RECORDINGS

BAGS = {
    "velodyne": ("velodyne/vlp16_ros2_dual", "1673400471837873222", "VLP16.yaml"),
    "hesai": ("hesai/pandarxt16", "1732848127890747768", "PandarXT16.csv"),
}


def sent_of(vendor: str, path: Path) -> Sent:
    """All packets of a recording."""
    payloads: list[bytes] = []
    host_ns: list[int] = []
    for batch in open_recording(path, StreamTable()).packets():
        for start, size in zip(batch.start.tolist(), batch.size.tolist(), strict=True):
            payloads.append(batch.data[start : start + size].tobytes())
        host_ns += batch.host_ns.tolist()
    none = np.empty(0, np.int64)
    return Sent(vendor, tuple(payloads), np.array(host_ns), none, none)


@pytest.mark.parametrize("vendor", BAGS)
def test_packets_of_a_real_bag_in_other_containers(vendor: str, tmp_path: Path) -> None:
    folder, bag, file = BAGS[vendor]
    source = RECORDINGS / folder / bag
    selection = SensorSelection(metadata=(RECORDINGS / folder / file,), identity_extrinsics=True)
    job = Job((source,), selection, Fraction(20), keep_partial=True)
    whole = prints(in_memory(job))
    assert len(whole) > 6
    sent = sent_of(vendor, source)
    for name, write in CONTAINERS.items():
        path = write(tmp_path, [sent])
        assert prints(in_memory(replace(job, recordings=(path,)))) == whole, name
