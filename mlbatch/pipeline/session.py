"""A session: its recordings opened, its sensors found and ready to be read."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array, U8Array
from mlbatch.discovery.calibrations import is_metadata
from mlbatch.discovery.discover import Discovery, discover, refuse_absent, refuse_untimed
from mlbatch.discovery.first_seconds import is_without_packets
from mlbatch.discovery.match import release
from mlbatch.discovery.sampler import clock_watch
from mlbatch.discovery.types import Note, PacketKind
from mlbatch.native import require_library
from mlbatch.native.arena import PacketArena
from mlbatch.outputs.inputs import open_inputs
from mlbatch.pipeline.ingest import Ingest
from mlbatch.pipeline.job import Job, TimeSegment
from mlbatch.pipeline.sensor import Sensor, sensors_of
from mlbatch.readers.source import BUFFER_BYTES
from mlbatch.types import (
    Message,
    PacketBatch,
    Recording,
    StreamTable,
    WrappedRecording,
)
from mlbatch.units import NS_PER_S

if TYPE_CHECKING:
    from mlbatch.discovery.overlap import RunOverlap
    from mlbatch.faults import FaultReplay

# A note for the user, no warning: how the times of decoded clouds were read.
CLOUDS = "clouds"


# Beyond all receive times, ns.
_EVER_NS = 2**63 - 1
# Share of the bytes of a recording.
_MOST = 0.5
# Packets of each sensor to read at a time, between 4 MB and 5 MB in all: each batch costs some
# calls a sensor, the columns of many small packets do not fit into the cache, and memory grows.
_READ_PACKETS = 512
_MOST_READ_BYTES = 5 << 20


class Session:
    """The recordings of a job and the sensors found in them.

    setup: result of discovery; sensors: in the order of `lidar_id`;
    replay: of injected faults, or None; delivered: packets given by `packets` so far; last_host_ns:
    receive time of the newest, 0 before the first.
    """

    def __init__(self, job: Job, progress: Callable[[int, int, int], None] | None = None) -> None:
        """progress: as `conversion.Progress`, of the pass for `--align-clocks`."""
        self.job = job
        self.delivered = 0
        self._first_host_ns = 0
        self.last_host_ns = 0
        self._overlap: RunOverlap | None = None
        require_library()
        streams = StreamTable()
        opened = open_inputs(job.recordings, streams, job.selection.rig)
        if job.segment != TimeSegment():
            opened = [_Segment(recording, job.segment) for recording in opened]
        self.setup: Discovery = discover(opened, streams, job.selection)
        self.recordings: Sequence[Recording] = self.setup.recordings
        kinds = {kind for found in self.setup.sensors for kind in found.kinds}
        sizes = [found.lidar.packet_size for found in self.setup.sensors]
        read_bytes = _READ_PACKETS * sum(sizes)
        self._arena = PacketArena(min(max(read_bytes, BUFFER_BYTES), _MOST_READ_BYTES))
        # Packets are decoded where they were read, unless most bytes there are of others, which
        # would be kept as long.
        self._reads_into_arena = self.setup.sampler.share_of(kinds) >= _MOST
        self.sensors = sensors_of(self.setup, job, self._arena)
        release(self.setup.sampler, kinds & self.setup.sampler.kinds.keys())
        self.refuse_untimed()
        self.replay = self._replay()
        if job.align_clocks_to:
            self._align_clocks(progress)
        maps_stamps = bool(job.faults or job.align_clocks_to)
        self.ingest = Ingest(
            self.setup.router,
            self.sensors,
            [sensor.intake() for sensor in self.sensors],
            self._map_stamps if maps_stamps else None,
            self._is_ignored if job.selection.only or job.selection.ignore else None,
        )

    def _map_stamps(self, sensor: Sensor, stamp_ns: I64Array, host_ns: I64Array) -> I64Array:
        """Timestamps (P, C) of packets received at (P,) as they are to be batched.

        Injected faults of clocks are added, then the maps of `--align-clocks` applied.
        """
        if self.replay is not None:
            stamp_ns = stamp_ns + self.replay.shift_ns(sensor.index, host_ns)[:, None]
        found = sensor.clock.map
        return stamp_ns if found is None else found.apply(stamp_ns, host_ns[:, None])

    def _align_clocks(self, progress: Callable[[int, int, int], None] | None) -> None:
        """Measure the clocks over the whole session, and set the map of each sensor."""
        from mlbatch.clocks.align import fit

        # Rings and ledgers of their own: this pass reads everything once more.
        arena = PacketArena()
        sensors = [sensor.unread(arena) for sensor in self.sensors]
        watches = [clock_watch(sensor.lidar) for sensor in sensors]
        intakes = [
            sensor.clock_intake(watch) for sensor, watch in zip(sensors, watches, strict=True)
        ]
        ingest = Ingest(self.setup.router, sensors, intakes, self._map_stamps)
        for batch in self._with_faults(self.setup.first.whole()):
            arena.keep_from(None)
            ingest.columns(batch)
            if progress is not None:
                progress(self.position_bytes, self.size_bytes, 0)
        for sensor, found in zip(self.sensors, fit(watches, self.job.align_clocks_to), strict=True):
            sensor.clock.map = found

    def _with_faults(self, batches: Iterator[PacketBatch]) -> Iterator[PacketBatch]:
        """The batches with injected faults."""
        if self.replay is None:
            return batches
        return self.replay.batches(batches, self.setup.router.owners)

    def _is_ignored(self, kind: PacketKind, packets: U8Array) -> BoolArray:
        """Return which packets (P, size) of no sensor the user left out: (P,) bool."""
        stream = self.setup.sampler.table.streams[kind.stream]
        return self.setup.ignored.packets(stream, kind, packets)

    def _replay(self) -> FaultReplay | None:
        """Replay of the job's faults, None without."""
        job = self.job
        if not job.faults:
            return None
        # Not loaded for runs without faults.
        from mlbatch.faults import FaultReplay

        replay = FaultReplay(job.faults, job.fault_seed, [one.name for one in self.sensors])
        replay.begin_ns = self.begin_ns if job.fault_begin_ns is None else job.fault_begin_ns
        return replay

    # -- reading ------------------------------------------------------------------------------

    def keep_from(self, ring_index: int | None) -> None:
        """Free all packets before the first one needed; None: none is needed."""
        self._arena.keep_from(ring_index)

    def packets(self) -> Generator[PacketBatch, None, None]:
        """Yield all packets in receive order, with injected faults."""
        # Also after an error, files are closed here, by the thread that opened them.
        # Only for several recordings: it costs a sort of every batch.
        if len(self.recordings) > 1:
            # Not loaded for single recordings.
            from mlbatch.discovery.overlap import RunOverlap

            self._overlap = RunOverlap(self.recordings, self.setup)
        elif self._reads_into_arena and self.replay is None and not self.setup.first.has_all:
            self.recordings[0].use_arena(self._arena)
        seen = None if self._overlap is None else self._overlap.add
        with contextlib.closing(self.setup.first.whole(is_without_packets, seen)) as batches:
            for batch in self._with_faults(batches):
                if len(batch):
                    if not self.delivered:
                        self._first_host_ns = int(batch.host_ns[0])
                    self.last_host_ns = int(batch.host_ns[-1])
                    self.delivered += len(batch)
                yield batch

    @property
    def begin_ns(self) -> int | None:
        """Receive time of the first packet of any sensor, among those sampled by discovery.

        Not of the first packet read: bags store many in a message, sensor by sensor.
        """
        firsts_ns = map(self.setup.sampler.first_host_ns, self.setup.sensors)
        return min((first_ns for first_ns in firsts_ns if first_ns is not None), default=None)

    @property
    def recorded_s(self) -> float:
        """Time between the first and the last packet read, by the capture host."""
        return (self.last_host_ns - self._first_host_ns) / NS_PER_S

    @property
    def size_bytes(self) -> int:
        """Size of all recordings."""
        return sum(recording.size_bytes for recording in self.recordings)

    @property
    def position_bytes(self) -> int:
        """Bytes read so far."""
        return sum(recording.position_bytes for recording in self.recordings)

    # -- what scans are made with -------------------------------------------------------------

    @property
    def boxes_m(self) -> F64Array:
        """Excluded boxes of rig and job: (k, 6), m, body frame."""
        boxes_m = np.array(self.job.boxes_m, np.float64).reshape(-1, 6)
        rig = self.setup.rig
        return boxes_m if rig is None else np.concatenate([rig.exclude_boxes_m, boxes_m])

    # -- checks and warnings ------------------------------------------------------------------

    def refuse_untimed(self) -> None:
        """Raise UsageError where receive times are needed and packets have none of their own."""
        aligned = bool(self.job.align_clocks_to)
        option = "--align-clocks" if aligned else "--clock host"
        for sensor in self.sensors:
            if aligned or sensor.clock.by_host:
                refuse_untimed(self.setup.sampler.table, sensor.detected, option)

    def refuse_absent(self) -> None:
        """Raise RigError if a sensor that the rig requires sent no packet."""
        for sensor in self.sensors:
            is_required = sensor.rig is not None and not sensor.rig.optional
            if is_required and not sensor.ledger.packets.read:
                refuse_absent(self.setup, sensor.detected, self.job.selection.rig)

    def refuse_apart(self) -> list[Note]:
        """Raise RecordingError if recordings do not overlap; a warning for optional sensors."""
        text = "" if self._overlap is None else self._overlap.finish()
        return [Note("no_overlap", "", text)] if text else []


