"""A sensor of a run: one object from its packets to its accounting."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from mlbatch.arrays import F64Array, I64Array
from mlbatch.batching.fill import Pace
from mlbatch.batching.intake import Intake
from mlbatch.clocks.timescale import timescale
from mlbatch.clocks.watch import ClockWatch
from mlbatch.decode.groups import Source
from mlbatch.decode.packet_ring import PacketRing
from mlbatch.discovery.discover import Discovery
from mlbatch.discovery.sampler import clock_watch
from mlbatch.discovery.types import DetectedSensor
from mlbatch.lidar.interface import Lidar
from mlbatch.native.arena import PacketArena
from mlbatch.pipeline.job import Job
from mlbatch.reports.ledger import SensorLedger
from mlbatch.rig.rig import RigSensor
from mlbatch.types import StreamTable
from mlbatch.units import NS_PER_S

if TYPE_CHECKING:
    from mlbatch.clocks.align import ClockMap


@dataclass(slots=True)
class SensorClock:
    """How the timestamps of a sensor become timestamps of the common clock."""

    by_host: bool  # receive times replace the sensor's timestamps
    offset_ns: int  # the rig's correction, added to the sensor's timestamps
    has_receive_times: bool  # False where packets share the log time of a message
    watch: ClockWatch  # measures timestamp minus receive time
    map: ClockMap | None = None  # of `--align-clocks`, once fitted
    stated: str = ""  # timescale that an output of `convert` has; "": by receive times

    @property
    def source(self) -> str:
        """`host` or `sensor`, as in the report."""
        return "host" if self.by_host else "sensor"

    @property
    def imu_offset_ns(self) -> int:
        """Correction of IMU timestamps; receive times need none."""
        return 0 if self.by_host else self.offset_ns

    def timescale(self, stamp_ns: int, host_ns: int) -> str:
        """Timescale of the timestamps as they are batched; host_ns: receive time of stamp_ns."""
        return self.stated or timescale(host_ns if self.by_host else stamp_ns, host_ns)


@dataclass(slots=True)
class Sensor:
    """A lidar of this run: its decoder, pose, clock, packets and counters."""

    index: int  # `lidar_id` in outputs
    detected: DetectedSensor  # result of discovery
    clock: SensorClock
    source: Source  # input of decoding, with its raw packets until their window closes
    columns_per_s: float | None  # nominal rate, None if unknown
    ledger: SensorLedger = field(default_factory=SensorLedger)

    @property
    def name(self) -> str:
        """Name in all outputs."""
        return self.detected.name

    @property
    def lidar(self) -> Lidar:
        """Decoder of its packets."""
        return self.detected.lidar

    @property
    def body_from_sensor(self) -> F64Array:
        """Extrinsics, (4, 4) float64, m."""
        return self.detected.pose.body_from_sensor

    @property
    def rig(self) -> RigSensor | None:
        """Entry in the rig file, None without a rig."""
        return self.detected.rig

    def message_ns(self, table: StreamTable) -> float:
        """Longest time of a message of several packets of this sensor, ns; 0: single ones."""
        lidar = self.lidar
        per_s = lidar.columns_per_s
        packet_ns = NS_PER_S * lidar.columns_per_packet / per_s if per_s else 0.0
        streams = self.detected.streams
        spans = [table.message_ns.get(stream, 0) for stream in streams]
        most = max((table.most_packets.get(stream, 0) for stream in streams), default=0)
        return max(*spans, 0, most * packet_ns if most > 1 else 0)

    def intake(self, *, host_clock: bool = False) -> Intake:
        """A new intake of the batcher for this sensor; host_clock: whatever its clock is."""
        lidar = self.lidar
        by_host = host_clock or self.clock.by_host
        watches = self.clock.has_receive_times and not by_host
        return Intake(
            self.name,
            self._column_offsets,
            lidar.reader,
            host_clock=by_host,
            offset_ns=self.clock.offset_ns,
            modulus=lidar.sequence_modulus,
            packet_ns=lidar.columns_per_packet * lidar.column_period_ns,
            has_receive_times=self.clock.has_receive_times,
            # Receive times show nothing of a sensor's clock.
            finds_jumps=not by_host,
            # Delays cannot be measured where packets share the log time of a message.
            watch=self.clock.watch if watches else None,
        )

    def clock_intake(self, watch: ClockWatch | None = None) -> Intake:
        """A new intake for a pass that only watches the clock, that of the run or another."""
        if watch is None and self.clock.has_receive_times:
            watch = self.clock.watch
        return Intake(
            self.name, self._column_offsets, self.lidar.reader, takes_all=True, watch=watch
        )

    def pace(self) -> Pace:
        """Columns that the sensor sends without loss."""
        lidar = self.lidar
        angles = lidar.beams.angle_rad
        positions = None if angles is None else len(angles)
        return Pace(lidar.columns_per_s, lidar.lit_share, positions)

    def unread(self, arena: PacketArena) -> Sensor:
        """The same sensor with an empty ring and ledger, for a pass of its own."""
        source = replace(self.source, ring=new_ring(self.lidar, arena))
        return replace(self, source=source, ledger=SensorLedger())

    @property
    def _column_offsets(self) -> I64Array:
        """Ring indexes of the columns of a packet, relative to that of the packet: (C,)."""
        return self.source.ring.column_offsets(self.lidar.columns_per_packet)


def new_ring(lidar: Lidar, arena: PacketArena) -> PacketRing:
    """An empty ring for packets of a lidar."""
    return PacketRing(lidar.packet_size, lidar.records, arena)


def sensors_of(setup: Discovery, job: Job, arena: PacketArena) -> list[Sensor]:
    """The sensors of a session with empty rings and ledgers; arena: where packets are kept."""
    sampler = setup.sampler
    sensors: list[Sensor] = []
    ring_base = 0
    for found in setup.sensors:
        rig, lidar = found.rig, found.lidar
        least_m, most_m = (None, None) if rig is None else (rig.min_range_m, rig.max_range_m)
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
                source=Source(
                    lidar,
                    new_ring(lidar, arena),
                    found.pose.body_from_sensor,
                    0 if job.split else ring_base,
                    # The narrower of the ranges of job and rig.
                    max(job.min_range_m, least_m or 0.0),
                    min(job.max_range_m, most_m or math.inf),
                    job.keep_repeated,
                ),
                columns_per_s=sampler.columns_per_s(found),
            )
        )
        ring_base += max(lidar.channels, int(lidar.channel.max()) + 1)
    return sensors
