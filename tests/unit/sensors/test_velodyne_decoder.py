"""The Velodyne decoder against the encoder of facts/velodyne.md, which shares no line with it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from mlbatch.errors import RigError, UsageError
from mlbatch.geometry import read_rotor_words
from mlbatch.lidar import FAULTS, READABLE, Evidence
from mlbatch.sensors import velodyne
from mlbatch.sensors._velodyne_packets import VelodyneLidar
from mlbatch.types import F32Array, F64Array, I64Array, Pixels, Stream, U8Array
from tests.builders.velodyne import (
    Sent,
    VelodyneSpec,
    directions,
    encode,
    firing_times_ns,
    origins,
)
from tests.builders.velodyne_tables import MODELS, calibration_yaml

PLAIN = ("VLP-16", "Puck Hi-Res", "HDL-32E", "VLP-32C", "VLS-128")
MODES = ("strongest", "last", "dual")
STREAM = Stream("192.168.1.201", 2368)
# Stamps are whole us; azimuths whole hundredths of a degree.
TIME_NS, ANGLE_DEG = 800, 0.012


@dataclass(frozen=True)
class Seen:
    """A stream, what was encoded into it, and its decoder."""

    spec: VelodyneSpec
    sent: Sent
    counts: I64Array
    level: I64Array
    lidar: VelodyneLidar

    @property
    def columns(self) -> I64Array:
        return np.arange(len(self.counts))


def made_of(spec: VelodyneSpec, packets: int = 24, options: dict[str, str] | None = None) -> Seen:
    """A stream of random readings."""
    rng = np.random.default_rng(7)
    lasers = len(spec.table.elevation_deg)
    shape = (packets * spec.columns_per_packet, lasers, spec.returns)
    counts = np.where(rng.random(shape) < 0.2, 0, rng.integers(1, 65536, shape))
    level = rng.integers(0, 256, shape)
    sent = encode(spec, counts, level)
    lidar = calibration(spec.model).lidar(options or {}, evidence(sent))
    return Seen(spec, sent, counts, level, lidar)


def evidence(sent: Sent) -> Evidence:
    return Evidence(STREAM, 1206, sent.payloads[:16], sent.host_ns[:16])


def calibration(model: str) -> velodyne.VelodyneCalibration:
    if model in PLAIN:
        built_in = [one for one in velodyne.BUILT_IN if one.model == model]
        assert isinstance(built_in[0], velodyne.VelodyneCalibration)
        return built_in[0]
    read = velodyne.read_calibration(Path("unit.yaml"), calibration_yaml(model).encode())
    assert read is not None
    named = read.for_model(model)
    assert named is not None
    return named


def records_of(lidar: VelodyneLidar, packets: U8Array) -> U8Array:
    """The columns of packets one after the other, as `lidar.records` says."""
    place = lidar.records
    at = [
        place.start + c // place.per_row * place.stride + c % place.per_row * place.step
        for c in range(lidar.columns_per_packet)
    ]
    parts = [packets[:, begin : begin + place.size] for begin in at]
    return np.stack(parts, axis=1).reshape(-1, place.size)


def pixels(lidar: VelodyneLidar, packets: U8Array) -> tuple[F32Array, F32Array]:
    """Ranges and levels, (columns, lasers, returns)."""
    records = records_of(lidar, packets)
    shape = (len(records), lidar.channels, lidar.returns)
    ranges, levels = np.full(shape, -1, np.float32), np.full(shape, -1, np.float32)
    for which in range(lidar.returns):
        plane = np.full(shape[:2], -1, np.float32)
        lidar.read(records, which, Pixels(plane, levels[..., which], None))
        ranges[..., which] = plane
    return ranges, levels


def fired(lidar: VelodyneLidar, sent: Sent) -> tuple[I64Array, F64Array]:
    """(columns, lasers): when each beam fires, ns, and the angle of the rotor then, rad."""
    heads = lidar.heads(sent.payloads, sent.host_ns)
    assert heads.valid.all()
    angle, speed, table = read_rotor_words(heads.encoder.reshape(-1))
    assert not table.any()
    time_ns = heads.stamp_ns.reshape(-1)[:, None] + lidar.firing_ns
    return time_ns, angle[:, None] + speed[:, None] * lidar.firing_ns


def pointing(lidar: VelodyneLidar, angle: F64Array) -> tuple[F64Array, F64Array]:
    """Directions and origins of beams at these angles, (columns, lasers, 3), in float64."""
    cosine, sine = np.cos(angle)[..., None], np.sin(angle)[..., None]
    direction, origin = (
        cosine * vectors[0] + sine * vectors[1] + vectors[2]
        for vectors in (lidar.beams.direction, lidar.beams.origin)
    )
    return direction, origin


def apart_deg(one: F64Array, other: F64Array) -> float:
    """Largest angle between unit vectors."""
    return float(np.degrees(2 * np.arcsin(np.linalg.norm(one - other, axis=-1) / 2)).max())


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("model", MODELS)
class TestEveryModel:
    def test_readings(self, model: str, mode: str) -> None:
        seen = made_of(VelodyneSpec(model, mode))
        ranges, levels = pixels(seen.lidar, seen.sent.payloads)
        exact = seen.counts.astype(np.float64) * seen.spec.table.unit_m
        assert (ranges == exact.astype(np.float32)).all()
        assert (levels == seen.level).all()

    def test_times_and_directions_of_all_beams(self, model: str, mode: str) -> None:
        for start_deg, start_us in ((0.0, 1e6), (358.0, 3_599_999_000.0), (90.0, 1_800_000_001.0)):
            spec = VelodyneSpec(model, mode, start_azimuth_deg=start_deg, start_us=start_us)
            seen = made_of(spec)
            time_ns, angle = fired(seen.lidar, seen.sent)
            wanted_ns = firing_times_ns(spec, seen.columns)
            assert np.abs(time_ns - wanted_ns).max() <= TIME_NS
            direction, origin = pointing(seen.lidar, angle)
            assert apart_deg(direction, directions(spec, seen.columns)) < ANGLE_DEG
            assert np.abs(origin - origins(spec, seen.columns)).max() < 1e-5

    def test_columns_behind_a_blind_sector(self, model: str, mode: str) -> None:
        """They fire when the rotor has passed it, wherever in a packet it lies."""
        for begin_deg in (30.0, 30.4, 31.3, 32.2):
            blind_deg = begin_deg, 250.0
            spec = VelodyneSpec(model, mode, start_azimuth_deg=29.0, blind_deg=blind_deg)
            seen = made_of(spec, packets=80)
            time_ns, angle = fired(seen.lidar, seen.sent)
            wanted_ns = firing_times_ns(spec, seen.columns)
            assert np.diff(wanted_ns[:, 0]).max() > 50_000_000
            late_ns = np.abs(time_ns - wanted_ns)
            # A hundredth of a degree, as the azimuth is rounded on both sides: 28 us.
            assert late_ns.max() < 40_000
            direction, _ = pointing(seen.lidar, angle)
            assert apart_deg(direction, directions(spec, seen.columns)) < ANGLE_DEG

    def test_what_it_says_of_itself(self, model: str, mode: str) -> None:
        seen = made_of(VelodyneSpec(model, mode))
        lidar, is_hdl64 = seen.lidar, model.startswith("HDL-64E")
        single = "single return" if is_hdl64 else f"{mode} return"
        assert lidar.mode == ("dual return" if mode == "dual" else single)
        types = {"strongest": (1,), "last": (2,), "dual": (0, 0)}[mode]
        assert lidar.return_types == ((0,) if is_hdl64 and mode != "dual" else types)
        assert (lidar.faults(seen.sent.payloads) == 0).all()
        order = np.argsort(seen.spec.table.elevation_deg, kind="stable")
        assert (lidar.channel[order] == np.arange(lidar.channels)).all()
        assert (lidar.firing_ns >= 0).all()
        assert calibration(model).fit(evidence(seen.sent)) > 0
        text = velodyne.describe(1206, seen.sent.payloads)
        assert text == f"Velodyne lidar {'HDL-64E' if is_hdl64 else model}, {lidar.mode}"

    def test_heads_do_not_depend_on_other_packets(self, model: str, mode: str) -> None:
        seen = made_of(VelodyneSpec(model, mode, blind_deg=(1.0, 200.0)), packets=30)
        packets, host_ns = seen.sent.payloads, seen.sent.host_ns
        whole = seen.lidar.heads(packets, host_ns)
        # As the core keeps them: rows of a wider buffer.
        wide = np.zeros((len(packets), 1300), np.uint8)
        wide[:, :1206] = packets
        for rows in (slice(0, 1), slice(7, 19), slice(29, 30)):
            part = seen.lidar.heads(wide[rows, :1206], host_ns[rows])
            assert (part.stamp_ns == whole.stamp_ns[rows]).all()
            assert (part.encoder == whole.encoder[rows]).all()


def test_second_half_of_a_block_is_turned_further() -> None:
    """600 rpm are 0.36 cdeg/us: half a block of the VLP-16 later, 19.9 cdeg further."""
    seen = made_of(VelodyneSpec("VLP-16"))
    angle, _, _ = read_rotor_words(seen.lidar.heads(seen.sent.payloads, seen.sent.host_ns).encoder)
    step_cdeg = np.degrees(angle[:, 1::2] - angle[:, 0::2]) * 100
    assert step_cdeg == pytest.approx(0.36 * 55.296, abs=0.3)


def test_without_motion_during_a_firing() -> None:
    """Columns keep their angles and beams their times; only the speed is gone."""
    on = made_of(VelodyneSpec("VLP-32C"))
    off = made_of(VelodyneSpec("VLP-32C"), options={"firing_azimuth": "off"})
    heads, still = (one.lidar.heads(one.sent.payloads, one.sent.host_ns) for one in (on, off))
    (angle, speed, _), (rest, none, _) = map(read_rotor_words, (heads.encoder, still.encoder))
    assert (angle == rest).all()
    assert speed == pytest.approx(2 * math.pi * 10 * 1e-9, rel=0.01)
    assert not none.any()
    assert (heads.stamp_ns == still.stamp_ns).all()
    assert (on.lidar.firing_ns == off.lidar.firing_ns).all()


def test_without_vertical_offsets_all_beams_leave_one_point() -> None:
    for model, lowest_m in (("VLP-16", 0.01123), ("HDL-32E", 0.01717), ("VLS-128", 0.0273)):
        on = made_of(VelodyneSpec(model)).lidar
        off = made_of(VelodyneSpec(model), options={"vertical_offset": "off"}).lidar
        assert on.beams.origin[2, :, 2].max() == pytest.approx(lowest_m, abs=5e-5)
        assert not off.beams.origin.any()
        assert (on.beams.direction == off.beams.direction).all()


def test_a_hdl_32e_that_stamps_the_end_of_its_packets() -> None:
    spec = VelodyneSpec("HDL-32E", stamps_end=True)
    seen = made_of(spec, options={"packet_stamp": "end"})
    time_ns, _ = fired(seen.lidar, seen.sent)
    assert np.abs(time_ns - firing_times_ns(spec, seen.columns)).max() <= TIME_NS
    # The option is none of the others'.
    other = made_of(VelodyneSpec("VLP-32C"), options={"packet_stamp": "end"})
    time_ns, _ = fired(other.lidar, other.sent)
    assert np.abs(time_ns - firing_times_ns(other.spec, other.columns)).max() <= TIME_NS


@pytest.mark.parametrize("mode", ["strongest", "dual"])
@pytest.mark.parametrize("sequence_us", [53.3, 53.33, 57.8])
def test_the_sequence_of_a_vls_128_is_measured(sequence_us: float, mode: str) -> None:
    spec = VelodyneSpec("VLS-128", mode, sequence_us=sequence_us)
    seen = made_of(spec)
    time_ns, angle = fired(seen.lidar, seen.sent)
    assert np.abs(time_ns - firing_times_ns(spec, seen.columns)).max() <= TIME_NS
    direction, _ = pointing(seen.lidar, angle)
    assert apart_deg(direction, directions(spec, seen.columns)) < 2 * ANGLE_DEG
    assert seen.lidar.notes == ()


def test_a_vls_128_seen_too_briefly_to_be_measured() -> None:
    seen = made_of(VelodyneSpec("VLS-128"), packets=3)
    (note,) = seen.lidar.notes
    assert note == "too few packets to measure its firing sequence: 55277 ns taken"


@pytest.mark.parametrize("rpm", [300.0, 1200.0])
@pytest.mark.parametrize("model", PLAIN)
def test_other_speeds(model: str, rpm: float) -> None:
    spec = VelodyneSpec(model, rpm=rpm, start_azimuth_deg=38.5, blind_deg=(40.0, 300.0))
    seen = made_of(spec, packets=60)
    time_ns, angle = fired(seen.lidar, seen.sent)
    assert np.abs(time_ns - firing_times_ns(spec, seen.columns)).max() < 80_000
    assert apart_deg(pointing(seen.lidar, angle)[0], directions(spec, seen.columns)) < ANGLE_DEG


def test_a_rotor_at_rest_has_no_speed_and_no_blind_sector() -> None:
    spec = VelodyneSpec("VLP-16", rpm=0.0, start_azimuth_deg=0.0)
    seen = made_of(spec)
    packets = seen.sent.payloads.copy()
    # It jitters around zero.
    packets[:, 102:104] = np.frombuffer((35999).to_bytes(2, "little"), np.uint8)
    heads = seen.lidar.heads(packets, seen.sent.host_ns)
    assert (np.diff(heads.stamp_ns, axis=1) == 55_296).all()
    _, speed, _ = read_rotor_words(heads.encoder)
    assert np.abs(speed).max() < 2 * math.pi * 1e-9 * 0.1


def test_a_rig_may_name_what_packets_do_not() -> None:
    sent = made_of(VelodyneSpec("VLP-16")).sent
    fits = {one.model: one.fit(evidence(sent)) for one in velodyne.BUILT_IN}
    readable = dict.fromkeys(("Puck LITE", "Puck Hi-Res", "HDL-32E", "VLP-32C"), READABLE)
    assert fits == {"VLP-16": 100, "VLS-128": 0, **readable}
    lite = next(one for one in velodyne.BUILT_IN if one.model == "Puck LITE")
    assert lite.lidar({}, evidence(sent)).model == "Puck LITE"


@pytest.mark.parametrize("product", [0x23, 0x31, 0x99])
def test_models_without_tables_are_never_taken_for_others(product: int) -> None:
    seen = made_of(VelodyneSpec("VLP-32C"))
    packets = seen.sent.payloads.copy()
    packets[:, 1205] = product
    part = Evidence(STREAM, 1206, packets, seen.sent.host_ns)
    assert {one.fit(part) for one in velodyne.BUILT_IN} == {0, READABLE}
    assert "no decoder in this version" in str(velodyne.describe(1206, packets))


def test_a_product_byte_belied_by_the_pace_is_told() -> None:
    spec = VelodyneSpec("VLP-16", product=0x21)
    sent = encode(spec, *np.ones((2, 16 * spec.columns_per_packet, 16, 1), np.int64))
    fits = {one.model: one.fit(evidence(sent)) for one in velodyne.BUILT_IN}
    assert fits["VLP-16"] == 100
    assert fits["HDL-32E"] == READABLE
    (note,) = calibration("VLP-16").lidar({}, evidence(sent)).notes
    assert note == "by the pace of its packets it is a VLP-16, though its product byte says HDL-32E"


def test_damaged_packets_are_told() -> None:
    good = made_of(VelodyneSpec("VLP-16", "dual"))
    spoiled = {
        "flag": (300, b"\xff\xdd"),
        "azimuth": (102, (36000).to_bytes(2, "little")),
        "stamp": (1200, (3_600_000_000).to_bytes(4, "little")),
        "another mode": (1204, b"\x37"),
    }
    for at, value in spoiled.values():
        packets = good.sent.payloads[:3].copy()
        packets[1, at : at + len(value)] = np.frombuffer(value, np.uint8)
        assert [FAULTS[code] for code in good.lidar.faults(packets)] == ["", "bad_header", ""]
    # Blocks that a VLS-128 does not use with two returns may hold anything.
    wide = made_of(VelodyneSpec("VLS-128", "dual"))
    packets = wide.sent.payloads.copy()
    packets[:, 800:1200] = 0
    assert not wide.lidar.faults(packets).any()


def test_a_sensor_that_is_silent_at_first_is_taken_for_a_single_return() -> None:
    lidar = calibration("VLP-16").lidar({}, None)
    (note,) = lidar.notes
    assert note == "no packet seen at first: taken for one that sends a single return"
    assert (lidar.returns, lidar.return_types) == (1, (0,))
    sent = made_of(VelodyneSpec("VLP-16", "last")).sent
    assert not lidar.faults(sent.payloads).any()
    # What it cannot read it refuses.
    dual = made_of(VelodyneSpec("VLP-16", "dual")).sent
    assert lidar.faults(dual.payloads).all()


def test_options_are_checked() -> None:
    with pytest.raises(UsageError, match="vertical_offset=on or vertical_offset=off"):
        calibration("VLP-16").lidar({"vertical_offset": "up"}, None)


class TestFiles:
    def test_the_model_is_the_one_with_the_nearest_angles(self) -> None:
        for model in PLAIN:
            read = velodyne.read_calibration(Path("a.yaml"), calibration_yaml(model).encode())
            assert read is not None
            assert (read.model, read.is_shared, read.serial) == (model, True, "")
            assert read.path == Path("a.yaml")

    def test_a_file_beats_the_table_of_its_model(self) -> None:
        seen = made_of(VelodyneSpec("VLP-16"))
        for model, fit in (("VLP-16", 200), ("Puck Hi-Res", READABLE), ("VLS-128", 0)):
            read = velodyne.read_calibration(Path("a.yaml"), calibration_yaml(model).encode())
            assert read is not None
            assert read.fit(evidence(seen.sent)) == fit

    def test_its_angles_and_offsets_are_used(self) -> None:
        table = MODELS["VLP-16"]
        text = calibration_yaml("VLP-16").replace(
            "- laser_id: 3\n  rot_correction: -0.0\n", "- laser_id: 3\n  rot_correction: -0.01\n"
        )
        lines = text.splitlines()
        at = lines.index("- laser_id: 3")
        lines[at + 3] = "  dist_correction: 0.05"
        lines[at + 5] = "  horiz_offset_correction: 0.02"
        read = velodyne.read_calibration(Path("a.yaml"), "\n".join(lines).encode())
        assert read is not None
        lidar = read.lidar({}, evidence(made_of(VelodyneSpec("VLP-16")).sent))
        # Section 5: alpha = azimuth - rot, so rotor at zero looks 0.01 rad to the right (-y); the
        # side offset of section 10 shifts it by h (sin, cos) of alpha.
        assert lidar.beams.reach_m.tolist() == [0.05 if laser == 3 else 0.0 for laser in range(16)]
        direction, origin = pointing(lidar, np.zeros((1, 16)))
        flat = math.cos(math.radians(table.elevation_deg[3]))
        assert direction[0, 3, 0] == pytest.approx(flat * math.cos(0.01))
        assert direction[0, 3, 1] == pytest.approx(-flat * math.sin(0.01))
        assert origin[0, 3] == pytest.approx(
            [0.02 * math.sin(0.01), 0.02 * math.cos(0.01), table.vertical_m[3]]
        )

    def test_another_unit_of_range_is_named_and_not_used(self) -> None:
        text = calibration_yaml("VLS-128").replace("resolution: 0.004", "resolution: 0.007")
        read = velodyne.read_calibration(Path("alpha.yaml"), text.encode())
        assert read is not None
        lidar = read.lidar({}, evidence(made_of(VelodyneSpec("VLS-128")).sent))
        assert lidar.notes == (
            "alpha.yaml: distance_resolution is 0.007 m, but a VLS-128 counts in 0.004 m, which is "
            "used",
        )

    def test_a_file_of_no_model(self) -> None:
        spec = replace(MODELS["VLP-16"], elevation_deg=tuple(np.linspace(-60, 60, 16)))
        text = calibration_yaml("VLP-16")
        for old, new in zip(MODELS["VLP-16"].elevation_deg, spec.elevation_deg, strict=True):
            text = text.replace(
                f"vert_correction: {math.radians(old)!r}\n",
                f"vert_correction: {math.radians(new)!r} \n",
            )
        with pytest.raises(RigError, match=r"odd\.yaml: .*wanted vertical angles of .*got some"):
            velodyne.read_calibration(Path("odd.yaml"), text.encode())

    def test_a_hdl_64e_is_an_s3_until_the_rig_says_s2(self) -> None:
        read = velodyne.read_calibration(Path("a.yaml"), calibration_yaml("HDL-64E S2").encode())
        assert read is not None
        sent = made_of(VelodyneSpec("HDL-64E S3")).sent
        assert read.model == "HDL-64E S3"
        assert read.fit(evidence(sent)) == 200
        (note,) = read.lidar({}, evidence(sent)).notes
        assert note == "taken for an HDL-64E S3; if it is an HDL-64E S2, name its model in the rig"
        other = read.for_model("HDL-64E S2")
        assert other is not None
        assert other.lidar({}, evidence(sent)).notes == ()
        assert read.for_model("VLP-16") is None

    def test_a_hdl_64e_needs_one(self) -> None:
        sent = made_of(VelodyneSpec("HDL-64E S3")).sent
        assert {one.fit(evidence(sent)) for one in velodyne.BUILT_IN} == {0}
