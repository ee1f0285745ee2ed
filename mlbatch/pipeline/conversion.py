"""The main loop: columns of all sensors by timestamp, cut at the bounds of the grid."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from mlbatch.batching.batcher import SLACK_NS, Batcher
from mlbatch.batching.grid import Grid
from mlbatch.batching.merge import ColumnMerge
from mlbatch.batching.windows import OWN, Policy
from mlbatch.clocks.host_offset import remedies
from mlbatch.clocks.timescale import common_timescale
from mlbatch.decode.decoder import Decoder
from mlbatch.decode.groups import Source
from mlbatch.discovery.types import OUTPUT, Note
from mlbatch.errors import NoScanError, PacketError, RecordingError, UsageError
from mlbatch.pipeline import run_report
from mlbatch.pipeline.decode_pool import DecodePool, DecodeTask
from mlbatch.pipeline.job import DEFAULT_RATE, Job, TimeSegment
from mlbatch.pipeline.passthrough import ImuQueue, MessageQueue
from mlbatch.pipeline.sensor import Sensor
from mlbatch.pipeline.session import Session
from mlbatch.reports.poses import NOT_ASKED, ONE_LIDAR, PoseFigures
from mlbatch.reports.report import ACCEPTED_WARNINGS
from mlbatch.reports.scan_table import ScanTable
from mlbatch.types import (
    BYTE_INTENSITY,
    IMU,
    MESSAGE_ENCODINGS,
    ImuSamples,
    Message,
    RunInfo,
    Scan,
    SensorInfo,
    Topic,
    Window,
    WindowColumns,
)
from mlbatch.units import NS_PER_MS, NS_PER_S, rate_text

if TYPE_CHECKING:
    from mlbatch.batching.fusion import SweepFusion
    from mlbatch.batching.sweeps import SweepCutter
    from mlbatch.pipeline.deskew import ConstantVelocity, Deskew
    from mlbatch.pipeline.pose_check import PoseCheck

# Called with the bytes read so far, the bytes of all recordings, and the scans so far.
Progress = Callable[[int, int, int], None]
Item = TypeVar("Item")
# First ring index of a sensor that is still needed, to be batched or decoded; None: none.
PacketUser = Callable[[int], int | None]
# Takes samples of IMUs and messages, as they are read.
ImuUser = Callable[[Iterable[ImuSamples], Iterable[Message]], None]
# Timescales on which messages of an IMU are comparable with scans.
_EPOCH_SCALES = ("utc", "tai")


@dataclass(slots=True)
class Stages:
    """Seconds spent in each stage."""

    read_s: float = 0.0
    decode_s: float = 0.0
    merge_s: float = 0.0  # ingest and batching, with reading
    write_s: float = 0.0
    _started_s: tuple[float, float] = field(
        default_factory=lambda: (time.perf_counter(), time.process_time())
    )

    @property
    def elapsed_s(self) -> tuple[float, float]:
        """Wall and CPU time since the start."""
        wall_s, cpu_s = self._started_s
        return time.perf_counter() - wall_s, time.process_time() - cpu_s

    def each(self, stage: str, items: Iterator[Item]) -> Iterator[Item]:
        """Yield the items; the time to make them is added to a stage."""
        while True:
            began_s = time.perf_counter()
            try:
                item = next(items)
            except StopIteration:
                return
            finally:
                setattr(self, stage, getattr(self, stage) + time.perf_counter() - began_s)
            yield item


class SkippedWindow(NamedTuple):
    """A window with columns that gives no scan (`--drop-incomplete`)."""

    end_ns: int


class Conversion:
    """One run: `windows`, `tasks` or `scans` drive it, `close` ends it.

    notes: warnings so far; info, table: None before the first window; poses: known once closed;
    dropped_incomplete: windows left out by `--drop-incomplete`; notes_before_points: number of
    warnings that precede those about points; users: of raw packets; imu_users: of samples of IMUs.
    """

    def __init__(self, job: Job, buffers: int = 1, progress: Progress | None = None) -> None:
        """buffers: number of scans of a decode worker that are valid at a time.

        progress: of the pass that `--align-clocks` makes here.
        """
        self.stages = Stages()
        self.notes: list[Note] = []
        self.job = job
        self.session = Session(job, progress)
        self.sensors: Sequence[Sensor] = self.session.sensors
        rig = self.session.setup.rig
        rate = job.rate or (rig.rate if rig is not None else None) or DEFAULT_RATE
        self.grid = Grid(rate, job.slices)
        paces = [sensor.pace() for sensor in self.sensors]
        merge = ColumnMerge([pace.positions for pace in paces])
        output = self.session.setup.output
        if output is not None and job.layout == "organized":
            raise UsageError(
                f"--layout organized: expected raw packets, found {output.path}, an output of "
                "mlbatch convert, which does not have the shots without a return; give the "
                "recording that was converted"
            )
        self.batcher = Batcher(
            self.grid,
            self.session.ingest.intakes,
            # Sweeps may begin or end in partial windows.
            Policy(
                job.max_wait_ns,
                job.keep_partial or job.is_fused,
                job.start,
                job.end,
                None if output is None or output.has_partial else output.coverage,
                # Of a part of a session, other parts may have whole windows.
                job.shard is None and job.segment == TimeSegment(),
            ),
            paces,
            merge,
        )
        self.users: list[PacketUser] = [self.batcher.oldest_ring_index]
        self.fusion: SweepFusion | None = None
        if job.is_fused:
            # Not loaded for windows.
            from mlbatch.batching.fusion import SweepFusion

            cutters = [sweep_cutter(sensor) for sensor in self.sensors]
            self.fusion = SweepFusion(job.batching, cutters, merge)
            self.users.append(self.fusion.oldest_ring_index)
        # What is forwarded in addition to scans.
        self.imu = ImuQueue(
            [sensor.ledger.imu_samples for sensor in self.sensors],
            [sensor.clock.imu_offset_ns for sensor in self.sensors],
            has_place=IMU in job.extras,
        )
        encodings = MESSAGE_ENCODINGS & job.extras
        self.messages = MessageQueue(job.passed, encodings, job.segment.begin_ns)
        self.messages.refuse_unknown(self.session.recordings)
        self.info: RunInfo | None = None
        self.table: ScanTable | None = None
        self.dropped_incomplete = 0
        self.notes_before_points = 0
        self._plain_decoder: Decoder | None = None
        self.deskew: Deskew | ConstantVelocity | None = None
        self.imu_users: list[ImuUser] = []
        if job.deskew:
            from mlbatch.pipeline.deskew import mover_of

            self.deskew = mover_of(self)
            self.users.append(self.deskew.oldest_ring_index)
            if self.deskew.source is not None:
                self.imu_users.append(self.deskew.source.add)
        self.poses = PoseFigures(ONE_LIDAR if job.checks_poses else NOT_ASKED)
        self.pose_check = self._new_pose_check()
        self._buffers = buffers
        self._pool: DecodePool | None = None
        if job.max_wait_ns is None:
            self.warn(Note("max_wait", "", "--max-wait inf: memory grows while a sensor is silent"))
        elif len(self.sensors) > 1:
            self._warn_of_long_messages(job.max_wait_ns)
        for note in self.session.setup.notes:
            self.warn(note)

    def _warn_of_long_messages(self, max_wait_ns: int) -> None:
        """Warn where a sensor counts as silent between two of its messages."""
        for sensor in self.sensors:
            message_ns = sensor.message_ns(self.session.setup.sampler.table)
            if message_ns and message_ns + SLACK_NS > max_wait_ns:
                length_s = message_ns / NS_PER_S
                text = (
                    f"--max-wait {max_wait_ns / NS_PER_S:g}: expected more than a message of "
                    f"{sensor.name}, which holds {length_s:.3g} s of its packets; it counts as "
                    f"silent until the next one, and other containers give other scans; "
                    f"give at least {math.ceil((message_ns + 2 * SLACK_NS) / NS_PER_MS) / 1e3:g}"
                )
                self.warn(Note("max_wait", sensor.name, text))

    def _new_pose_check(self) -> PoseCheck | None:
        """The object that compares what lidars see; None for one, and with `--no-pose-check`."""
        if not self.job.checks_poses or len(self.sensors) < 2:
            return None
        from mlbatch.pipeline.pose_check import PoseCheck

        return PoseCheck(self.sensors, self.job.slices, self.plain_scan)

    def topic_offset_ns(self, topic: Topic) -> int | None:
        """Scan clock minus receive time, as for messages of an IMU that are forwarded."""
        if self.messages.is_asked_for(topic):
            return self._scan_offset_ns()
        is_epoch = common_timescale(self._timescales()) in _EPOCH_SCALES
        return self._scan_offset_ns() if is_epoch else None

    def plain_scan(self, columns: WindowColumns, start_ns: int, end_ns: int) -> Scan:
        """Decode columns in the thread that batches: a dense scan with `column`, without figures.

        Its arrays are valid until the next one.
        """
        if self._plain_decoder is None:
            # There is a window, so that the clocks are known.
            info = self._run_info()._replace(layout="dense", sort="columns")
            sources = [sensor.source for sensor in self.sensors]
            extras = frozenset({"column"})
            self._plain_decoder = Decoder(info, sources, self.session.boxes_m, extras)
        return self._plain_decoder.scan(Window(0, 0, start_ns, end_ns, True, 0, columns))

    # -- the loop -----------------------------------------------------------------------------

    def windows(self, progress: Progress | None = None) -> Generator[Window, None, None]:
        """Yield the windows of the grid, in order, each once no more columns of it can come.

        Section 2.1 of Faitli et al. (2025): the columns of all sensors are taken by timestamp,
        smallest first, and cut at the bounds of an absolute grid.
        """
        self.messages.subscribe(self.session.recordings)
        if progress is not None:
            # A pass begins: that of `--align-clocks` came before.
            progress(0, self.session.size_bytes, 0)
        with contextlib.closing(self.session.packets()) as packets:
            for batch in self.stages.each("read_s", packets):
                # Steps 1 and 2: the sensor of each packet, the timestamps of its columns.
                ingested = self.session.ingest.columns(batch)
                for user in self.imu_users:
                    user(ingested.imu, batch.messages)
                for samples in ingested.imu:
                    self.imu.add(samples)
                self.messages.add(batch.messages)
                low_ns, _ = self.batcher.limits_ns
                if low_ns is not None:
                    # Otherwise all of it would wait for the first scan.
                    self.imu.drop_before(low_ns)
                    self.messages.drop_before(low_ns)
                self._refuse_rejected()
                # Steps 3 and 4: columns by timestamp; windows close behind the watermark.
                yield from self.batcher.push(ingested.accepted, batch.host_ns)
                if progress is not None:
                    scans = 0 if self.table is None else self.table.rows
                    progress(self.session.position_bytes, self.session.size_bytes, scans)
                if self.batcher.past_end and not self._awaits_poses():
                    break
                self.session.keep_from(self._oldest_ring_index())
        for note in self.session.refuse_apart():
            self.warn(note)
        # Step 5: end of input; no sensor is waited for.
        is_short = False
        for window in self.batcher.finish(self.session.last_host_ns):
            if self.batcher.gave_partial and not is_short:
                is_short = True
                text = (
                    f"no whole window of {float(NS_PER_S / self.grid.rate / NS_PER_MS):g} ms, "
                    "since the recording is shorter than two: its partial windows are written, as "
                    "by --keep-partial"
                )
                self.warn(Note("short", "", text))
            yield window

    def _awaits_poses(self) -> bool:
        """Whether windows before `--end` need poses that are recorded after it."""
        if self.deskew is None:
            return False
        return self.deskew.awaits(max(span[1] for span in self.batcher.spans_ns if span))

    def tasks(
        self, progress: Progress | None = None
    ) -> Generator[DecodeTask | SkippedWindow, None, None]:
        """Yield what is to be decoded, scan by scan; `close` has to follow the last.

        Each task may be given to any decode worker, by any thread, while the next are made.
        """
        with contextlib.closing(self.windows(progress)) as windows:
            for window in self.stages.each("merge_s", self._batches(windows)):
                pool = self._pool or self._begin()
                if self._is_too_incomplete(window):
                    yield SkippedWindow(window.end_ns)
                else:
                    yield from pool.tasks(window)

    def _batches(self, windows: Iterator[Window]) -> Iterator[Window]:
        """Yield what becomes a scan: windows, or the sets of sweeps in them, with their moves."""
        if self.pose_check is not None:
            windows = self._checked(windows, self.pose_check)
        batches = windows if self.fusion is None else self.fusion.sets(windows)
        if self.deskew is None:
            yield from batches
            return
        for window in batches:
            yield from self.deskew.push(window)
        yield from self.deskew.finish()

    @staticmethod
    def _checked(windows: Iterator[Window], check: PoseCheck) -> Iterator[Window]:
        for window in windows:
            check.add(window)
            yield window

    def scans(self, progress: Progress | None = None) -> Iterator[tuple[Scan, int | None]]:
        """Yield every scan and, with `--split`, the index of its sensor.

        Arrays of a scan are valid until the next.
        """
        with contextlib.closing(self.tasks(progress)) as tasks:
            for task in tasks:
                if isinstance(task, SkippedWindow):
                    continue
                began_s = time.perf_counter()
                scan = self.pool.workers[0].decode(task).scan
                self.stages.decode_s += time.perf_counter() - began_s
                self.account(scan)
                yield scan, task.only
        self.close()

    def _oldest_ring_index(self) -> int | None:
        """First ring index of any sensor that is still needed; None: none."""
        numbers = range(len(self.sensors))
        oldest = (user(number) for user in self.users for number in numbers)
        return min((index for index in oldest if index is not None), default=None)

    def _is_too_incomplete(self, window: Window) -> bool:
        """True if --drop-incomplete leaves a window out; its columns are counted."""
        share = self.job.drop_incomplete / 100
        # No comparison with an unknown fill is true.
        if not share or not bool((window.fill < share).any()):
            return False
        for sensor, own in zip(self.sensors, window.figures, strict=True):
            sensor.ledger.columns.drop("incomplete", own.columns)
        self.dropped_incomplete += 1
        return True

    # -- the first window ---------------------------------------------------------------------

    def _begin(self) -> DecodePool:
        """Settle what needs the clocks to be known: timescale, headers of scans, decoders."""
        names = self._timescales()
        shared = common_timescale(names)
        if len(set(names)) > 1:
            self.warn(Note("timescale", "", f"sensors differ in timescale: {', '.join(names)}"))
        self._check_dates(shared)
        self._check_limits()
        self._check_passed()
        info = self._run_info()
        self.info = info
        self.table = ScanTable(info, [sensor.columns_per_s for sensor in self.sensors])
        boxes_m = self.session.boxes_m
        job = self.job

        def decoder(sources: Sequence[Source], only: int | None) -> Decoder:
            return Decoder(
                *(info, sources, boxes_m, job.extras, only, self._buffers, job.record),
                own_times=job.batching_times == OWN,
            )

        self._pool = DecodePool(
            [sensor.source for sensor in self.sensors],
            decoder,
            workers=job.jobs,
            split=job.split,
            counts_clipped=BYTE_INTENSITY in job.extras,
        )
        self.users.append(self._pool.oldest_ring_index)
        return self._pool

    def _run_info(self) -> RunInfo:
        """The description that all scans share, once there is a window."""
        job, setup = self.job, self.session.setup
        sensors = tuple(
            SensorInfo(
                sensor.name,
                sensor.lidar.model,
                sensor.lidar.channels,
                sensor.lidar.returns,
                sensor.source.ring_base,
                sensor.body_from_sensor,
                sensor.lidar.has_reflectivity,
                sensor.lidar.sensor_from_imu(),
            )
            for sensor in self.sensors
        )
        # Of recorded messages, which are written, too.
        forwards = self.messages.is_asked(self.session.recordings)
        return RunInfo(
            sensors,
            setup.frame_id,
            rate_text(self.grid.rate),
            common_timescale(self._timescales()),
            job.slices,
            job.layout,
            job.sort,
            tuple(setup.frames().items()) if forwards else (),
            job.variants,
            self.batcher.t_init_ns,
        )

    @property
    def pool(self) -> DecodePool:
        """The decode workers; there are some from the first task on."""
        return self._pool or self._begin()

    def _timescales(self) -> list[str]:
        """Timescale of each sensor that gave a timestamp."""
        return [
            sensor.clock.timescale(*first)
            for sensor, first in zip(self.sensors, self.batcher.firsts, strict=True)
            if first is not None
        ]

    def _check_dates(self, shared: str) -> None:
        """Refuse dates on a clock without an epoch."""
        if self.job.limits_are_dates and shared not in ("utc", "tai"):
            raise UsageError(
                "--start/--end: expected seconds, since the sensors' clock has no date "
                f"(timescale {shared}), found a date; write +SECONDS after the first scan"
            )

    def _check_limits(self) -> None:
        """Refuse `--start` and `--end` that are no times of the recording."""
        if self.job.start is None and self.job.end is None:
            return
        # Not loaded for whole recordings.
        from mlbatch.pipeline.time_limits import refuse_outside

        firsts = [first[0] for first in self.batcher.firsts if first is not None]
        # Later segments begin where another one ended, and need not contain the limits.
        if firsts and self.job.segment.begin_ns is None:
            refuse_outside(self.job.start, self.job.end, min(firsts))

    def _check_passed(self) -> None:
        """Refuse `--pass` of topics on another clock than that of the scans."""
        if not self.job.passed:
            return
        offset_ns = self._scan_offset_ns()
        timed = all(sensor.clock.has_receive_times for sensor in self.sensors)
        line = f"clock: {{offset_s: {-offset_ns / NS_PER_S:.3f}}}"
        text = remedies(line, timed=timed, sensors=len(self.sensors))
        self.messages.check_clock(self.session.recordings, offset_ns, text)

    # -- accounting ---------------------------------------------------------------------------

    def account(self, scan: Scan, checksum: int | None = None, is_listed: bool = True) -> None:
        """Count a scan that is written; call in the order of the scans; see `ScanTable.add`."""
        for sensor, count in zip(self.sensors, scan.columns_per_sensor, strict=True):
            sensor.ledger.columns.written += count
        if self.table is not None:
            self.table.add(scan, checksum, is_listed)

    def passed_through(
        self, end_ns: int | None, most_bytes: float = math.inf
    ) -> list[ImuSamples | Message]:
        """IMU samples, then messages, before `end_ns` (None: all), each given once.

        most_bytes: of messages, before the rest is left for the next call.
        """
        limits_ns = self.batcher.limits_ns
        found: list[ImuSamples | Message] = []
        if self.imu.is_waiting:
            found += self.imu.drain_until(end_ns, limits_ns)
        if self.messages.waiting:
            offset_ns = self._clock_offset_ns()
            found += self.messages.drain_until(end_ns, limits_ns, offset_ns, most_bytes)
        return found

    def _clock_offset_ns(self) -> int | None:
        """Scan clock minus receive time; None where scans are not on an epoch clock."""
        if self.info is None or self.info.timescale not in _EPOCH_SCALES:
            return None
        return self._scan_offset_ns()

    def _scan_offset_ns(self) -> int:
        """Scan clock minus receive time, by the first packet of the first sensor that has one."""
        for sensor in self.sensors:
            offset_ns = self.batcher.host_offset_ns(sensor.index)
            if offset_ns is not None:
                return 0 if sensor.clock.by_host else offset_ns
        return 0

    def close(self) -> None:
        """Complete the ledgers; raise where the run has no valid result."""
        self._check_limits()
        for sensor in self.sensors:
            self._complete_ledger(sensor)
        self._refuse_rejected()
        if self.pose_check is not None:
            self.poses = self.pose_check.figures()
        for note in run_report.final_notes(self):
            self.warn(note)
        self.notes_before_points = len(self.notes)
        # A shard has a part of the points: their notes are made when all are merged.
        points: Iterable[Note] = ()
        if self.job.shard is None:
            where = ", ".join(map(str, self.job.recordings))
            counts = [(sensor.name, sensor.ledger.points) for sensor in self.sensors]
            run_report.refuse_all_removed(where, [one for _, one in counts])
            if self.table is not None:
                points = run_report.point_notes(counts, self.table.statistics(0))
        for note in (*points, *run_report.unassigned_notes(self), *run_report.clock_notes(self)):
            self.warn(note)
        # A later message may be the first without receive times.
        self.session.refuse_untimed()
        self.session.refuse_absent()
        if self.info is None and (names := self._timescales()):
            # A date may be so far from an uptime clock that no window was reached.
            self._check_dates(common_timescale(names))
        if self.table is None or not self.table.rows:
            raise NoScanError(run_report.why_no_scan(self))

    def _complete_ledger(self, sensor: Sensor) -> None:
        """Add what batching and decoding counted."""
        ledger = sensor.ledger
        for reason, count in self.batcher.rejected[sensor.index].items():
            ledger.packets.reject(reason, count)
        ledger.packets.accepted = ledger.packets.read - sum(ledger.packets.rejected.values())
        ledger.packets.lost, ledger.packets.reordered = self.batcher.loss(sensor.index)
        ledger.columns.decoded = self.batcher.decoded[sensor.index]
        for reason, count in self.batcher.dropped[sensor.index].items():
            ledger.columns.drop(reason, count)
        if self.fusion is not None:
            for reason, count in self.fusion.dropped[sensor.index].items():
                ledger.columns.drop(reason, count)
            ledger.columns.reused = self.fusion.reused[sensor.index]
        if self.deskew is not None:
            ledger.columns.drop("no_pose", self.deskew.dropped[sensor.index])
        if self._pool is not None:
            ledger.points = self._pool.points(sensor.index)

    def _refuse_rejected(self) -> None:
        """With --strict, raise PacketError if a packet was rejected."""
        if not self.job.strict:
            return
        for sensor in self.sensors:
            rejected = sensor.ledger.packets.rejected | self.batcher.rejected[sensor.index]
            for reason, count in rejected.items():
                raise PacketError(
                    f"sensor {sensor.name}: expected no rejected packet because of --strict, found "
                    f"{count} rejected as {reason}; leave --strict out to count them instead"
                )

    def warn(self, note: Note) -> None:
        """Add a warning; RecordingError with `--strict`."""
        if self.job.strict and note.code not in ACCEPTED_WARNINGS:
            raise RecordingError(f"{note.message} ({note.code}, an error because of --strict)")
        self.notes.append(note)


def sweep_cutter(sensor: Sensor) -> SweepCutter:
    """Return what cuts the columns of a sensor into sweeps."""
    from mlbatch.batching.sweeps import SweepCutter

    if sensor.detected.pose.source == OUTPUT:
        raise UsageError(
            f"sweeps of {sensor.name}: expected the positions of its rotor, found an output of "
            f"mlbatch convert ({sensor.lidar.calibration}), which has none; give the recording "
            "that was converted"
        )
    angles = sensor.lidar.beams.angle_rad
    return SweepCutter(sensor.index, None if angles is None else len(angles))
