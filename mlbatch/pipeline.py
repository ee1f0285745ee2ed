"""The main job: packets in, scans out; the only place that knows all stages."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mlbatch import accounts
from mlbatch.assembly import boxes_of, feed_of, intake_of, replay_of, run_info, source_of
from mlbatch.batching.batcher import Batcher
from mlbatch.batching.grid import Grid
from mlbatch.batching.windows import Policy, Window
from mlbatch.clipping import ClippedRecording, Part
from mlbatch.clock import common_timescale, timescale
from mlbatch.decode import Decoder, Source
from mlbatch.decoding import Bench, Benches, LeftOut, Task, with_own_lidars
from mlbatch.discover import Note, Setup, absent, discover, untimed
from mlbatch.errors import NoScanError, PacketError, RecordingError, UsageError
from mlbatch.feeding import Feeder
from mlbatch.inertial import ImuQueue
from mlbatch.job import DEFAULT_RATE, Job
from mlbatch.kernels import choose_engine
from mlbatch.looking import is_without_packets
from mlbatch.mounting import Mounted
from mlbatch.passing import PassQueue
from mlbatch.readers import merge, open_recording
from mlbatch.scan_table import ScanTable
from mlbatch.timekeeping import Timekeeper
from mlbatch.types import (
    IMU,
    MESSAGE_ENCODINGS,
    ImuSamples,
    Message,
    PacketBatch,
    Recording,
    RunInfo,
    Scan,
    StreamTable,
)
from mlbatch.units import NS_PER_S


@dataclass(slots=True)
class Stages:
    """Seconds spent in each stage."""

    read_s: float = 0.0
    decode_s: float = 0.0
    merge_s: float = 0.0
    write_s: float = 0.0


Progress = Callable[[int, int], None]


class Conversion:
    """One run; `scans` or `tasks` drive it, the rest tells what came of it."""

    def __init__(self, job: Job, buffers: int = 1) -> None:
        """buffers: so many scans of a bench are valid at a time."""
        self.job = job
        self.stages = Stages()
        self.table: ScanTable | None = None
        self.info: RunInfo | None = None
        self.delivered = 0
        self.dropped_incomplete = 0
        # Of scans that a continued output holds: the fates of the slots of all sensors.
        self.finished: Iterator[Sequence[Sequence[int]]] = iter(())
        self._buffers = buffers
        self._started_s = (time.perf_counter(), time.process_time())
        self._hosts_ns: tuple[int, int] | None = None
        self._notes: list[Note] = []
        streams = StreamTable()
        opened = [open_recording(path, streams) for path in job.recordings]
        self.engine = choose_engine(job.engine, sum(one.size_bytes for one in opened))
        for recording in opened:
            recording.use_engine(self.engine)
        if job.part != Part():
            opened = [ClippedRecording(recording, job.part) for recording in opened]
        self.setup: Setup = discover(opened, streams, job.wishes)
        self.recordings: Sequence[Recording] = self.setup.recordings
        sampler = self.setup.sampler
        self._columns_per_s = [sampler.columns_per_s(one.found) for one in self.setup.sensors]
        self._prepare()
        for note in self.setup.notes:
            self.warn(note)

    def _prepare(self) -> None:
        job, rig = self.job, self.setup.rig
        rate = job.rate or (rig.rate if rig is not None else None) or DEFAULT_RATE
        self.grid = Grid(rate, job.slices)
        self.feeds = [feed_of(sensor) for sensor in self.setup.sensors]
        sensors = self.setup.sensors
        host_clocks = [self.uses_host_clock(sensor) for sensor in sensors]
        pairs = zip(sensors, host_clocks, strict=True)
        intakes = [intake_of(sensor, host_clock=by_host) for sensor, by_host in pairs]
        policy = Policy(job.max_wait_ns, job.keep_partial, job.start, job.end)
        self._refuse_untimed()
        self.replay = replay_of(self.setup, self.job, self.begin_ns)
        streams = self.setup.sampler.table
        self.clocks = Timekeeper(sensors, host_clocks, self.replay, streams.untimed)
        if job.align_clocks_to:
            self.clocks.align(merge(self.recordings), self.setup, job.align_clocks_to)
        self.batcher = Batcher(self.grid, intakes, policy, self.clocks.guards)
        retimes = bool(job.faults or job.align_clocks_to)
        self.feeder = Feeder(
            self.setup, self.feeds, host_clocks, self.clocks.retime if retimes else None
        )
        self._work = Benches()
        self._imu = ImuQueue(
            [feed.ledger.imu_samples for feed in self.feeds],
            [self._offset_ns(sensor) for sensor in self.setup.sensors],
            wanted=IMU in job.extras,
        )
        self.passed = PassQueue(job.passed, MESSAGE_ENCODINGS & job.extras, job.part.begin_ns)
        self.passed.refuse_unknown(self.recordings)
        if job.max_wait_ns is None:
            self.warn(Note("max_wait", "", "--max-wait inf: memory grows while a sensor is silent"))

    # -- the run ------------------------------------------------------------------------------

    def scans(self, progress: Progress | None = None) -> Iterator[tuple[Scan, int | None]]:
        """Yield every scan and, with split, the sensor it is of; arrays live until the next."""
        with contextlib.closing(self.tasks(progress)) as tasks:
            for task in tasks:
                if isinstance(task, LeftOut):
                    continue
                with self._timed("decode_s"):
                    scan = self.benches[0].decode(task).scan
                self.account(scan)
                yield scan, task.only
        self.close()

    def tasks(self, progress: Progress | None = None) -> Generator[Task | LeftOut, None, None]:
        """Yield what is to be decoded, scan by scan; `close` has to follow the last.

        Each task may be given to any of the benches, by any thread, while the next are made.
        """
        size = sum(recording.size_bytes for recording in self.recordings)
        self.passed.keep(self.recordings)
        # Also after an error files are closed here, by the thread that opened them.
        with contextlib.closing(merge(self.recordings, is_without_packets)) as merged:
            batches: Iterator[PacketBatch] = merged
            if self.replay is not None:
                batches = self.replay.batches(batches, self.feeder.owners)
            while (batch := self._read(batches)) is not None:
                yield from self._due(self._push(batch))
                if progress is not None:
                    progress(sum(r.position_bytes for r in self.recordings), size)
                if self.batcher.past_end:
                    break
        last = self._hosts_ns[1] if self._hosts_ns is not None else 0
        yield from self._due(self.batcher.finish(last))

    def _read(self, batches: Iterator[PacketBatch]) -> PacketBatch | None:
        with self._timed("read_s"):
            batch = next(batches, None)
        if batch is not None and len(batch):
            self.delivered += len(batch)
            first = int(batch.host_ns[0]) if self._hosts_ns is None else self._hosts_ns[0]
            self._hosts_ns = first, int(batch.host_ns[-1])
        return batch

    def _push(self, batch: PacketBatch) -> Iterator[Window]:
        with self._timed("merge_s"):
            places = [
                self._work.oldest_place(number, self.batcher.oldest_place(number))
                for number in range(len(self.feeds))
            ]
            fed = self.feeder.feed(batch, places)
            for samples in fed.imu:
                self._imu.add(samples)
            self.passed.add(batch.messages)
            low_ns, _ = self.batcher.limits_ns
            if low_ns is not None:
                # Until the first scan all of it would wait.
                self._imu.drop_before(low_ns)
                self.passed.drop_before(low_ns)
            if self.job.strict:
                self._refuse_rejected()
        return self.batcher.push(fed.arrivals, batch.host_ns)

    def _due(self, windows: Iterator[Window]) -> Iterator[Task | LeftOut]:
        while True:
            with self._timed("merge_s"):
                window = next(windows, None)
            if window is None:
                return
            if self.info is None:
                self._begin()
            if self._is_too_incomplete(window):
                yield LeftOut(window.end_ns)
            else:
                yield from self._work.open(window, self.job.split, self.finished)

    def _is_too_incomplete(self, window: Window) -> bool:
        """Whether --drop-incomplete leaves a window out; its columns are counted."""
        share = self.job.drop_incomplete / 100
        if not share:
            return False
        counts = np.bincount(window.sensor, minlength=len(self.feeds)).tolist()
        seconds = (window.end_ns - window.start_ns) / NS_PER_S
        # Of a sensor that was not seen at first at least one column is expected.
        wanted = [1 if rate is None else share * rate * seconds for rate in self._columns_per_s]
        if all(count >= least for count, least in zip(counts, wanted, strict=True)):
            return False
        for feed, count in zip(self.feeds, counts, strict=True):
            feed.ledger.columns.drop("incomplete", count)
        self.dropped_incomplete += 1
        return True

    def account(self, scan: Scan) -> None:
        """Take a scan that is written into the books; in the order of the scans."""
        for feed, count in zip(self.feeds, scan.columns_per_sensor, strict=True):
            feed.ledger.columns.written += count
        if self.table is not None:
            self.table.add(scan)

    def _begin(self) -> None:
        """What needs the clocks to be known: the timescale, and with it all labels of scans."""
        names = self._timescales()
        shared = common_timescale(names)
        if len(set(names)) > 1:
            self.warn(Note("timescale", "", f"sensors differ in timescale: {', '.join(names)}"))
        self._check_dates(shared)
        self.info = run_info(self.setup, self.job, self.grid, shared)
        self.table = ScanTable(self.info, self._columns_per_s)
        info, boxes_m, extras = self.info, boxes_of(self.setup, self.job), self.job.extras
        buffers, engine = self._buffers, self.engine

        def decoder(sources: Sequence[Source], only: int | None) -> Decoder:
            return Decoder(info, sources, boxes_m, extras, only, buffers, engine)

        sources = [
            source_of(sensor, feed, known.ring_base, self.job)
            for sensor, feed, known in zip(
                self.setup.sensors, self.feeds, info.sensors, strict=True
            )
        ]
        several = self.job.jobs > 1
        for _ in range(self.job.jobs):
            # Lidars also read the heads of packets, in the thread that feeds the batching.
            own = with_own_lidars(sources) if several else sources
            self.benches.append(Bench(own, self.job.split, decoder))

    @property
    def benches(self) -> list[Bench]:
        """Who decodes: one for each of the jobs, once the first task is there."""
        return self._work.benches

    def _timescales(self) -> list[str]:
        """Timescale of each sensor that gave a stamp."""
        return [
            self.timescale_of(sensor, *stamps)
            for sensor, stamps in zip(self.setup.sensors, self.batcher.firsts, strict=True)
            if stamps is not None
        ]

    def _check_dates(self, shared: str) -> None:
        """Refuse dates for a clock that knows none."""
        if self.job.limits_are_dates and shared not in ("utc", "tai"):
            raise UsageError(
                f"--start/--end: wanted seconds, since the sensors' clock ({shared}) knows no "
                "date, got a date; write +SECONDS after the first scan"
            )

    def uses_host_clock(self, sensor: Mounted) -> bool:
        """Whether a sensor's stamps are replaced by arrival times."""
        return self.job.wishes.host_clock or (sensor.rig is not None and sensor.rig.clock == "host")

    def _refuse_untimed(self) -> None:
        """Refuse arrival times as stamps, or to map clocks by, where packets have none."""
        aligned = bool(self.job.align_clocks_to)
        option = "--align-clocks" if aligned else "--clock host"
        for sensor in self.setup.sensors:
            error = untimed(self.setup.sampler.table, sensor.found, option)
            if error is not None and (aligned or self.uses_host_clock(sensor)):
                raise error

    def _offset_ns(self, sensor: Mounted) -> int:
        """What is added to the stamps of a sensor; arrival times need no correction."""
        return 0 if self.uses_host_clock(sensor) else sensor.offset_ns

    def timescale_of(self, sensor: Mounted, stamp_ns: int, host_ns: int) -> str:
        """Timescale of a sensor's stamps as they are batched."""
        if self.uses_host_clock(sensor):
            return timescale(host_ns, host_ns)
        return timescale(stamp_ns, host_ns)

    def take_passing(self, end_ns: int | None) -> list[ImuSamples | Message]:
        """What goes past the batching and is older than `end_ns` (None: all)."""
        limits_ns = self.batcher.limits_ns
        return [
            *self._imu.take(end_ns, limits_ns),
            *self.passed.take(end_ns, limits_ns, self._clock_offset_ns()),
        ]

    def _clock_offset_ns(self) -> int | None:
        """Scan clock minus arrival; None where scans are not on an epoch clock."""
        if self.info is None or self.info.timescale not in ("utc", "tai"):
            return None
        if self.job.wishes.host_clock:
            return 0
        offsets = (first[0] - first[1] for first in self.batcher.firsts if first is not None)
        return next(offsets, None)

    # -- the end ------------------------------------------------------------------------------

    def close(self) -> None:
        """Bring the ledgers together, and refuse what the contract calls no result."""
        for number, feed in enumerate(self.feeds):
            ledger = feed.ledger
            for reason, count in self.batcher.rejected[number].items():
                ledger.packets.reject(reason, count)
            ledger.packets.accepted = ledger.packets.read - sum(ledger.packets.rejected.values())
            ledger.packets.lost, ledger.packets.reordered = self.batcher.loss(number)
            ledger.columns.decoded = self.batcher.decoded[number]
            for reason, count in self.batcher.dropped[number].items():
                ledger.columns.drop(reason, count)
            ledger.points = self.points(number)
        if self.job.strict:
            self._refuse_rejected()
        for note in (*accounts.late_notes(self), *self.clocks.notes()):
            self.warn(note)
        # A later message may be the first without stamps.
        self._refuse_untimed()
        for sensor, feed in zip(self.setup.sensors, self.feeds, strict=True):
            if sensor.rig is not None and not sensor.rig.optional and not feed.ledger.packets.read:
                raise absent(sensor, self.job.wishes.rig)
        if self.info is None and (names := self._timescales()):
            # A date can lie so far from an uptime clock that no window was ever reached.
            self._check_dates(common_timescale(names))
        if self.table is None or not self.table.rows:
            raise NoScanError(accounts.why_nothing(self))

    def points(self, number: int) -> accounts.PointCounts:
        """What became of the pixels of a sensor so far."""
        return self._work.points(number)

    def _refuse_rejected(self) -> None:
        for number, sensor in enumerate(self.setup.sensors):
            rejected = self.feeds[number].ledger.packets.rejected | self.batcher.rejected[number]
            for reason, count in rejected.items():
                raise PacketError(
                    f"sensor {sensor.name}: {count} packet(s) rejected as {reason} while --strict "
                    "was given; leave it out to count them and go on"
                )

    def tell_of_passed(self) -> None:
        """Warn of messages that were to pass through and could not."""
        for topic, counts in self.passed.counts.items():
            if self.passed.has_room and (other := counts.dropped.get("no_place")):
                text = f"{topic}: {other} message(s) dropped: a bag of the other ROS has no place"
                self.warn(Note("other_ros", "", text))
            if other := counts.dropped.get("other_clock"):
                text = f"{topic}: {other} message(s) dropped: their clock is not that of the scans"
                self.warn(Note("imu_clock", "", text))

    def warn(self, note: Note) -> None:
        """Note a warning; with --strict it is an error."""
        if self.job.strict and note.code != accounts.CLOUDS:
            raise RecordingError(f"{note.message} ({note.code}, an error because of --strict)")
        self._notes.append(note)

    @property
    def notes(self) -> Sequence[Note]:
        """Warnings so far."""
        return self._notes

    @property
    def begin_ns(self) -> int | None:
        """Arrival of the first packet of any sensor, as far as they were seen at first."""
        spans = self.setup.sampler.span_ns
        kinds = [kind for sensor in self.setup.sensors for kind in sensor.found.kinds]
        return min((spans[kind][0] for kind in kinds if kind in spans), default=None)

    @property
    def elapsed_s(self) -> tuple[float, float]:
        """Wall and CPU time since the start."""
        wall_s, cpu_s = self._started_s
        return time.perf_counter() - wall_s, time.process_time() - cpu_s

    @property
    def recorded_s(self) -> float:
        """Length of what was read, by the recorder's clock."""
        if self._hosts_ns is None:
            return 0.0
        return (self._hosts_ns[1] - self._hosts_ns[0]) / NS_PER_S

    @contextlib.contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        began_s = time.perf_counter()
        try:
            yield
        finally:
            spent_s = time.perf_counter() - began_s
            setattr(self.stages, stage, getattr(self.stages, stage) + spent_s)
