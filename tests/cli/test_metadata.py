"""Ouster metadata that do not belong to the packets: what `convert` and `inspect` say of them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mlbatch.simulate.ouster.encode import OusterSpec, encode_frame
from tests.builders.captures import udp_frame
from tests.builders.sessions import (
    EPOCH_NS,
    NS_PER_MS,
    NS_PER_S,
    SMALL,
    Records,
    Shell,
    Unit,
    report_of,
    write_metadata,
    write_session,
)

FAST = replace(SMALL, columns_per_frame=1024)


def revolutions(spec: OusterSpec, begin_ns: int, count: int, frame: int) -> Records:
    """Packets of whole revolutions, each received 1 ms after its last column."""
    ranges = np.full((spec.columns_per_frame, spec.beams, 1), 4000)
    found: Records = []
    for turn in range(count):
        start_ns = begin_ns + turn * NS_PER_S // spec.rate_hz
        packets = encode_frame(spec, start_ns, frame + turn, ranges)
        step_ns = NS_PER_S // spec.rate_hz // len(packets)
        for number, payload in enumerate(packets, 1):
            (data,) = udp_frame(payload, "10.0.0.1", dport=7502)
            found.append((start_ns + number * step_ns + NS_PER_MS, data))
    return found


def warned(shell: Shell, *options: str) -> tuple[dict[str, Any], list[tuple[str, str]]]:
    """The sensor in the report of a run, and its warnings."""
    outcome = shell(" ".join(["convert drive.pcap -o out --keep-partial", *options]))
    assert outcome.code == 0, outcome.err
    report = report_of("out/report.json")
    return report["sensors"][0], [(one["code"], one["message"]) for one in report["warnings"]]


def test_inspect_says_why_metadata_cannot_be_used(shell: Shell, tmp_path: Path) -> None:
    write_session(tmp_path, Unit(), metadata=False)
    write_metadata(tmp_path / "111.json", FAST)
    outcome = shell("inspect drive.pcap")
    assert "note: 10.0.0.1 > port 7502: 111.json: Ouster metadata, lidar_mode: " in outcome.out
    assert "expected packets of 1024x10, found those of 512x10" in outcome.out


def test_of_two_files_of_one_unit_that_of_the_mode_is_used(shell: Shell, tmp_path: Path) -> None:
    write_session(tmp_path, Unit(), metadata=False)
    write_metadata(tmp_path / "a.json", FAST)
    write_metadata(tmp_path / "b.json", SMALL)
    sensor, warnings = warned(shell)
    assert (sensor["calibration"], sensor["mode"]) == ("b.json", "512x10 RNG15_RFL8_NIR8")
    assert warnings == []


def test_another_rate_is_warned_of_and_the_right_mode_reported(
    shell: Shell, tmp_path: Path
) -> None:
    write_session(tmp_path, Unit(turns=6), metadata=False)
    write_metadata(tmp_path / "111.json", replace(SMALL, rate_hz=20))
    sensor, ((code, text),) = warned(shell)
    assert (code, sensor["mode"]) == ("calibration", "512x10 RNG15_RFL8_NIR8")
    assert "expected packets of 512x20, found those of 512x10 by their timestamps" in text
    assert sensor["fill"] == 1.0
    assert text in shell("inspect drive.pcap").out
    assert shell("convert drive.pcap -o strict --strict").code == 1


def test_another_initialization_id_is_warned_of(shell: Shell, tmp_path: Path) -> None:
    write_session(tmp_path, Unit(turns=6), metadata=False)
    write_metadata(tmp_path / "111.json", replace(SMALL, init_id=SMALL.init_id + 1))
    _, ((code, text),) = warned(shell)
    assert code == "calibration"
    assert f"expected packets of initialization_id {SMALL.init_id + 1}, found " in text
    assert f"found {SMALL.init_id}: " in text
    assert text in shell("inspect drive.pcap").out
    outcome = shell("convert drive.pcap -o strict --strict")
    assert "(calibration, an error because of --strict)" in outcome.err


@pytest.mark.parametrize("profile", ["RNG15_RFL8_NIR8", "LEGACY"])
def test_packets_of_a_later_mode_are_rejected(shell: Shell, tmp_path: Path, profile: str) -> None:
    """11 s of 512x10, then 0.5 s of 1024x10, half of whose ids are beyond 511."""
    spec = replace(SMALL, profile=profile)
    begin_ns = EPOCH_NS + 20 * NS_PER_MS
    later_ns = begin_ns + 11 * NS_PER_S
    fast = replace(FAST, profile=profile)
    later = revolutions(fast, later_ns, 5, 200)
    write_session(tmp_path, more=[*revolutions(spec, begin_ns, 110, 5), *later])
    write_metadata(tmp_path / "111.json", spec)
    sensor, warnings = warned(shell)
    assert sensor["packets"]["rejected"] == {"bad_header": 5 * 32}
    assert sensor["packets"]["accepted"] == 110 * 32 + 5 * 32
    (text,) = [text for code, text in warnings if code == "rejected"]
    assert text.endswith("(160 bad_header): their model or mode is not that of the first packets")


def test_packets_whose_numbers_stand_still_are_warned_of(shell: Shell, tmp_path: Path) -> None:
    """All revolutions but the first are rejected as duplicates, which they are not."""
    begin_ns = EPOCH_NS + 20 * NS_PER_MS
    same = [revolutions(SMALL, begin_ns + turn * 100 * NS_PER_MS, 1, 5) for turn in range(6)]
    write_session(tmp_path, more=[one for records in same for one in records])
    write_metadata(tmp_path / "111.json", SMALL)
    sensor, warnings = warned(shell)
    assert sensor["packets"]["rejected"] == {"duplicate": 5 * 32}
    assert warnings == [
        (
            "rejected",
            "ouster_111: 160 of 192 packets rejected (160 duplicate): their numbers are those of "
            "earlier packets with other timestamps",
        )
    ]


def test_packets_captured_twice_are_not(shell: Shell, tmp_path: Path) -> None:
    unit = Unit(turns=6)
    write_session(tmp_path, unit, more=unit.records)
    sensor, warnings = warned(shell)
    assert (sensor["packets"]["rejected"], warnings) == ({"duplicate": 6 * 32}, [])


# -- information, no warnings --------------------------------------------------------------------


def test_metadata_of_legacy_packets_are_not_proven(shell: Shell, tmp_path: Path) -> None:
    write_session(tmp_path, Unit(replace(SMALL, profile="LEGACY"), turns=6))
    sensor, warnings = warned(shell)
    text = "metadata not proven: packets and metadata have no serial number in common"
    assert (sensor["calibration_note"].startswith(text), warnings) == (True, [])
    assert f"note: ouster_111: 111.json: {text}" in shell("inspect drive.pcap").out
    write_session(tmp_path / "serial", Unit(turns=6))
    assert "not proven" not in shell("inspect serial/drive.pcap").out


@pytest.mark.parametrize("mode", ["", "TIME_FROM_INTERNAL_OSC"])
def test_a_count_from_power_on_without_a_named_source(
    shell: Shell, tmp_path: Path, mode: str
) -> None:
    spec = replace(SMALL, timestamp_mode=mode)
    unit = Unit(spec, begin_ns=866 * NS_PER_S, host_ns=EPOCH_NS - 866 * NS_PER_S, turns=6)
    write_session(tmp_path, unit)
    text = "no time source is named: dates would be of 1970"
    sensor, warnings = warned(shell)
    assert (text in json.dumps(sensor["clock"]["notes"]), warnings) == (not mode, [])
    assert (text in shell("inspect drive.pcap").out) == (not mode)


@pytest.mark.parametrize("option", ["", "--identity-extrinsics"])
def test_extrinsics_of_the_metadata_are_named(shell: Shell, tmp_path: Path, option: str) -> None:
    pose = [1.0, 0.0, 0.0, 1.5, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 2.0, 0.0, 0.0, 0.0, 1.0]
    write_session(tmp_path, Unit(replace(SMALL, extrinsic_m=pose)))
    outcome = shell(f"convert drive.pcap -o out {option}")
    line = "extrinsics of ouster_111 are from its metadata, 111.json"
    assert line in outcome.out.splitlines()
    sensor = report_of("out/report.json")["sensors"][0]
    assert sensor["extrinsics"]["source"] == "metadata"
    np.testing.assert_array_equal(sensor["extrinsics"]["body_from_sensor"][0], pose[:4])
    # Without one there is nothing to say.
    write_session(tmp_path / "bare", Unit())
    assert line not in shell(f"convert bare/drive.pcap -o bare/out {option}").out
