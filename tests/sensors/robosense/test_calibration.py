"""Where ROBOSENSE angles and modes come from: device packets, csv files; and what goes wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mlbatch.errors import RigError, UsageError
from mlbatch.lidar.geometry import read_rotor_words
from mlbatch.lidar.interface import NAMED_ONLY, Evidence, ModelFile, NeighbourStream
from mlbatch.sensors import models
from mlbatch.sensors.robosense import sensor as robosense
from mlbatch.sensors.robosense.difop import Angles, find_difop
from mlbatch.sensors.robosense.models import AIRY_96, BPEARL_V4, ROWS, RS16, RS32, Model
from mlbatch.simulate.robosense.encode import RobosenseSpec, angles_csv, difop, fan, msop
from mlbatch.simulate.robosense.models import DUAL, LAST, STRONGEST
from mlbatch.types import Stream
from tests.builders.others import filled, rows
from tests.builders.robosense_decoded import DIFOP, built_in, decoded, evidence_of
from tests.reference import robosense as reference

MAGIC, TAIL = bytes.fromhex("a5ff005a11115555"), b"\x0f\xf0"


def _sent(spec: RobosenseSpec, packets: int = 8) -> list[bytes]:
    shape = (int(packets * spec.columns_per_packet), spec.row.channels, spec.returns)
    return [payload for _, payload in msop(spec, np.ones(shape, int), np.ones(shape, int))]


def _evidence(name: str, mode: str = STRONGEST, *, with_difop: bool = True) -> Evidence:
    spec = RobosenseSpec(name, mode)
    return evidence_of(_sent(spec), [difop(spec, fan(spec))] if with_difop else [])


def _csv(name: str) -> bytes:
    return angles_csv(fan(RobosenseSpec(name))).encode()


def _difop_angles(parts: dict[int, bytes], row: Model) -> Angles | None:
    payload = filled(1248, {0: MAGIC, 1246: TAIL, **parts})
    found = find_difop(evidence_of([payload]))
    assert found is not None
    return found.angles(row)


def test_every_model_is_listed_and_built_in() -> None:
    names = [one.model for one in robosense.BUILT_IN]
    assert names == [one.name for one in models() if one.vendor == "ROBOSENSE"]
    assert len(set(names)) == 14
    assert all(one.is_shared and one.path is None for one in robosense.BUILT_IN)
    real = [one.name for one in robosense.MODELS if one.verified == "real recording"]
    assert real == ["Helios 32"]


@pytest.mark.parametrize(
    ("row", "at", "field", "wanted_deg"),
    [
        (RS32, 468, "012829", -10.281),
        (BPEARL_V4, 468, "0022f6", 89.50),
        (AIRY_96, 468, "000171", 3.69),
    ],
)
def test_angles_that_the_manuals_print(row: Model, at: int, field: str, wanted_deg: float) -> None:
    angles = _difop_angles({at: bytes.fromhex(field)}, row)
    assert angles is not None
    assert angles.elevation_deg[0] == pytest.approx(wanted_deg, abs=1e-9)


def test_angles_of_rs16_have_no_sign() -> None:
    """u24, 0.0001 degree: 0x0249F0 is 15 degrees; the first eight channels look down."""
    fields = bytes.fromhex("0249f0") + bytes(21) + bytes.fromhex("0249f0") + bytes(21)
    angles = _difop_angles({1165: fields}, RS16)
    assert angles is not None
    assert angles.elevation_deg[[0, 8]] == pytest.approx([-15.0, 15.0], abs=1e-12)
    assert not angles.azimuth_deg.any()


@pytest.mark.parametrize("parts", [{}, {468: b"\xff" * 768}, {468: b"\0\x40\0" * 32}])
def test_angles_that_were_never_written(parts: dict[int, bytes]) -> None:
    assert _difop_angles(parts, BPEARL_V4) is None


def test_fields_of_a_device_packet() -> None:
    lidar = built_in(_evidence("Helios 32", LAST)).lidar({}, _evidence("Helios 32", LAST))
    assert lidar.serial == "0a1b2c3d4e5f"
    assert lidar.timestamp_mode == "PTP"
    assert lidar.mode == "single return, last"
    assert lidar.calibration == "DIFOP packets of 0a1b2c3d4e5f"


def test_device_packets_between_point_packets() -> None:
    """Topics have both kinds, which have one size."""
    spec = RobosenseSpec("Helios 16", DUAL)
    sent = _sent(spec)
    mixed = [difop(spec, fan(spec)), *sent[:4], difop(spec, fan(spec)), *sent[4:]]
    evidence = evidence_of(mixed)._replace(stream=Stream(topic="/rslidar_packets"))
    lidar = built_in(evidence).lidar({}, evidence)
    assert lidar.mode == "dual return"
    assert lidar.sent_by_me(evidence.sample).tolist() == [False, *[True] * 4, False, *[True] * 4]


def test_damage_of_one_device_packet_does_no_harm() -> None:
    spec = RobosenseSpec("RS-32")
    good = difop(spec, fan(spec))
    damaged = bytearray(good)
    damaged[470] ^= 0xFF
    expected = built_in(_evidence("RS-32")).lidar({}, _evidence("RS-32"))
    evidence = evidence_of(_sent(spec), [bytes(damaged), good, good])
    lidar = built_in(evidence).lidar({}, evidence)
    np.testing.assert_array_equal(lidar.beams.direction, expected.beams.direction)


def test_units_behind_one_address_are_identified_by_their_ports() -> None:
    spec, other = RobosenseSpec("RS-32"), RobosenseSpec("RS-32", serial="ffffffffffff")
    mine = difop(spec, fan(spec))
    theirs = difop(other, fan(other), parts={24: b"\x1a\x2c\x1a\x2c"})  # 6700
    evidence = evidence_of(_sent(spec), [theirs, mine])
    assert built_in(evidence).lidar({}, evidence).serial == "0a1b2c3d4e5f"
    evidence = evidence_of(_sent(spec), [difop(other, fan(other)), mine])
    with pytest.raises(RigError) as caught:
        built_in(evidence).lidar({}, evidence)
    assert "found those of 2 (serial numbers 0a1b2c3d4e5f, ffffffffffff)" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["RS-16", "RS-32", "Helios 32", "Airy 96", "Ruby Plus 128"])
def test_angles_are_asked_for(name: str) -> None:
    for evidence, found in (
        (_evidence(name, with_difop=False), "no DIFOP packet"),
        (
            _evidence(name, with_difop=False)._replace(
                neighbours=(
                    NeighbourStream(
                        DIFOP, 1248, rows([filled(1248, {0: MAGIC, 1246: TAIL})]), np.zeros(1, int)
                    ),
                ),
            ),
            "DIFOP packets without angles",
        ),
    ):
        with pytest.raises(RigError) as caught:
            built_in(evidence).lidar({}, evidence)
        text = str(caught.value)
        assert f"found {found}" in text
        assert "7788" in text
        assert "--metadata" in text
        assert "\n" not in text


def test_a_bpearl_v4_has_nominal_angles() -> None:
    evidence = _evidence("Bpearl v4", with_difop=False)
    lidar = built_in(evidence).lidar({}, evidence)
    assert lidar.calibration == "nominal angles"
    assert len(lidar.notes) == 1
    assert "nominal" in lidar.notes[0]
    rise = np.degrees(np.arcsin(lidar.beams.direction[2, :, 2]))
    assert rise == pytest.approx(reference.bpearl_v4_elevation_deg(), abs=1e-4)


@pytest.mark.parametrize(
    ("family", "names"),
    [
        ("RS-16, RS-32, Bpearl v3", ("RS-LiDAR-16", "RS-LiDAR-32", "RS-Bpearl v3")),
        ("Bpearl v4, Helios", ("RS-Bpearl v4", "Helios 16", "Helios 32")),
        ("Ruby (old)", ("Ruby 48", "Ruby 80", "Ruby 128")),
        ("Ruby Plus", ("Ruby Plus 48", "Ruby Plus 80", "Ruby Plus 128")),
        ("Airy", ("Airy 48", "Airy 96")),
    ],
)
def test_return_modes_are_those_of_the_document(family: str, names: tuple[str, ...]) -> None:
    wanted = reference.return_modes(family)
    for row in (row for row in ROWS if row.name in names):
        found = {code: mode.name or reference.DUAL for code, mode in row.modes.items()}
        assert found == wanted
        assert {mode.returns for mode in row.modes.values() if not mode.name} <= {2}
    assert set(names) <= {row.name for row in ROWS}


def test_a_sensor_that_is_silent_cannot_be_made() -> None:
    file = robosense.read_calibration(Path("a.csv"), _csv("Helios 32"))
    assert file is not None
    for calibration in (robosense.BUILT_IN[0], file):
        with pytest.raises(RigError, match="expected packets in the first 10 seconds"):
            calibration.lidar({}, None)


def test_options_are_checked() -> None:
    evidence = _evidence("Helios 32")
    with pytest.raises(UsageError):
        built_in(evidence).lidar({"firing_azimuth": "perhaps"}, evidence)


def _scores(evidence: Evidence) -> dict[str, int]:
    return {
        one.model: one.match_score(evidence)
        for one in robosense.BUILT_IN
        if one.match_score(evidence)
    }


def test_models_that_could_read_packets_of_another() -> None:
    """Of one layout, and with a time that is one in the other's form."""
    assert _scores(_evidence("RS-32")) == {
        "RS-LiDAR-16": NAMED_ONLY,
        "RS-LiDAR-32": 100,
        "RS-Bpearl v3": NAMED_ONLY,
    }
    assert _scores(_evidence("Ruby Plus 80")) == {"Ruby 80": NAMED_ONLY, "Ruby Plus 80": 100}
    assert _scores(_evidence("Bpearl v4")) == {"RS-Bpearl v4": 100}
    assert _scores(evidence_of([difop(RobosenseSpec("RS-32"), fan(RobosenseSpec("RS-32")))])) == {}
    assert _scores(evidence_of([bytes(1248)] * 3)) == {}
    assert _scores(evidence_of([bytes(12)] * 3)) == {}


