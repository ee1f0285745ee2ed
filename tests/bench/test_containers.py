"""A standard recording in each container has the same packets."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.bench import containers
from tests.bench.cases import CAPTURE, RECORDINGS
from tests.bench.recordings import make

pytestmark = pytest.mark.slow


def test_containers_have_the_same_packets(tmp_path: Path) -> None:
    make(RECORDINGS["dual-4"], 1.0, tmp_path)
    pcap = tmp_path / CAPTURE
    # 640 packets per second; the second sensor's rotor is 37.1 ms late: 24 packets less.
    expected = (640 + 616, (640 + 616) * 8448)
    for suffix in (".pcap", *containers.WRITERS):
        path = pcap.with_suffix(suffix)
        if suffix != ".pcap":
            containers.write(pcap, path)
        found = containers.read(path)
        assert (found["packets"], found["bytes"]) == expected, suffix
