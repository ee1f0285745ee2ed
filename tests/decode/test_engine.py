"""Pixels of any bytes against the literal decoder, and no writes beyond the arrays."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import weakref
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mlbatch.arrays import I64Array
from mlbatch.decode import decoder as decode
from mlbatch.decode import engine
from mlbatch.decode.decoder import Decoder
from mlbatch.decode.groups import Source
from mlbatch.decode.packet_ring import PacketRing
from mlbatch.decode.scan_buffer import LABEL, ScanBuffer
from mlbatch.frames.transforms import from_rpy_deg
from mlbatch.lidar.geometry import BeamTable
from mlbatch.lidar.interface import Lidar
from mlbatch.native.arena import PacketArena
from mlbatch.native.library import library
from mlbatch.pipeline.conversion import Conversion
from mlbatch.pipeline.sensor import new_ring
from mlbatch.sensors.ouster.profiles import PROFILES
from mlbatch.simulate.ouster.encode import OusterSpec
from mlbatch.simulate.spinning import SpinningSpec
from mlbatch.types import EXTRAS, RecordLayout, RunInfo, SensorInfo, Window, WindowColumns
from mlbatch.writers.las_encoder import RECORD as LAS
from mlbatch.writers.point_layouts import (
    CLOUD_LAYOUTS,
    PLY_LAYOUTS,
    ROWS_KITTI,
    ROWS_NUSCENES,
    ROWS_TIME,
)
from tests.builders import every_model as models
from tests.builders.decoded import rotor_words
from tests.builders.engines import BOXES_M, MOST_COLUMNS, Pair, assert_same
from tests.builders.spinning import ouster_calibration
from tests.contract.tree import PACKAGE
from tests.reference.decoder import readings_of, record_of
from tests.reference.records import check_records

START_NS = 1_800_000_000_000_000_000
END_NS = 1_800_000_000_100_000_000


def window_of(columns: WindowColumns) -> Window:
    """A window with these columns."""
    return Window(0, 0, START_NS, END_NS, True, 0, columns)


# Tilted, level, where the vehicle is, and upside down, with zeros of both signs: sensors that are
# decoded together differ in these.
POSES = (
    from_rpy_deg((0.3, -1.1, 1.7), (3.0, -7.0, 131.0)),
    from_rpy_deg((-1.0, 0.0, 1.8), (0.0, 0.0, 180.0)),
    np.eye(4),
    np.array([[1, 0, 0, 0], [0, -1, 0, 0], [-0.0, -0.0, -1, 0], [0, 0, 0, 1]]),
)
NAMES = tuple(name for name in PROFILES if name != "OFF")
GUARD_ROWS = 64
GUARD = 0xA5
# All layouts whose records the loops pack, and the arrays that these need.
PACKED = {
    layout.name: (layout.record, layout.extras)
    for layout in (
        *(*CLOUD_LAYOUTS.values(), *PLY_LAYOUTS.values(), ROWS_KITTI, ROWS_NUSCENES, ROWS_TIME),
    )
    if layout.record is not None
} | {"las": (LAS, frozenset({"reflectivity"}))}
# Of all kinds of rotors and pixels.
OTHERS = (
    models.velodyne("VLP-16", "dual"),
    models.velodyne("HDL-64E S3", "strongest"),
    models.hesai("XT32M2X", "triple"),
    models.hesai("AT128", "strongest"),
    models.hesai("Pandar128E3X", "strongest"),
    models.robosense("RS-16", "dual"),
    # Pixels that are not in the order of their shots.
    models.velodyne("VLS-128", "strongest"),
    models.velodyne("VLP-32C", "strongest"),
)


def ouster(profile: str, beams: int, seed: int = 0) -> Lidar:
    """A sensor with beams of its own."""
    angles = np.random.default_rng(seed).uniform(-22, 22, (2, beams)).round(2)
    # From the top beam to the lowest.
    angles[0][::-1].sort()
    spec = OusterSpec(
        profile, beams, 512, altitude_deg=angles[0].tolist(), azimuth_deg=angles[1].tolist()
    )
    return ouster_calibration(spec).lidar({}, None)


def lidar_of(spec: SpinningSpec, folder: Path) -> Lidar:
    """The lidar that a conversion finds in the packets of a unit."""
    (sensor,) = Conversion(models.job_of(models.sent_by(spec), folder)).sensors
    return sensor.lidar


@pytest.fixture(scope="module")
def others(tmp_path_factory: pytest.TempPathFactory) -> list[Lidar]:
    """Lidars of other vendors."""
    return [lidar_of(spec, tmp_path_factory.mktemp("lidar")) for spec in OTHERS]


@dataclass(frozen=True, slots=True)
class Case:
    """Drawn values; everything else follows from the seed."""

    seed: int
    columns: int
    layout: str
    extras: frozenset[str]
    is_cut: bool
    keeps_repeated: bool


cases = st.builds(
    Case,
    st.integers(0, 2**32),
    st.sampled_from((1, 2, 17, 130, 700)),
    st.sampled_from(("dense", "organized")),
    st.frozensets(st.sampled_from(sorted(EXTRAS))),
    st.booleans(),
    st.booleans(),
)


class Guarded(ScanBuffer):
    """A scan buffer between guard rows that nothing may write to."""

    def __init__(self, rows: int, slots: int | None, record: RecordLayout | None = None) -> None:
        super().__init__(rows, slots, record)
        self._guards: list[npt.NDArray[np.uint8]] = []
        for name in ("point", "range_m", "reflectivity", "label", "column", "packed"):
            array = getattr(self, name)
            row = array.itemsize * int(np.prod(array.shape[1:]))
            whole = np.full((len(array) + 2 * GUARD_ROWS) * row, GUARD, np.uint8)
            begin = GUARD_ROWS * row
            end = (GUARD_ROWS + len(array)) * row
            whole[begin:end] = 0
            self._guards += [whole[:begin], whole[end:]]
            setattr(self, name, whole[begin:end].view(array.dtype).reshape(array.shape))
        self.view_labels()

    @property
    def is_intact(self) -> bool:
        """Whether nothing was written beyond the arrays."""
        return all(bool((guard == GUARD).all()) for guard in self._guards)


def packets_of(lidar: Lidar, rng: np.random.Generator, count: int) -> npt.NDArray[np.uint8]:
    """Any bytes; many zeros, and few different ones, so that returns are absent or equal."""
    data = rng.integers(0, 256, count * lidar.packet_size, np.uint8)
    few = rng.random(len(data)) < rng.choice((0.0, 0.6, 0.95))
    data[few] = rng.integers(0, 2, int(few.sum()), np.uint8)
    return data


def filled(lidar: Lidar, rng: np.random.Generator) -> tuple[PacketRing, I64Array]:
    """A ring that has wrapped, and the ring indexes of the columns that it contains."""
    arena = PacketArena()
    ring = new_ring(lidar, arena)
    places: I64Array = np.empty(0, np.int64)
    for _ in range(4):
        count = int(rng.integers(20, 45))
        start = np.arange(count) * lidar.packet_size
        arena.keep_from(int(places[0]) if len(places) else None)
        places = ring.keep(packets_of(lidar, rng, count), start).ring_index
    return ring, (places[:, None] + ring.column_offsets(lidar.columns_per_packet)).reshape(-1)


def words_of(lidar: Lidar, rng: np.random.Generator, count: int) -> I64Array:
    """Any positions of the rotor."""
    if lidar.beams.angle_rad is not None:
        return rng.integers(0, len(lidar.beams.angle_rad), count)
    speed = rng.choice((0.0, 5.0, -20.0, 40.0), count)
    return rotor_words(rng.uniform(-1, 2, count), speed, int(rng.integers(len(lidar.firing_ns))))


class Packing:
    """Records that the loops pack, against the literal ones of the points in arrays."""

    def __init__(
        self, info: RunInfo, sources: list[Source], boxes_m: npt.NDArray[np.float64], name: str
    ) -> None:
        record, extras = PACKED[name]
        self._name = name
        self._arrays, self._records = (
            Decoder(info, sources, boxes_m, extras, record=chosen) for chosen in (None, record)
        )

    def check(self, window: Window) -> None:
        """Decode a window by both."""
        scan = self._arrays.scan(window)
        found = self._records.scan(window)
        assert scan.packed is None
        assert found.packed is not None
        packed = found.packed
        assert packed.shape == scan.time_ns.T.shape
        records = packed.buffer[packed.begin : packed.end].tobytes()
        check_records(records, scan, self._name, seed=len(window.columns))
        assert self._arrays.counts == self._records.counts
        if packed.totals is not None and scan.points:
            assert packed.totals.low_m == tuple(scan.xyz.min(axis=0).tolist())
            assert packed.totals.high_m == tuple(scan.xyz.max(axis=0).tolist())
            farther = int(np.isin(scan.return_type, (4, 6)).sum())
            assert packed.totals.second_returns == farther


class Drawn:
    """Sensors with any bytes in their rings, and windows of their columns."""

    def __init__(self, lidars: list[Lidar], case: Case) -> None:
        self._case = case
        self._lidars = lidars
        self._rng = np.random.default_rng(case.seed)
        rings = [filled(lidar, self._rng) for lidar in lidars]
        self._places = [places for _, places in rings]
        self.boxes_m = np.array(BOXES_M if case.is_cut else ()).reshape(-1, 6)
        infos = []
        self.sources = []
        base = 0
        for number, (lidar, (ring, _)) in enumerate(zip(lidars, rings, strict=True)):
            pose = POSES[(case.seed + number) % len(POSES)]
            low_m, high_m = (1.0 + number, 60.0) if case.is_cut else (0.0, float("inf"))
            source = Source(lidar, ring, pose, base, low_m, high_m, case.keeps_repeated)
            self.sources.append(source)
            infos.append(SensorInfo("one", lidar.model, lidar.channels, lidar.returns, base, pose))
            base += lidar.channels
        self.info = RunInfo(tuple(infos), "base_link", "10", "utc", 1, case.layout)

    def columns(self) -> WindowColumns:
        """Columns of all sensors, of a window from START_NS on."""
        rng, count = self._rng, self._case.columns
        sensor = rng.integers(0, len(self._lidars), count)
        place, word = np.empty((2, count), np.int64)
        for number, (lidar, places) in enumerate(zip(self._lidars, self._places, strict=True)):
            own = sensor == number
            place[own] = rng.choice(places, int(own.sum()))
            word[own] = words_of(lidar, rng, int(own.sum()))
        stamp_ns = np.sort(rng.integers(START_NS, END_NS, count))
        return WindowColumns(stamp_ns, sensor, place, word)


def check(lidars: list[Lidar], case: Case) -> None:
    """Decode the same columns, twice, by both decoders."""
    drawn = Drawn(lidars, case)
    rng = np.random.default_rng(case.seed)
    pair = Pair(drawn.info, drawn.sources, drawn.boxes_m, case.extras)
    names = [name for name in PACKED if name != "las" or case.layout == "dense"]
    name = names[case.seed % len(names)]
    packing = Packing(drawn.info, drawn.sources, drawn.boxes_m, name)
    for _ in range(2):
        columns = drawn.columns()
        few = np.sort(rng.permutation(case.columns)[:MOST_COLUMNS])
        pair.check(window_of(columns.take(few)))
        packing.check(window_of(columns))


# Lanes of the baseline of a processor, and another compiler, where it is installed.
@pytest.mark.parametrize("words", [("cc", "-DMLBATCH_NARROW"), ("clang",)], ids=" ".join)
@pytest.mark.parametrize("layout", ["dense", "organized"])
def test_all_builds_give_the_same_bytes(
    words: tuple[str, ...], layout: str, others: list[Lidar], tmp_path: Path
) -> None:
    if shutil.which(words[0]) is None:
        pytest.skip(f"{words[0]} is not installed")
    path = tmp_path / "other.so"
    flags = ["-std=c11", "-O3", "-ffp-contract=off", "-fPIC", "-shared", "-o", str(path)]
    sources = [str(one) for one in sorted((PACKAGE / "native").glob("*.c"))]
    subprocess.run([*words, *flags, *sources], check=True)
    other = ctypes.CDLL(str(path))
    ours_of = library().mlbatch_decode
    other.mlbatch_decode.restype, other.mlbatch_decode.argtypes = ours_of.restype, ours_of.argtypes
    lidars = [*others, level_sensor("RNG15_RFL8_NIR8"), ouster("RNG19_RFL8_SIG16_NIR16_DUAL", 16)]
    for seed, extras in enumerate((frozenset[str](), EXTRAS, EXTRAS)):
        case = Case(seed, 700, layout, extras, is_cut=seed == 1, keeps_repeated=seed == 2)
        drawn = Drawn(lidars, case)
        columns = drawn.columns()
        moves = np.random.default_rng(seed).normal(size=(case.columns, 3, 4)).astype(np.float32)
        decoders = [Decoder(drawn.info, drawn.sources, drawn.boxes_m, extras) for _ in range(2)]
        cast(Any, decoders[1])._engine._library = other
        for due in (columns, replace(columns, moves=moves)):
            ours, theirs = (decoder.scan(window_of(due)) for decoder in decoders)
            assert ours.points > 0
            assert_same(ours, theirs)
        assert decoders[0].counts == decoders[1].counts


def level_sensor(profile: str) -> Lidar:
    """A sensor whose upper 64 beams are at elevation 0."""
    altitude_deg = (5.0,) * 64 + (0.0,) * 64
    spec = OusterSpec(profile, 128, 512, altitude_deg=altitude_deg, azimuth_deg=(0.0,) * 128)
    return ouster_calibration(spec).lidar({}, None)


upright = pytest.mark.parametrize("profile", ["RNG15_RFL8_NIR8", "RNG19_RFL8_SIG16_NIR16"])


@upright
@pytest.mark.parametrize("pose", range(len(POSES)))
@pytest.mark.parametrize("origin_m", [None, 0.0, -0.0])
@pytest.mark.parametrize("layout", ["dense", "organized"])
@pytest.mark.parametrize("extras", [frozenset(), EXTRAS], ids=["plain", "extras"])
def test_terms_of_zero_keep_the_signs_of_zeros(
    pose: int,
    profile: str,
    origin_m: float | None,
    layout: str,
    extras: frozenset[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The loops leave terms of zero out: origins of -0 would show it. All bits are compared."""
    lidar = level_sensor(profile)
    beams = lidar.beams.moved(POSES[pose])
    if origin_m is not None:
        rows = np.full((512, 3, 1), origin_m, np.float32)
        monkeypatch.setattr(BeamTable, "origins", lambda self: rows)
    rng = np.random.default_rng(pose)
    ring, places = filled(lidar, rng)
    word = words_of(lidar, rng, len(places))
    source = Source(lidar, ring, POSES[pose], 0)
    first, second, third = beams.vectors()
    cosine, sine = (part[word, None, None] for part in beams.rotor())
    direction = cosine * first + sine * second + third
    ranges_m = np.stack([readings_of(lidar, record_of(source.ring, at), 0)[0] for at in places])
    reaches_m = ranges_m + beams.reach_m.astype(np.float32)
    expected = (reaches_m[:, None] * direction + beams.origins()[word]).transpose(0, 2, 1)
    info = SensorInfo("one", lidar.model, lidar.channels, lidar.returns, 0, POSES[pose])
    run = RunInfo((info,), "base_link", "10", "utc", 1, layout)
    stamp_ns = np.full(len(places), START_NS)
    due = WindowColumns(stamp_ns, np.zeros(len(places), np.int64), places, word)
    xyz = Decoder(run, [source], np.empty((0, 6)), extras).scan(window_of(due)).xyz
    is_point = ranges_m > 0
    found = xyz[: len(places)][is_point] if layout == "organized" else xyz
    assert is_point.any()
    assert found.tobytes() == expected[is_point].tobytes()