class _Segment(WrappedRecording):
    """The packets and messages of a recording that were received in [begin_ns, end_ns).

    Others are not counted either: they belong to another segment. Messages from before the segment
    are given only if they describe sensors, since metadata are recorded once, at the start.
    """

    __slots__ = ("_begin_ns", "_end_ns")

    def __init__(self, inner: Recording, segment: TimeSegment) -> None:
        super().__init__(inner)
        self._begin_ns = -_EVER_NS if segment.begin_ns is None else segment.begin_ns
        self._end_ns = _EVER_NS if segment.end_ns is None else segment.end_ns

    def packets(self) -> Generator[PacketBatch, None, None]:
        """Yield the packets of the segment, in file order; each call is a new pass."""
        self.inner.keep = self.keep
        self.inner.lend = self.lend
        with contextlib.closing(self.inner.packets()) as batches:
            for batch in batches:
                inside = (batch.host_ns >= self._begin_ns) & (batch.host_ns < self._end_ns)
                left_out = len(batch) - int(np.count_nonzero(inside))
                self.inner.counts.frames -= left_out
                self.inner.counts.datagrams -= left_out
                clipped = batch.take(np.flatnonzero(inside)) if left_out else batch
                clipped = replace(clipped, messages=tuple(filter(self._is_due, batch.messages)))
                if len(clipped) or clipped.messages:
                    yield clipped

    def _is_due(self, message: Message) -> bool:
        is_begun = message.host_ns >= self._begin_ns or is_metadata(message.topic)
        return is_begun and message.host_ns < self._end_ns