def test_ruby_and_ruby_plus_are_not_distinguished_silently() -> None:
    evidence = _evidence("Ruby 80")
    (plus,) = [one for one in robosense.BUILT_IN if one.model == "Ruby Plus 80"]
    for lidar in (built_in(evidence).lidar({}, evidence), plus.lidar({}, evidence)):
        assert any("Ruby 80 or Ruby Plus 80" in note for note in lidar.notes)


@pytest.mark.parametrize("model", ["Ruby 80", "Ruby Plus 80"])
def test_a_rig_distinguishes_ruby_and_ruby_plus(model: str) -> None:
    evidence = _evidence("Ruby 80")
    (known,) = [one for one in robosense.BUILT_IN if one.model == model]
    file = robosense.read_calibration(Path("a.csv"), _csv("Ruby 80"))
    for one, score in ((known, 100), (file, 200)):
        assert isinstance(one, ModelFile)
        named = one.for_model(model)
        assert named is not None
        assert named.match_score(evidence) == score
        lidar = named.lidar({}, evidence)
        assert (lidar.model, lidar.notes) == (model, ())
        assert one.for_model("Ruby 128") is None


@pytest.mark.parametrize("value", [2, 255])
@pytest.mark.parametrize("name", ["Bpearl v3", "Bpearl v4"])
def test_an_unusual_reversal_is_noted(name: str, value: int) -> None:
    """rs_driver mirrors by any value but 0."""
    spec = RobosenseSpec(name, start_deg=30.0)
    evidence = evidence_of(_sent(spec), [difop(spec, fan(spec), parts={337: bytes((value,))})])
    lidar = built_in(evidence).lidar({}, evidence)
    angle_rad, _, _ = read_rotor_words(
        lidar.column_headers(evidence.sample, evidence.host_ns).encoder[0]
    )
    assert np.degrees(angle_rad[0]) % 360 == pytest.approx(330.0)
    (note,) = lidar.notes
    assert f"byte 337 to be 0 or 1, found {value}" in note


