"""Packets of real bags in all other containers."""

from __future__ import annotations

from pathlib import Path

import pytest

from mlbatch.readers import open_recording
from mlbatch.types import StreamTable
from tests.builders.run import in_memory, prints
from tests.golden.test_vendor_containers import job
from tests.golden.vendor_messages import CONTAINERS, unit_of
from tests.recordings import RECORDINGS

BAGS = {
    "velodyne": ("velodyne/vlp16_ros2_dual", "1673400471837873222", "VLP16.yaml"),
    "hesai": ("hesai/pandarxt16", "1732848127890747768", "PandarXT16.csv"),
}


def packets_of(path: Path) -> tuple[tuple[int, bytes], ...]:
    """Receive time and payload of all packets of a recording."""
    found = []
    for batch in open_recording(path, StreamTable()).packets():
        places = (batch.host_ns, batch.start, batch.size)
        for host_ns, start, size in zip(*(values.tolist() for values in places), strict=True):
            found.append((host_ns, batch.data[start : start + size].tobytes()))
    return tuple(found)


@pytest.mark.parametrize("vendor", BAGS)
def test_packets_of_a_real_bag_in_other_containers(vendor: str, tmp_path: Path) -> None:
    folder, bag, file = BAGS[vendor]
    metadata, source = RECORDINGS / folder / file, RECORDINGS / folder / bag
    whole = prints(in_memory(job(metadata, source)))
    assert len(whole) > 6
    unit = unit_of(vendor, packets_of(source))
    for number, write in enumerate(CONTAINERS.values()):
        (tmp_path / str(number)).mkdir()
        path = write(tmp_path / str(number), (unit,))
        assert prints(in_memory(job(metadata, path))) == whole
