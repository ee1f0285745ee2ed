"""Scans as LAS 1.4 files, written by laspy.

Sources: ASPRS, "LAS specification 1.4 R15", tables 3, 4, 16 and 24; docs/sources/outputs.md
section 6.
"""

from __future__ import annotations

import importlib
import io
from datetime import datetime, timezone
from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt

import mlbatch
from mlbatch.arrays import F64Array, I32Array, I64Array, U8Array
from mlbatch.clocks.timescale import GPS_EPOCH_S, TAI, TAI_GPS_S, UTC, gps_utc_s
from mlbatch.errors import ExportError, UsageError, install_extra
from mlbatch.types import Scan
from mlbatch.units import NS_PER_S
from mlbatch.writers.output_file import Bytes
from mlbatch.writers.scan_comments import scan_comments

LAS_EXTRAS = frozenset({"reflectivity"})
# Coordinates are int32 multiples of it: 0.05 mm of error, up to 214 km from the origin.
SCALE_M = 1e-4
_POINT_FORMAT = 6
_FARTHEST_M = float(np.iinfo(np.int32).max) * SCALE_M
_MOST_INTENSITY = 65535
# Adjusted standard GPS time is GPS time minus so many seconds.
_ADJUSTMENT_S = 10**9
# Name, type and description of the extra bytes.
_EXTRA_BYTES = (
    ("time_ns", "u4", "ns after start_ns"),
    ("ring", "u2", "channel over all sensors"),
    ("return_type", "u1", "0 unknown, 1 to 7"),
    ("intensity_f32", "f4", "as sent by the sensor"),
)
# Only where a sensor of the run has it.
_REFLECTIVITY = ("reflectivity", "u2", "calibrated by the sensor")
# By return type (docs/formats.md#npz): of two returns the first is the nearer one.
_RETURN_NUMBER = np.array([1, 1, 1, 1, 2, 1, 2, 1], np.uint8)
_NUMBER_OF_RETURNS = np.array([1, 1, 1, 2, 2, 2, 2, 1], np.uint8)
# Of the record with start_ns, sensors and so on: user and number.
VLR_USER = "mlbatch"
VLR_NUMBER = 1


def load_laspy(name: str) -> ModuleType:
    """Return laspy; UsageError without it or, for laz, without its compressor."""
    try:
        if name == "laz":
            importlib.import_module("lazrs")
        return importlib.import_module("laspy")
    except ImportError as err:
        raise UsageError(
            f"--format {name}: expected the packages laspy and lazrs, found none ({err}); "
            f"{install_extra('las')}"
        ) from err


class LasEncoder:
    """Encodes scans as LAS or LAZ files."""

    def __init__(self, laspy: ModuleType, *, compresses: bool) -> None:
        self._laspy = laspy
        self._compresses = compresses

    def encode(self, scan: Scan) -> list[Bytes]:
        """Return the file of a scan; ExportError where coordinates do not fit into int32."""
        laspy = self._laspy
        header = self._header(scan)
        points = laspy.PackedPointRecord.zeros(len(scan.time_ns), header.point_format)
        _fill(points, scan)
        stream = io.BytesIO()
        # Threads come from --jobs.
        backend = laspy.LazBackend.Lazrs if self._compresses else None
        with laspy.LasWriter(
            stream, header, do_compress=self._compresses, laz_backend=backend, closefd=False
        ) as writer:
            writer.write_points(points)
        return [stream.getbuffer()]

    def _header(self, scan: Scan) -> Any:
        """Return a header without points; laspy has no types."""
        laspy = self._laspy
        header = laspy.LasHeader(point_format=_POINT_FORMAT, version="1.4")
        header.scales = np.full(3, SCALE_M)
        header.offsets = np.zeros(3)
        # Equal runs give equal bytes: the day of the scan, not of the run.
        header.creation_date = datetime.fromtimestamp(
            scan.start_ns // NS_PER_S, timezone.utc
        ).date()
        header.system_identifier = "mlbatch"
        header.generating_software = f"mlbatch {mlbatch.__version__}"
        # Required of this point format, also without a coordinate system.
        header.global_encoding.wkt = True
        if scan.info.timescale in (UTC, TAI):
            header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
        further = () if scan.reflectivity is None else (_REFLECTIVITY,)
        header.add_extra_dims([laspy.ExtraBytesParams(*one) for one in (*_EXTRA_BYTES, *further)])
        text = "\n".join(scan_comments(scan, "x y z m; gps_time s; time_ns ns after start_ns"))
        header.vlrs.append(laspy.VLR(VLR_USER, VLR_NUMBER, "scan", text.encode()))
        return header


def _fill(points: Any, scan: Scan) -> None:
    """Set all fields; laspy has no types."""
    for name, axis in (("X", 0), ("Y", 1), ("Z", 2)):
        points[name] = _steps(scan, axis)
    points["intensity"] = np.clip(np.rint(scan.intensity), 0, _MOST_INTENSITY).astype(np.uint16)
    points["return_number"] = _by_type(_RETURN_NUMBER, scan.return_type)
    points["number_of_returns"] = _by_type(_NUMBER_OF_RETURNS, scan.return_type)
    # 0 is reserved for points that were made in this file.
    points["point_source_id"] = scan.lidar_id.astype(np.uint16) + 1
    points["gps_time"] = gps_time_s(scan)
    points["time_ns"] = scan.time_ns
    points["ring"] = scan.ring
    points["return_type"] = scan.return_type
    points["intensity_f32"] = scan.intensity
    if scan.reflectivity is not None:
        points["reflectivity"] = scan.reflectivity


def _by_type(table: U8Array, return_type: U8Array) -> U8Array:
    found: U8Array = table[np.minimum(return_type, len(table) - 1)]
    return found


def _steps(scan: Scan, axis: int) -> I32Array:
    """Return a coordinate in multiples of the scale."""
    value_m: npt.NDArray[np.float64] = scan.xyz[:, axis].astype(np.float64)
    farthest_m = float(np.abs(value_m).max(initial=0.0))
    if farthest_m > _FARTHEST_M:
        raise ExportError(
            f"scan {scan.index}: expected coordinates up to {_FARTHEST_M:.0f} m for las and laz, "
            f"found {farthest_m:.0f} m; write another format, or --max-range"
        )
    return np.rint(value_m / SCALE_M).astype(np.int32)


def gps_time_s(scan: Scan) -> F64Array:
    """Return adjusted standard GPS time; on other clocks than UTC and TAI their own seconds."""
    base_ns = scan.start_ns - gps_shift_s(scan.info.timescale, scan.start_ns) * NS_PER_S
    whole_s, rest_ns = divmod(base_ns, NS_PER_S)
    time_ns: I64Array = scan.time_ns.astype(np.int64) + rest_ns
    time_s: F64Array = time_ns / NS_PER_S
    return np.add(time_s, whole_s, out=time_s)


def gps_shift_s(timescale: str, start_ns: int) -> int:
    """Return what to subtract from seconds of a clock to get adjusted standard GPS time."""
    shifts = {
        UTC: GPS_EPOCH_S + _ADJUSTMENT_S - gps_utc_s(start_ns),
        TAI: GPS_EPOCH_S + _ADJUSTMENT_S + TAI_GPS_S,
    }
    return shifts.get(timescale, 0)
