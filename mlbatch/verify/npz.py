"""A folder of npz files (CONTRACT.md, section 3): all that a scan holds can be held against it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import F32Array, I64Array, U8Array, U16Array, U32Array
from mlbatch.verify.claims import Claims
from mlbatch.verify.folders import ScanFile, check_name
from mlbatch.verify.scan import HeldScan
from mlbatch.verify.verdict import DamageError, Judge
from mlbatch.verify.zips import Array, array, members

SUFFIX = ".npz"
SCHEMA = "mlbatch.scan/1"
# Of points: type, and length of what follows the axes of the scan's shape.
_POINTS = {
    "xyz": ("<f4", (3,)),
    "intensity": ("<f4", ()),
    "range_m": ("<f4", ()),
    "time_ns": ("<u4", ()),
    "ring": ("<u2", ()),
    "return_type": ("|u1", ()),
    "lidar_id": ("|u1", ()),
}
_DENSE = {"column": ("<u4", ())}
_OPTIONAL = {"reflectivity": ("<u2", ())}
_COLUMNS = {"column_stamp_ns": "<i8", "column_lidar_id": "|u1"}
_NUMBERS = {
    **dict.fromkeys(("start_ns", "end_ns", "index", "slice", "slices"), "<i8"),
    "complete": "|b1",
}
_TEXTS = ("sensors", "frame_id", "rate_hz", "timescale", "schema")
# The same in every scan of a run.
_CONSTANT = ("slices", *_TEXTS)

LIMITS = {
    "tf_static": "npz has no transforms",
    "imu": "npz has no place for IMU samples",
    "messages": "npz has no place for messages",
    "stamps": "npz has no log times",
}
ORGANIZED_LIMITS = {"order": "columns only: organized scans keep no order within a column"}

Values = npt.NDArray[np.generic]


@dataclass(slots=True)
class NpzReader:
    """Reads files of one folder; all of a run hold the same keys and constants."""

    judge: Judge
    sensors: tuple[str, ...] = ()
    organized: bool = False
    _first: str = ""
    _keys: dict[str | None, frozenset[str]] = field(default_factory=dict)
    _constant: dict[str, bytes] = field(default_factory=dict)

    def begin(self, file: ScanFile) -> Claims:
        """What the first scan says of the run."""
        data = _members(file)
        self._first = file.where
        arrays = {key: array(key, data[key]) for key in _CONSTANT if key in data}
        values = {key: one.values for key, one in arrays.items() if self._fits(file, key, one)}
        self._constant = {key: bytes(data[key]) for key in values}
        xyz = data.get("xyz")
        self.organized = xyz is not None and array("xyz", xyz).values.ndim == 3
        texts = {key: str(values[key]) for key in _TEXTS if key in values and key != "sensors"}
        self.judge.equal("layout", f"{file.where} schema", SCHEMA, texts.get("schema"))
        names = values.get("sensors")
        if names is not None:
            self.sensors = tuple(map(str, names.tolist()))
        slices = values.get("slices")
        return Claims(
            texts.get("rate_hz"),
            None if slices is None else int(cast(I64Array, slices)),
            None,
            self.sensors or None,
            texts.get("timescale"),
            texts.get("frame_id"),
        )

    def _fits(self, file: ScanFile, key: str, found: Array) -> bool:
        """Whether a constant is what it should be; a number that is none is blamed in each scan."""
        axes = found.values.ndim
        if key not in _TEXTS:
            return (found.kind, axes) == (_NUMBERS[key], 0)
        wanted = "texts" if key == "sensors" else "a text"
        got = f"{found.kind} of {axes} axes"
        fits = found.kind.startswith("<U") and axes == (key == "sensors")
        return self.judge.equal("layout", f"{file.where} {key}", wanted, wanted if fits else got)

    def scans(self, files: list[ScanFile]) -> Iterator[HeldScan]:
        """Every scan that can be read; what cannot is blamed."""
        for file in files:
            try:
                scan = self._scan(file)
            except DamageError as err:
                self.judge.blame("container", file.where, err.wanted, err.got)
                continue
            self.judge.passed("container")
            if scan is not None:
                yield scan

    def _scan(self, file: ScanFile) -> HeldScan | None:
        data = _members(file)
        self._check_keys(file, data)
        values = {
            key: array(key, raw)
            for key, raw in data.items()
            if key not in self._constant or bytes(raw) != self._constant[key]
        }
        whole = True
        for key, kind in self._kinds(data).items():
            if key in values and values[key].kind != kind:
                self.judge.blame("layout", f"{file.where} {key}", kind, values[key].kind)
                whole = False
        found = {key: one.values for key, one in values.items()}
        if not whole or not self._check_shapes(file, found):
            return None
        return self._held(file, found)

    def _check_keys(self, file: ScanFile, data: dict[str, memoryview]) -> None:
        self.judge.passed("layout")
        keys = self._keys.setdefault(file.sensor, frozenset(data))
        if keys != data.keys():
            changed = ", ".join(sorted(keys ^ data.keys()))
            self.judge.blame(
                "layout", file.where, "the keys of the first scan", f"not so: {changed}"
            )
        for key, raw in self._constant.items():
            if key in data and bytes(data[key]) != raw:
                got = array(key, data[key]).values
                self.judge.blame("metadata", f"{file.where} {key}", f"as in {self._first}", got)
        self.judge.passed("metadata", len(self._constant))

    def _kinds(self, data: dict[str, memoryview]) -> dict[str, str]:
        """Types by key; what must be there and is not is damage."""
        points = _POINTS | ({} if self.organized else _DENSE)
        needed = {key: kind for key, (kind, _) in points.items()} | _COLUMNS | _NUMBERS
        missing = [key for key in (*needed, *_TEXTS) if key not in data]
        if missing:
            raise DamageError("all keys of a scan", f"no {', '.join(missing)}")
        return needed | {key: kind for key, (kind, _) in _OPTIONAL.items()}

    def _check_shapes(self, file: ScanFile, found: dict[str, Values]) -> bool:
        """Whether all point arrays have one shape, and the others theirs."""
        points = _POINTS | _OPTIONAL | ({} if self.organized else _DENSE)
        axes = 2 if self.organized else 1
        shape = found["time_ns"].shape
        wanted = {key: shape + tail for key, (_, tail) in points.items()}
        wanted |= dict.fromkeys(_COLUMNS, found["column_stamp_ns"].shape[:1])
        wanted |= dict.fromkeys(_NUMBERS, ())
        if self.organized:
            wanted |= dict.fromkeys(_COLUMNS, shape[:1])
        good = True
        for key, own in wanted.items():
            if key in found and (found[key].shape != own or len(shape) != axes):
                self.judge.blame("layout", f"{file.where} {key}", f"shape {own}", found[key].shape)
                good = False
        return good

    def _held(self, file: ScanFile, found: dict[str, Values]) -> HeldScan:
        constant = {key: array(key, memoryview(raw)).values for key, raw in self._constant.items()}
        number = {key: int(cast(I64Array, found.get(key, constant.get(key)))) for key in _NUMBERS}
        check_name(self.judge, file, number["index"], number["slice"], number["slices"])
        scan = HeldScan(
            where=file.where,
            start_ns=number["start_ns"],
            end_ns=number["end_ns"],
            index=number["index"],
            slice=number["slice"],
            complete=bool(number["complete"]),
            xyz=cast(F32Array, found["xyz"]),
            organized=self.organized,
            intensity=cast(F32Array, found["intensity"]),
            range_m=cast(F32Array, found["range_m"]),
            time_ns=cast(I64Array, found["time_ns"].astype(np.int64)),
            ring=cast(U16Array, found["ring"]),
            return_type=cast(U8Array, found["return_type"]),
            lidar_id=cast(U8Array, found["lidar_id"]),
            column=cast("U32Array | None", found.get("column")),
            column_stamp_ns=cast(I64Array, found["column_stamp_ns"]),
            column_lidar_id=cast(U8Array, found["column_lidar_id"]),
        )
        if file.sensor is None:
            return scan
        if file.sensor not in self.sensors:
            wanted = f"the folder of one of {', '.join(self.sensors)}"
            self.judge.blame("names", file.where, wanted, file.sensor)
            return scan
        return replace(scan, sensor=self.sensors.index(file.sensor))


def _members(file: ScanFile) -> dict[str, memoryview]:
    try:
        data = file.path.read_bytes()
    except OSError as err:
        raise DamageError("a file that can be read", str(err.strerror)) from err
    found = members(data)
    return {name.removesuffix(".npy"): member for name, member in found.items()}
