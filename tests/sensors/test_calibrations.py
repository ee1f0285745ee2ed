"""Which calibration fits which packets, which model that gives, what is noted and what refused.

A row is a unit: what it sends, what is given for it. Errors as the command line prints them:
`tests/cli/test_vendor_mistakes.py`; broken files: `test_files.py`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from mlbatch import sensors
from mlbatch.errors import RigError, UsageError
from mlbatch.lidar.geometry import read_rotor_words
from mlbatch.lidar.interface import NAMED_ONLY, Calibration, Evidence
from mlbatch.simulate.hesai.encode import HesaiSpec, angles_csv
from mlbatch.simulate.ouster.encode import OusterSpec
from mlbatch.simulate.robosense.encode import RobosenseSpec
from mlbatch.simulate.robosense.encode import angles_csv as robosense_csv
from mlbatch.simulate.robosense.models import LAST
from mlbatch.simulate.robosense.models import MODELS as ROBOSENSE
from mlbatch.simulate.spinning import SpinningSpec
from mlbatch.simulate.velodyne.encode import VelodyneSpec
from mlbatch.simulate.velodyne.models import MODELS as VELODYNE
from mlbatch.simulate.velodyne.models import calibration_yaml
from mlbatch.types import Stream
from tests.builders.others import filled
from tests.builders.spinning import (
    STREAM,
    Encoded,
    difops_of,
    evidence_of,
    from_file,
    named,
    ouster_calibration,
    stream_of,
    velodyne_calibration,
)

NO_ANGLES = filled(1248, {0: bytes.fromhex("a5ff005a11115555"), 1246: b"\x0f\xf0"})


@dataclass(frozen=True)
class Unit:
    """A unit; points: bytes of all its packets by place; device: of its DIFOP, None: none comes."""

    spec: SpinningSpec
    points: Mapping[int, bytes] = field(default_factory=dict)
    device: Mapping[int, bytes] | None = field(default_factory=dict)
    packets: int = 8

    @property
    def stream(self) -> Encoded:
        """What it sends."""
        stream = stream_of(self.spec, self.packets)
        for at, value in self.points.items():
            stream.packets[:, at : at + len(value)] = list(value)
        if not isinstance(self.spec, RobosenseSpec):
            return stream
        difops = [self.spec.device_packet(parts=self.device)] * (self.device is not None)
        return replace(stream, neighbours=difops_of(*difops))


def file_of(model: str) -> Calibration:
    """The file of a unit of a model."""
    if model in VELODYNE:
        return from_file(calibration_yaml(model), "unit.yaml")
    if model in ROBOSENSE:
        return from_file(robosense_csv(RobosenseSpec(model).angles))
    return from_file(HesaiSpec(model).files.content)


def scores(stream: Encoded | Evidence) -> dict[str, int]:
    """Of all that are built in, but for those that do not fit."""
    evidence = stream.evidence if isinstance(stream, Encoded) else stream
    every = {one.model: one.match_score(evidence) for one in sensors.built_in()}
    return {model: score for model, score in every.items() if score}


# -- which fits -----------------------------------------------------------------------------------

VLP32C, XT32M2X = VelodyneSpec("VLP-32C"), HesaiSpec("XT32M2X")


@pytest.mark.parametrize(
    ("unit", "expected"),
    [
        # Blocks of an HDL-32E and a VLP-32C take half as long.
        (
            Unit(VelodyneSpec("VLP-16")),
            {"VLP-16": 100, "Puck LITE": NAMED_ONLY, "Puck Hi-Res": NAMED_ONLY},
        ),
        (
            Unit(VelodyneSpec("VLP-16", product=0x21)),
            {"VLP-16": 100, "Puck LITE": NAMED_ONLY, "Puck Hi-Res": NAMED_ONLY},
        ),
        (Unit(VelodyneSpec("HDL-64E S3")), {"HDL-64E S3": 100, "HDL-64E S2": NAMED_ONLY}),
        # Models without tables are never taken for others.
        *(
            (Unit(VLP32C, {1205: product}), {"VLP-32C": NAMED_ONLY})
            for product in (b"#", b"1", b"\x99")
        ),
        # Of one layout, and with a time that is one in the other's form.
        (
            Unit(RobosenseSpec("RS-32")),
            {"RS-LiDAR-16": NAMED_ONLY, "RS-LiDAR-32": 100, "RS-Bpearl v3": NAMED_ONLY},
        ),
        (Unit(RobosenseSpec("Ruby Plus 80")), {"Ruby 80": NAMED_ONLY, "Ruby Plus 80": 100}),
        (Unit(RobosenseSpec("Bpearl v4")), {"RS-Bpearl v4": 100}),
        (Unit(XT32M2X), {}),
    ],
)
def test_models_that_packets_fit(unit: Unit, expected: Mapping[str, int]) -> None:
    assert scores(unit.stream) == expected


RS32 = RobosenseSpec("RS-32")


@pytest.mark.parametrize("payload", [RS32.device_packet(), bytes(1248), bytes(12)])
def test_other_packets_fit_none(payload: bytes) -> None:
    assert scores(evidence_of([payload] * 3)) == {}


# A file; what is sent; its score: -1: if the rig names the model, 0: never.
SCORES = [
    ("VLP-16", Unit(VelodyneSpec("VLP-16")), 200),
    ("Puck Hi-Res", Unit(VelodyneSpec("VLP-16")), NAMED_ONLY),
    ("VLS-128", Unit(VelodyneSpec("VLP-16")), 0),
    ("HDL-64E S2", Unit(VelodyneSpec("HDL-64E S3")), 200),
    ("Pandar64", Unit(HesaiSpec("Pandar64")), 300),
    ("PandarQT64", Unit(HesaiSpec("Pandar64")), 200),
    ("Pandar40P", Unit(HesaiSpec("Pandar64")), 0),
    ("AT128", Unit(HesaiSpec("Pandar64")), 0),
    # A return mode that is not known.
    ("XT32M2X", Unit(XT32M2X, {802: b"\x40"}), 0),
    ("Helios 32", Unit(RobosenseSpec("Helios 32"), device=None), 200),
    ("Helios 32", Unit(RobosenseSpec("Helios 16"), device=None), 0),
    *((name, Unit(RobosenseSpec(name), device=None), 200) for name in ROBOSENSE),
    *((name, Unit(RobosenseSpec(name, "dual"), device=None), 200) for name in ROBOSENSE),
]


@pytest.mark.parametrize(("file", "unit", "score"), SCORES)
def test_files_that_packets_fit(file: str, unit: Unit, score: int) -> None:
    """For want of a device packet, points of a ROBOSENSE tell their returns themselves."""
    calibration = file_of(file)
    stream = unit.stream
    evidence = evidence_of(stream.packets, stream.host_ns)
    assert calibration.match_score(evidence) == score
    if score == 200 and isinstance(unit.spec, RobosenseSpec):
        lidar = calibration.lidar({}, evidence)
        assert (
            lidar.mode.split(",")[0] == f"{'dual' if unit.spec.returns == 2 else 'single'} return"
        )
        assert set(lidar.return_types) == {0}
        rise = np.sin(np.radians(unit.spec.angles.elevation_deg))
        np.testing.assert_allclose(lidar.beams.direction[2, :, 2], rise, atol=1e-6)


def test_a_rig_cannot_name_what_packets_contradict() -> None:
    """The Puck Hi-Res has its own product byte, a Ruby Plus of rs_driver its own type."""
    plus = Unit(RobosenseSpec("Ruby Plus 80"), {30: bytes.fromhex("050200")})
    for model, unit in (("Puck Hi-Res", Unit(VelodyneSpec("VLP-16"))), ("Ruby 80", plus)):
        assert named(model).match_score(unit.stream.evidence) == NAMED_ONLY


# -- models and notes -----------------------------------------------------------------------------

HELIOS_32, HELIOS_16 = RobosenseSpec("Helios 32"), RobosenseSpec("Helios 16")
RUBY_80, BPEARL_4 = RobosenseSpec("Ruby 80"), RobosenseSpec("Bpearl v4")
# Models that packets of an early firmware do not name.
TYPES = {text: {30: bytes.fromhex(text)} for text in (
    *("060000", "000600", "000300", "050200", "050300", "000200"),
)}  # fmt: skip


@dataclass(frozen=True)
class Given:
    """A unit, the model that a rig names or a file (of a model), and what is found and noted.

    unit_m: of a count of range; rotor_deg: in the first packet; 0: not checked.
    """

    unit: Unit
    model: str
    notes: tuple[str, ...] = ()
    named: str = ""
    file: str = ""
    mode: str = ""
    options: Mapping[str, str] = field(default_factory=dict)
    unit_m: float = 0
    rotor_deg: float = 0


GIVEN = [
    Given(Unit(VelodyneSpec("VLP-16")), "Puck LITE", named="Puck LITE"),
    Given(
        Unit(VelodyneSpec("VLP-16", product=0x21)),
        *("VLP-16", ("model by the pace of its packets: VLP-16, although its product byte says",)),
    ),
    Given(
        Unit(VelodyneSpec("VLS-128"), packets=3),
        *("VLS-128", ("too few packets to measure its firing sequence: 55277 ns assumed",)),
    ),
    Given(
        Unit(VelodyneSpec("HDL-64E S3")),
        "HDL-64E S3",
        ("assumed to be an HDL-64E S3; if it is an HDL-64E S2, name its model in the rig",),
        file="HDL-64E S2",
    ),
    Given(Unit(VelodyneSpec("HDL-64E S3")), "HDL-64E S2", named="HDL-64E S2", file="HDL-64E S2"),
    Given(Unit(HesaiSpec("Pandar64")), "Pandar64", file="Pandar64"),
    # Ruby and Ruby Plus are distinguished by a rig, or by the layout of rs_driver.
    Given(Unit(RUBY_80), "Ruby 80", ("Ruby 80 or Ruby Plus 80",)),
    *(
        Given(Unit(RUBY_80), name, named=name, file=file)
        for name in ("Ruby 80", "Ruby Plus 80")
        for file in ("", "Ruby 80")
    ),
    *(
        # Their second byte chooses the firing times of the 80v.
        Given(Unit(RobosenseSpec(f"Ruby Plus 80{kind}"), TYPES[types]), "Ruby Plus 80")
        for types, kind in (("050200", ""), ("050300", "v"), ("000200", ""))
    ),
    # A Bpearl of model 0 is a v4 by its manual, a v3 in rs_driver.
    *(
        Given(
            Unit(RobosenseSpec(name), TYPES["000300"]),
            *(f"RS-{name}", ("packets fit RS-Bpearl v3 or RS-Bpearl v4",)),
            unit_m=unit_m,
        )
        for name, unit_m in (("Bpearl v3", 0.005), ("Bpearl v4", 0.0025))
    ),
    *(
        Given(Unit(RobosenseSpec(name), TYPES["000300"]), f"RS-{name}", named=f"RS-{name}")
        for name in ("Bpearl v3", "Bpearl v4")
    ),
    # With times in the form that the packets have.
    Given(
        Unit(BPEARL_4, TYPES["000300"]),
        "RS-Bpearl v3",
        ("expected dates in the packets of an RS-Bpearl v3, found seconds",),
        named="RS-Bpearl v3",
        unit_m=0.005,
    ),
    # A Helios without a model: by its device packet, whose return mode distinguishes 32 lines with
    # one return from 16 with two; by the lines of its file; by the rig.
    *(
        Given(Unit(RobosenseSpec(name, mode), TYPES[types]), name, mode=f"{word} return")
        for types in ("060000", "000600")
        for name in ("Helios 32", "Helios 16")
        for mode, word in (("strongest", "single"), ("dual", "dual"))
    ),
    *(
        Given(
            Unit(RobosenseSpec(name, mode), TYPES["060000"], None), name, file=name, mode=f"{word} "
        )
        for name, mode, word in (
            ("Helios 32", "strongest", "single"),
            ("Helios 16", "dual", "dual"),
        )
    ),
    Given(
        Unit(HELIOS_32, TYPES["060000"], {300: b"\x09"}),
        "Helios 32",
        ("packets fit Helios 16 or Helios 32: decoded as Helios 32",),
    ),
    *(
        Given(Unit(HELIOS_32, TYPES["060000"], {300: b"\x09"}), name, named=name)
        for name in ("Helios 16", "Helios 32")
    ),
    # The first firmware of an RS-16 counts in 1 cm.
    Given(Unit(RobosenseSpec("RS-16"), device={41: bytes(3)}), "RS-LiDAR-16", ("1 cm",)),
    Given(Unit(RobosenseSpec("RS-16"), device={41: b"\3\2\1"}), "RS-LiDAR-16"),
    Given(
        Unit(RobosenseSpec("RS-16"), device=None, packets=1),
        *("RS-LiDAR-16", ("neither point nor DIFOP packets",)),
        file="RS-16",
        mode="single return",
    ),
    # Points outweigh a device packet of another mode (5: last).
    Given(Unit(RobosenseSpec("Helios 32", "dual"), device={300: b"\5"}), "Helios 32", mode="dual"),
    # rs_driver mirrors a Bpearl by any value but 0.
    *(
        Given(
            Unit(RobosenseSpec(name, start_deg=30.0), device={337: bytes((value,))}),
            *(f"RS-{name}", (f"byte 337 to be 0 or 1, found {value}",)),
            rotor_deg=330.0,
        )
        for name in ("Bpearl v3", "Bpearl v4")
        for value in (2, 255)
    ),
    # Others are not mirrored.
    *(
        Given(Unit(RobosenseSpec(name, start_deg=30.0), points, {337: b"\1"}), name, rotor_deg=30.0)
        for name, points in (("Helios 32", {}), ("Ruby Plus 80", TYPES["050200"]))
    ),
    # Byte 17 of a Helios is reserved in current manuals; in older ones 0 means 5 mm.
    *(
        Given(
            Unit(RobosenseSpec(name), {17: bytes((byte_17,))}),
            *(name.partition(",")[0], ("range_unit=5mm",) * (byte_17 == 0 and not option)),
            options={"range_unit": option} if option else {},
            unit_m=0.005 if option == "5mm" else 0.0025,
        )
        for name in ("Helios 32", "Helios 16", "Helios 32, early type")
        for byte_17, option in ((0, ""), (1, ""), (7, ""), (0, "5mm"), (1, "5mm"), (0, "2.5mm"))
    ),
    # Units of other models are their own.
    *(
        Given(Unit(RobosenseSpec(name)), model, options={"range_unit": "2.5mm"}, unit_m=unit_m)
        for name, model, unit_m in (
            *(("RS-32", "RS-LiDAR-32", 0.005), ("Bpearl v4", "RS-Bpearl v4", 0.0025)),
            ("Airy 96", "Airy 96", 0.005),
        )
    ),
]


@pytest.mark.parametrize("given", GIVEN, ids=lambda one: f"{one.model} {one.named} {one.file}")
def test_models_and_notes(given: Given) -> None:
    stream = given.unit.stream
    calibration = file_of(given.file) if given.file else stream.calibration
    if given.named:
        calibration = named(given.named, calibration if given.file else None)
        assert calibration.match_score(stream.evidence) == (200 if given.file else 100)
        assert calibration.for_model("Ruby 128") is None
    lidar = calibration.lidar(given.options, stream.evidence)
    assert lidar.model == given.model
    assert lidar.mode.startswith(given.mode)
    assert len(lidar.notes) == len(given.notes)
    for note, expected in zip(lidar.notes, given.notes, strict=True):
        assert expected in note
        assert "\n" not in note
    assert not lidar.faults(stream.packets).any()
    found = stream.read(lidar)
    if given.unit_m:
        range_m = (stream.truth.counts * given.unit_m).astype(np.float32)
        np.testing.assert_array_equal(found.range_m, range_m)
    spec = given.unit.spec
    if isinstance(spec, RobosenseSpec) and (not given.named or "Bpearl" in given.named):
        assert found.stamp_ns[0] == spec.start_ns + spec.firing_ns.min()
    if isinstance(spec, RobosenseSpec) and not given.named:
        np.testing.assert_array_equal(lidar.firing_ns[0], spec.firing_ns - spec.firing_ns.min())
    if given.rotor_deg:
        rotor_rad, _, _ = read_rotor_words(found.encoder[:1])
        assert np.degrees(rotor_rad) == pytest.approx(given.rotor_deg)


@pytest.mark.parametrize("mode", ["strongest", "last", "dual"])
def test_a_velodyne_that_is_silent_at_first_is_taken_for_a_single_return(mode: str) -> None:
    lidar = velodyne_calibration("VLP-16").lidar({}, None)
    assert lidar.notes == ("no packets in the first 10 seconds: single return assumed",)
    assert (lidar.returns, lidar.return_types) == (1, (0,))
    # What it cannot read it refuses.
    faults = lidar.faults(stream_of(VelodyneSpec("VLP-16", mode)).packets)
    assert (faults != 0).tolist() == [mode == "dual"] * len(faults)


def test_a_robosense_is_described_by_its_device_packets() -> None:
    """Topics have points and device packets, of one size; damage of one does no harm."""
    spec = RobosenseSpec("Helios 32", LAST)
    stream = stream_of(spec, 8)
    good = spec.device_packet()
    damaged = bytearray(good)
    damaged[470] ^= 0xFF
    expected = stream.lidar()
    assert (expected.serial, expected.timestamp_mode) == ("0a1b2c3d4e5f", "PTP")
    assert (expected.mode, expected.calibration) == (
        *("single return, last", "DIFOP packets of 0a1b2c3d4e5f"),
    )
    payloads = [row.tobytes() for row in stream.packets]
    mixed = [good, *payloads[:4], good, *payloads[4:]]
    topic = evidence_of(mixed, stream=Stream(topic="/rslidar_packets"))
    neighbours = difops_of(bytes(damaged), good, good)
    for evidence in (topic, stream.evidence._replace(neighbours=neighbours)):
        lidar = stream.calibration.lidar({}, evidence)
        np.testing.assert_array_equal(lidar.beams.direction, expected.beams.direction)
        is_mine = lidar.sent_by_me(evidence.sample)
        assert is_mine.tolist() == [row.tobytes() != good for row in evidence.sample]


# -- refusals -------------------------------------------------------------------------------------

OTHER = RobosenseSpec("RS-32", serial="ffffffffffff")
SILENT = "expected packets in the first 10 seconds"


def two_units(parts: Mapping[int, bytes]) -> Evidence:
    """An RS-32 next to device packets of another unit and of its own."""
    theirs = OTHER.device_packet(parts=parts)
    mine = RS32.device_packet()
    stream = Stream(STREAM.source_ip, 6699)
    evidence = Unit(RS32).stream.evidence
    return evidence._replace(stream=stream, neighbours=difops_of(theirs, mine))


def test_units_behind_one_address_are_identified_by_their_ports() -> None:
    evidence = two_units({24: b"\x1a\x2c\x1a\x2c"})  # 6700
    assert named("RS-LiDAR-32").lidar({}, evidence).serial == "0a1b2c3d4e5f"


def csv_of(low_deg: float, high_deg: float) -> Calibration:
    """Angles of a lidar of 64 channels."""
    return from_file(angles_csv(np.linspace(high_deg, low_deg, 64).tolist(), [0.0] * 64))


BUILT_IN = {one.model: one for one in sensors.built_in()}
FIRST_10_S = "expected packets of the lidar in the first 10 seconds"
HDL64 = "HDL-64E: expected its calibration, found none; give the unit's YAML or db.xml with"
PANDAR64 = Unit(HesaiSpec("Pandar64"))
# A calibration, a unit or what is known of it, and why it is refused.
REFUSED: list[tuple[Calibration, Unit | Evidence | None, str]] = [
    (file_of("Pandar64"), None, FIRST_10_S),
    (file_of("AT128"), None, FIRST_10_S),
    (file_of("Helios 32"), None, SILENT),
    (BUILT_IN["Helios 32"], None, SILENT),
    (BUILT_IN["Livox SDK2"], None, "Livox SDK2: expected packets of points in the first 10 sec"),
    (BUILT_IN["PointCloud2"], None, "PointCloud2: expected a cloud of the topic in the first 10"),
    *(
        (BUILT_IN[name], Unit(VelodyneSpec("HDL-64E S3")), HDL64)
        for name in ("HDL-64E S2", "HDL-64E S3")
    ),
    (
        file_of("Pandar40P"),
        PANDAR64,
        "expected 64 channels for the packets of a Pandar64, found 40; give",
    ),
    (
        file_of("AT128"),
        PANDAR64,
        "expected the csv of a Pandar64 for these packets, found the file of",
    ),
    (
        file_of("OT128"),
        Unit(HesaiSpec("AT128")),
        "HESAI AT128: expected its correction file (.dat), found a csv",
    ),
    (
        csv_of(-52.1, 52.1),
        PANDAR64,
        "unit.csv: expected elevations of a Pandar64, -25 to 15 deg, found -52.1 to 52.1, the "
        "file of another model; give the one of this lidar",
    ),
    (file_of("Helios 32"), Unit(HELIOS_16), "expected packets of a ROBOSENSE 32-line lidar"),
    (
        named("RS-LiDAR-32"),
        two_units({}),
        "found those of 2 (serial numbers 0a1b2c3d4e5f, ffffffffffff)",
    ),
]


@pytest.mark.parametrize(("calibration", "given", "text"), REFUSED)
def test_what_cannot_be_decoded_is_refused_in_one_line(
    calibration: Calibration, given: Unit | Evidence | None, text: str
) -> None:
    evidence = given.stream.evidence if isinstance(given, Unit) else given
    with pytest.raises(RigError) as caught:
        calibration.lidar({}, evidence)
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["RS-16", "RS-32", "Helios 32", "Airy 96", "Ruby Plus 128"])
@pytest.mark.parametrize(
    ("difops", "found"), [([], "no DIFOP packet"), ([NO_ANGLES], "DIFOP packets without angles")]
)
def test_angles_of_a_robosense_are_asked_for(name: str, difops: list[bytes], found: str) -> None:
    stream = stream_of(RobosenseSpec(name), 8)
    evidence = stream.evidence._replace(neighbours=difops_of(*difops))
    with pytest.raises(RigError, match=f"found {found}.*7788.*--metadata"):
        stream.calibration.lidar({}, evidence)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"colour": "red"}, "--decode: expected one of crc, firing_azimuth, optical_cen"),
        ({"vertical_offset": "up"}, "--decode vertical_offset: expected on or off, found 'up'"),
        ({"crc": "never"}, "--decode crc: expected check, found 'never'"),
    ],
)
@pytest.mark.parametrize(
    "calibration",
    [
        *(ouster_calibration(OusterSpec()), file_of("HDL-64E S2"), file_of("Pandar64")),
        *(file_of("AT128"), file_of("Helios 32")),
        *(named(model) for model in ("VLP-16", "Helios 32")),
        *(BUILT_IN["Livox SDK2"], BUILT_IN["PointCloud2"]),
    ],
    ids=lambda one: one.model,
)
def test_options_are_checked(
    calibration: Calibration, options: Mapping[str, str], text: str
) -> None:
    with pytest.raises(UsageError, match=text):
        calibration.lidar(options, None)


def test_options_of_all_vendors_are_taken_by_all() -> None:
    options = {"crc": "check", "firing_azimuth": "on", "optical_centre": "on"}
    lidar = ouster_calibration(OusterSpec()).lidar({**options, "vertical_offset": "off"}, None)
    assert lidar.notes == ()