@given(
    case=cases,
    chosen=st.lists(st.integers(0, len(OTHERS) + 2), min_size=1, max_size=4),
    profile=st.sampled_from(NAMES),
    beams=st.sampled_from((16, 32, 64, 128)),
)
@settings(max_examples=60)
def test_any_pixels_of_any_rig(
    case: Case, chosen: list[int], profile: str, beams: int, others: list[Lidar]
) -> None:
    # Two that are decoded together, as their pixels are alike.
    alike = [ouster("RNG15_RFL8_NIR8", 32, 1), ouster("RNG15_RFL8_NIR8", 32, 2)]
    check([[*others, *alike, ouster(profile, beams)][number] for number in chosen], case)


@pytest.mark.parametrize("chosen", [[0, 0, 0], [0, 2, 0], [5, 0, 5], [4, 1, 4], [6, 7, 6]])
def test_sensors_of_one_model_are_decoded_together(chosen: list[int], others: list[Lidar]) -> None:
    for seed, layout in enumerate(("dense", "organized", "dense")):
        case = Case(seed, 700, layout, EXTRAS, is_cut=seed == 0, keeps_repeated=False)
        check([others[number] for number in chosen], case)
        alone(Drawn([others[number] for number in chosen], case))


def alone(drawn: Drawn) -> None:
    """Each sensor has the points, bit by bit, that it has alone."""
    columns = drawn.columns()
    together = Decoder(drawn.info, drawn.sources, drawn.boxes_m).scan(window_of(columns))
    for number, source in enumerate(drawn.sources):
        own = columns.take(np.flatnonzero(columns.sensor == number))
        one = replace(own, sensor=np.zeros(len(own), np.int64))
        decoder = Decoder(drawn.info, [source], drawn.boxes_m, only=number)
        scan = decoder.scan(window_of(one))
        is_organized = scan.info.layout == "organized"
        is_own = columns.sensor == number if is_organized else together.lidar_id == number
        assert scan.points > 0
        for name in ("xyz", "intensity", "time_ns", "ring", "return_type"):
            expected = getattr(scan, name)
            found = getattr(together, name)[is_own]
            # Of sensors with fewer slots the others are empty.
            found = found[:, : expected.shape[1]] if is_organized else found
            assert found.tobytes() == expected.tobytes(), name


