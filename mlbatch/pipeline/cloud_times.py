"""Times of decoded clouds as `inspect` checks them: sweeps of the first seconds, and the verdicts.

The check itself is `poses.point_times`; here are the clouds that it needs, and the keys of the rig
that read the times as they fit.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from mlbatch.arrays import F64Array, I64Array, U8Array
from mlbatch.discovery.discover import Discovery
from mlbatch.discovery.sampler import split_by_kind
from mlbatch.discovery.types import DetectedSensor
from mlbatch.poses.point_times import (
    DIFFERS,
    FITS,
    MOVED,
    OPEN,
    DelayFit,
    OrderFit,
    TimedLidar,
    Track,
    fit_delay,
    fit_order,
    track,
)
from mlbatch.poses.solve import Cloud
from mlbatch.ros.point_packets import HEAD
from mlbatch.ros.point_times import BACK, END, START
from mlbatch.types import CLOUDS, PacketBatch
from mlbatch.units import NS_PER_S

# Sweeps of a lidar that are kept, the last ones; points of each, about.
_SWEEPS = 60
_POINTS = 20_000
_FEWEST_POINTS = 500
_FARTHEST_M = 80.0
_MM_PER_M = 1000.0
_MS_PER_S = 1000.0
# Lengths of sweeps by their points: shots without a return at their ends are missing, s.
_SWEEP_ERROR_S = 0.0005
_SIGMAS = 4.0
# A delay is taken for a header at the other end of a sweep within so many standard deviations; with
# more uncertainty than this share of a sweep, or half of it off, both are named.
_NEAR_SIGMAS = 2.5
_RESOLVED = 0.024


@dataclass(frozen=True, slots=True)
class TimeFinding:
    """How the times of the points of a lidar fit; see `inspect --json`.

    order, delay: verdicts, and reasons where they are not decided; late_ms, sigma_ms: against
    `reference`; residuals in mm, as in `OrderFit` and `DelayFit`; set: what to write in the rig.
    """

    sensor: str
    order: str
    order_reason: str = ""
    order_residual_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    delay: str = ""
    delay_reason: str = ""
    reference: str = ""
    late_ms: float | None = None
    sigma_ms: float | None = None
    delay_residual_mm: tuple[float, float] = (0.0, 0.0)
    set: dict[str, str] = field(default_factory=dict)

    @property
    def is_open(self) -> bool:
        """Whether the keys are alternatives: a header at the other end of a sweep, or a delay."""
        return self.order == FITS and len(self.set) > 1

    def describe(self) -> str:
        """The finding as one line."""
        text = f"{self.sensor}: times of points within a sweep: {self._order()}"
        if self.delay:
            text += f"; against {self.reference}: {self._delay()}"
        if self.set:
            joined = ", or " if self.is_open else ", "
            keys = joined.join(f"{name}: {value}" for name, value in self.set.items())
            text += f"; if the poses are right, write in the rig: {keys}"
            if self.is_open:
                text += ", which the motion does not separate"
        return text

    def _order(self) -> str:
        read_mm, back_mm, once_mm = self.order_residual_mm
        figures = f"sweeps agree within {read_mm:.1f} mm, in the opposite order {back_mm:.1f} mm"
        if self.order == MOVED:
            return (
                "points fit as if all were measured at one time, so the driver has moved them "
                f"(sweeps agree within {once_mm:.1f} mm, with their times {read_mm:.1f} mm): "
                "record the points as measured"
            )
        if self.order == FITS:
            return f"the order fits ({figures})"
        if self.order == DIFFERS:
            return f"the opposite order fits better ({figures})"
        return f"not decided: {self.order_reason}"

    def _delay(self) -> str:
        read_mm, fit_mm = self.delay_residual_mm
        if self.delay == OPEN:
            known = "" if self.late_ms is None else f" ({self._late()})"
            return f"not decided: {self.delay_reason}{known}"
        if self.delay == FITS:
            return f"they fit ({self._late()}; surfaces agree within {fit_mm:.0f} mm)"
        word = "earlier" if self.late_ms is not None and self.late_ms > 0 else "later"
        return (
            f"points fit {self._late(signed=False)} {word} (surfaces agree within {fit_mm:.0f} mm "
            f"instead of {read_mm:.0f} mm)"
        )

    def _late(self, *, signed: bool = True) -> str:
        if self.late_ms is None or self.sigma_ms is None:
            return ""
        late_ms = self.late_ms if signed else abs(self.late_ms)
        word = " late" if signed else ""
        return f"{late_ms:.1f} ms{word}, standard deviation {self.sigma_ms:.1f} ms"


class CloudTimes:
    """Keeps sweeps of decoded clouds, and checks their times."""

    def __init__(self, discovery: Discovery) -> None:
        self._discovery = discovery
        self._lidars = [
            _Lidar(sensor)
            for sensor in discovery.sensors
            if sensor.lidar.model in CLOUDS and (sensor.rig is None or sensor.rig.epoch is None)
        ]

    def add(self, batch: PacketBatch) -> None:
        """Keep the points of a batch."""
        if not self._lidars:
            return
        for kind, index in split_by_kind(batch):
            for lidar in self._lidars:
                if kind in lidar.sensor.kinds:
                    begins = batch.start[index]
                    lidar.add(batch.data[begins[:, None] + np.arange(kind.size)])

    def findings(self) -> list[TimeFinding]:
        """The verdict on each lidar."""
        for lidar in self._lidars:
            lidar.close()
        lidars = [lidar for lidar in self._lidars if len(lidar.sweeps) > 2]
        sweeps = [tuple(lidar.sweeps) for lidar in lidars]
        tracks = list(map(track, sweeps))
        orders = list(map(fit_order, sweeps, tracks))
        reference = next(
            (
                number
                for number, (lidar, order) in enumerate(zip(lidars, orders, strict=True))
                if order.verdict in (FITS, DIFFERS) and lidar.sensor.pose.is_known
            ),
            None,
        )
        few = f"less than 3 sweeps with {_FEWEST_POINTS} points within {_FARTHEST_M:g} m"
        found = [
            TimeFinding(lidar.sensor.name, OPEN, few)
            for lidar in self._lidars
            if lidar not in lidars
        ]
        for number, (lidar, order) in enumerate(zip(lidars, orders, strict=True)):
            delay: DelayFit | None = None
            if reference not in (None, number) and len(lidars) > 1:
                delay = self._delay(lidars, orders, tracks, reference, number)
            elif reference is None and number and len(lidars) > 1:
                delay = DelayFit(OPEN, "the order within a sweep is not decided of any lidar")
            of = lidars[reference or 0]
            found.append(self._finding(lidar, order, of, delay))
        return found

    @staticmethod
    def _delay(
        lidars: Sequence[_Lidar],
        orders: Sequence[OrderFit],
        tracks: Sequence[Track],
        reference: int,
        number: int,
    ) -> DelayFit:
        if not lidars[number].sensor.pose.is_known:
            return DelayFit(OPEN, "its pose is not known")
        if orders[number].verdict not in (FITS, DIFFERS):
            return DelayFit(OPEN, "the order within its sweeps is not decided")
        timed = [
            TimedLidar(tuple(lidars[one].sweeps), orders[one].verdict == DIFFERS)
            for one in (reference, number)
        ]
        return fit_delay(timed[0], timed[1], tracks[reference], orders[reference].sweep_s)

    def _finding(
        self, lidar: _Lidar, order: OrderFit, reference: _Lidar, delay: DelayFit | None
    ) -> TimeFinding:
        known = delay is not None and delay.sigma_s > 0
        return TimeFinding(
            lidar.sensor.name,
            order.verdict,
            order.reason,
            (_mm(order.residual_m[0]), _mm(order.residual_m[1]), _mm(order.residual_m[2])),
            "" if delay is None else delay.verdict,
            "" if delay is None else delay.reason,
            "" if delay is None else reference.sensor.name,
            round(delay.late_s * _MS_PER_S, 3) if delay is not None and known else None,
            round(delay.sigma_s * _MS_PER_S, 3) if delay is not None and known else None,
            (0.0, 0.0) if delay is None else (_mm(delay.residual_m[0]), _mm(delay.residual_m[1])),
            self._keys(lidar, order, reference, delay),
        )

    def _keys(
        self, lidar: _Lidar, order: OrderFit, reference: _Lidar, delay: DelayFit | None
    ) -> dict[str, str]:
        """Keys of the rig that read the times as they fit, by lidar and key."""
        origin = self._origin(lidar.sensor)
        name = lidar.sensor.name
        sweep_s = order.sweep_s
        is_known = delay is not None and delay.verdict != OPEN
        late_s, sigma_s = (delay.late_s, delay.sigma_s) if delay and is_known else (0.0, 0.0)
        near_s = _NEAR_SIGMAS * sigma_s + _SWEEP_ERROR_S
        found: dict[str, str] = {}
        if order.verdict == DIFFERS and origin in (START, END):
            found[f"{name} points"] = f"{{from: {BACK}}}"
            late_s -= sweep_s if origin == START else 0.0
            is_late = abs(late_s) > _SIGMAS * sigma_s + _SWEEP_ERROR_S
        elif origin == START and abs(late_s - sweep_s) <= near_s:
            found[f"{name} points"] = f"{{from: {END}}}"
            is_late = max(near_s, 2 * abs(late_s - sweep_s)) > _RESOLVED * sweep_s
        elif origin == END and abs(late_s + sweep_s) <= near_s:
            found[f"{name} points"] = f"{{from: {START}}}"
            is_late = max(near_s, 2 * abs(late_s + sweep_s)) > _RESOLVED * sweep_s
        elif self._origin(reference.sensor) == START and abs(late_s + sweep_s) <= near_s:
            found[f"{reference.sensor.name} points"] = f"{{from: {END}}}"
            is_late = max(near_s, 2 * abs(late_s + sweep_s)) > _RESOLVED * sweep_s
        else:
            is_late = delay is not None and delay.verdict == DIFFERS
        if is_known and is_late:
            offset_s = lidar.sensor.offset_ns / NS_PER_S - late_s
            found[f"{name} clock"] = f"{{offset_s: {offset_s:.4f}}}"
        return found

    def _origin(self, sensor: DetectedSensor) -> str:
        clouds = self._discovery.first.clouds
        if clouds is None:
            return ""
        stream = self._discovery.sampler.table.streams[min(sensor.kinds).stream]
        return clouds.origins.get((stream.topic, clouds.frames.get(stream, "")), "")


def _mm(residual_m: float) -> float:
    return round(residual_m * _MM_PER_M, 2)


class _Lidar:
    """The last sweeps of a lidar, as its messages cut them."""

    def __init__(self, sensor: DetectedSensor) -> None:
        self.sensor = sensor
        self.sweeps: deque[Cloud] = deque(maxlen=_SWEEPS)
        # Points (k, 3) and stamps (k,) of the message that is read.
        self._parts: list[tuple[F64Array, I64Array]] = []

    def add(self, packets: U8Array) -> None:
        """Add packets (n, size); a message begins with its column 0."""
        heads = np.ascontiguousarray(packets[:, : HEAD.itemsize]).view(HEAD)[:, 0]
        begins = np.flatnonzero(heads["number"] == 0).tolist()
        edges = [0, *(one for one in begins if one), len(packets)]
        for first, last in pairwise(edges):
            if first in begins:
                self.close()
            self._parts.append(self._points(packets[first:last], heads[first:last]["stamp_ns"]))

    def _points(self, packets: U8Array, stamp_ns: I64Array) -> tuple[F64Array, I64Array]:
        slots = int(packets[0, : HEAD.itemsize].view(HEAD)["slots"][0])
        planes = np.ascontiguousarray(packets[:, HEAD.itemsize : HEAD.itemsize + 12 * slots])
        xyz = planes.view("<f4").reshape(len(packets), 3, slots).transpose(0, 2, 1)
        column, slot = np.nonzero(xyz.any(axis=2))
        points_m = xyz[column, slot].astype(np.float64)
        return points_m, stamp_ns[column].astype(np.int64)

    def close(self) -> None:
        """Keep the message that was read, if it is a sweep after the last one."""
        parts, self._parts = self._parts, []
        if not parts:
            return
        points_m = np.concatenate([points for points, _ in parts])
        stamp_ns = np.concatenate([stamps for _, stamps in parts]) + self.sensor.offset_ns
        near = (points_m**2).sum(axis=1) < _FARTHEST_M**2
        step = max(1, -(-len(points_m) // _POINTS))
        if step > 1:
            # Whole columns, so that neighbours of a surface stay together.
            number = np.cumsum(np.concatenate([[0], np.diff(stamp_ns) != 0]))
            near &= number % step == 0
        if np.count_nonzero(near) < _FEWEST_POINTS:
            return
        pose = self.sensor.pose.body_from_sensor
        points_m = np.matmul(points_m[near], pose[:3, :3].T) + pose[:3, 3]
        sweep = Cloud.of_sweep(points_m, stamp_ns[near])
        if sweep.span_s > 0 and (not self.sweeps or sweep.instant_ns > self.sweeps[-1].instant_ns):
            self.sweeps.append(sweep)
