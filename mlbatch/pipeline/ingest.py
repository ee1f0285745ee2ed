"""From batches of packets to arrivals of sensors: routing, first checks, raw pixels into rings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.batching.intake import Arrival
from mlbatch.decode.packet_ring import RawRing
from mlbatch.discovery.discover import Setup
from mlbatch.discovery.sampler import Kind, Role, split_by_kind
from mlbatch.lidar.interface import FAULTS, Lidar
from mlbatch.report.ledger import SensorLedger
from mlbatch.sensors import content_keys
from mlbatch.types import ImuSamples, PacketBatch

# Copies are looked for among so many IMU packets.
RECENT_IMU = 64
# Sensor, stamps (P, C) and arrivals (P,) of its packets: stamps as they are to be batched.
Retime = Callable[[int, I64Array, I64Array], I64Array]


@dataclass(slots=True)
class Feed:
    """One sensor's way into the batching."""

    lidar: Lidar
    ring: RawRing
    ledger: SensorLedger = field(default_factory=SensorLedger)


@dataclass(slots=True)
class Fed:
    """What a batch brought: an arrival for each sensor (or None), and IMU samples."""

    arrivals: list[Arrival | None]
    imu: list[ImuSamples]


class Feeder:
    """Sorts packets to their sensors.

    What belongs to none is counted in `unassigned`; `samples` has one of each kind, (1, size).
    """

    def __init__(
        self,
        setup: Setup,
        feeds: Sequence[Feed],
        host_clocks: Sequence[bool],
        retime: Retime | None = None,
    ) -> None:
        """retime: what becomes of stamps before they are batched; None: nothing."""
        self.unassigned: dict[Kind, int] = {}
        self.samples: dict[Kind, U8Array] = {}
        self._router = setup.router
        self._feeds = list(feeds)
        self._host_clocks = list(host_clocks)
        self._retime = retime
        self._recent: list[I64Array] = [np.empty(0, np.int64) for _ in self._feeds]

    def feed(self, batch: PacketBatch, oldest_places: Sequence[int | None]) -> Fed:
        """Route a batch, copy lidar packets to their rings and read their heads."""
        own: list[list[I64Array]] = [[] for _ in self._feeds]
        fed = Fed([None] * len(self._feeds), [])
        owned = np.zeros(len(batch), bool)
        shared: list[tuple[Kind, I64Array]] = []
        for kind, index in split_by_kind(batch):
            begin = int(batch.start[index[0]])
            route = self._router.route(kind, batch.data[begin : begin + kind[1]])
            if route.role is Role.LIDAR:
                shared.append((kind, index))
                for number in route.sensors:
                    own[number].append(index)
            elif route.role is Role.IMU:
                fed.imu += self._imu(batch, index, route.sensors[0])
            elif route.role is Role.BAD_SIZE:
                packets = self._feeds[route.sensors[0]].ledger.packets
                packets.read += len(index)
                packets.reject("bad_size", len(index))
            else:
                self._unassign(kind, batch, index)
        for number, parts in enumerate(own):
            if parts:
                index = parts[0] if len(parts) == 1 else np.sort(np.concatenate(parts))
                fed.arrivals[number] = self._arrive(
                    number, batch, index, owned, oldest_places[number]
                )
        if not owned.all():
            for kind, index in shared:
                self._unassign(kind, batch, index[~owned[index]])
        return fed

    def owners(self, batch: PacketBatch) -> I64Array:
        """Number of the sensor that each packet is of, its IMU included; -1 of none."""
        owner = np.full(len(batch), -1, np.int64)
        for kind, index in split_by_kind(batch):
            begin = int(batch.start[index[0]])
            route = self._router.route(kind, batch.data[begin : begin + kind[1]])
            if len(route.sensors) == 1:
                owner[index] = route.sensors[0]
                continue
            for number in route.sensors:
                lidar, left = self._feeds[number].lidar, index[owner[index] < 0]
                packets = batch.data[batch.start[left, None] + np.arange(lidar.packet_size)]
                owner[left[lidar.owns(packets)]] = number
        return owner

    def _unassign(self, kind: Kind, batch: PacketBatch, index: I64Array) -> None:
        if not len(index):
            return
        self.unassigned[kind] = self.unassigned.get(kind, 0) + len(index)
        if kind not in self.samples:
            begin = int(batch.start[index[0]])
            self.samples[kind] = batch.data[begin : begin + kind[1]][None].copy()

    def _arrive(
        self,
        number: int,
        batch: PacketBatch,
        index: I64Array,
        owned: BoolArray,
        oldest_place: int | None,
    ) -> Arrival:
        feed = self._feeds[number]
        lidar, counts = feed.lidar, feed.ledger.packets
        packets, place = feed.ring.store(batch.data, batch.start[index], oldest_place)
        good = lidar.owns(packets) & ~owned[index]
        counts.read += int(np.count_nonzero(good))
        owned[index] |= good
        faults = lidar.faults(packets)
        if faults.any():
            for fault, count in enumerate(np.bincount(faults[good])[1:].tolist(), 1):
                counts.reject(FAULTS[fault], count)
            good &= faults == 0
        if not good.all():
            packets, place, index = packets[good], place[good], index[good]
        host_ns = batch.host_ns[index]
        heads = lidar.heads(packets, host_ns)
        if self._retime is not None:
            heads.stamp_ns = self._retime(number, heads.stamp_ns, host_ns)
        return Arrival(
            position=index,
            host_ns=host_ns,
            key=lidar.sequence(packets),
            heads=heads,
            place=place,
        )

    def _fresh(self, number: int, key: I64Array) -> BoolArray:
        """Which IMU packets (n,) of a sensor are no copies of recent ones, by their content."""
        keys = np.concatenate([self._recent[number], key])
        _, first = np.unique(keys, return_index=True)
        fresh = np.zeros(len(keys), np.bool_)
        fresh[first] = True
        self._recent[number] = keys[-RECENT_IMU:]
        return fresh[len(keys) - len(key) :]

    def _imu(self, batch: PacketBatch, index: I64Array, number: int) -> list[ImuSamples]:
        feed = self._feeds[number]
        feed.ledger.imu_packets += len(index)
        payloads = batch.data[batch.start[index, None] + np.arange(int(batch.size[index[0]]))]
        fresh = self._fresh(number, content_keys(payloads))
        if not fresh.all():
            again = len(feed.lidar.imu(payloads[~fresh], number).stamp_ns)
            feed.ledger.imu_samples.decoded += again
            feed.ledger.imu_samples.drop("duplicate", again)
            payloads, index = payloads[fresh], index[fresh]
        if not self._host_clocks[number] and self._retime is None:
            return [feed.lidar.imu(payloads, number)]
        samples = []
        for host_ns, payload in zip(batch.host_ns[index].tolist(), payloads, strict=True):
            sample = feed.lidar.imu(payload[None], number)
            if not self._host_clocks[number] and self._retime is not None:
                stamps_ns = sample.stamp_ns[None]
                sample.stamp_ns = self._retime(number, stamps_ns, np.array([host_ns]))[0]
            elif len(sample.stamp_ns):
                # Ages first: damaged stamps may be too large to be added to an arrival.
                sample.stamp_ns = sample.stamp_ns - sample.stamp_ns[-1:] + host_ns
            samples.append(sample)
        return samples