@pytest.mark.parametrize("layout", ["dense", "organized"])
@pytest.mark.parametrize("chosen", [[0], [2], [3, 0], [5, 8, 2, 9], [6, 7]])
def test_nothing_is_written_beyond_the_arrays(
    layout: str, chosen: list[int], others: list[Lidar], monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Guarded] = []

    def guarded(rows: int, slots: int | None, record: RecordLayout | None = None) -> Guarded:
        made.append(Guarded(rows, slots, record))
        return made[-1]

    monkeypatch.setattr(decode, "ScanBuffer", guarded)
    monkeypatch.setattr(engine, "ScanBuffer", guarded)
    full = [ouster("RNG15_RFL8_NIR8", 16), ouster("RNG19_RFL8_SIG16_NIR16_DUAL", 16)]
    lidars = [[*others, *full][number] for number in chosen]
    for seed in range(3):
        check(lidars, Case(seed, 130, layout, EXTRAS, is_cut=False, keeps_repeated=True))
    assert made
    assert all(buffer.is_intact for buffer in made)


@pytest.mark.parametrize("layout", ["dense", "organized"])
@pytest.mark.parametrize("number", range(len(PACKED)), ids=list(PACKED))
def test_records_of_every_layout(layout: str, number: int, others: list[Lidar]) -> None:
    alike = [ouster("RNG15_RFL8_NIR8", 32, 1), ouster("RNG15_RFL8_NIR8", 32, 2)]
    dual = ouster("RNG19_RFL8_SIG16_NIR16_DUAL", 16)
    for lidars in (alike, [dual, *alike], others):
        case = Case(number, 333, layout, EXTRAS, is_cut=False, keeps_repeated=True)
        check(lidars, case)