@pytest.mark.parametrize("name", ["Helios 32", "Ruby Plus 80"])
def test_other_models_are_not_mirrored(name: str) -> None:
    spec = RobosenseSpec(name, start_deg=30.0)
    evidence = evidence_of(_sent(spec), [difop(spec, fan(spec), parts={337: b"\1"})])
    lidar = built_in(evidence).lidar({}, evidence)
    angle_rad, _, _ = read_rotor_words(
        lidar.column_headers(evidence.sample, evidence.host_ns).encoder[0]
    )
    assert np.degrees(angle_rad[0]) == pytest.approx(30.0)


def _with_types(payloads: list[bytes], types: str) -> list[bytes]:
    """Packets with other bytes 30 to 32."""
    return [payload[:30] + bytes.fromhex(types) + payload[33:] for payload in payloads]


def _named(model: str) -> robosense.DifopCalibration:
    (known,) = [one for one in robosense.BUILT_IN if one.model == model]
    assert isinstance(known, robosense.DifopCalibration)
    named = known.for_model(model)
    assert named is not None
    return named


@pytest.mark.parametrize(
    ("name", "is_calendar", "unit_m"), [("Bpearl v4", False, 0.0025), ("Bpearl v3", True, 0.005)]
)
def test_bpearl_of_model_0(name: str, is_calendar: bool, unit_m: float) -> None:
    """A v4 by its manual, a v3 in rs_driver: a note, until the rig names it."""
    spec = RobosenseSpec(name)
    packets = _with_types(_sent(spec), "00 03 00")
    evidence = evidence_of(packets, [difop(spec, fan(spec))])
    own = built_in(evidence)
    assert own.model == f"RS-{name}"
    (note,) = own.lidar({}, evidence).notes
    assert "packets fit RS-Bpearl v3 or RS-Bpearl v4" in note
    assert "rs_driver" in note
    lidar = _named(f"RS-{name}").lidar({}, evidence)
    assert lidar.notes == ()
    assert decoded(lidar, evidence.sample).range_m[0, 0, 0] == np.float32(unit_m)


