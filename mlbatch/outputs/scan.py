"""A scan for users: arrays named as the npz keys, and what is commonly computed from them."""

from __future__ import annotations

import html
import importlib
from dataclasses import dataclass, field, fields, replace
from types import ModuleType
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch import types
from mlbatch.arrays import (
    BoolArray,
    F32Array,
    F64Array,
    I64Array,
    U8Array,
    U16Array,
    U32Array,
)
from mlbatch.errors import UsageError
from mlbatch.outputs.stored_scan import POINT_ARRAYS
from mlbatch.types import RunInfo
from mlbatch.units import NS_PER_S
from mlbatch.writers.point_layouts import CLOUD_LAYOUTS, PLY_LAYOUT

Records: TypeAlias = npt.NDArray[np.void]

_LAYOUTS = CLOUD_LAYOUTS | {PLY_LAYOUT.name: PLY_LAYOUT}
# Fields that scans of conversions do not have.
_OF_OUTPUTS = ("absent", "sensor")
# Arrays from which the fields of a point layout are made; the others are made of `xyz`.
_NEEDED = {
    "intensity": "intensity",
    "time": "time_ns",
    "t": "time_ns",
    "timestamp": "time_ns",
    "time_stamp": "time_ns",
    "ring": "ring",
    "channel": "ring_base",
    "return_type": "return_type",
    "lidar_id": "lidar_id",
    "range": "range_m",
    "reflectivity": "reflectivity",
    "azimuth": "lidar_id",
    "elevation": "lidar_id",
    "distance": "lidar_id",
}


