"""Ouster metadata that do not belong to the packets: what `convert` and `inspect` say of them."""

from __future__ import annotations

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


# -- information, no warnings --------------------------------------------------------------------
