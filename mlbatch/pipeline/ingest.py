"""Packets of a batch to columns of sensors: routing, validity, raw packets into rings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.batching.intake import Arrival
from mlbatch.discovery.router import Role, Router
from mlbatch.discovery.sampler import split_by_kind
from mlbatch.discovery.types import PacketKind
from mlbatch.lidar.interface import FAULTS
from mlbatch.pipeline.sensor import Sensor
from mlbatch.sensors import content_keys
from mlbatch.types import ImuSamples, PacketBatch

# Duplicate IMU packets are detected among this many.
RECENT_IMU = 64
# Maps timestamps (P, C) of packets of a sensor, received at (P,), to those that are batched.
StampMap = Callable[[Sensor, I64Array, I64Array], I64Array]


@dataclass(slots=True)
class Ingested:
    """Content of a batch: an arrival for each sensor (None: no packet of it), IMU samples."""

    arrivals: list[Arrival | None]
    imu: list[ImuSamples]


class Ingest:
    """Assigns packets to sensors and reads their column headers; pixels stay raw.

    unassigned: packets of no sensor, by kind; samples: one packet of each such kind, (1, size).
    """

    def __init__(
        self, router: Router, sensors: Sequence[Sensor], stamp_map: StampMap | None = None
    ) -> None:
        """stamp_map: applied to timestamps before they are batched; None: unchanged."""
        self.unassigned: dict[PacketKind, int] = {}
        self.samples: dict[PacketKind, U8Array] = {}
        self._router = router
        self._sensors = list(sensors)
        self._stamp_map = stamp_map
        self._recent_imu: list[I64Array] = [np.empty(0, np.int64) for _ in self._sensors]

    def columns(self, batch: PacketBatch, oldest_places: Sequence[int | None]) -> Ingested:
        """Route a batch, copy lidar packets to their rings and read their column headers.

        oldest_places: first ring place that is still needed, of each sensor.
        """
        own: list[list[I64Array]] = [[] for _ in self._sensors]
        ingested = Ingested([None] * len(self._sensors), [])
        owned = np.zeros(len(batch), bool)
        shared: list[tuple[PacketKind, I64Array]] = []
        for kind, index in split_by_kind(batch):
            route = self._router.route(kind, _payload(batch, int(index[0]), kind))
            if route.role is Role.LIDAR:
                shared.append((kind, index))
                for number in route.sensors:
                    own[number].append(index)
            elif route.role is Role.IMU:
                ingested.imu += self._imu(batch, index, self._sensors[route.sensors[0]])
            elif route.role is Role.BAD_SIZE:
                packets = self._sensors[route.sensors[0]].ledger.packets
                packets.read += len(index)
                packets.reject("bad_size", len(index))
            else:
                self._unassign(kind, batch, index)
        for sensor, parts, oldest_place in zip(self._sensors, own, oldest_places, strict=True):
            if parts:
                index = parts[0] if len(parts) == 1 else np.sort(np.concatenate(parts))
                arrival = self._arrive(sensor, batch, index, owned, oldest_place)
                ingested.arrivals[sensor.index] = arrival
        if not owned.all():
            for kind, index in shared:
                self._unassign(kind, batch, index[~owned[index]])
        return ingested

    def owners(self, batch: PacketBatch) -> I64Array:
        """Index of the sensor that sent each packet, IMU packets included; -1: no sensor."""
        owner = np.full(len(batch), -1, np.int64)
        for kind, index in split_by_kind(batch):
            route = self._router.route(kind, _payload(batch, int(index[0]), kind))
            if len(route.sensors) == 1:
                owner[index] = route.sensors[0]
                continue
            for number in route.sensors:
                lidar = self._sensors[number].lidar
                left = index[owner[index] < 0]
                packets = batch.data[batch.start[left, None] + np.arange(lidar.packet_size)]
                owner[left[lidar.owns(packets)]] = number
        return owner

    def _unassign(self, kind: PacketKind, batch: PacketBatch, index: I64Array) -> None:
        if not len(index):
            return
        self.unassigned[kind] = self.unassigned.get(kind, 0) + len(index)
        if kind not in self.samples:
            self.samples[kind] = _payload(batch, int(index[0]), kind)[None].copy()

    def _arrive(
        self,
        sensor: Sensor,
        batch: PacketBatch,
        index: I64Array,
        owned: BoolArray,
        oldest_place: int | None,
    ) -> Arrival:
        """Copy packets that may be of a sensor to its ring; give those that are, and are valid."""
        lidar = sensor.lidar
        counts = sensor.ledger.packets
        packets, place = sensor.ring.store(batch.data, batch.start[index], oldest_place)
        good = lidar.owns(packets) & ~owned[index]
        counts.read += int(np.count_nonzero(good))
        owned[index] |= good
        faults = lidar.faults(packets)
        if faults.any():
            for fault, count in enumerate(np.bincount(faults[good])[1:].tolist(), 1):
                counts.reject(FAULTS[fault], count)
            good &= faults == 0
        if not good.all():
            packets = packets[good]
            place = place[good]
            index = index[good]
        host_ns = batch.host_ns[index]
        heads = lidar.heads(packets, host_ns)
        if self._stamp_map is not None:
            heads.stamp_ns = self._stamp_map(sensor, heads.stamp_ns, host_ns)
        return Arrival(
            position=index,
            host_ns=host_ns,
            key=lidar.sequence(packets),
            heads=heads,
            place=place,
        )

    def _imu(self, batch: PacketBatch, index: I64Array, sensor: Sensor) -> list[ImuSamples]:
        """Samples of IMU packets; duplicates are counted and left out."""
        ledger = sensor.ledger
        ledger.imu_packets += len(index)
        payloads = batch.data[batch.start[index, None] + np.arange(int(batch.size[index[0]]))]
        fresh = self._fresh_imu(sensor, content_keys(payloads))
        if not fresh.all():
            again = len(sensor.lidar.imu(payloads[~fresh], sensor.index).stamp_ns)
            ledger.imu_samples.decoded += again
            ledger.imu_samples.drop("duplicate", again)
            payloads = payloads[fresh]
            index = index[fresh]
        if not sensor.clock.by_host and self._stamp_map is None:
            return [sensor.lidar.imu(payloads, sensor.index)]
        samples = []
        for host_ns, payload in zip(batch.host_ns[index].tolist(), payloads, strict=True):
            sample = sensor.lidar.imu(payload[None], sensor.index)
            if not sensor.clock.by_host and self._stamp_map is not None:
                stamps_ns = sample.stamp_ns[None]
                sample.stamp_ns = self._stamp_map(sensor, stamps_ns, np.array([host_ns]))[0]
            elif len(sample.stamp_ns):
                # Subtract first: damaged timestamps may overflow if added to a receive time.
                sample.stamp_ns = sample.stamp_ns - sample.stamp_ns[-1:] + host_ns
            samples.append(sample)
        return samples

    def _fresh_imu(self, sensor: Sensor, key: I64Array) -> BoolArray:
        """Mask (n,) of the IMU packets whose content differs from that of recent ones."""
        keys = np.concatenate([self._recent_imu[sensor.index], key])
        _, first = np.unique(keys, return_index=True)
        fresh = np.zeros(len(keys), np.bool_)
        fresh[first] = True
        self._recent_imu[sensor.index] = keys[-RECENT_IMU:]
        return fresh[len(keys) - len(key) :]


def _payload(batch: PacketBatch, number: int, kind: PacketKind) -> U8Array:
    """Payload of one packet of a kind."""
    begin = int(batch.start[number])
    return batch.data[begin : begin + kind.size]
