"""Clocks that agree with each other, but not with the capture host's; messages next to them."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcap.reader import make_reader

from tests.builders.bags import Body, Recorded
from tests.builders.mcaps import write_mcap
from tests.builders.sessions import NO_RECORDINGS, NS_PER_MS, NS_PER_S, RECORDINGS, Shell, Unit
from tests.builders.sessions_of_bags import unit_messages

TAI_S = 37
needs_recordings = pytest.mark.skipif(not RECORDINGS.is_dir(), reason=NO_RECORDINGS)


def _ahead(seconds: float) -> Unit:
    """A lidar whose clock is ahead of the capture host's, and whose packets take 1 ms."""
    return Unit(turns=6).ahead(round(seconds * NS_PER_S))


@needs_recordings
@pytest.mark.parametrize(
    ("recording", "line"),
    [
        ("ouster/os2-128_duplicate-ip-id/duplicate_id.pcap", "-540.793"),
        ("velodyne/vlp32c_ros2/1713492677464078412", "51.668"),
    ],
)
def test_real_recordings(shell: Shell, recording: str, line: str) -> None:
    """Offsets of MANIFEST.md and docs/sources/velodyne.md, section 7: 540.79 s and 51.7 s."""
    outcome = shell(f"convert {RECORDINGS / recording} -o out --keep-partial --quiet")
    assert "clock_epoch" in outcome.warnings
    assert f"`clock: {{offset_s: {line}}}` in the rig" in outcome.err


# -- messages ---------------------------------------------------------------------------------


def _with_notes(folder: Path, unit: Unit, imu_ahead_s: float | None = None) -> Path:
    """A lidar, messages of /note every 20 ms, and of an IMU ahead of the capture host."""
    messages = unit_messages(unit, "top")
    first_ns = messages[0].log_ns
    for number in range(25):
        log_ns = first_ns + number * 20 * NS_PER_MS
        text = Body("cdr").text(str(number)).done()
        messages.append(Recorded("/note", "std_msgs/String", log_ns, text))
        if imu_ahead_s is not None:
            stamp_ns = log_ns + round(imu_ahead_s * NS_PER_S)
            body = Body("cdr").header(stamp_ns, "imu").put("d", *[0.0] * 37).done()
            messages.append(Recorded("/imu", "sensor_msgs/Imu", log_ns, body))
    return write_mcap(folder / "drive.mcap", sorted(messages, key=lambda one: one.log_ns))


def _count(path: Path, topic: str) -> int:
    with path.open("rb") as file:
        return sum(1 for _ in make_reader(file).iter_messages([topic]))


COMMON = "convert drive.mcap -o out.mcap --keep-partial"


@pytest.mark.parametrize("ahead_s", [TAI_S, -1.5, 866 - 1_800_000_000])
@pytest.mark.parametrize("jobs", ["1", "3"])
def test_topics_on_another_clock_are_refused(
    shell: Shell, tmp_path: Path, ahead_s: float, jobs: str
) -> None:
    _with_notes(tmp_path, _ahead(ahead_s))
    outcome = shell(f"{COMMON} --pass /note --jobs {jobs}")
    assert outcome.code == 1
    error = outcome.err.splitlines()[-1]
    assert error.startswith(
        "mlbatch: error: --pass /note: expected the capture host's clock and that of the scans "
        "within 1 s of each other, since both are written at their own times, found the scans "
    )
    assert "use --clock host or --align-clocks, or `clock: {offset_s: " in error
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize("remedy", ["--clock host", "--align-clocks"])
def test_aligned_they_are_written(shell: Shell, tmp_path: Path, remedy: str) -> None:
    _with_notes(tmp_path, _ahead(TAI_S))
    outcome = shell(f"{COMMON} --pass /note {remedy}")
    assert outcome.code == 0, outcome.err
    assert _count(tmp_path / "out.mcap", "/note") == 25


def test_what_the_output_cannot_store_is_not_refused(shell: Shell, tmp_path: Path) -> None:
    _with_notes(tmp_path, _ahead(TAI_S))
    assert shell("convert drive.mcap -o out --keep-partial --pass /note").code == 0


def test_an_imu_that_is_asked_for_is_refused_by_its_header(shell: Shell, tmp_path: Path) -> None:
    """The scans are on UTC, the IMU on TAI."""
    _with_notes(tmp_path, _ahead(0), TAI_S)
    outcome = shell(f"{COMMON} --pass /imu")
    assert outcome.code == 1
    assert "--pass /imu: expected the clock of its header and that of the scans" in outcome.err
    assert "found the scans -37.00" in outcome.err
    # Not asked for, it is left out with a warning.
    outcome = shell(COMMON)
    assert (outcome.code, outcome.warnings) == (0, ["imu_clock"])
    assert _count(tmp_path / "out.mcap", "/imu") == 0


def test_an_imu_on_the_clock_of_the_scans_is_written_on_request(
    shell: Shell, tmp_path: Path
) -> None:
    """Both are 540 s ahead of the capture host, on no known timescale."""
    _with_notes(tmp_path, _ahead(540.793), 540.79)
    outcome = shell(f"{COMMON} --pass /imu")
    assert (outcome.code, outcome.warnings) == (0, ["clock_epoch"]), outcome.err
    assert _count(tmp_path / "out.mcap", "/imu") == 25
