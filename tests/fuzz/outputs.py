"""Targets: outputs of mlbatch that others changed, and `verify` has to judge."""

from __future__ import annotations

import random
import shutil
import tempfile
from collections.abc import Sequence
from functools import lru_cache, partial
from pathlib import Path

from mlbatch.verify import verify
from tests.builders.run import command
from tests.contract.tree import ROOT
from tests.fuzz.framing import Part, joined, parts_of
from tests.fuzz.harness import Target
from tests.fuzz.mutation import Seeds, mutated, mutated_text

_FIXTURE = ROOT / "fixtures" / "two_lidars"
_FORMATS = {"mcap": "o.mcap", "npz": "n", "ply": "p", "rosbag1": "o.bag", "rosbag2": "r"}
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
    for form, target in _FORMATS.items():
        told = command(
            "convert", *words, *limits, "--format", form, "-o", Path(place.name) / target
        )
        if told.code:
            raise RuntimeError(told.err)
    return place


def _files(form: str) -> list[Path]:
    """Files of an output, those of a folder from its front on; and what lies beside it."""
    place = Path(_whole().name)
    target = place / _FORMATS[form]
    inner = sorted(target.iterdir()) if target.is_dir() else sorted(place.glob(f"{target.name}*"))
    return [path.relative_to(place) for path in [*inner[:_PER_OUTPUT], *inner[-2:]]]


def _seeds(form: str) -> Seeds:
    return tuple(
        joined([Part(number, 0, (Path(_whole().name) / path).read_bytes())])
        for number, path in enumerate(_files(form))
    )


def _mutated(rng: random.Random, seeds: Seeds) -> bytes:
    (part,) = parts_of(rng.choice(seeds))
    # Texts are told by their first byte: report, table, metadata.
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
        verify(copy / _FORMATS[form])
    finally:
        path.write_bytes(sound)


TARGETS: Sequence[Target] = tuple(
    Target(f"verify {form}", partial(_seeds, form), partial(_verify, form), _mutated, 2)
    for form in _FORMATS
)