def test_a_rig_names_a_bpearl_of_model_0() -> None:
    """As a v3, with times in the form that the packets have."""
    spec = RobosenseSpec("Bpearl v4")
    evidence = evidence_of(_with_types(_sent(spec), "00 03 00"), [difop(spec, fan(spec))])
    named = _named("RS-Bpearl v3")
    assert named.match_score(evidence) == 100
    lidar = named.lidar({}, evidence)
    assert not lidar.faults(evidence.sample).any()
    found = decoded(lidar, evidence.sample)
    assert found.range_m[0, 0, 0] == np.float32(0.005)
    assert found.time_ns[0, 0] == spec.start_ns
    (note,) = lidar.notes
    assert note.startswith("expected dates in the packets of an RS-Bpearl v3, found seconds")


@pytest.mark.parametrize(
    ("name", "mode", "model"),
    [
        ("Helios 32", STRONGEST, "Helios 32"),
        ("Helios 32", DUAL, "Helios 32"),
        ("Helios 16", STRONGEST, "Helios 16"),
        ("Helios 16", DUAL, "Helios 16"),
    ],
)
@pytest.mark.parametrize("types", ["06 00 00", "00 06 00"])
def test_helios_without_a_model_by_its_device_packet(
    name: str, mode: str, model: str, types: str
) -> None:
    """Its return mode distinguishes 32 lines with one return from 16 with two."""
    spec = RobosenseSpec(name, mode)
    evidence = evidence_of(_with_types(_sent(spec), types), [difop(spec, fan(spec))])
    lidar = built_in(evidence).lidar({}, evidence)
    assert (lidar.model, lidar.notes) == (model, ())
    assert lidar.mode.startswith("dual" if mode == DUAL else "single")


@pytest.mark.parametrize(("name", "mode"), [("Helios 32", STRONGEST), ("Helios 16", DUAL)])
def test_helios_without_a_model_by_the_lines_of_its_file(name: str, mode: str) -> None:
    evidence = evidence_of(_with_types(_sent(RobosenseSpec(name, mode)), "06 00 00"))
    file = robosense.read_calibration(Path("a.csv"), _csv(name))
    assert file is not None
    assert file.match_score(evidence) == 200
    lidar = file.lidar({}, evidence)
    assert (lidar.model, lidar.notes) == (name, ())
    assert lidar.mode.startswith("dual" if mode == DUAL else "single")


def test_helios_without_a_model_or_a_usable_mode() -> None:
    spec = RobosenseSpec("Helios 32")
    unknown = difop(spec, fan(spec), parts={300: b"\x09"})
    evidence = evidence_of(_with_types(_sent(spec), "06 00 00"), [unknown])
    lidar = built_in(evidence).lidar({}, evidence)
    assert lidar.model == "Helios 32"
    (note,) = lidar.notes
    assert "packets fit Helios 16 or Helios 32: decoded as Helios 32" in note
    assert _named("Helios 16").match_score(evidence) == 100
    assert _named("Helios 16").lidar({}, evidence).model == "Helios 16"
    assert _named("Helios 32").lidar({}, evidence).notes == ()


