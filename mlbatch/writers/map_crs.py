"""The coordinate reference system of a map, looked up by pyproj (extra `crs`)."""

from __future__ import annotations

import importlib
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
        try:
            pyproj = importlib.import_module("pyproj")
        except ImportError as err:
            raise UsageError(
                f"--crs: expected the package pyproj, found none ({err}); {install_extra('crs')}"
            ) from err
        _, _, code = name.upper().partition("EPSG:")
        try:
            crs: Any = pyproj.CRS.from_epsg(code)
            # OGC 01-009 (WKT 1), which ends with a zero in LAS.
            self.wkt = crs.to_wkt("WKT1_GDAL").encode() + b"\0"
        except pyproj.exceptions.CRSError as err:
            text = f"--crs: expected a known EPSG:NNNN, found {name!r}; write --crs EPSG:32633"
            raise UsageError(text) from err
        self.name = f"EPSG:{code}"
        plane = crs.sub_crs_list[0] if crs.is_compound else crs
        if not plane.is_projected or {axis.unit_name for axis in crs.axis_info} != {"metre"}:
            found = f"{plane.type_name} in {crs.axis_info[0].unit_name} ({crs.name})"
            text = f"--crs: expected a projected system in metres, found {found}"
            raise UsageError(f"{text}; give that of the poses")
        self._area = crs.area_of_use
        self._to_degrees = pyproj.Transformer.from_crs(plane, plane.geodetic_crs, always_xy=True)

    def check(self, x: float, y: float) -> None:
        """RigError for a position in m that is far from where the system is used."""
        east, north = self._to_degrees.transform(x, y)
        wider, higher = (0.0, 0.0) if max(abs(x), abs(y)) < _LOCAL_M else _BEYOND_DEG
        area = self._area
        # Areas may enclose 180 degrees.
        width = (area.east - area.west) % 360.0 or 360.0
        is_known = area.south - higher <= north <= area.north + higher
        if not (is_known and (east - area.west + wider) % 360.0 <= width + 2.0 * wider):
            raise RigError(
                f"--crs {self.name}: expected poses with eastings and northings of {area.name}, "
                f"found x {x:.1f}, y {y:.1f} m; give their system, or none for a local frame"
            )
