"""A session: its recordings opened, its sensors found and ready to be read."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, U8Array
from mlbatch.discovery.discover import Discovery, discover, refuse_absent, refuse_untimed
from mlbatch.discovery.first_seconds import is_without_packets
from mlbatch.discovery.match import release
from mlbatch.discovery.sampler import clock_watch
from mlbatch.discovery.types import Note, PacketKind
from mlbatch.errors import RecordingError
from mlbatch.native import require_library
from mlbatch.native.arena import PacketArena
from mlbatch.outputs.inputs import open_inputs
from mlbatch.pipeline.clock_monitor import ClockMonitor
from mlbatch.pipeline.ingest import Ingest
from mlbatch.pipeline.job import Job, TimeSegment
from mlbatch.pipeline.sensor import Limits, Sensor, SensorClock, new_ring
from mlbatch.readers.source import BUFFER_BYTES
from mlbatch.reports.report import ACCEPTED_WARNINGS
from mlbatch.rig.rig import Rig, RigSensor
from mlbatch.types import PacketBatch, Recording, RunInfo, SensorInfo, StreamTable
from mlbatch.units import NS_PER_S

if TYPE_CHECKING:
    from mlbatch.faults import FaultReplay
    from mlbatch.pipeline.overlap import RunOverlap

# A note for the user, no warning: how the times of decoded clouds were read.
CLOUDS = "clouds"


# Share of the bytes of a recording.
_MOST = 0.5
# Packets of each sensor to read at a time, between 4 MB and 5 MB in all: each batch costs some
# calls a sensor, the columns of many small packets do not fit into the cache, and memory grows.
_READ_PACKETS = 512
_MOST_READ_BYTES = 5 << 20


class Session:
    """The recordings of a job and the sensors found in them.

    setup: result of discovery; sensors: in the order of `lidar_id`;
    replay: of injected faults, or None; delivered: packets given by `packets` so far; notes:
    warnings so far.
    """

    def __init__(self, job: Job, progress: Callable[[int, int, int], None] | None = None) -> None:
        """progress: as `conversion.Progress`, of the pass for `--align-clocks`."""
        self.job = job
        self.delivered = 0
        self.notes: list[Note] = []
        self._received_ns: tuple[int, int] | None = None
        self._overlap: RunOverlap | None = None
        require_library()
        streams = StreamTable()
        opened = open_inputs(job.recordings, streams, job.selection.rig)
        if job.segment != TimeSegment():
            # Not loaded for whole sessions.
            from mlbatch.pipeline.segments import ClippedRecording

            opened = [ClippedRecording(recording, job.segment) for recording in opened]
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
        self.clocks = ClockMonitor(self.sensors, self.replay)
        if job.align_clocks_to:
            batches = self._shown(self.setup.first.whole(), progress)
            self.clocks.align(batches, self.setup.router, job.align_clocks_to)
        maps_stamps = bool(job.faults or job.align_clocks_to)
        self.ingest = Ingest(
            self.setup.router,
            self.sensors,
            [sensor.intake() for sensor in self.sensors],
            self.clocks.map_stamps if maps_stamps else None,
            self._is_ignored if job.selection.only or job.selection.ignore else None,
        )

    def _shown(
        self,
        batches: Iterator[PacketBatch],
        progress: Callable[[int, int, int], None] | None,
    ) -> Iterator[PacketBatch]:
        """The batches; each is reported."""
        for batch in batches:
            yield batch
            if progress is not None:
                progress(self.position_bytes, self.size_bytes, 0)

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

    def keep_from(self, oldest_ring_indexes: Sequence[int | None]) -> None:
        """Free all packets before the first one needed, by sensor; None: none is needed."""
        needed = [index for index in oldest_ring_indexes if index is not None]
        self._arena.keep_from(min(needed, default=None))

    def packets(self) -> Generator[PacketBatch, None, None]:
        """Yield all packets in receive order, with injected faults."""
        # Also after an error, files are closed here, by the thread that opened them.
        # Only for several recordings: it costs a sort of every batch.
        if len(self.recordings) > 1:
            # Not loaded for single recordings.
            from mlbatch.pipeline.overlap import RunOverlap

            self._overlap = RunOverlap(self.recordings, self.setup)
        elif self._reads_into_arena and self.replay is None and not self.setup.first.has_all:
            self.recordings[0].use_arena(self._arena)
        seen = None if self._overlap is None else self._overlap.add
        with contextlib.closing(self.setup.first.whole(is_without_packets, seen)) as merged:
            batches: Iterator[PacketBatch] = merged
            if self.replay is not None:
                batches = self.replay.batches(batches, self.setup.router.owners)
            for batch in batches:
                self._count(batch)
                yield batch

    def _count(self, batch: PacketBatch) -> None:
        if not len(batch):
            return
        self.delivered += len(batch)
        first_ns = int(batch.host_ns[0]) if self._received_ns is None else self._received_ns[0]
        self._received_ns = first_ns, int(batch.host_ns[-1])

    @property
    def begin_ns(self) -> int | None:
        """Receive time of the first packet of any sensor, among those sampled by discovery.

        Not of the first packet read: bags store many in a message, sensor by sensor.
        """
        firsts_ns = map(self.setup.sampler.first_host_ns, self.setup.sensors)
        return min((first_ns for first_ns in firsts_ns if first_ns is not None), default=None)

    @property
    def last_host_ns(self) -> int:
        """Receive time of the newest packet; 0 before the first."""
        return 0 if self._received_ns is None else self._received_ns[1]

    @property
    def recorded_s(self) -> float:
        """Time between the first and the last packet read, by the capture host."""
        if self._received_ns is None:
            return 0.0
        return (self._received_ns[1] - self._received_ns[0]) / NS_PER_S

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
        return excluded_boxes_m(self.job, self.setup.rig)

    def run_info(
        self,
        rate_hz: str,
        timescale: str,
        t_init_ns: int | None = None,
        *,
        forwards: bool = False,
    ) -> RunInfo:
        """The description that all scans share.

        rate_hz: exact rate as text; forwards: recorded messages are written, too.
        """
        job = self.job
        sensors = tuple(
            SensorInfo(
                sensor.name,
                sensor.lidar.model,
                sensor.lidar.channels,
                sensor.lidar.returns,
                0 if job.split else sensor.ring_base,
                sensor.body_from_sensor,
                sensor.lidar.has_reflectivity,
                sensor.lidar.sensor_from_imu(),
            )
            for sensor in self.sensors
        )
        frames = tuple(self.setup.frames().items()) if forwards else ()
        return RunInfo(
            sensors,
            self.setup.frame_id,
            rate_hz,
            timescale,
            job.slices,
            job.layout,
            job.sort,
            frames,
            job.variants,
            t_init_ns,
        )

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
            if sensor.is_required and not sensor.ledger.packets.read:
                refuse_absent(self.setup, sensor.detected, self.job.selection.rig)

    def refuse_apart(self) -> None:
        """Raise RecordingError if recordings do not overlap; a warning for optional sensors."""
        text = "" if self._overlap is None else self._overlap.finish()
        if text:
            self.warn(Note("no_overlap", "", text))

    def warn(self, note: Note) -> None:
        """Add a warning; RecordingError with `--strict`."""
        if self.job.strict and note.code not in ACCEPTED_WARNINGS:
            raise RecordingError(f"{note.message} ({note.code}, an error because of --strict)")
        self.notes.append(note)


def sensors_of(setup: Discovery, job: Job, arena: PacketArena) -> list[Sensor]:
    """The sensors of a session with empty rings and ledgers; arena: where packets are kept."""
    sampler = setup.sampler
    sensors: list[Sensor] = []
    ring_base = 0
    for found in setup.sensors:
        rig = found.rig
        lidar = found.lidar
        sensors.append(
            Sensor(
                index=len(sensors),
                detected=found,
                clock=SensorClock(
                    by_host=job.selection.host_clock or (rig is not None and rig.clock == "host"),
                    offset_ns=found.offset_ns,
                    has_receive_times=sampler.has_receive_times(found),
                    watch=clock_watch(lidar),
                    stated="" if setup.output is None else setup.output.timescale,
                ),
                limits=limits(job, rig),
                ring_base=ring_base,
                columns_per_s=sampler.columns_per_s(found),
                ring=new_ring(lidar, arena),
            )
        )
        ring_base += max(lidar.channels, int(lidar.channel.max()) + 1)
    return sensors


def limits(job: Job, rig: RigSensor | None) -> Limits:
    """The narrower of the job's and the rig's ranges for a sensor."""
    min_range_m = 0.0 if rig is None else rig.min_range_m or 0.0
    max_range_m = math.inf if rig is None else rig.max_range_m or math.inf
    return Limits(
        max(job.min_range_m, min_range_m), min(job.max_range_m, max_range_m), job.keep_repeated
    )


def excluded_boxes_m(job: Job, rig: Rig | None) -> F64Array:
    """Excluded boxes of rig and job: (k, 6), m, body frame."""
    boxes_m = np.array(job.boxes_m, np.float64).reshape(-1, 6)
    if rig is None:
        return boxes_m
    return np.concatenate([rig.exclude_boxes_m, boxes_m])
