"""`mlbatch.dataset`: the scans of many outputs by number, in any order and by any process."""

from __future__ import annotations

import glob
from collections.abc import Iterable, Sequence
from operator import index as whole_number
from pathlib import Path
from typing import SupportsIndex, overload

import numpy as np

from mlbatch.arrays import I64Array
from mlbatch.bounded import parse_json, read_text
from mlbatch.errors import UsageError
from mlbatch.outputs.read import IndexedScans, open_scans
from mlbatch.outputs.run_files import SESSION_JSON, is_output
from mlbatch.outputs.scan import Scan
from mlbatch.outputs.table import Rows
from mlbatch.writers.atomic import PARTIAL_SUFFIX, SHARD_JSON

# Of files that may be outputs: reports and tables are next to them.
_SUFFIXES = (".mcap", ".bag", PARTIAL_SUFFIX)


class Dataset(Sequence[Scan]):
    """Scans of finished outputs of `convert`: each output in the order of `mlbatch.read`.

    It has the protocol of a map-style dataset of torch, and can be pickled. No file is open between
    two scans, so that processes may share it. skipped: folders, .mcap and .bag files that match a
    pattern and are no finished output.
    """

    def __init__(
        self, outputs: Sequence[IndexedScans], skipped: Sequence[Path], places: I64Array
    ) -> None:
        """places: (n, 2) output of each scan, and its number there."""
        self.skipped = tuple(skipped)
        self._outputs = tuple(outputs)
        self._places = places

    def __len__(self) -> int:
        return len(self._places)

    @overload
    def __getitem__(self, index: SupportsIndex) -> Scan: ...

    @overload
    def __getitem__(self, index: slice) -> Dataset: ...

    def __getitem__(self, index: SupportsIndex | slice) -> Scan | Dataset:
        """Read one scan; of a slice the dataset of these scans. RecordingError where it is damaged.

        IndexError outside of the dataset; -1 is the last scan.
        """
        if isinstance(index, slice):
            return Dataset(self._outputs, self.skipped, self._places[index])
        number = whole_number(index)
        if not -len(self) <= number < len(self):
            raise IndexError(f"scan {number}: expected less than {len(self)}")
        output, own = map(int, self._places[number])
        return self._outputs[output].scan(own)

    @property
    def table(self) -> Rows:
        """(n,) session, sensor, index, slice, start_ns, points, path of each scan, as a table.

        session: name of the output; sensor: with `--split`; points: -1 where scans.csv has not the
        number of this scan; path: of the file with the scan. `pandas.DataFrame(dataset.table)`.
        """
        places = [
            (_session_name(self._outputs[output].path), *self._outputs[output].places[own])
            for output, own in self._places.tolist()
        ]
        # Texts as wide as the longest.
        widths = [max((len(row[at]) for row in places), default=1) for at in (0, 1, -1)]
        session, sensor, path = (f"U{max(width, 1)}" for width in widths)
        numbers = [(name, np.int64) for name in ("index", "slice", "start_ns", "points")]
        return np.array(
            places, [("session", session), ("sensor", sensor), *numbers, ("path", path)]
        )

    def __repr__(self) -> str:
        """Numbers of scans and outputs."""
        skipped = f", {len(self.skipped)} paths skipped" if self.skipped else ""
        used = len(np.unique(self._places[:, 0]))
        outputs = "1 output" if used == 1 else f"{used} outputs"
        return f"<Dataset: {len(self)} scans of {outputs}{skipped}>"


def _session_name(path: Path) -> str:
    """The name of an output, or of its session in a batch."""
    return path.parent.name if (path.parent / SESSION_JSON).exists() else path.name


def dataset_of(paths: Iterable[Path]) -> Dataset:
    """The scans of outputs; of a pattern all finished outputs that match it."""
    outputs: list[IndexedScans] = []
    skipped: list[Path] = []
    for path in paths:
        if path.exists() or not glob.has_magic(str(path)):
            outputs += map(open_scans, _of_session(path))
            continue
        matches = [
            output
            for match in sorted(glob.glob(str(path), recursive=True))
            for output in _of_session(Path(match))
        ]
        # Neither of unfinished runs nor shards.
        finished = [
            match
            for match in matches
            if match.suffix != PARTIAL_SUFFIX
            and not (match / SHARD_JSON).exists()
            and is_output(match)
        ]
        if not finished:
            raise UsageError(
                f"{path}: expected outputs of `mlbatch convert`, found {len(matches)} other paths; "
                "check it with `ls`"
            )
        outputs += map(open_scans, finished)
        others = (match for match in matches if match not in finished)
        skipped += (match for match in others if match.is_dir() or match.suffix in _SUFFIXES)
    if not outputs:
        raise UsageError("output: expected at least one path, found none; name an output")
    places = [
        np.stack([np.full(len(one.places), at), np.arange(len(one.places))], axis=1)
        for at, one in enumerate(outputs)
    ]
    return Dataset(outputs, skipped, np.concatenate(places))


def _of_session(path: Path) -> list[Path]:
    """The outputs in the folder of a session of `mlbatch batch` that is done; else the path."""
    try:
        record = parse_json(read_text(path / SESSION_JSON))
        is_done = record["state"] == "done"
        return [path / name for name in record["outputs"]] if is_done else [path]
    except (OSError, ValueError, LookupError, TypeError):
        return [path]