@pytest.mark.parametrize("types", ["05 02 00", "05 03 00", "00 02 00"])
def test_ruby_plus_80_in_the_layout_of_rs_driver(types: str) -> None:
    """No note; its second byte chooses the firing times of the 80v."""
    spec = RobosenseSpec("Ruby Plus 80v" if types[4] == "3" else "Ruby Plus 80")
    evidence = evidence_of(_with_types(_sent(spec), types), [difop(spec, fan(spec))])
    lidar = built_in(evidence).lidar({}, evidence)
    assert (lidar.model, lidar.notes) == ("Ruby Plus 80", ())
    np.testing.assert_array_equal(lidar.firing_ns[0], spec.firing_ns)
    assert _named("Ruby 80").match_score(evidence) == NAMED_ONLY


def test_the_first_firmware_is_not_decoded_silently() -> None:
    spec = RobosenseSpec("RS-16")
    unnamed = difop(spec, fan(spec), parts={41: b"\0\0\0"})
    evidence = evidence_of(_sent(spec), [unnamed])
    assert any("1 cm" in note for note in built_in(evidence).lidar({}, evidence).notes)
    named = difop(spec, fan(spec), parts={41: b"\x03\x02\x01"})
    evidence = evidence_of(_sent(spec), [named])
    assert built_in(evidence).lidar({}, evidence).notes == ()


def test_a_mode_that_is_unknown() -> None:
    evidence = evidence_of(_sent(RobosenseSpec("RS-16"))[:1])
    file = robosense.read_calibration(Path("a.csv"), _csv("RS-16"))
    assert file is not None
    lidar = file.lidar({}, evidence)
    assert lidar.mode == "single return"
    assert "neither point nor DIFOP packets" in " ".join(lidar.notes)


def test_point_packets_outweigh_a_device_packet_of_another_mode() -> None:
    spec = RobosenseSpec("Helios 32", DUAL)
    stale = RobosenseSpec("Helios 32", LAST)
    evidence = evidence_of(_sent(spec), [difop(stale, fan(stale))])
    assert built_in(evidence).lidar({}, evidence).mode == "dual return"


def test_a_csv_of_angles() -> None:
    text = b"elevation,azimuth\r\n" + _csv("Helios 32").replace(b"\n", b"\r\n")
    for content in (_csv("Helios 32"), b"\xef\xbb\xbf" + text):
        file = robosense.read_calibration(Path("folder/a.csv"), content)
        assert file is not None
        assert not file.is_shared
        assert file.match_score(_evidence("Helios 32", with_difop=False)) == 200
        assert file.match_score(_evidence("Helios 16", with_difop=False)) == 0
        evidence = _evidence("Helios 32")
        lidar, own = file.lidar({}, evidence), built_in(evidence).lidar({}, evidence)
        np.testing.assert_allclose(lidar.beams.direction, own.beams.direction, atol=1e-9)
        assert lidar.calibration == "folder/a.csv"
        with pytest.raises(RigError, match="expected packets of a ROBOSENSE 32-line lidar"):
            file.lidar({}, _evidence("Helios 16"))


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\xff\xfe\x00",
        b"Channel,Elevation,Azimuth\n1,14.882,-1.042\n2,11.032,-1.042\n",  # HESAI
        b"name,value\nleft,right\n",
        b"{}",
        b"1\n" * 32,
        b"a,b\n" * 200_000,
    ],
)
def test_files_that_are_no_angles(content: bytes) -> None:
    assert robosense.read_calibration(Path("a.csv"), content) is None


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (
            b"1.0,2.0\n" * 31,
            "expected 16, 32, 48, 80, 96 or 128 lines `elevation,azimuth`, found 31",
        ),
        (b"1.0,2.0\n" * 15 + b"95,0\n", "in line 16, found '95,0'"),
        (b"elevation,azimuth\n" + b"1,2\n" * 15 + b"1,x\n", "in line 17, found '1,x'"),
        (b"1.0,2.0\n" * 15 + b"nan,0\n", "in line 16, found 'nan,0'"),
    ],
)
def test_angles_that_cannot_be(content: bytes, expected: str) -> None:
    with pytest.raises(RigError) as caught:
        robosense.read_calibration(Path("a.csv"), content)
    assert str(caught.value).startswith("a.csv: ROBOSENSE angles: ")
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)
