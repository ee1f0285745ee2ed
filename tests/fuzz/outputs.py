"""Targets: changed outputs of mlbatch, for `verify` and for the readers."""

from __future__ import annotations

import random
import shutil
import tempfile
from collections.abc import Sequence
from functools import lru_cache, partial
from pathlib import Path

from mlbatch.readers import open_recording
from mlbatch.types import StreamTable
from mlbatch.verification import verify
from tests.builders.run import command
from tests.contract.tree import ROOT
from tests.fuzz.framing import Part, joined, parts_of
from tests.fuzz.harness import Target
from tests.fuzz.mutation import Seeds, mutated, mutated_text
from tests.fuzz.readers import mutated_mcap, read_all

_FIXTURE = ROOT / "fixtures" / "two_lidars"
# Format, target, compression.
_FORMS = {
    "mcap": ("mcap", "o.mcap", "none"),
    "mcap lz4": ("mcap", "lz4.mcap", "lz4"),
    "mcap zstd": ("mcap", "zstd.mcap", "zstd:1"),
    "npz": ("npz", "n", "none"),
    "webdataset": ("webdataset", "w", "none"),
    "ply": ("ply", "p", "none"),
    "pcd": ("pcd", "c", "none"),
    "las": ("las", "l", "none"),
    "kitti": ("kitti", "k", "none"),
    "nuscenes": ("nuscenes", "s", "none"),
    "rosbag1": ("rosbag1", "o.bag", "none"),
    "rosbag2": ("rosbag2", "r", "none"),
}
_MAGIC = b"\x89MCAP"
_MCAPS = ("mcap", "mcap lz4", "mcap zstd")
_PER_OUTPUT = 4


@lru_cache(maxsize=1)
def _whole() -> tempfile.TemporaryDirectory[str]:
    """A folder with a short output of every format; gone with this process."""
    place: tempfile.TemporaryDirectory[str] = tempfile.TemporaryDirectory()
    words = (_FIXTURE / "two_lidars.pcap", "--rig", _FIXTURE / "rig.yaml", "--quiet")
    limits = (
        "--rate",
        "50",
        "--end",
        "+0.041",
        "--min-range",
        "4.5",
        "--exclude-box=-9,-9,0,9,9,9",
    )
    for form, target, compression in _FORMS.values():
        run = command(
            *("convert", *words, *limits, "--format", form, "--compression", compression),
            *("-o", Path(place.name) / target),
        )
        if run.code:
            raise RuntimeError(run.err)
    return place


def _files(form: str) -> list[Path]:
    """The first and last files of an output, report and table included."""
    place = Path(_whole().name)
    target = place / _FORMS[form][1]
    inner = sorted(target.iterdir()) if target.is_dir() else sorted(place.glob(f"{target.name}*"))
    return [path.relative_to(place) for path in [*inner[:_PER_OUTPUT], *inner[-2:]]]


def _seeds(form: str) -> Seeds:
    return tuple(
        joined([Part(number, 0, (Path(_whole().name) / path).read_bytes())])
        for number, path in enumerate(_files(form))
    )


def _mutated(rng: random.Random, seeds: Seeds) -> bytes:
    (part,) = parts_of(rng.choice(seeds))
    if part.data.startswith(_MAGIC) and rng.random() < 0.6:
        return joined([Part(part.kind, 0, mutated_mcap(rng, [part.data]))])
    # Report, table and metadata.yaml, by their first byte.
    change = mutated_text if part.data[:1] in b"{ir" and rng.random() < 0.9 else mutated
    return joined([Part(part.kind, 0, change(rng, [part.data]))])


def _verify(form: str, data: bytes, folder: Path) -> None:
    copy = folder / "outputs"
    if not copy.exists():
        shutil.copytree(_whole().name, copy)
    (part,) = parts_of(data)
    path = copy / _files(form)[part.kind]
    sound = path.read_bytes()
    path.write_bytes(part.data)
    try:
        verify(copy / _FORMS[form][1])
    finally:
        path.write_bytes(sound)


# -- as recordings --------------------------------------------------------------------------------


def _mcaps() -> Seeds:
    return tuple((Path(_whole().name) / _FORMS[form][1]).read_bytes() for form in _MCAPS)


def _read(data: bytes, folder: Path) -> None:
    path = folder / "a.mcap"
    path.write_bytes(data)
    streams = StreamTable()
    read_all(open_recording(path, streams), streams)


TARGETS: Sequence[Target] = (
    *(
        Target(f"verify {form}", partial(_seeds, form), partial(_verify, form), _mutated, 2)
        for form in _FORMS
    ),
    Target("read outputs", _mcaps, _read, mutated_mcap, 3),
)
