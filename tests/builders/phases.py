"""Recordings of two lidars with a known phase of their rotors, and the sets of joined sweeps.

    python -m tests.builders.phases FOLDER

writes the recordings of all `CASES`. Stamps matter, pixels do not: there are four beams and no
returns. The receive time of a packet is the timestamp of its last column: no transport time.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mlbatch.simulate.ouster.encode import OusterSpec, encode_packets
from tests.builders.captures import udp_frame, write_pcap
from tests.builders.sessions import EPOCH_NS, NS_PER_MS, NS_PER_S, SMALL, write_metadata

# The epoch is a whole number of periods of 10 Hz and of 20 Hz; rotors pass zero some time after it.
COLUMNS = 512
REVOLUTION_NS = 100 * NS_PER_MS


@dataclass(frozen=True, slots=True)
class Rotor:
    """A lidar that first passes zero `zero_ms` after the epoch, and then every `revolution_ns`.

    silent_s: from when to when its packets are lost, seconds after the epoch.
    """

    serial: int
    zero_ms: int = 20
    revolution_ns: int = REVOLUTION_NS
    silent_s: tuple[float, float] = (0.0, 0.0)

    @property
    def spec(self) -> OusterSpec:
        """The sensor that the packets and the metadata are of."""
        rate_hz = round(NS_PER_S / self.revolution_ns)
        own = replace(SMALL, serial=self.serial, init_id=self.serial)
        return replace(own, beams=4, rate_hz=rate_hz, with_crc=False)

    def packets(self, seconds: float) -> Iterator[tuple[int, bytes]]:
        """(receive time in ns, payload) of all packets of the whole revolutions in `seconds`."""
        begin_ns = EPOCH_NS + self.zero_ms * NS_PER_MS
        revolutions = int((seconds * NS_PER_S - self.zero_ms * NS_PER_MS) // self.revolution_ns)
        column = np.arange(revolutions * COLUMNS)
        stamp_ns = begin_ns + column * self.revolution_ns // COLUMNS
        mids = column % COLUMNS
        frames = column // COLUMNS
        payloads = encode_packets(self.spec, stamp_ns, mids, frames, {})
        size = self.spec.columns_per_packet
        silent_ns = [EPOCH_NS + round(at * NS_PER_S) for at in self.silent_s]
        ends_ns = stamp_ns[size - 1 :: size].tolist()
        for first_ns, last_ns, payload in zip(
            stamp_ns[::size].tolist(), ends_ns, payloads, strict=True
        ):
            if not silent_ns[0] <= first_ns < silent_ns[1]:
                yield last_ns, payload


RIGHT = 1002
# The right rotor, and for how many seconds it and the left one are recorded.
CASES: dict[str, tuple[Rotor, float]] = {
    "10 Hz, in phase": (Rotor(RIGHT), 10.0),
    "10 Hz, 37 ms apart": (Rotor(RIGHT, 57), 10.0),
    "10 Hz, 63 ms apart": (Rotor(RIGHT, 83), 10.0),
    "10 Hz with 20 Hz": (Rotor(RIGHT, revolution_ns=REVOLUTION_NS // 2), 10.0),
    "10.00 Hz with 9.95 Hz": (Rotor(RIGHT, revolution_ns=100_502_513), 60.0),
    "10 Hz, one silent from 5 s to 8 s": (Rotor(RIGHT, silent_s=(5.0, 8.0)), 10.0),
}


def write_case(folder: Path, name: str) -> Path:
    """A capture of the case, and metadata, in a folder of its own in `folder`."""
    own = folder / "".join(letter if letter.isalnum() else "_" for letter in name)
    own.mkdir(parents=True, exist_ok=True)
    right, seconds = CASES[name]
    records = []
    for number, rotor in enumerate((Rotor(1001), right), 1):
        write_metadata(own / f"{rotor.serial}.json", rotor.spec)
        records += [
            (host_ns, udp_frame(payload, f"10.0.0.{number}")[0])
            for host_ns, payload in rotor.packets(seconds)
        ]
    return write_pcap(own / "drive.pcap", sorted(records, key=lambda record: record[0]))


if __name__ == "__main__":
    for title in CASES:
        write_case(Path(sys.argv[1]), title)
