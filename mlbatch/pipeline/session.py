"""The stages of a run, made from what was found and what is wanted."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.batching.grid import Grid
from mlbatch.batching.intake import Intake
from mlbatch.decode.decoder import Source
from mlbatch.decode.packet_ring import RawRing
from mlbatch.discovery.discover import Setup
from mlbatch.discovery.extrinsics import Mounted
from mlbatch.pipeline.ingest import Feed
from mlbatch.pipeline.job import Job
from mlbatch.types import RunInfo, SensorInfo
from mlbatch.units import rate_text

if TYPE_CHECKING:
    from mlbatch.faults.replay import FaultReplay


def feed_of(sensor: Mounted) -> Feed:
    """A sensor's ring and ledger."""
    lidar = sensor.found.lidar
    return Feed(lidar, RawRing(lidar.packet_size, lidar.records))


def intake_of(sensor: Mounted, *, host_clock: bool) -> Intake:
    """The door of a sensor, with what the rig says of its clock."""
    lidar = sensor.found.lidar
    return Intake(
        sensor.name,
        host_clock=host_clock,
        offset_ns=sensor.offset_ns,
        modulus=lidar.sequence_modulus,
        packet_ns=lidar.columns_per_packet * lidar.column_period_ns,
    )


def source_of(sensor: Mounted, feed: Feed, ring_base: int, job: Job) -> Source:
    """What the decoder has to know of a sensor."""
    rig = sensor.rig
    low = [job.min_range_m, 0.0 if rig is None else rig.min_range_m or 0.0]
    high = [job.max_range_m, float("inf") if rig is None else rig.max_range_m or float("inf")]
    return Source(
        feed.lidar,
        feed.ring,
        sensor.body_from_sensor,
        ring_base,
        max(low),
        min(high),
        job.keep_repeated,
    )


def replay_of(setup: Setup, job: Job, begin_ns: int | None) -> FaultReplay | None:
    """The replay of the faults wanted; begin_ns: arrival of the first packet, where it is known."""
    if not job.faults:
        return None
    # Not loaded for runs without faults.
    from mlbatch.faults.replay import FaultReplay

    replay = FaultReplay(job.faults, job.fault_seed, [one.name for one in setup.sensors])
    # Not the first packet that is read: bags hold many in a message, of each sensor in turn.
    replay.begin_ns = begin_ns if job.fault_begin_ns is None else job.fault_begin_ns
    return replay


def boxes_of(setup: Setup, job: Job) -> F64Array:
    """Boxes to leave out, of rig and job: (k, 6), m, body frame."""
    boxes_m = np.array(job.boxes_m, np.float64).reshape(-1, 6)
    if setup.rig is None:
        return boxes_m
    return np.concatenate([setup.rig.exclude_boxes_m, boxes_m])


def run_info(setup: Setup, job: Job, grid: Grid, scale: str) -> RunInfo:
    """What is the same for all scans; scale: their timescale."""
    sensors, ring_base = [], 0
    for sensor in setup.sensors:
        lidar = sensor.found.lidar
        sensors.append(
            SensorInfo(
                sensor.name,
                lidar.model,
                lidar.channels,
                lidar.returns,
                0 if job.split else ring_base,
                sensor.body_from_sensor,
            )
        )
        ring_base += max(lidar.channels, int(lidar.channel.max()) + 1)
    return RunInfo(
        tuple(sensors), setup.frame_id, rate_text(grid.rate), scale, job.slices, job.layout
    )
