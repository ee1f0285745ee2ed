"""Receive times of the lidars in each recording of a run: do they belong together?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from mlbatch import sensors
from mlbatch.arrays import U8Array
from mlbatch.discovery.discover import Discovery
from mlbatch.discovery.first_seconds import FIRST_NS
from mlbatch.discovery.overlap import LidarSpan, SharedLidars, lidar_name, problem
from mlbatch.discovery.router import Role
from mlbatch.discovery.sampler import SAMPLES_PER_KIND, KindFilter, split_by_kind
from mlbatch.discovery.types import PacketKind
from mlbatch.errors import RecordingError
from mlbatch.types import PacketBatch, Recording


class RunOverlap:
    """Follows the packets of several recordings; an error as soon as they are no session."""

    def __init__(self, recordings: Sequence[Recording], setup: Discovery) -> None:
        self._setup = setup
        self._spans = {id(one): LidarSpan(one.path) for one in recordings}
        self._shared = SharedLidars()
        self._kind_filters = {id(one): KindFilter() for one in recordings}
        # By recording and kind, as lidars of several recordings may have one address.
        self._lidars: dict[tuple[int, PacketKind], list[str]] = {}
        self._begun_ns: int | None = None
        self._is_settled = False

    def add(self, recording: Recording, batch: PacketBatch | None) -> None:
        """Add the next packets of a recording; None: it has no more."""
        span = self._spans[id(recording)]
        if batch is None:
            span.is_whole = True
            return
        is_new = span.first_ns is None
        parts = split_by_kind(batch)
        for kind, index in self._kind_filters[id(recording)].followed(batch, parts):
            key = id(recording), kind
            names = self._lidars.get(key)
            if names is None:
                first = batch.start[index[:SAMPLES_PER_KIND], None] + np.arange(kind.size)
                names = list(self._names(kind, batch.data[first]))
                self._lidars[key] = names
            host_ns = batch.host_ns[index]
            for name in names:
                span.add(name, int(host_ns.min()), int(host_ns.max()))
            for sensor in self._setup.sensors:
                if sensor.name in names:
                    self._shared.add(recording, sensor, batch, index)
        newest_ns = int(batch.host_ns[-1])
        if is_new and span.first_ns is not None:
            self._begun_ns = newest_ns
            self._is_settled = False
            self._refuse(are_all_known=False)
        elif (
            not self._is_settled
            and self._begun_ns is not None
            and newest_ns - self._begun_ns > FIRST_NS
            and all(one.first_ns is not None or one.is_whole for one in self._spans.values())
        ):
            self._is_settled = True
            self._refuse()

    def finish(self) -> str:
        """Check all that was read, at the end; gives a warning about optional sensors, or ""."""
        for span in self._spans.values():
            span.is_whole = True
        return self._refuse()

    def _refuse(self, *, are_all_known: bool = True) -> str:
        """Raise RecordingError if recordings are no session; gives a warning, or ""."""
        optional = [
            one.name for one in self._setup.sensors if one.rig is not None and one.rig.optional
        ]
        text, is_optional = problem(
            list(self._spans.values()), optional, are_all_known=are_all_known
        )
        if text and not is_optional:
            raise RecordingError(text)
        return text

    def _names(self, kind: PacketKind, packets: U8Array) -> Iterator[str]:
        """Lidars that sent packets (k, size) of a kind, but for those that the user left out."""
        setup = self._setup
        stream = setup.sampler.table.streams[kind.stream]
        route = setup.router.route(kind, packets[0])
        if route.role in (Role.IMU, Role.BAD_SIZE):
            return
        owned = np.zeros(len(packets), np.bool_)
        for number in route.sensors:
            sensor = setup.sensors[number]
            own = sensor.lidar.sent_by_me(packets[:, : sensor.lidar.packet_size])
            owned |= own
            if own.any():
                yield sensor.name
        others = packets[~owned]
        if setup.rig is not None or setup.ignored.all_others or not len(others):
            return
        others = others[~setup.ignored.packets(stream, kind, others)]
        what = sensors.describe(kind.size, others[:1]) if len(others) else None
        if what is not None and "lidar" in what:
            yield lidar_name(stream, what)
