"""A peer: velodyne-decoder (BSD-3-Clause), turns of each sensor in its own frame, not merged.

Source: the API of velodyne-decoder 3.1. Run by the interpreter that has it; imports nothing of
mlbatch. Packets come from dpkt, as in the decoder's own `read_pcap`, which knows one sensor a file.

    python peer_velodyne.py all RECORDING RESULT
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from pathlib import Path
from typing import Protocol

SLOTS_PER_PACKET = 384


class Stream(Protocol):
    """The decoder of one sensor; a turn is its time and its points."""

    def decode(self, stamp: float, packet: bytes) -> tuple[float, list[object]] | None:
        """Add a packet; gives a turn that it completes."""
        ...

    def finish(self) -> tuple[float, list[object]] | None:
        """The last turn."""
        ...


def run(recording: str) -> dict[str, object]:
    """Read the recording once; says what was found."""
    # By name, since checks run where the decoder is absent.
    decoder = importlib.import_module("velodyne_decoder")
    pcap = importlib.import_module("dpkt.pcap")
    ethernet = importlib.import_module("dpkt.ethernet")
    began_s = time.process_time()
    streams: dict[bytes, Stream] = {}
    slots = points = scans = 0
    with Path(recording).open("rb") as file:
        for stamp, frame in pcap.Reader(file):
            packet = ethernet.Ethernet(frame).data
            if packet.src not in streams:
                config = decoder.Config(model=decoder.Model.VLP16)
                streams[packet.src] = decoder.StreamDecoder(config)
            turn = streams[packet.src].decode(stamp, packet.data.data)
            slots += SLOTS_PER_PACKET
            if turn is not None:
                scans += 1
                points += len(turn[1])
    for turn in [stream.finish() for stream in streams.values()]:
        if turn is not None:
            scans += 1
            points += len(turn[1])
    own_cpu_s = time.process_time() - began_s
    return {"slots": slots, "points": points, "scans": scans, "own_cpu_s": own_cpu_s}


if __name__ == "__main__":
    Path(sys.argv[3]).write_text(json.dumps(run(sys.argv[2])), encoding="utf-8")
