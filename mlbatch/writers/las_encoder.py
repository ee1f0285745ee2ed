"""Scans as LAS 1.4 files, and as LAZ, compressed by lazrs.

Sources: ASPRS, "LAS specification 1.4 R15", tables 3, 4, 16 and 24; docs/sources/outputs.md
section 6.
"""

from __future__ import annotations

import importlib
import io
import struct
from datetime import datetime, timezone
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import mlbatch
from mlbatch.clocks.timescale import GPS_EPOCH_S, TAI, TAI_GPS_S, UTC, gps_utc_s
from mlbatch.errors import ExportError, UsageError, install_extra
from mlbatch.types import RecordLayout, RecordPiece, RunInfo
from mlbatch.units import NS_PER_S
from mlbatch.writers.base import ScanWriter, WriterOptions, fixed
from mlbatch.writers.point_layouts import ScanRecords, record_bytes
from mlbatch.writers.scan_folder import FolderWriter, check_dense, scan_comments

if TYPE_CHECKING:
    from mlbatch.types import PackedPoints, Scan
    from mlbatch.writers.output_file import Bytes

# Coordinates are int32 multiples of it: 0.05 mm of error, up to 214 km from the origin.
SCALE_M = 1e-4
_FARTHEST_M = (2**31 - 1) * SCALE_M
# Adjusted standard GPS time is GPS time minus so many seconds.
_ADJUSTMENT_S = 10**9
# Table 3: signature, source, encoding, GUID, version, system, software, day and year, sizes of the
# header and up to the points, number of VLRs, point format and bytes of a point, counts of earlier
# versions, scales, offsets, highest and lowest x, y, z, waveforms, extended VLRs, points, and those
# by number of return.
_HEADER = struct.Struct("<4sHH16sBB32s32sHHHIIBH6I6d6dQQIQ15Q")
_STANDARD_TIME = 1
# Required of this point format, also without a coordinate system.
_WKT = 16
_POINT_FORMAT = 6
_COMPRESSED = 128
# Table 4: reserved, user, number, bytes after it, description.
_VLR = struct.Struct("<H16sHH32s")
# Table 24: data type, options (lowest and highest are given), name, lowest, highest, description.
_EXTRA = struct.Struct("<2xBB32s4x24x8s16x8s16x24x24x32s")
_HAS_EXTREMES = 6
# Name, data type, description, form of the extremes, and those of no points.
EXTRA_BYTES = (
    ("time_ns", 5, "ns after start_ns", "<Q"),
    ("ring", 3, "channel over all sensors", "<Q"),
    ("return_type", 1, "0 unknown, 1 to 7", "<Q"),
    ("intensity_f32", 9, "as sent by the sensor", "<d"),
    # Only where a sensor of the run has it.
    ("reflectivity", 3, "calibrated by the sensor", "<Q"),
)
_NO_EXTREMES = {"<Q": (2**64 - 1, 0), "<d": (1.7976931348623157e308, -1.7976931348623157e308)}
_EXTRA_VALUES = struct.Struct("<30xIHBfH")
# Of the record with start_ns, sensors and so on: user and number.
VLR_USER = "mlbatch"
VLR_NUMBER = 1


def gps_shift_s(timescale: str, start_ns: int) -> int:
    """Return what to subtract from seconds of a clock to get adjusted standard GPS time."""
    shifts = {
        UTC: GPS_EPOCH_S + _ADJUSTMENT_S - gps_utc_s(start_ns),
        TAI: GPS_EPOCH_S + _ADJUSTMENT_S + TAI_GPS_S,
    }
    return shifts.get(timescale, 0)


# Point data record format 6, then the extra bytes. Times are adjusted standard GPS time; on other
# clocks than UTC and TAI their own seconds.
_PLAIN = RecordLayout(41, (RecordPiece("las", 0, 0, 41),), epoch_s=gps_shift_s)
RECORD = RecordLayout(43, (RecordPiece("las", 0, 0, 43),), _PLAIN, gps_shift_s)


# Reflectivities are extra bytes.
extras = fixed(frozenset({"reflectivity"}))
record_layout = fixed(RECORD)


