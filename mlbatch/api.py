"""Python interface: the scans that `mlbatch convert` writes, one after another in memory."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import TypeAlias

import numpy as np

from mlbatch.discovery.discover import SensorSelection
from mlbatch.errors import UsageError
from mlbatch.native import ALIASES, ENGINES
from mlbatch.pipeline.conversion import Conversion
from mlbatch.pipeline.job import Job, check_ranges_m, check_slices, check_sort, wait_ns
from mlbatch.types import Scan
from mlbatch.units import parse_rate

PathLike: TypeAlias = str | Path


def scans(
    *recordings: PathLike,
    rig: PathLike | None = None,
    rate: int | float | str | Fraction | None = None,
    slices: int = 1,
    layout: str = "dense",
    sort: str = "columns",
    keep_partial: bool = False,
    max_wait: float = 1.0,
    clock: str = "sensor",
    min_range: float = 0.0,
    max_range: float = math.inf,
    metadata: Sequence[PathLike] = (),
    only: Sequence[str] = (),
    ignore: Sequence[str] = (),
    identity_extrinsics: bool = False,
    keep_repeated: bool = False,
    decode: Mapping[str, str] | None = None,
    strict: bool = False,
    engine: str = "auto",
) -> Iterator[Scan]:
    """Yield the merged scans of one session, each with arrays of its own.

    Arguments are the options of `mlbatch convert` (max_wait in s, ranges in m, rate in Hz); fields
    of a Scan are named as the npz keys. Raises MlbatchError where the command ends with an error.
    """
    for name, value, known in (
        ("layout", layout, ("dense", "organized")),
        ("clock", clock, ("sensor", "host")),
        ("engine", engine, (*ENGINES, *ALIASES)),
    ):
        if value not in known:
            raise UsageError(f"{name}: expected {' or '.join(known)}, found {value!r}; choose one")
    check_ranges_m("min_range", min_range, "max_range", max_range)
    job = Job(
        recordings=tuple(Path(path) for path in recordings),
        selection=SensorSelection(
            rig=None if rig is None else Path(rig),
            metadata=tuple(Path(path) for path in metadata),
            only=tuple(only),
            ignore=tuple(ignore),
            identity_extrinsics=identity_extrinsics,
            host_clock=clock == "host",
            decode=dict(decode or {}),
        ),
        # By the text of a float: 29.97 means 2997/100, not the nearest binary number.
        rate=None if rate is None else parse_rate(str(rate)),
        slices=check_slices("slices", slices),
        layout=layout,
        sort=check_sort("sort", sort, layout),
        keep_partial=keep_partial,
        keep_repeated=keep_repeated,
        max_wait_ns=wait_ns("max_wait", max_wait, max_wait),
        min_range_m=min_range,
        max_range_m=max_range,
        strict=strict,
        engine=engine,
    )
    for scan, _ in Conversion(job).scans():
        yield _owned(scan)


def _owned(scan: Scan) -> Scan:
    """A scan with arrays of its own."""
    return replace(
        scan,
        xyz=np.array(scan.xyz, order="C"),
        intensity=scan.intensity.copy(),
        reflectivity=None if scan.reflectivity is None else scan.reflectivity.copy(),
        range_m=None if scan.range_m is None else scan.range_m.copy(),
        time_ns=scan.time_ns.copy(),
        ring=scan.ring.copy(),
        return_type=scan.return_type.copy(),
        lidar_id=scan.lidar_id.copy(),
        column=None if scan.column is None else scan.column.copy(),
    )
