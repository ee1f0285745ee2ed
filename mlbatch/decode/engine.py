"""The interface of the engines that decode windows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from mlbatch.arrays import I64Array
from mlbatch.decode.projector import Extras, Projector
from mlbatch.decode.scan_buffer import ScanBuffer
from mlbatch.types import RecordLayout, WindowColumns


class EngineSetup(NamedTuple):
    """The sensors that an engine decodes, and the layout of their scans.

    seat: (sensors, 2) int64, index of the projector of each sensor, and its member there; -1: the
    engine skips the sensor. tile_columns: most columns that a projector takes. first_sensor: index
    of the first sensor in the scan. extras: optional arrays of the scan, of any sensor.
    organized_slots: slots of a row of an organized scan; 0: scans are dense. record: layout of the
    records that the output takes; None: it takes arrays.
    """

    projectors: Sequence[Projector]
    seat: I64Array
    tile_columns: int
    first_sensor: int
    extras: Extras
    organized_slots: int
    record: RecordLayout | None = None


class Engine(Protocol):
    """Decodes windows of columns. All engines write the same bytes.

    record: layout of the records that the engine packs; None: it writes arrays.
    """

    record: RecordLayout | None

    def decode(
        self, columns: WindowColumns, start_ns: int, first_number: int, out: ScanBuffer
    ) -> int:
        """Write the points of a window to `out`, from its first row; return their number.

        start_ns: start of the scan; first_number: number of the first column in the scan.
        """
        ...
