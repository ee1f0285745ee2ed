"""The coordinate reference system of a map, looked up by pyproj (extra `crs`)."""

from __future__ import annotations

import importlib
import re
from collections.abc import Sequence
from typing import Any

from mlbatch.errors import RigError, UsageError, install_extra

# Poses so near to the origin, m, are usually those of a local frame.
_LOCAL_M = 10_000.0
# Systems are used beyond their area, but less far, degrees.
_BEYOND_DEG = (20.0, 10.0)


class MapCrs:
    """A projected system in metres; x is easting, y northing, z up."""

    def __init__(self, name: str) -> None:
        """name: EPSG:NNNN; UsageError for another or an unknown one, and without pyproj."""
        match = re.fullmatch(r"EPSG:(\d{4,6})", name, re.ASCII | re.IGNORECASE)
        if match is None:
            raise UsageError(f"--crs: expected EPSG:NNNN, found {name!r}; write --crs EPSG:32633")
        try:
            pyproj = importlib.import_module("pyproj")
        except ImportError as err:
            raise UsageError(
                f"--crs: expected the package pyproj, found none ({err}); {install_extra('crs')}"
            ) from err
        self.name = f"EPSG:{match[1]}"
        # pyproj may come without types.
        try:
            crs: Any = pyproj.CRS.from_epsg(int(match[1]))
            self.wkt = str(crs.to_wkt("WKT1_GDAL"))
        except pyproj.exceptions.CRSError as err:
            raise UsageError(
                f"--crs: expected a code of EPSG, found {name!r}, which is unknown; correct it"
            ) from err
        plane = crs.sub_crs_list[0] if crs.is_compound else crs
        units = sorted({axis.unit_name for axis in crs.axis_info} - {"metre"})
        if not plane.is_projected or units:
            found = f"units of {units[0]}" if units else plane.type_name
            raise UsageError(
                f"--crs: expected a projected system in metres, as poses are, found {found} "
                f"({crs.name}); give that of the poses"
            )
        self._area = crs.area_of_use
        self._to_degrees = pyproj.Transformer.from_crs(plane, plane.geodetic_crs, always_xy=True)

    def check(self, position_m: Sequence[float]) -> None:
        """RigError for a position that is far from where the system is used."""
        x, y = position_m[:2]
        east, north = self._to_degrees.transform(x, y)
        beyond = (0.0, 0.0) if max(abs(x), abs(y)) < _LOCAL_M else _BEYOND_DEG
        area = self._area
        if area is None or (
            _is_within(east, area.west, area.east, beyond[0])
            and area.south - beyond[1] <= north <= area.north + beyond[1]
        ):
            return
        raise RigError(
            f"--crs {self.name}: expected poses with eastings and northings of {area.name}, found "
            f"x {x:.1f}, y {y:.1f} m ({east:.1f}, {north:.1f} degrees); give the system of the "
            "poses, or leave it out for a local frame"
        )


def _is_within(east: float, west_end: float, east_end: float, beyond: float) -> bool:
    """Whether a longitude is between two, which may enclose 180 degrees; all in degrees."""
    width = (east_end - west_end) % 360.0 or 360.0
    return (east - west_end + beyond) % 360.0 <= width + 2.0 * beyond
