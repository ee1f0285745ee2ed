"""Recordings of two lidars with a known phase of their rotors, and the sets of joined sweeps.

    python -m tests.builders.phases FOLDER

writes the recordings of all `CASES`. Stamps matter, pixels do not: there are four beams and no
returns. The receive time of a packet is the timestamp of its last column: no transport time.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mlbatch.simulate.ouster.encode import OusterSpec, encode_packets, metadata_json
from tests.builders.captures import udp_frame, write_pcap

NS_PER_S = 10**9
NS_PER_MS = 10**6
# A whole number of periods of 10 Hz and of 20 Hz; the rotors pass zero some time after it.
EPOCH_NS = 1_800_000_000 * NS_PER_S
BEAMS = 4
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
        return OusterSpec(
            beams=BEAMS,
            columns_per_frame=COLUMNS,
            rate_hz=round(NS_PER_S / self.revolution_ns),
            serial=self.serial,
            init_id=self.serial,
            with_crc=False,
        )

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


@dataclass(frozen=True, slots=True)
class Case:
    """Two rotors, and for how long they are recorded."""

    left: Rotor
    right: Rotor
    seconds: float = 10.0


LEFT = 1001
RIGHT = 1002
CASES: dict[str, Case] = {
    "10 Hz, in phase": Case(Rotor(LEFT), Rotor(RIGHT)),
    "10 Hz, 37 ms apart": Case(Rotor(LEFT), Rotor(RIGHT, 57)),
    "10 Hz, 63 ms apart": Case(Rotor(LEFT), Rotor(RIGHT, 83)),
    "10 Hz with 20 Hz": Case(Rotor(LEFT), Rotor(RIGHT, revolution_ns=REVOLUTION_NS // 2)),
    "10.00 Hz with 9.95 Hz": Case(Rotor(LEFT), Rotor(RIGHT, revolution_ns=100_502_513), 60.0),
    "10 Hz, one silent from 5 s to 8 s": Case(Rotor(LEFT), Rotor(RIGHT, silent_s=(5.0, 8.0))),
}


def write_case(folder: Path, case: Case) -> Path:
    """A capture of the case in `folder`, with its metadata file."""
    folder.mkdir(parents=True, exist_ok=True)
    records = []
    for number, rotor in enumerate((case.left, case.right), 1):
        (folder / f"{rotor.serial}.json").write_text(
            json.dumps(metadata_json(rotor.spec)), encoding="utf-8"
        )
        records += [
            (host_ns, udp_frame(payload, f"10.0.0.{number}")[0])
            for host_ns, payload in rotor.packets(case.seconds)
        ]
    return write_pcap(folder / "drive.pcap", sorted(records, key=lambda record: record[0]))


def slug(name: str) -> str:
    """The name of a case as that of a folder."""
    return "".join(letter if letter.isalnum() else "_" for letter in name)


if __name__ == "__main__":
    for title, one in CASES.items():
        write_case(Path(sys.argv[1]) / slug(title), one)
