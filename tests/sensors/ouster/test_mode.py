"""Metadata of another mode: refused where azimuths are wrong, corrected where only the rate is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mlbatch.errors import RigError
from mlbatch.lidar.interface import Evidence
from mlbatch.sensors.ouster.mode import MODES
from mlbatch.simulate.ouster.encode import OusterSpec, encode_packets
from mlbatch.units import NS_PER_S
from tests.builders.others import rows
from tests.builders.spinning import evidence_of, ouster_calibration

SPEC = OusterSpec(beams=16)
PROFILES = ("RNG15_RFL8_NIR8", "LEGACY", "FUSA_RNG15_RFL8_NIR8_DUAL")
Mode = tuple[int, int]


def in_mode(mode: Mode, profile: str = PROFILES[0]) -> OusterSpec:
    return replace(SPEC, columns_per_frame=mode[0], rate_hz=mode[1], profile=profile)


def sampled(spec: OusterSpec, *numbers: int) -> Evidence:
    """Packets of these numbers, counted from the first column of a frame."""
    column = (np.array(numbers)[:, None] * 16 + np.arange(16)).ravel()
    per_frame = spec.columns_per_frame
    packets = encode_packets(
        spec,
        NS_PER_S + column * NS_PER_S // (per_frame * spec.rate_hz),
        column % per_frame,
        40 + column // per_frame,
        {},
    )
    return evidence_of(packets, np.zeros(len(packets), np.int64))


def usual(spec: OusterSpec) -> Evidence:
    """As discovery samples: 16 packets, then six of every quarter of a second."""
    per_second = spec.columns_per_frame * spec.rate_hz // 16
    later = [tick * per_second // 4 + number for tick in range(1, 5) for number in range(6)]
    return sampled(spec, *range(16), *later)


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("mode", MODES)
def test_metadata_of_the_mode_of_the_packets_are_taken_as_they_are(
    mode: Mode, profile: str
) -> None:
    spec = in_mode(mode, profile)
    for evidence in (usual(spec), sampled(spec, 0), sampled(spec, 7, 8, 9)):
        lidar = ouster_calibration(spec).lidar({}, evidence)
        assert (lidar.notes, lidar.mode) == ((), f"{mode[0]}x{mode[1]} {profile}")


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("stated", MODES)
@pytest.mark.parametrize("sent", MODES)
def test_another_number_of_columns_is_refused_and_another_rate_corrected(
    sent: Mode, stated: Mode, profile: str
) -> None:
    evidence = usual(in_mode(sent, profile))
    found = ouster_calibration(in_mode(stated, profile))
    if sent[0] != stated[0]:
        with pytest.raises(RigError, match=rf"expected packets of {stated[0]}x{stated[1]}, found"):
            found.lidar({}, evidence)
        # Those of the right mode beside them are preferred.
        right = ouster_calibration(in_mode(sent, profile)).match_score(evidence)
        assert right > found.match_score(evidence) > 0
        return
    lidar = found.lidar({}, evidence)
    assert lidar.mode == f"{sent[0]}x{sent[1]} {profile}"
    assert lidar.column_period_ns == NS_PER_S / (sent[0] * sent[1])
    assert len(lidar.notes) == (sent != stated)


def test_the_error_names_file_mode_ids_and_remedy() -> None:
    with pytest.raises(RigError) as caught:
        ouster_calibration(in_mode((512, 10))).lidar({}, usual(in_mode((1024, 10))))
    assert str(caught.value) == (
        "a.json: Ouster metadata, lidar_mode: expected packets of 512x10, found those of 1024x10 "
        "(1024 columns per revolution, measurement ids up to 607, columns 97.7 us apart): the mode "
        "changed after the metadata were saved, all azimuths would be wrong; save the metadata "
        "from the sensor again, or give those that were saved with this recording"
    )


def test_a_part_of_a_revolution_that_fits_two_modes_is_refused() -> None:
    """Columns 97.7 us apart are of 1024x10 or 512x20: azimuths may be right or doubled."""
    with pytest.raises(RigError, match=r"found those of 512x20 or 1024x10 \(measurement ids up to"):
        ouster_calibration(in_mode((512, 10))).lidar({}, sampled(in_mode((1024, 10)), *range(16)))
    # The encoder of LEGACY columns decides.
    legacy = in_mode((1024, 10), "LEGACY")
    with pytest.raises(RigError, match=r"found those of 1024x10 \(1024 columns per revolution"):
        ouster_calibration(in_mode((512, 10), "LEGACY")).lidar({}, sampled(legacy, *range(16)))


def test_a_change_of_mode_later_in_the_recording_is_rejected_packet_by_packet() -> None:
    old = in_mode((512, 10))
    lidar = ouster_calibration(old).lidar({}, usual(old))
    late = sampled(in_mode((1024, 10)), *range(64)).sample
    # Half of the ids of 1024 columns are beyond those of 512.
    assert lidar.faults(late).tolist() == [0] * 32 + [2] * 32
    # A few of them in the first 10 s are no reason to refuse the rest.
    mixed = usual(old)
    sample = np.concatenate([mixed.sample, late[60:]])
    mixed = mixed._replace(sample=sample, host_ns=np.zeros(len(sample), np.int64))
    assert ouster_calibration(old).lidar({}, mixed).notes == ()


def test_one_clock_that_was_set_is_no_other_mode() -> None:
    spec = in_mode((1024, 10))
    parts = [sampled(spec, *range(first, first + 6)) for first in (0, 160, 320)]
    later = parts[1].sample.copy()
    jumped = encode_packets(
        spec, 77 * NS_PER_S + np.arange(96) * 97656, np.arange(512, 608), np.full(96, 42), {}
    )
    later[:6] = rows(jumped)
    sample = np.concatenate([parts[0].sample, parts[2].sample, later])
    evidence = parts[0]._replace(sample=sample, host_ns=np.zeros(len(sample), np.int64))
    assert ouster_calibration(spec).lidar({}, evidence).notes == ()


def test_another_initialization_id_is_noted() -> None:
    sent = replace(SPEC, init_id=5)
    (note,) = ouster_calibration(replace(SPEC, init_id=6)).lidar({}, usual(sent)).notes
    assert note.startswith("a.json: Ouster metadata: expected packets of initialization_id 6, ")
    assert "found 5: the sensor was started or set again" in note
    # Neither zero nor LEGACY packets say anything.
    for spec in (replace(SPEC, init_id=0), replace(SPEC, profile="LEGACY")):
        assert ouster_calibration(replace(spec, init_id=6)).lidar({}, usual(spec)).notes == ()
