"""Targets: rig files, robot descriptions, and what users type as values of options."""

from __future__ import annotations

import random
import shutil
import zlib
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path

from mlbatch import sensors
from mlbatch.discovery.match import ExpectedSensor, match_rig
from mlbatch.discovery.sampler import Sampler
from mlbatch.errors import MlbatchError
from mlbatch.faults import parse_fault
from mlbatch.frames.urdf import joints
from mlbatch.pipeline import time_limits
from mlbatch.pipeline.job import wait_ns
from mlbatch.python.options import box_m, choice
from mlbatch.rig.rig import Rig, read_rig
from mlbatch.rig.write import write_rig
from mlbatch.sensors.options import check_options
from mlbatch.types import StreamTable
from mlbatch.units import parse_rate
from tests.builders.sessions_of_bags import urdf
from tests.contract.tree import ROOT
from tests.fuzz.harness import BrokenLaw, Target
from tests.fuzz.mutation import NUMBERS, Seeds, mutated_text

_FIXTURES = tuple(sorted((ROOT / "fixtures").glob("*/rig.yaml")))
_FULL_RIG = """\
body_frame: base_link
rate_hz: 20
sensors:
  - name: left
    model: auto
    stream: {source_ip: 10.5.5.87, port: 7502, serial: "122201000998"}
    metadata: ./left.json
    extrinsics: {translation_m: [1, -0.5, 1.25], rotation_rpy_deg: [0, 1.5, -179.9]}
    clock: {source: sensor, offset_s: -0.000000001}
    min_range_m: 0.5
    max_range_m: 120
    optional: true
    decode: {firing_azimuth: off, crc: check}
  - name: right
    model: VLP-16
    stream: {topic: /right/velodyne_packets}
    extrinsics:
      matrix: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  - name: rear
    stream: {port: 2368}
    extrinsics: {translation_m: [0, 0, 0], quaternion_xyzw: [0, 0, 0, 1]}
  - name: top
    stream: {topic: /top/points}
    extrinsics: {frame: top_lidar}
exclude_boxes_m:
  - [-1, -1, 0, 1, 1, 2]
"""


def _rigs() -> Seeds:
    return (_FULL_RIG.encode(), *(path.read_bytes() for path in _FIXTURES))


@lru_cache(maxsize=1)
def _sampler() -> Sampler:
    """A first look at the fixture with two lidars."""
    table = StreamTable()
    sampler = Sampler(table)
    from mlbatch.readers import open_recording

    recording = open_recording(_FIXTURES[-1].parent / "two_lidars.pcap", table)
    for batch in recording.packets():
        sampler.add(batch)
    return sampler


def _rig(data: bytes, folder: Path) -> None:
    """Read a rig; what was read is written, read again, and looked for among packets."""
    if not (folder / "left.json").exists():
        for path in _FIXTURES:
            for file in (*path.parent.glob("*.json"), *path.parent.glob("*.csv")):
                shutil.copy(file, folder)
    path = folder / "rig.yaml"
    path.write_bytes(data)
    rig = read_rig(path)
    path.write_text(write_rig(rig, folder), encoding="utf-8")
    try:
        again = read_rig(path)
    except MlbatchError as err:
        raise BrokenLaw(f"a rig that was written cannot be read: {err}") from err
    if write_rig(again, folder) != path.read_text(encoding="utf-8"):
        raise BrokenLaw("a rig changes when it is read and written")
    if zlib.crc32(data) % 8 == 0:
        _match(rig, path)


def _match(rig: Rig, path: Path) -> None:
    every = sensors.built_in()
    expected = [
        ExpectedSensor(
            one,
            [sensors.read_calibration(one.metadata) or every[0]] if one.metadata else every,
            {},
            path,
        )
        for one in rig.sensors
    ]
    match_rig(_sampler(), expected)


def _urdfs() -> Seeds:
    arm = (
        '<?xml version="1.0"?><robot name="r"><link name="a"/><joint name="j" type="revolute">'
        '<origin xyz="1 2 3" rpy="0 0.5 -3.14"/><parent link="a"/><child link="b"/>'
        '<axis xyz="0 0 1"/></joint><transmission><joint name="j"/></transmission></robot>'
    )
    bomb = '<!DOCTYPE r [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;">]><robot>&b;</robot>'
    return (urdf(1.5).encode(), arm.encode(), bomb.encode(), b"<robot/>")


def _urdf(data: bytes, folder: Path) -> None:
    text = data.decode("utf-8", "replace")
    if not all(joint.parent and joint.child for joint in joints(text)):
        raise BrokenLaw("a joint without two links")


_TYPED: Sequence[tuple[Callable[[str], object], tuple[str, ...]]] = (
    (parse_rate, ("10", "29.97", "10/3", "1e1", "0.25")),
    (
        lambda text: box_m("--exclude-box", text),
        ("-1,-1,0,1,1,2", "0,0,0,1,1,1", "-1e3,-1,0,1,1,2.5"),
    ),
    (lambda text: wait_ns("--max-wait", text), ("1.0", "inf", "0.05", "1e9")),
    (lambda text: time_limits.time_limit("--start", text), ("+12.5", "1700000000.5", "-3")),
    (lambda text: time_limits.time_limit("--end", text), ("2026-05-01T12:00:00Z", "2026-05-01")),
    (
        lambda text: check_options(dict(pair.partition("=")[::2] for pair in text.split(";"))),
        ("packet_stamp=end", "crc=check;optical_centre=on"),
    ),
    (
        lambda text: list(map(parse_fault, text.split(" "))),
        (
            *("drop:left:5%", "stall:left:5s-8s", "delay:left:60ms", "jump:left:37s@10s"),
            *("dup:left:1%", "reorder", "bitflip:*:0.1%", "drift:left:50ppm", "late:left:3s"),
        ),
    ),
    (lambda text: choice("--layout", text, ("dense", "organized")), ("dense",)),
)


def _typed_seeds() -> Seeds:
    return tuple(
        bytes([number]) + text.encode()
        for number, (_, texts) in enumerate(_TYPED)
        for text in (*texts, *NUMBERS)
    )


def _typed_mutated(rng: random.Random, seeds: Seeds) -> bytes:
    """The first byte chooses the option."""
    return bytes([rng.randrange(len(_TYPED))]) + mutated_text(
        rng, [seed[1:] for seed in rng.choices(seeds, k=4)]
    )


def _typed(data: bytes, folder: Path) -> None:
    parse, _ = _TYPED[data[0]]
    parse(data[1:].decode("utf-8", "replace"))


TARGETS: Sequence[Target] = (
    Target("rig", _rigs, _rig, mutated_text, 10),
    Target("robot description", _urdfs, _urdf, mutated_text, 30),
    Target("typed values", _typed_seeds, _typed, _typed_mutated, 30),
)
