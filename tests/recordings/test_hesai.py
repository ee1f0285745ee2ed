"""Real HESAI recordings, converted whole, against the published clouds and the sheet's totals.

Figures and the rules of the clouds: docs/sources/hesai.md sections 0, 3, 4, 5 and 9.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from mlbatch.arrays import BoolArray, I64Array
from tests.builders.run import Cloud
from tests.recordings.hesai import CASES, FOLDER, Case
from tests.recordings.references import (
    STRONGEST_FIRST,
    STRONGEST_LAST,
    WEAK_FIRST,
    WEAK_LAST,
    Made,
    converted,
    heading_deg,
    turned_deg,
)

every_case = pytest.mark.parametrize("case", CASES, ids=lambda case: case.folder)
# As the published clouds: both returns, and no rotor motion while the beams of a column fire.
AS_PUBLISHED = ("--keep-repeated", "--decode", "firing_azimuth=off")


@dataclass(frozen=True, slots=True)
class Sorted:
    """Points by column, channel and return; cdeg: the rotor's angle as in the packets."""

    case: Case
    cloud: Cloud
    order: I64Array
    channel: I64Array
    cdeg: I64Array

    @classmethod
    def of(cls, case: Case, cloud: Cloud) -> Sorted:
        """Returns of a beam stay in their order: they fire at once."""
        order = np.lexsort((cloud.ring, cloud.column))
        channel = cloud.ring[order].astype(np.int64)
        beam_deg = case.azimuth_micro_deg[channel] / 1e6
        rotor = turned_deg(heading_deg(cloud.xyz[order], ahead=1), beam_deg) * 100
        cdeg = np.rint(rotor).astype(np.int64)
        # Whole hundredths of a degree, as nothing rotates the beams further.
        assert np.abs(rotor - cdeg).max() < 0.01
        return cls(case, cloud, order, channel, cdeg % 36_000)

    @property
    def pairs(self) -> I64Array:
        """First of two returns of a beam; the other follows."""
        column = self.cloud.column[self.order]
        same = (np.diff(column) == 0) & (np.diff(self.channel) == 0)
        return np.flatnonzero(same)

    def sweeps(self) -> I64Array:
        """Sweep of each point, from 0: it ends where the beam's own azimuth passes 0 (rule 3)."""
        past_s = (self.cloud.stamp_ns - self.cloud.stamp_ns.min())[self.order] / 1e9
        # Ten revolutions a second, to a few hundredths of one.
        rotor = self.cdeg / 36_000
        whole = np.rint(rotor[0] + past_s * 10 - rotor).astype(np.int64)
        micro_deg = (whole * 36_000 + self.cdeg) * 10_000
        azimuth = micro_deg + self.case.azimuth_micro_deg[self.channel]
        ended: I64Array = -(-azimuth // 360_000_000)
        sweeps: I64Array = ended - ended.min()
        return sweeps

    def kept(self) -> BoolArray:
        """Rules 1 and 2: limits of range, and no first return that is like the last."""
        range_m, level = self.cloud.range_m[self.order], self.cloud.intensity[self.order]
        low_m, high_m = self.case.limits_m
        keep: BoolArray = (range_m >= low_m) & (range_m <= high_m)
        first = self.pairs
        same = (range_m[first] == range_m[first + 1]) & (level[first] == level[first + 1])
        near = np.abs(range_m[first] - range_m[first + 1]) < 0.1
        keep[first[same | near]] = False
        return keep


@every_case
def test_every_published_point_and_no_other(case: Case, tmp_path: Path) -> None:
    points = Sorted.of(case, converted(case.bag, tmp_path / "out", *AS_PUBLISHED).cloud)
    sweeps, keep = points.sweeps(), points.kept()
    assert tuple(np.bincount(sweeps[keep]).tolist()) == case.points_per_sweep
    ours = points.cloud.xyz[points.order[keep & (sweeps == case.sweep)]]
    published = case.published
    assert ours.shape == published.shape
    assert len(ours) == case.points_per_sweep[case.sweep]
    # Both by firing group, channel and return.
    assert np.abs(ours - published).max() < 1e-4


@every_case
def test_totals(case: Case, tmp_path: Path) -> None:
    made = converted(case.bag, tmp_path / "out", *AS_PUBLISHED)
    sensor, points, offset_ns = made.sensor, made.sensor["points"], case.offset_ns
    assert (sensor["model"], sensor["mode"]) == (case.model, case.mode)
    assert sensor["calibration"] == case.file
    # The date of all these lidars was never set.
    assert [one["code"] for one in made.report["warnings"]] == ["clock_epoch"]
    assert made.err.count("\n") == 1
    packets = {"read": case.packets, "accepted": case.packets, "rejected": {}}
    assert sensor["packets"] == {**packets, "lost": 0, "reordered": 0}
    assert sensor["columns"] == {"decoded": case.groups, "written": case.groups, "dropped": {}}
    assert points["slots"] == case.groups * len(offset_ns) * 2
    assert points["written"] == case.ranges
    assert points["repeated"] == 0
    assert -sensor["clock"]["offset_to_host_ms"] / 1e3 == pytest.approx(
        np.mean(case.host_ahead_s), abs=0.001
    )
    stamps = made.cloud.column_stamp_ns
    # The stamp of a column is its first firing.
    assert stamps[0] == case.first_ns + case.block_ns[0] + offset_ns.min()
    assert stamps[-1] == case.last_ns + case.block_ns[1] + offset_ns.min()
    assert (np.diff(stamps) > 0).all()


@every_case
def test_times_channels_and_returns(case: Case, tmp_path: Path) -> None:
    """Each point at the time of its own beam; organized scans hold the same, slot by slot."""
    made = converted(case.bag, tmp_path / "dense", *AS_PUBLISHED)
    cloud, offset_ns = made.cloud, case.offset_ns
    assert np.array_equal(cloud.at_ns - cloud.stamp_ns, (offset_ns - offset_ns.min())[cloud.ring])
    grid = converted(case.bag, tmp_path / "grid", *AS_PUBLISHED, "--layout", "organized").grid
    assert grid["range_m"].shape == (case.groups, 2 * len(offset_ns))
    filled = ~np.isnan(grid["range_m"])
    assert np.count_nonzero(filled[:, ::2]) == case.ranges_first
    assert np.count_nonzero(filled) == case.ranges
    slot = filled.nonzero()[1]
    assert np.array_equal(grid["ring"][filled], slot // 2)
    order = Sorted.of(case, cloud).order
    for key in ("xyz", "range_m", "intensity", "return_type", "at_ns"):
        assert np.array_equal(grid[key][filled], getattr(cloud, key)[order]), key


@every_case
def test_returns_of_a_pair_are_distinguished(case: Case, tmp_path: Path) -> None:
    """Equal ones are one; of others the nearer is first and the brighter strongest (section 3)."""
    made = converted(case.bag, tmp_path / "out", "--decode", "firing_azimuth=off")
    assert made.sensor["points"]["repeated"] == case.equal
    assert made.sensor["points"]["written"] == case.ranges - case.equal
    points = Sorted.of(case, made.cloud)
    first, types = points.pairs, points.cloud.return_type[points.order].astype(np.int64)
    assert len(first) == case.differ
    range_m, level = points.cloud.range_m[points.order], points.cloud.intensity[points.order]
    farther = range_m[first] > range_m[first + 1]
    # The documented order is "last, strongest"; that of the XT-32 is the other one.
    assert farther.all() if case.model not in ("PandarXT-32", "PandarQT64") else not farther.any()
    near, far = (np.where(farther, first + step, first + 1 - step) for step in (1, 0))
    assert (types[near] + types[far] == STRONGEST_FIRST + WEAK_LAST).all()
    brighter = level[near] > level[far]
    assert (types[near][brighter] == STRONGEST_FIRST).all()
    dimmer = level[near] < level[far]
    assert (types[near][dimmer] == WEAK_FIRST).all()
    assert np.isin(types[far], (STRONGEST_LAST, WEAK_LAST)).all()
    if case.model == "PandarXT-32":
        assert dimmer.mean() == pytest.approx(0.85, abs=0.02)


@every_case
def test_the_rotor_goes_on_while_beams_fire(case: Case, tmp_path: Path) -> None:
    """3600 degrees a second from the time of its azimuth on (section 6)."""
    off = converted(case.bag, tmp_path / "off", *AS_PUBLISHED).cloud
    on = converted(case.bag, tmp_path / "on", "--keep-repeated").cloud
    for key in ("range_m", "at_ns", "ring", "intensity", "column_stamp_ns"):
        assert np.array_equal(getattr(on, key), getattr(off, key)), key
    assert np.array_equal(on.xyz[:, 2], off.xyz[:, 2])
    moved_deg = turned_deg(heading_deg(on.xyz, ahead=1), heading_deg(off.xyz, ahead=1))
    # The firing-time files of XT models begin at 6 us, not at 368 ns.
    lag_ns = 5632 if case.model.startswith("PandarXT") else 0
    # 600 rpm, but for the motor's ripple.
    assert np.abs(moved_deg - (case.offset_ns[on.ring] + lag_ns) * 3600e-9).max() < 0.002


def test_a_recording_whose_ranges_are_all_one(tmp_path: Path) -> None:
    """Every distance was overwritten with 0x9696 counts of 4 mm, so that every beam has points."""
    bag = FOLDER / "pandar64_all-points" / "all_points"
    both = converted(bag, tmp_path / "both", *AS_PUBLISHED)
    assert _figures(both) == (7200 * 64 * 2, 0, 0)
    assert (both.cloud.range_m == np.float32(0x9696 / 250)).all()
    case = next(case for case in CASES if case.folder == "pandar64")
    counts = np.bincount(Sorted.of(case, both.cloud).sweeps())
    # 1800 groups of 0.2 degrees a revolution, but for the motor's ripple and partial revolutions.
    assert counts[1:-1] == pytest.approx(1800 * 64 * 2, rel=5e-3)
    one = converted(bag, tmp_path / "one")
    assert _figures(one) == (7200 * 64, 7200 * 64, 0)


def _figures(made: Made) -> tuple[int, ...]:
    points = made.sensor["points"]
    return tuple(points[key] for key in ("written", "repeated", "no_return"))
