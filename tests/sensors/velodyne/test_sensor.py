"""Velodyne decoder: encoded packets come back; calibration files and models that they fit."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mlbatch.errors import RigError, UsageError
from mlbatch.lidar.geometry import read_rotor_words
from mlbatch.lidar.interface import FAULTS, NAMED_ONLY, Evidence, ModelFile
from mlbatch.sensors.velodyne import sensor as velodyne
from mlbatch.simulate.velodyne.encode import (
    Sent,
    VelodyneSpec,
    directions,
    encode,
    firing_times_ns,
    origins,
)
from mlbatch.simulate.velodyne.models import MODELS, calibration_yaml
from tests.builders.decoded import readings
from tests.builders.velodyne_streams import (
    ANGLE_DEG,
    MODES,
    PLAIN,
    STREAM,
    TIME_NS,
    apart_deg,
    calibration,
    evidence,
    fired,
    made_of,
    pixels,
    pointing,
)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("model", MODELS)
class TestEveryModel:
    def test_readings(self, model: str, mode: str) -> None:
        seen = made_of(VelodyneSpec(model, mode))
        ranges, levels = pixels(seen.lidar, seen.sent.payloads)
        exact = seen.counts.astype(np.float64) * seen.spec.table.unit_m
        assert (ranges == exact.astype(np.float32)).all()
        is_return = exact > 0
        assert (levels[is_return] == seen.level[is_return]).all()

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
        """They fire when the rotor has passed it, wherever it is in a packet."""
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

    def test_an_azimuth_of_36000_is_0(self, model: str, mode: str) -> None:
        """Units send both; 36001 is damage."""
        plain = VelodyneSpec(model, mode)
        # 600 rpm are 0.0036 degrees/us: the third azimuth is 0.
        seen = made_of(replace(plain, start_azimuth_deg=-2 * 0.0036 * plain.row_us))
        used = 8 if (model, mode) == ("VLS-128", "dual") else 12
        at = np.arange(used) * 100 + 2
        words = seen.sent.payloads[:, at] | seen.sent.payloads[:, at + 1].astype(np.int64) << 8
        rows, blocks = (words == 0).nonzero()
        assert len(rows) == plain.returns * len(plain.table.flags)

        def rewritten(cdeg: int) -> Sent:
            payloads = seen.sent.payloads.copy()
            payloads[rows, at[blocks]] = cdeg & 0xFF
            payloads[rows, at[blocks] + 1] = cdeg >> 8
            return Sent(payloads, seen.sent.host_ns)

        full = rewritten(36000)
        lidar = calibration(model).lidar({}, evidence(full))
        assert not lidar.faults(full.payloads).any()
        found = lidar.column_headers(full.payloads, full.host_ns)
        expected = seen.lidar.column_headers(seen.sent.payloads, full.host_ns)
        assert (found.stamp_ns == expected.stamp_ns).all()
        assert (found.encoder == expected.encoder).all()
        # Alone, too, it is a packet of this model.
        only = full.payloads[rows[:1]]
        assert velodyne.describe(1206, only) is not None
        faults = lidar.faults(rewritten(36001).payloads)
        assert faults.nonzero()[0].tolist() == np.unique(rows).tolist()

    def test_attributes(self, model: str, mode: str) -> None:
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
        assert calibration(model).match_score(evidence(seen.sent)) > 0
        text = velodyne.describe(1206, seen.sent.payloads)
        assert text == f"Velodyne lidar {'HDL-64E' if is_hdl64 else model}, {lidar.mode}"

    def test_heads_do_not_depend_on_other_packets(self, model: str, mode: str) -> None:
        seen = made_of(VelodyneSpec(model, mode, blind_deg=(1.0, 200.0)), packets=30)
        packets, host_ns = seen.sent.payloads, seen.sent.host_ns
        whole = seen.lidar.column_headers(packets, host_ns)
        # As the core keeps them: rows of a wider buffer.
        wide = np.zeros((len(packets), 1300), np.uint8)
        wide[:, :1206] = packets
        for rows in (slice(0, 1), slice(7, 19), slice(29, 30)):
            part = seen.lidar.column_headers(wide[rows, :1206], host_ns[rows])
            assert (part.stamp_ns == whole.stamp_ns[rows]).all()
            assert (part.encoder == whole.encoder[rows]).all()


def test_second_half_of_a_block_is_turned_further() -> None:
    """600 rpm are 0.36 cdeg/us: half a block of the VLP-16 later, 19.9 cdeg further."""
    seen = made_of(VelodyneSpec("VLP-16"))
    angle, _, _ = read_rotor_words(
        seen.lidar.column_headers(seen.sent.payloads, seen.sent.host_ns).encoder
    )
    step_cdeg = np.degrees(angle[:, 1::2] - angle[:, 0::2]) * 100
    assert step_cdeg == pytest.approx(0.36 * 55.296, abs=0.3)


def test_without_motion_during_a_firing() -> None:
    """Columns keep their angles and beams their times; only the speed is gone."""
    on = made_of(VelodyneSpec("VLP-32C"))
    off = made_of(VelodyneSpec("VLP-32C"), options={"firing_azimuth": "off"})
    headers, still = (
        one.lidar.column_headers(one.sent.payloads, one.sent.host_ns) for one in (on, off)
    )
    (angle, speed, _), (rest, none, _) = map(read_rotor_words, (headers.encoder, still.encoder))
    assert (angle == rest).all()
    assert speed == pytest.approx(2 * math.pi * 10 * 1e-9, rel=0.01)
    assert not none.any()
    assert (headers.stamp_ns == still.stamp_ns).all()
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
    assert note == "too few packets to measure its firing sequence: 55277 ns assumed"


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
    headers = seen.lidar.column_headers(packets, seen.sent.host_ns)
    assert (np.diff(headers.stamp_ns, axis=1) == 55_296).all()
    _, speed, _ = read_rotor_words(headers.encoder)
    assert np.abs(speed).max() < 2 * math.pi * 1e-9 * 0.1


def test_a_rig_may_name_what_packets_do_not() -> None:
    sent = made_of(VelodyneSpec("VLP-16")).sent
    fits = {one.model: one.match_score(evidence(sent)) for one in velodyne.BUILT_IN}
    readable = dict.fromkeys(("Puck LITE", "Puck Hi-Res"), NAMED_ONLY)
    # Blocks of an HDL-32E and a VLP-32C take half as long.
    others = dict.fromkeys(("HDL-32E", "VLP-32C", "VLS-128", "HDL-64E S2", "HDL-64E S3"), 0)
    assert fits == {"VLP-16": 100, **others, **readable}
    lite = next(one for one in velodyne.BUILT_IN if one.model == "Puck LITE")
    assert lite.lidar({}, evidence(sent)).model == "Puck LITE"
    files = [one for one in velodyne.BUILT_IN if isinstance(one, ModelFile)]
    named = [one.for_model(one.model) for one in files]
    fits = {one.model: one.match_score(evidence(sent)) for one in named if one is not None}
    # VLP-16 and Puck LITE send the same; the Puck Hi-Res has its own product byte.
    assert fits == {"VLP-16": 100, **others, "Puck LITE": 100, "Puck Hi-Res": NAMED_ONLY}


@pytest.mark.parametrize("product", [0x23, 0x31, 0x99])
def test_models_without_tables_are_never_taken_for_others(product: int) -> None:
    seen = made_of(VelodyneSpec("VLP-32C"))
    packets = seen.sent.payloads.copy()
    packets[:, 1205] = product
    part = Evidence(STREAM, 1206, packets, seen.sent.host_ns)
    assert {one.match_score(part) for one in velodyne.BUILT_IN} == {0, NAMED_ONLY}
    assert "no decoder in this version" in str(velodyne.describe(1206, packets))


def test_a_product_byte_contradicted_by_the_pace_is_noted() -> None:
    spec = VelodyneSpec("VLP-16", product=0x21)
    sent = encode(spec, *np.ones((2, 16 * spec.columns_per_packet, 16, 1), np.int64))
    fits = {one.model: one.match_score(evidence(sent)) for one in velodyne.BUILT_IN}
    assert fits["VLP-16"] == 100
    assert fits["HDL-32E"] == 0
    (note,) = calibration("VLP-16").lidar({}, evidence(sent)).notes
    assert (
        note == "model by the pace of its packets: VLP-16, although its product byte says HDL-32E"
    )


def test_damaged_packets_are_reported() -> None:
    good = made_of(VelodyneSpec("VLP-16", "dual"))
    spoiled = {
        "flag": (300, b"\xff\xdd"),
        "azimuth": (102, (36001).to_bytes(2, "little")),
        "stamp": (1200, (3_600_000_000).to_bytes(4, "little")),
        "another mode": (1204, b"\x37"),
    }
    for at, value in spoiled.values():
        packets = good.sent.payloads[:3].copy()
        packets[1, at : at + len(value)] = np.frombuffer(value, np.uint8)
        assert [FAULTS[code] for code in good.lidar.faults(packets)] == ["", "bad_header", ""]
    # Blocks that a VLS-128 does not use with two returns may have any content.
    wide = made_of(VelodyneSpec("VLS-128", "dual"))
    packets = wide.sent.payloads.copy()
    packets[:, 800:1200] = 0
    assert not wide.lidar.faults(packets).any()


def test_a_sensor_that_is_silent_at_first_is_taken_for_a_single_return() -> None:
    lidar = calibration("VLP-16").lidar({}, None)
    (note,) = lidar.notes
    assert note == "no packets in the first 10 seconds: single return assumed"
    assert (lidar.returns, lidar.return_types) == (1, (0,))
    sent = made_of(VelodyneSpec("VLP-16", "last")).sent
    assert not lidar.faults(sent.payloads).any()
    # What it cannot read it refuses.
    dual = made_of(VelodyneSpec("VLP-16", "dual")).sent
    assert lidar.faults(dual.payloads).all()


def test_options_are_checked() -> None:
    with pytest.raises(UsageError, match="vertical_offset=on or vertical_offset=off"):
        calibration("VLP-16").lidar({"vertical_offset": "up"}, None)


@pytest.mark.parametrize("mode", ["strongest", "dual"])
@pytest.mark.parametrize("model", ["HDL-64E S2", "HDL-64E S3"])
def test_points_of_a_hdl_64e(model: str, mode: str) -> None:
    """Every ray ends where it met something, corrections and all; counts are 2 mm."""
    spec = VelodyneSpec(model, mode, start_azimuth_deg=200.0)
    seen = made_of(spec, packets=20)
    met_m = seen.counts[..., 0] * 0.002 + np.array(spec.table.dist_m)
    expected = origins(spec, seen.columns)
    expected = expected + met_m[..., None] * directions(spec, seen.columns)
    for height, options in ((0.0, {}), (1.0, {"vertical_offset": "off"})):
        lidar = calibration(model).lidar(options, evidence(seen.sent))
        points = readings(lidar, seen.sent.payloads, seen.sent.host_ns).xyz[:, :, 0]
        lowered = expected - [0, 0, height] * np.array(spec.table.vertical_m)[:, None]
        away_m = np.linalg.norm(points - lowered, axis=-1)
        # Without a return there is no point.
        is_met = seen.counts[..., 0] > 0
        assert is_met.any()
        assert (away_m / met_m)[is_met].max() < np.radians(ANGLE_DEG)


def test_other_models_need_no_projection_of_their_own() -> None:
    lidar = made_of(VelodyneSpec("VLP-16")).lidar
    assert lidar.projection(np.eye(4)) is None


def test_a_laser_that_a_file_disables_sees_nothing() -> None:
    seen = made_of(VelodyneSpec("VLP-16"))
    read = velodyne.read_calibration(Path("a.yaml"), calibration_yaml("VLP-16").encode())
    assert read is not None
    assert read.file is not None
    enabled = np.arange(16) != 5
    dark = velodyne.VelodyneCalibration(read.row, replace(read.file, enabled=enabled))
    lidar = dark.lidar({}, evidence(seen.sent))
    ranges, _ = pixels(lidar, seen.sent.payloads)
    assert not ranges[:, 5].any()
    assert (ranges[:, enabled] == pixels(seen.lidar, seen.sent.payloads)[0][:, enabled]).all()
    assert lidar.firing_ns[0, 5] == -1


def test_the_model_is_the_one_with_the_nearest_angles() -> None:
    for model in PLAIN:
        read = velodyne.read_calibration(Path("a.yaml"), calibration_yaml(model).encode())
        assert read is not None
        assert (read.model, read.is_shared, read.serial) == (model, True, "")
        assert read.path == Path("a.yaml")


def test_a_file_beats_the_table_of_its_model() -> None:
    seen = made_of(VelodyneSpec("VLP-16"))
    for model, fit in (("VLP-16", 200), ("Puck Hi-Res", NAMED_ONLY), ("VLS-128", 0)):
        read = velodyne.read_calibration(Path("a.yaml"), calibration_yaml(model).encode())
        assert read is not None
        assert read.match_score(evidence(seen.sent)) == fit


def test_its_angles_and_offsets_are_used() -> None:
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


@pytest.mark.parametrize("model", PLAIN)
def test_a_file_without_heights_keeps_the_built_in_ones(model: str) -> None:
    """ROS drivers write 0 for all lasers, or nothing."""
    table = MODELS[model]
    seen = evidence(made_of(VelodyneSpec(model)).sent)
    lines = calibration_yaml(model).splitlines()
    missing = "\n".join(one for one in lines if "vert_offset" not in one)
    zeros = missing.replace("  dist_corr", "  vert_offset_correction: 0.0\n  dist_corr")
    highest_mm = max(abs(value) for value in table.vertical_m) * 1000
    for content in (missing, zeros):
        read = velodyne.read_calibration(Path("unit.yaml"), content.encode())
        assert read is not None
        lidar = read.lidar({}, seen)
        heights_m = lidar.beams.origin[2, :, 2]
        assert np.abs(heights_m - np.array(table.vertical_m)).max() < 1e-5
        assert lidar.notes == (
            f"unit.yaml: the vertical offsets of all lasers are 0; those of a {model} are used, "
            f"up to {highest_mm:.1f} mm (vertical_offset=off: none)",
        )
        lowered = read.lidar({"vertical_offset": "off"}, seen)
        assert lowered.notes == ()
        assert not lowered.beams.origin.any()
    # A single value is the unit's own.
    one_value = zeros.splitlines()
    first = next(n for n, one in enumerate(one_value) if "vert_offset" in one)
    one_value[first] = "  vert_offset_correction: 0.003"
    read = velodyne.read_calibration(Path("unit.yaml"), "\n".join(one_value).encode())
    assert read is not None
    lidar = read.lidar({}, seen)
    assert lidar.notes == ()
    assert lidar.beams.origin[2, :, 2].tolist() == [0.003] + [0.0] * (len(table.vertical_m) - 1)


def test_another_unit_of_range_is_named_and_not_used() -> None:
    text = calibration_yaml("VLS-128").replace("resolution: 0.004", "resolution: 0.007")
    read = velodyne.read_calibration(Path("alpha.yaml"), text.encode())
    assert read is not None
    lidar = read.lidar({}, evidence(made_of(VelodyneSpec("VLS-128")).sent))
    assert lidar.notes == (
        "alpha.yaml: distance_resolution is 0.007 m, but a VLS-128 counts in 0.004 m, which is "
        "used",
    )


def test_a_file_of_no_model() -> None:
    spec = replace(MODELS["VLP-16"], elevation_deg=tuple(np.linspace(-60, 60, 16)))
    text = calibration_yaml("VLP-16")
    for old, new in zip(MODELS["VLP-16"].elevation_deg, spec.elevation_deg, strict=True):
        text = text.replace(
            f"vert_correction: {math.radians(old)!r}\n",
            f"vert_correction: {math.radians(new)!r} \n",
        )
    with pytest.raises(
        RigError, match=r"odd\.yaml: .*expected vertical angles of .*found a mean difference"
    ):
        velodyne.read_calibration(Path("odd.yaml"), text.encode())


def test_a_hdl_64e_is_an_s3_until_the_rig_names_s2() -> None:
    read = velodyne.read_calibration(Path("a.yaml"), calibration_yaml("HDL-64E S2").encode())
    assert read is not None
    sent = made_of(VelodyneSpec("HDL-64E S3")).sent
    assert read.model == "HDL-64E S3"
    assert read.match_score(evidence(sent)) == 200
    (note,) = read.lidar({}, evidence(sent)).notes
    assert note == "assumed to be an HDL-64E S3; if it is an HDL-64E S2, name its model in the rig"
    other = read.for_model("HDL-64E S2")
    assert other is not None
    assert other.lidar({}, evidence(sent)).notes == ()
    assert read.for_model("VLP-16") is None


def test_a_hdl_64e_needs_one() -> None:
    sent = made_of(VelodyneSpec("HDL-64E S3")).sent
    fits = {one.model: one.match_score(evidence(sent)) for one in velodyne.BUILT_IN}
    assert {model: fit for model, fit in fits.items() if fit} == {
        "HDL-64E S3": 100,
        "HDL-64E S2": NAMED_ONLY,
    }
    expected = "HDL-64E: expected its calibration, found none; give the unit's YAML or db.xml with"
    for one in velodyne.BUILT_IN:
        if fits[one.model]:
            with pytest.raises(RigError, match=expected):
                one.lidar({}, evidence(sent))