def open_folder(name: str, target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start a folder of LAS files, or of LAZ files; name: of the format."""
    check_dense(name, info)
    lazrs = load_lazrs() if name == "laz" else None
    return FolderWriter(target, info, options, name, lambda: LasEncoder(lazrs))


def load_lazrs(option: str = "--format laz", package: str = "lazrs") -> ModuleType:
    """Return the compressor, or another package of the extra `las`; UsageError without it."""
    try:
        return importlib.import_module(package)
    except ImportError as err:
        raise UsageError(
            f"{option}: expected the package {package}, found none ({err}); {install_extra('las')}"
        ) from err


class LasEncoder:
    """Encodes scans as LAS files, or as LAZ files by `lazrs`."""

    def __init__(self, lazrs: ModuleType | None = None) -> None:
        self._lazrs = lazrs
        self._records = ScanRecords(RECORD)

    def encode(self, scan: Scan) -> list[Bytes]:
        """Return the file of a scan; ExportError where coordinates do not fit into int32."""
        packed = self._records.of(scan)
        records = record_bytes(packed)
        point_bytes = (RECORD if scan.reflectivity is not None else _PLAIN).step
        text = "\n".join(scan_comments(scan, "x y z m; gps_time s; time_ns ns after start_ns"))
        vlrs = [
            _vlr("LASF_Spec", 4, "Extra Bytes Record", _extra_bytes(records, point_bytes)),
            _vlr(VLR_USER, VLR_NUMBER, "scan", text.encode()),
        ]
        if self._lazrs is None:
            return [_header(scan, packed, vlrs, _POINT_FORMAT, point_bytes), records]
        items = self._lazrs.LazVlr.new_for_compression(_POINT_FORMAT, point_bytes - 30)
        vlrs.append(_vlr("laszip encoded", 22204, "http://laszip.org", items.record_data()))
        stream = io.BytesIO()
        stream.write(_header(scan, packed, vlrs, _POINT_FORMAT | _COMPRESSED, point_bytes))
        # Threads come from --jobs.
        compressor = self._lazrs.LasZipCompressor(stream, items)
        if len(records):
            compressor.compress_many(packed.buffer[packed.begin : packed.end])
        compressor.done()
        return [stream.getbuffer()]


def _header(
    scan: Scan, packed: PackedPoints, vlrs: list[bytes], point_format: int, point_bytes: int
) -> bytes:
    """Return a header and its variable length records."""
    (count,) = packed.shape
    second = 0
    bounds = [0.0] * 6
    if packed.totals is not None and count:
        low_m, high_m, second = packed.totals
        farthest_m = max(map(abs, (*low_m, *high_m)))
        if farthest_m > _FARTHEST_M:
            raise ExportError(
                f"scan {scan.index}: expected coordinates up to {_FARTHEST_M:.0f} m for las and "
                f"laz, found {farthest_m:.0f} m; write another format, or --max-range"
            )
        # Rounded as the coordinates, half to even.
        ends = (end_m for ends_m in zip(high_m, low_m, strict=True) for end_m in ends_m)
        bounds = [round(end_m / SCALE_M) * SCALE_M for end_m in ends]
    is_standard = scan.info.timescale in (UTC, TAI)
    # Equal runs give equal bytes: the day of the scan, not of the run.
    day = datetime.fromtimestamp(scan.start_ns // NS_PER_S, timezone.utc).timetuple()
    fields = [
        *(b"LASF", 0, _WKT | (_STANDARD_TIME if is_standard else 0), b"", 1, 4),
        *(b"mlbatch", f"mlbatch {mlbatch.__version__}".encode()),
        *(day.tm_yday, day.tm_year),
        *(_HEADER.size, _HEADER.size + sum(map(len, vlrs)), len(vlrs)),
        *(point_format, point_bytes, *[0] * 6),
        *(SCALE_M, SCALE_M, SCALE_M, 0.0, 0.0, 0.0, *bounds),
        *(0, 0, 0, count, count - second, second, *[0] * 13),
    ]
    return b"".join([_HEADER.pack(*fields), *vlrs])


def _vlr(user: str, number: int, description: str, content: bytes) -> bytes:
    """Return a variable length record."""
    head = _VLR.pack(0, user.encode(), number, len(content), description.encode())
    return head + content


def _extra_bytes(records: memoryview, point_bytes: int) -> bytes:
    """Return the descriptions of the extra bytes.

    Lowest and highest are those of the first point, as laspy has them, whatever the others are.
    """
    first: tuple[float, ...] = ()
    if len(records):
        first = _EXTRA_VALUES.unpack(bytes(records[:point_bytes]).ljust(_EXTRA_VALUES.size, b"\0"))
    known = EXTRA_BYTES if point_bytes == RECORD.step else EXTRA_BYTES[:-1]
    parts = []
    for index, (name, kind, description, form) in enumerate(known):
        low, high = (first[index],) * 2 if first else _NO_EXTREMES[form]
        ends = (struct.pack(form, low), struct.pack(form, high))
        parts.append(_EXTRA.pack(kind, _HAS_EXTREMES, name.encode(), *ends, description.encode()))
    return b"".join(parts)