@dataclass(slots=True, eq=False)
class Scan:
    """All columns of one window of the common clock, sorted by timestamp; named as the npz keys.

    n columns. Dense: p points, only valid returns, never NaN. Organized: arrays of points are
    (n, slots[, 3]), NaN where empty. Of a scan that was read from an output, arrays that the
    output does not store are in `absent`: they are empty, or None.
    """

    info: RunInfo  # shared by all scans of a run
    index: int  # of the window, from t_init; -1: the partial one before it
    slice: int  # within the window
    start_ns: int
    end_ns: int
    complete: bool  # every sensor covers the window in time
    ready_host_ns: int  # receive time of the packet that closed the window; 0: not stored
    xyz: F32Array  # (p, 3) m, body frame
    intensity: F32Array  # (p,)
    reflectivity: U16Array | None  # (p,); None: no sensor has it
    range_m: F32Array | None  # (p,)
    time_ns: U32Array  # (p,) after `start_ns`
    ring: U16Array  # (p,)
    return_type: U8Array  # (p,)
    lidar_id: U8Array  # (p,) index into `sensors`
    column: U32Array | None  # (p,) index of the point's column; None when organized
    column_stamp_ns: I64Array  # (n,)
    column_lidar_id: U8Array  # (n,)
    columns_per_sensor: tuple[int, ...]
    # By sensor: widest time without a column, from the last one before the window up to its end.
    max_gap_ns: tuple[int, ...]
    coverage: tuple[float, ...] = ()  # by sensor, share of a revolution passed at least once
    overlap: tuple[float, ...] = ()  # by sensor, share of a revolution passed more than once
    # (s,) by sensor, columns present / columns expected, 0 to 1; NaN: unknown.
    fill: F32Array = field(default_factory=lambda: np.zeros(0, np.float32))
    absent: frozenset[str] = frozenset()
    sensor: str = ""  # the only one: of a part, or with `--split`

    @classmethod
    def copied(cls, scan: types.Scan) -> Scan:
        """A scan of a conversion with arrays of its own, contiguous."""
        names = [one.name for one in fields(cls) if one.name not in _OF_OUTPUTS]
        values = {name: getattr(scan, name) for name in names}
        for name, value in values.items():
            if isinstance(value, np.ndarray):
                values[name] = np.array(value, order="C")
        return cls(**values)

    # -- description --------------------------------------------------------------------------

    @property
    def point_count(self) -> int:
        """Number of points, without the empty slots of an organized scan."""
        return int(np.count_nonzero(self.is_valid))

    @property
    def frame_id(self) -> str:
        """Name of the body frame, in which `xyz` is."""
        return self.info.frame_id

    @property
    def rate_hz(self) -> str:
        """Rate of the windows as text, exact: "10", "10/3"."""
        return self.info.rate_hz

    @property
    def timescale(self) -> str:
        """Timescale of all times: utc, tai, uptime or unknown."""
        return self.info.timescale

    @property
    def slices(self) -> int:
        """Slices of a window."""
        return self.info.slices

    @property
    def sort(self) -> str:
        """Order of the points of a dense scan: `columns` or `points`."""
        return self.info.sort

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors, by `lidar_id`."""
        return tuple(sensor.name for sensor in self.info.sensors)

    @property
    def time_s(self) -> F64Array:
        """Time of each point after `start_ns`, s; UsageError where it is not stored."""
        self._require("time_s", "time_ns")
        return np.divide(self.time_ns, NS_PER_S, dtype=np.float64)

    @property
    def stamp_ns(self) -> I64Array:
        """Time of each point on the common clock, ns; UsageError where it is not stored."""
        self._require("stamp_ns", "time_ns")
        return np.add(self.time_ns, self.start_ns, dtype=np.int64)

    @property
    def is_valid(self) -> BoolArray:
        """True where there is a point: in all of a dense scan, in slots of an organized one."""
        valid: BoolArray = np.isfinite(self.xyz[..., 0])
        return valid

    def __repr__(self) -> str:
        """One line; the arrays are not printed."""
        state = "complete" if self.complete else "incomplete"
        names = self.sensor or ", ".join(self.sensors)
        return (
            f"<Scan {self.index}: {self.point_count} points of {names}, "
            f"{self.start_ns} to {self.end_ns} ns {self.info.timescale}, {state}>"
        )

    def _repr_html_(self) -> str:
        arrays = ((one.name, getattr(self, one.name)) for one in fields(self))
        shapes = [
            f"{name:16} {one.dtype} {one.shape}"
            for name, one in arrays
            if isinstance(one, np.ndarray) and name not in self.absent
        ]
        return preformatted("\n".join([repr(self), *shapes]))

    # -- parts --------------------------------------------------------------------------------

    def __getitem__(self, sensor: str) -> Scan:
        """The points and columns of one sensor; `lidar_id` remains, columns are counted anew.

        UsageError for an unknown name, or where the output does not store `lidar_id`.
        """
        if sensor not in self.sensors:
            raise UsageError(
                f"sensor: expected one of {', '.join(self.sensors)}, found {sensor!r}; choose one"
            )
        self._require(f"scan[{sensor!r}]", "lidar_id")
        number = self.sensors.index(sensor)
        columns = self.column_lidar_id == number
        # Organized arrays have a row for each column.
        is_organized = self.lidar_id.ndim == 2
        mine = self.lidar_id[:, 0] == number if is_organized else self.lidar_id == number
        found = replace(
            self,
            sensor=sensor,
            column_stamp_ns=self.column_stamp_ns[columns],
            column_lidar_id=self.column_lidar_id[columns],
            columns_per_sensor=_only(self.columns_per_sensor, number, 0),
            max_gap_ns=_only(self.max_gap_ns, number, 0),
            coverage=_only(self.coverage, number, 0.0),
            overlap=_only(self.overlap, number, 0.0),
            fill=np.where(np.arange(len(self.fill)) == number, self.fill, np.float32("nan")),
        )
        found.xyz = self.xyz[mine]
        for name in POINT_ARRAYS:
            values = getattr(self, name)
            if values is not None and name not in self.absent:
                setattr(found, name, values[mine])
        if self.column is not None:
            before = np.cumsum(columns, dtype=np.uint32) - np.uint32(1)
            found.column = before[self.column[mine]]
        return found

    @property
    def xyz_sensor(self) -> F32Array:
        """Each point in the frame of its own sensor, m; shape of `xyz`.

        UsageError where the output stores no `lidar_id`, or no report with the extrinsics.
        """
        self._require("xyz_sensor", "lidar_id")
        self._require_poses("xyz_sensor")
        poses = np.stack([sensor.body_from_sensor for sensor in self.info.sensors])
        own = self.lidar_id
        rotation = poses[:, :3, :3][own]
        offset = self.xyz - poses[:, :3, 3][own]
        # The inverse of a rotation is its transpose.
        moved: F64Array = np.einsum("...ji,...j->...i", rotation, offset)
        return moved.astype(np.float32)

    # -- other forms --------------------------------------------------------------------------

    def points(self, layout: str = "standard") -> Records:
        """The points as records of a point layout; shape of the point arrays.

        UsageError for an unknown layout, or for fields that the output does not store.
        """
        if layout not in _LAYOUTS:
            raise UsageError(
                f"layout: expected one of {', '.join(_LAYOUTS)}, found {layout!r}; choose one"
            )
        chosen = _LAYOUTS[layout]
        needed = {_NEEDED[field.name] for field in chosen.fields if field.name in _NEEDED}
        if self.range_m is None and "range_m" in needed:
            needed.add("range_m")
        self._require(f"layout {layout}", *needed)
        if layout == "autoware":
            self._require_poses(f"layout {layout}")
        scan = self._record()
        records: Records = np.zeros(scan.time_ns.T.shape or (0,), chosen.dtype)
        chosen.pack(scan, records)
        in_shape: Records = records.T
        return in_shape

    def to_pandas(self) -> Any:
        """A pandas.DataFrame with a row for each point; UsageError without pandas.

        Columns: x, y, z (m, body frame), the stored point arrays, and `stamp_ns`.
        """
        pandas = _optional("pandas", "to_pandas")
        # Organized scans have empty slots.
        valid = self.is_valid
        x, y, z = (self.xyz[..., axis][valid] for axis in range(3))
        table: dict[str, npt.NDArray[np.generic]] = {"x": x, "y": y, "z": z}
        for name in POINT_ARRAYS:
            values = getattr(self, name)
            if values is not None and name not in self.absent:
                table[name] = values[valid]
        if "time_ns" not in self.absent:
            table["stamp_ns"] = self.stamp_ns[valid]
        return pandas.DataFrame(table)

    def plot(self, color: str = "height", axes: Any = None) -> Any:
        """Draw all points from above into axes of matplotlib (None: new ones), and return these.

        color: height, time, intensity or lidar. UsageError without matplotlib.
        """
        pyplot = _optional("matplotlib.pyplot", "plot", "matplotlib")
        arrays = {"time": "time_ns", "intensity": "intensity", "lidar": "lidar_id"}
        if color not in ("height", *arrays):
            known = ", ".join(("height", *arrays))
            raise UsageError(f"color: expected one of {known}, found {color!r}; choose one")
        self._require(f"color {color}", arrays.get(color, "xyz"))
        valid = self.is_valid
        x, y, z = self.xyz[valid].T
        values = z if color == "height" else getattr(self, arrays[color])[valid]
        if axes is None:
            _, axes = pyplot.subplots()
        drawn = axes.scatter(x, y, s=0.3, c=values, linewidths=0, rasterized=True)
        axes.set(xlabel="x, m", ylabel="y, m", title=f"scan {self.index}", aspect="equal")
        unit = {"height": "z, m", "time": "time, ns", "intensity": "intensity", "lidar": "lidar"}
        axes.figure.colorbar(drawn, ax=axes, label=unit[color])
        return axes

    def to_open3d(self) -> Any:
        """An open3d.t.geometry.PointCloud (m, body frame); UsageError without open3d.

        Attributes: positions, and intensity and time (s after `start_ns`) where they are stored.
        """
        open3d = _optional("open3d", "to_open3d")
        valid = self.is_valid
        tensor = open3d.core.Tensor
        cloud = open3d.t.geometry.PointCloud(tensor(np.ascontiguousarray(self.xyz[valid])))
        if "intensity" not in self.absent:
            intensity = self.intensity[valid].astype(np.float32)
            cloud.point["intensity"] = tensor(intensity.reshape(-1, 1))
        if "time_ns" not in self.absent:
            cloud.point["time"] = tensor(self.time_s[valid].reshape(-1, 1))
        return cloud

    def _record(self) -> types.Scan:
        """The same arrays as conversions pass them to writers."""
        names = [one.name for one in fields(self) if one.name not in _OF_OUTPUTS]
        values = {name: getattr(self, name) for name in names}
        for name in self.absent & set(POINT_ARRAYS):
            if values[name] is not None:
                # Not used by the layout, but of the shape of all others.
                values[name] = np.zeros(self.xyz.shape[:-1], values[name].dtype)
        return types.Scan(points=self.point_count, points_per_sensor=(), **values)

    # -- checks -------------------------------------------------------------------------------

    def _require(self, what: str, *names: str) -> None:
        missing = sorted(self.absent & set(names))
        if missing:
            raise UsageError(
                f"{what}: expected {', '.join(missing)} in the output, which does not store it; "
                "convert to npz, or to a point layout that has it"
            )

    def _require_poses(self, what: str) -> None:
        for sensor in self.info.sensors:
            if not np.isfinite(sensor.body_from_sensor).all():
                raise UsageError(
                    f"{what}: expected the extrinsics of {sensor.name}, found no report of the "
                    "run; put report.json back where `convert` wrote it"
                )


def _only(values: tuple[Any, ...], number: int, other: float) -> tuple[Any, ...]:
    """The value of one sensor; `other` for all others."""
    return tuple(value if i == number else other for i, value in enumerate(values))


def preformatted(shown: object) -> str:
    """The text of an object for notebooks, as HTML."""
    return f"<pre>{html.escape(str(shown))}</pre>"


def _optional(module: str, method: str, package: str = "") -> ModuleType:
    """A module of a package that mlbatch does not depend on."""
    package = package or module
    try:
        return importlib.import_module(module)
    except ImportError as err:
        raise UsageError(
            f"{method}: expected the package {package}, found none ({err}); pip install {package}"
        ) from err