def test_records_stay_while_the_loops_run() -> None:
    lidar = ouster("RNG15_RFL8_NIR8", 16)
    rng = np.random.default_rng(0)
    ring, places = filled(lidar, rng)
    before = weakref.ref(ring.view[0])
    info = SensorInfo("one", lidar.model, lidar.channels, lidar.returns, 0, POSES[0])
    run = RunInfo((info,), "base_link", "10", "utc", 1, "dense")
    sources = [Source(lidar, ring, POSES[0], 0)]
    decoder = Decoder(run, sources, np.empty((0, 6)), EXTRAS)
    decode_columns = library().mlbatch_decode
    grown = []

    class Late:
        """The library, whose ring grows before it runs."""

        def mlbatch_decode(self, scan: object) -> int:
            start = np.arange(1000) * lidar.packet_size
            ring.keep(packets_of(lidar, rng, 1000), start)
            grown.append(before() is not None and before() is not ring.view[0])
            return int(decode_columns(scan))

    cast(Any, decoder)._engine._library = Late()
    stamp_ns = np.full(len(places), START_NS)
    nothing = np.zeros(len(places), np.int64)
    due = WindowColumns(stamp_ns, nothing, places, nothing)
    assert decoder.scan(window_of(due)).points > 0
    assert grown == [True]


def test_labels_are_words_of_eight_bytes() -> None:
    """As the compiled loops read them."""
    assert LABEL.itemsize == 8
    assert LABEL.fields is not None
    assert LABEL.fields["lidar_id"][1] == 7
