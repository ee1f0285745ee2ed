"""What all tests share: one profile of hypothesis, and the command line in an empty folder."""

from __future__ import annotations

import gc
import signal
from collections.abc import Generator, Iterator
from pathlib import Path
from unittest.mock import patch

import pytest
from hypothesis import HealthCheck, settings

from mlbatch.pipeline.pose_check import PoseCheck
from tests.builders.sessions import Shell

# No deadline: how long an example takes depends on how loaded the machine is.
settings.register_profile("mlbatch", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("mlbatch")

# In the background shells have SIGINT ignored, and so would the commands that tests interrupt.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Whole suites of cases: `make test-quick` leaves them out; who works on their subject names them:
# `pytest tests/verification`.
LONG = (
    "batch/",
    "bench/",
    "digests/",
    "entry_points/",
    "fuzz/",
    "golden/",
    "matrix/",
    "property/",
    "python/",
    "recordings/",
    "simulate/",
    "verification/",
    "batching/test_reference.py",
    "cli/test_calibrate.py",
    "cli/test_deskew.py",
    "cli/test_fusion.py",
    "cli/test_progress.py",
    "cli/test_shards.py",
    "pipeline/test_accumulate.py",
    "pipeline/test_extract.py",
    "clocks/test_align.py::test_memory",
    "clocks/test_simulated.py",
    "contract/test_blocks.py::test_blocks_run",
    "contract/test_models.py",
    "contract/test_start.py",
    "decode/test_engine.py::test_any_pixels",
    "discovery/test_interleaved.py",
    "discovery/test_overlap.py",
    "discovery/test_router.py::test_packets_are_assigned",
    "motion/test_constant_velocity.py",
    "motion/test_poses_refused.py",
    "motion/test_wall.py",
    "outputs/test_read.py",
    "page/test_browser.py",
    "page/test_view.py",
    "page/test_comparison.py::test_it_is_drawn_in_a_browser",
    "page/test_windows.py::test_long_runs",
    "pipeline/test_resume.py",
    "poses/test_calibration.py",
    "poses/test_solve.py::test_directions",
    "poses/test_solve.py::test_stated",
    "readers/test_buffer_ends.py",
    "rig/test_extrinsics_files.py::test_any_text",
    "sensors/test_sensors.py::test_no_bytes_are_excluded",
    "sensors/test_sensors.py::test_no_other_vendor",
    "writers/test_bag_writer.py",
    "writers/test_durable.py",
    "writers/test_formats.py",
    "writers/test_mcap_container.py",
    "writers/test_messages.py",
)
# Tests that take seconds together: `make test-quick` leaves them out as well.
SECONDS = (
    "batching/test_grid.py",
    "batching/test_intake.py::test_the_rules",
    "batching/test_loss.py",
    "batching/test_merge.py",
    "batching/test_page.py",
    "cli/test_bag_mistakes.py",
    "cli/test_clipped.py",
    "cli/test_clocks.py::test_aligned",
    "cli/test_clouds.py",
    "cli/test_compare.py",
    "cli/test_datasets.py",
    "cli/test_fill.py",
    "cli/test_jumps.py",
    "cli/test_machine.py",
    "cli/test_metadata.py",
    "cli/test_mistakes.py",
    "cli/test_outputs.py::test_an_end",
    "cli/test_passthrough.py",
    "cli/test_sort.py",
    "cli/test_tables.py",
    "cli/test_vendor_mistakes.py",
    "comparison/test_instant.py",
    "contract/test_code.py::test_comments_name",
    "contract/test_docs.py::test_every_npz_key",
    "contract/test_help.py::test_a_shell_completes",
    "contract/test_help.py::test_help_fits_the_terminal",
    "contract/test_packaging.py",
    "contract/test_pictures.py",
    "contract/test_python_page.py::test_every_option_of_the_page_works",
    "decode/test_engine.py",
    "discovery/test_gravity.py::test_poses",
    "discovery/test_kind_filter.py",
    "discovery/test_match.py",
    "examples/test_notebook.py",
    "faults/test_laws.py",
    "motion/test_estimate.py",
    "native/test_library.py::test_a_library_of_another_version",
    "outputs/test_recording.py",
    "outputs/test_scan.py::test_a_table",
    "page/test_comparison.py",
    "page/test_page.py",
    "pipeline/test_conversion.py::test_memory",
    "pipeline/test_inspect.py",
    "pipeline/test_passthrough.py",
    "poses/test_check.py",
    "poses/test_from_motion.py",
    "poses/test_point_times.py",
    "poses/test_solve.py",
    "readers/bag/test_packet_messages.py::test_lengths",
    "readers/capture/test_fragments.py::test_pieces_of_any",
    "readers/capture/test_frames.py::test_any_traffic",
    "readers/capture/test_frames.py::test_frames_with_any_byte",
    "readers/capture/test_odd.py::test_any_damage",
    "readers/capture/test_recording.py::test_any_buffer",
    "readers/formats/test_bags.py",
    "readers/formats/test_captures.py::test_damage_ends",
    "readers/test_merge.py",
    "rig/test_mistakes.py::test_any_text",
    "rig/test_rig.py::test_written_rigs",
    "ros/test_point_rows.py",
    "sensors/test_clocks.py::test_dates_of_the_encoder",
    "sensors/test_round_trip.py",
    "sensors/test_sensors.py::test_bytes_that_are_all",
    "writers/test_voxel_filter.py",
)

# Where the versions of dependencies matter most: `make test-lowest` runs all of these, and the
# tests of `make test-quick`.
LOWEST = ("readers/", "ros/", "writers/")
# Conversions of other tests do not compare what lidars see, which is half of the time of those as
# short as theirs.
POSES = (
    "poses/",
    "cli/test_calibrate.py",
    "contract/test_blocks.py",
    "golden/test_digests.py",
    "page/",
    "pipeline/test_inspect.py",
    "pipeline/test_resume.py::test_a_complete_output",
    "python/",
)


def _paths(entries: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"tests/{entry}" for entry in entries)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Check poses in the tests that are about it alone, their shared fixtures included."""
    if item.nodeid.startswith(_paths(POSES)):
        return (yield)
    with patch.object(PoseCheck, "add", lambda check, window: None):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Let the collector of cycles leave the tests alone, which all live to the end.

    It would traverse them repeatedly: half of the time of the collection of tests.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of long suites, those that take seconds, and those of `make test-lowest`."""
    for mark, entries in ((pytest.mark.long, LONG), (pytest.mark.seconds, SECONDS)):
        starts = _paths(entries)
        for item in items:
            if item.nodeid.startswith(starts):
                item.add_marker(mark)
    starts = _paths(LOWEST)
    for item in items:
        marks = {mark.name for mark in item.iter_markers()}
        if "slow" not in marks and (
            not marks & {"long", "seconds"} or item.nodeid.startswith(starts)
        ):
            item.add_marker(pytest.mark.lowest)


@pytest.fixture
def shell(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Shell:
    """The command line, in an empty folder."""
    return Shell(monkeypatch, tmp_path)
