"""Calibration of a rig: the guess, the recording, the refined rig file."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import replace
from datetime import date
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TypedDict, cast

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.discovery.discover import Discovery
from mlbatch.discovery.gravity import ups, vertical_of
from mlbatch.errors import ExportError, NoScanError, RecordingError, RigError, UsageError
from mlbatch.frames.transforms import compose, inverse, rpy_deg
from mlbatch.motion.gravity import standing_gravity, tilt_deg
from mlbatch.motion.registration import ORIGIN, Pose
from mlbatch.motion.se3 import exp_rotation
from mlbatch.pipeline.conversion import Conversion, Progress
from mlbatch.pipeline.imu_poses import ImuStreams
from mlbatch.pipeline.job import Job
from mlbatch.poses.calibration import (
    MOST_OFF_DEG,
    MOST_OFF_M,
    MS_PER_S,
    STAGES,
    Calibration,
    LidarPose,
    Undetermined,
    by_motion,
    calibrated,
    imu_note,
    known_by_motion,
    motion_poses,
    numbers,
    rounded,
)
from mlbatch.poses.from_motion import (
    MotionPoses,
    MotionWindow,
    contradiction,
    poses_from_motion,
)
from mlbatch.poses.places import LEAST_RANGE_M, MOST_RANGE_M, Places, places_of
from mlbatch.poses.solve import Cloud, State
from mlbatch.poses.turning import (
    ImuRotation,
    gyroscope_turns,
    imu_rotation,
    refused_imu,
    turns_too_little,
)
from mlbatch.python.options import (
    Documents,
    Moment,
    Names,
    Paths,
    ScanOptions,
    recordings_of,
    session_job,
    window_job,
)
from mlbatch.rig.rig import Rig, RigSensor, UnknownExtrinsics, read_rig
from mlbatch.rig.write import write_rig
from mlbatch.types import Scan
from mlbatch.units import NS_PER_MS, NS_PER_S
from mlbatch.writers.atomic import check_name

# Windows in which a machine moves evenly, Hz.
_RATE = 10
# A delay that moves a window by a part of itself, s.
_LATE_S = 0.005
# Windows that motion is measured in for IMUs and delays; where poses begin with it, in all.
_MOST_TURNS = 300
# The ground is rarely more level.
_LEVEL_DEG = 2.0


class CalibrateOptions(TypedDict, total=False):
    """Options that select recordings, lidars and times, with the names of `mlbatch calibrate`."""

    metadata: Documents | None
    only: Names | None
    clock: str
    align_clocks: bool
    start: Moment | None
    end: Moment | None


def calibrate_job(
    recordings: Paths | tuple[Paths, ...],
    rig: Path,
    options: CalibrateOptions,
    *,
    from_motion: bool = False,
    shown: Callable[[str], str] = str,
) -> Job:
    """The job whose scans a calibration reads; shown: the name of an option in errors."""
    if not from_motion:
        _refuse_unknown(rig, recordings_of(recordings))
    more = {"rig": rig, "identity_extrinsics": from_motion, "rate": _RATE}
    values = cast(ScanOptions, {**options, **more})
    job = window_job(session_job(recordings, values, shown), values, shown)
    # It checks nothing that a calibration does not measure.
    return replace(job, min_range_m=LEAST_RANGE_M, max_range_m=MOST_RANGE_M, checks_poses=False)


def _refuse_unknown(rig: Path, recordings: Sequence[Path]) -> None:
    for sensor in read_rig(rig, recordings).sensors:
        if isinstance(sensor.extrinsics, UnknownExtrinsics):
            raise RigError(
                f"{sensor.extrinsics.place}: expected a guess of the pose of {sensor.name}, within "
                f"{MOST_OFF_DEG:g} degrees and {MOST_OFF_M:g} m, found unknown; give translation_m "
                "and rotation_rpy_deg as a tape measure shows them, or --from-motion"
            )


def calibrate(
    job: Job,
    *,
    time_offset: bool = False,
    from_motion: bool = False,
    progress: Progress | None = None,
) -> Calibration:
    """Refine the poses of the rig of a job; MlbatchError where they are not determined.

    from_motion: begin with poses by the motion of each lidar; where the lidars share no surfaces
    that determine their poses, these are the result.
    """
    if time_offset and job.align_clocks_to:
        raise UsageError(
            "--time-offset: expected clocks as recorded, whose offsets a rig can keep, found "
            "--align-clocks, which aligns them anew in each run; leave one out"
        )
    run = Conversion(job)
    streams = ImuStreams(run.sensors)
    run.imu_users.append(streams.add)
    names = [sensor.name for sensor in run.sensors]
    if len(names) < 2:
        raise UsageError(
            f"calibrate: expected two lidars or more, found {names[0]} alone; give the recordings "
            "of all, and a rig with all of them"
        )
    level = _level(run.session.setup, names[0])
    found, motion = _calibrated(
        run, names, time_offset=time_offset, from_motion=from_motion, progress=progress
    )
    return replace(found, level=level, imus=tuple(_imus(run, streams, found, motion, progress)))


def _imus(
    run: Conversion,
    streams: ImuStreams,
    found: Calibration,
    motion: MotionPoses | None,
    progress: Progress | None,
) -> Iterator[ImuRotation]:
    """How the IMUs of a recording lie; motion: of the lidars, measured here where it is None."""
    frames = run.session.setup.frames()
    for key, stamp_ns, rate in streams.rates():
        turns = gyroscope_turns(stamp_ns, rate)
        stated: F64Array | None
        if isinstance(key, int):
            name = f"the IMU of {run.sensors[key].name}"
            stated = run.sensors[key].lidar.sensor_from_imu()
            if stated is not None:
                stated = compose(found.lidars[key].body_from_sensor, stated)
        else:
            name, stated = key, frames.get(streams.frame_of[key].lstrip("/"))
        if refusal := turns_too_little(turns, name):
            yield refused_imu(name, refusal)
            continue
        if motion is None:
            poses = [run.session.setup.sensors[0].pose.body_from_sensor]
            again, names = Conversion(run.job), [found.lidars[0].name]
            motion = _motion(again, poses, names, progress, _MOST_TURNS)
        seen, first = motion.twist[0, :, 3:], found.lidars[0].body_from_sensor[:3, :3]
        known = None if stated is None else stated[:3, :3]
        yield imu_rotation(seen, motion.middle_ns, turns, name, first, known)


def _level(setup: Discovery, first: str) -> str:
    """Note on the tilt of the first lidar, whose pose is taken as it is, by its IMU; or ""."""
    vertical = vertical_of(setup.frame_id)
    for sensor, up in ups(setup.sampler, setup.router, setup.sensors, standing_gravity):
        tilted_deg = tilt_deg(up, np.array(vertical))
        if sensor.name != first or tilted_deg < _LEVEL_DEG:
            continue
        across = np.cross(up, vertical)
        across *= np.deg2rad(tilted_deg) / max(float(np.linalg.norm(across)), 1e-9)
        levelled = sensor.pose.body_from_sensor.copy()
        levelled[:3, :3] = exp_rotation(across[None])[0] @ levelled[:3, :3]
        angles = ", ".join(f"{round(angle, 1) + 0.0:.1f}" for angle in rpy_deg(levelled))
        return (
            f"{first}: its IMU finds the vertical {tilted_deg:.1f} degrees off with this pose, "
            "which all others are relative to; where the machine stood level in the first "
            f"second, rotation_rpy_deg: [{angles}] makes it level"
        )
    return ""


def _calibrated(
    run: Conversion,
    names: Sequence[str],
    *,
    time_offset: bool,
    from_motion: bool,
    progress: Progress | None,
) -> tuple[Calibration, MotionPoses | None]:
    job = run.job
    poses = [sensor.pose.body_from_sensor for sensor in run.session.setup.sensors]
    zeros = np.zeros(len(names))
    if not (from_motion or time_offset):
        return calibrated(_places(run, progress), names, poses), None
    most = None if from_motion else _MOST_TURNS
    motion = _motion(run, poses, names, progress, most)
    offset_s = -np.nan_to_num([pose.late_s for pose in motion.poses]) if time_offset else zeros
    if np.abs(offset_s).max() > _LATE_S:
        # Windows with the same motion of all lidars.
        offset_ns = {name: round(s * NS_PER_S) for name, s in zip(names, offset_s, strict=True)}
        job = replace(job, selection=replace(job.selection, offset_ns=offset_ns))
        motion = _motion(Conversion(job), poses, names, progress, most)
    else:
        offset_s = zeros
    if from_motion and motion.refusal:
        raise RecordingError(f"calibrate: {motion.refusal}")
    moved = motion_poses(poses[0], motion)
    by_turns = State.start(len(names), 0)
    by_turns.corrections = [
        Pose(change[:3, :3], change[:3, 3])
        for change in (compose(new, inverse(old)) for new, old in zip(moved, poses, strict=True))
    ]
    if time_offset:
        by_turns.delay_s = -np.nan_to_num([pose.late_s for pose in motion.poses])
    guess = by_turns if from_motion else replace(by_turns, corrections=[ORIGIN] * len(names))
    places = _places(Conversion(job), progress)
    refined = partial(calibrated, places, names, poses, delays=time_offset, guess=guess)
    try:
        found = refined()
    except Undetermined:
        if from_motion and not (time_offset or motion.undetermined):
            return by_motion(names, moved, motion, places.windows), motion
        known = known_by_motion(poses[0], motion, moved, by_turns)
        try:
            found = refined(known=known)
        except Undetermined as err:
            if time_offset:
                raise
            # Each ends with the same remedy.
            words = [direction.partition("; ") for direction in motion.undetermined]
            raise Undetermined(
                "calibrate: expected surfaces in common and motion that fix the poses, found "
                f"neither: {'; '.join(word for word, _, _ in words)}; {words[-1][2]}"
            ) from err
    lidars = zip(found.lidars, offset_s.tolist(), strict=True)
    found = replace(
        found,
        lidars=tuple(replace(one, delay_ms=one.delay_ms + MS_PER_S * s) for one, s in lidars),
    )
    if not from_motion:
        return found, motion
    back = inverse(found.lidars[0].body_from_sensor)
    relative = [compose(back, lidar.body_from_sensor) for lidar in found.lidars]
    if wrong := contradiction(motion, [Pose(own[:3, :3], own[:3, 3]) for own in relative], names):
        raise RecordingError(f"calibrate: {wrong}")
    return found, motion


def _motion(
    run: Conversion,
    poses: Sequence[F64Array],
    names: Sequence[str],
    progress: Progress | None,
    most: int | None,
) -> MotionPoses:
    """The motion of some lidars, the first ones of a run, in all or `most` windows."""
    STAGES.info("reading for the motion of %s", ", ".join(names))
    with contextlib.closing(_scans(run, progress)) as scans:
        return poses_from_motion(_motion_windows(islice(scans, most), poses), names)


def _places(run: Conversion, progress: Progress | None) -> Places:
    """The places of a run; none where it has no whole window."""
    lidars = len(run.sensors)
    STAGES.info("reading for places that several lidars see")
    try:
        with contextlib.closing(_scans(run, progress)) as scans:
            return places_of(scans, lidars)
    except NoScanError:
        # Its remedies are for outputs.
        return Places([], 0, [0] * lidars)


def _motion_windows(scans: Iterable[Scan], poses: Sequence[F64Array]) -> Iterator[MotionWindow]:
    """The points of each lidar as it measured them; poses: (4, 4) that they were converted with."""
    for scan in scans:
        middle_ns = (scan.start_ns + scan.end_ns) // 2
        time_s = (scan.time_ns.astype(np.int64) + (scan.start_ns - middle_ns)) / NS_PER_S
        clouds = []
        for lidar, pose in enumerate(poses):
            rows = scan.lidar_id == lidar
            off_m = scan.xyz[rows].astype(np.float64) - pose[:3, 3]
            clouds.append(Cloud(lidar, np.matmul(off_m, pose[:3, :3]), time_s[rows]))
        yield MotionWindow(scan.start_ns, scan.end_ns, clouds)


def _scans(run: Conversion, progress: Progress | None) -> Generator[Scan, None, None]:
    for scan, _ in run.scans(progress):
        yield scan


def rig_text(job: Job, found: Calibration, folder: Path, on: date) -> str:
    """The rig of a job with refined poses, for a file in a folder; on: the day in its comments.

    All other keys are those of the guess.
    """
    guess = _rig_path(job)
    rig = read_rig(guess, job.recordings)
    lidars = {lidar.name: lidar for lidar in found.lidars}
    sensors = [
        _refined(sensor, lidars[sensor.name], job) if sensor.name in lidars else sensor
        for sensor in rig.sensors
    ]
    source = ", ".join(path.name for path in job.recordings)
    notes = {
        lidar.name: _of_first(rig.sensors, lidar.name, guess.name)
        if lidar.is_fixed
        else f"extrinsics by mlbatch calibrate, {on.isoformat()}, from {source}; standard "
        f"deviations {_deviations(lidar)} (x, y, z of the body)"
        for lidar in found.lidars
    }
    notes[found.lidars[0].name] += "".join(
        f"; {imu_note(imu)}" for imu in found.imus if not imu.refusal
    )
    refined: Rig = replace(rig, sensors=tuple(sensors))
    return write_rig(refined, folder, notes)


def _of_first(sensors: Sequence[RigSensor], name: str, guess: str) -> str:
    """Where the first lidar is: the only one that is not measured."""
    is_known = any(
        one.name == name and not isinstance(one.extrinsics, UnknownExtrinsics) for one in sensors
    )
    origin = f"as in {guess}" if is_known else f"the origin of the body, as {guess} has no pose"
    return f"extrinsics: {origin}; the others are relative to it"


def _rig_path(job: Job) -> Path:
    if job.selection.rig is None:
        raise UsageError(
            "--rig: expected a rig file with a guess of each pose, found none; write one with "
            "`mlbatch inspect RECORDING --write-rig rig.yaml` and fill it in"
        )
    return job.selection.rig


def _refined(sensor: RigSensor, lidar: LidarPose, job: Job) -> RigSensor:
    """A sensor of the rig with what was found."""
    if lidar.is_fixed and not isinstance(sensor.extrinsics, UnknownExtrinsics):
        return sensor
    delay_ns = round(lidar.delay_ms * NS_PER_MS)
    clock = "host" if delay_ns and job.selection.host_clock else sensor.clock
    return replace(
        sensor,
        extrinsics=rounded(lidar.body_from_sensor),
        extrinsics_files=(),
        offset_ns=sensor.offset_ns + delay_ns,
        clock=clock,
    )


def _deviations(lidar: LidarPose) -> str:
    sigma_mm, sigma_deg = lidar.sigma_mm.tolist(), lidar.sigma_deg.tolist()
    return f"{numbers(sigma_mm, 1)} mm, {numbers(sigma_deg, 3)} degrees"


def check_output(path: Path, *, overwrite: bool) -> None:
    """Raise ExportError if a rig file cannot be written to a path."""
    check_name(path)
    if path.is_dir():
        raise ExportError(f"{path}: expected a file for the rig, found a folder; add a name")
    if path.exists() and not overwrite:
        raise ExportError(
            f"{path}: expected a new rig file, found an existing one; choose another name or "
            "--overwrite"
        )
