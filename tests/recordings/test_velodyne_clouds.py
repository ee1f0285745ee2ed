"""Returns of a real VLP-16, and Velodyne recordings against Nebula's published clouds.

Figures: docs/sources/velodyne.md sections 3 (returns), 11, and 12 (where those clouds are wrong).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mlbatch.arrays import BoolArray, F32Array, I64Array
from mlbatch.simulate.velodyne.models import MODELS
from tests.recordings.references import (
    ONLY,
    STRONGEST_FIRST,
    STRONGEST_LAST,
    WEAK_FIRST,
    WEAK_LAST,
    converted,
    heading_deg,
    read_pcd,
    turned_deg,
    xyz_of,
)
from tests.recordings.velodyne import DUAL, FOLDER, GAPS

# Nebula's types from 4 on (first and last weak, identical, ..., first and last strongest), by what
# its blocks contain: see the test.
NEBULA = [WEAK_LAST, WEAK_FIRST, ONLY, 0, 0, STRONGEST_LAST, STRONGEST_FIRST]


def test_returns_of_a_pair_are_distinguished(tmp_path: Path) -> None:
    """Even blocks have the last return: the farther one, wherever two are seen (section 3)."""
    ours, theirs = converted(DUAL.path, tmp_path / "out").cloud, DUAL.theirs
    types = ours.return_type[np.lexsort((ours.range_m, ours.ring, ours.column))]
    # 97.8 % of pairs are equal; one return is missing in 528 and 57; 708 differ.
    assert [(theirs.which == kind).sum() for kind in (1, 2, 3)] == [708 + 57, 708 + 528, 57_413]
    alone = types == ONLY
    assert alone[theirs.which == 3].all()
    assert [(alone & (theirs.which == kind)).sum() for kind in (1, 2)] == [57, 528]
    first, last = (~alone & (theirs.which == kind) for kind in (1, 2))
    assert np.isin(types[first], (STRONGEST_FIRST, WEAK_FIRST)).all()
    assert np.isin(types[last], (STRONGEST_LAST, WEAK_LAST)).all()
    # Both of a pair are adjacent in this order; one of them is the stronger.
    pair = first.nonzero()[0]
    assert np.array_equal(pair + 1, last.nonzero()[0])
    levels = theirs.intensity
    differ = levels[pair] != levels[pair + 1]
    nearer_is_stronger = levels[pair] > levels[pair + 1]
    assert np.array_equal((types[pair] == STRONGEST_FIRST)[differ], nearer_is_stronger[differ])
    assert (types[pair].astype(int) + types[pair + 1] == STRONGEST_FIRST + WEAK_LAST).all()
    # The sheet: the odd one is the stronger in 41 %.
    assert nearer_is_stronger.mean() == pytest.approx(0.41, abs=0.02)


# The published clouds have beams from the sensor's origin.
NO_HEIGHTS = ("--decode", "vertical_offset=off")


class Pairs:
    """Slots of the dual recording in Nebula's order: pair of blocks, even block first, laser ids.

    Arrays are (n,), or (n, 3) for xyz; a pair of blocks has 64 slots.
    """

    def __init__(self, folder: Path) -> None:
        words = ("--layout", "organized", *NO_HEIGHTS)
        grid = converted(DUAL.path, folder, *words).grid
        self.rings = np.argsort(np.argsort(MODELS["VLP-16"].elevation_deg))
        # Pair of blocks, sequence, laser, return.
        self._slots = {
            key: grid[key].reshape(-1, 2, 16, 2, *grid[key].shape[2:])[:, :, self.rings]
            for key in ("xyz", "range_m", "intensity", "return_type")
        }
        self.xyz: F32Array = self.ordered("xyz")
        self.range_m: F32Array = self.ordered("range_m")
        self.ring: I64Array = np.tile(self.rings, len(self.range_m) // 16)
        level = self._slots["intensity"]
        tied = np.broadcast_to(level[..., :1] == level[..., 1:], level.shape)
        self.is_tied: BoolArray = tied.swapaxes(2, 3).swapaxes(1, 2).reshape(-1)

    def ordered(self, key: str) -> Any:
        """All values of a key."""
        values = np.moveaxis(self._slots[key], 3, 1)
        return values.reshape(-1, *values.shape[4:])


def test_the_published_cloud_of_a_vlp_16(tmp_path: Path) -> None:
    """It has points from 0.3 m and up to 359 degrees, in the order of the packets."""
    theirs = read_pcd(FOLDER / "vlp16_ros2_dual" / "1673400472138016708.pcd")
    ours = Pairs(tmp_path / "out")
    kept = ((ours.range_m >= 0.3) & (heading_deg(ours.xyz) % 360 < 359)).nonzero()[0]
    expected = theirs["channel"]
    starts = np.lib.stride_tricks.sliding_window_view(ours.ring[kept], 200) == expected[:200]
    begin = int(starts.all(axis=1).nonzero()[0][0])
    chosen = kept[begin : begin + len(theirs)]
    assert len(chosen) == 14_831
    assert np.array_equal(ours.ring[chosen], expected)
    assert np.abs(ours.range_m[chosen] - theirs["distance"]).max() < 5e-5
    assert np.array_equal(ours.ordered("intensity")[chosen], theirs["intensity"])
    away_m = np.linalg.norm(ours.xyz[chosen] - xyz_of(theirs), axis=1)
    assert np.median(away_m) < 0.0002
    assert away_m.max() < 0.050
    # Its odd blocks take the azimuth of the next pair, and the last pair has no rate (trap 1).
    right = (chosen % 64 < 32) & (chosen // 64 % 6 < 5)
    off_deg = np.abs(turned_deg(heading_deg(ours.xyz[chosen]), heading_deg(xyz_of(theirs))))
    assert off_deg[right].max() < 0.03
    assert off_deg.max() < 0.45
    # It calls the even block first and the odd one last, though the even one is farther.
    named = np.choose(theirs["return_type"], [0] * 4 + NEBULA)
    same = ours.ordered("return_type")[chosen] == named
    assert (same | ours.is_tied[chosen]).all()
    assert same.sum() == len(theirs) - 2 * 23


def test_the_published_cloud_of_a_vlp_32c(tmp_path: Path) -> None:
    """It has one revolution, 0.4 to 50 m; their azimuths are re-enacted."""
    theirs = xyz_of(read_pcd(FOLDER / "vlp32c_ros2" / "1713492677464078412.pcd"))
    limits = ("--min-range", "0.4", "--max-range", "50")
    ours = converted(GAPS.path, tmp_path / "out", *limits, *NO_HEIGHTS).cloud
    table = MODELS["VLP-32C"]
    laser = np.argsort(table.elevation_deg)[ours.ring]
    # By column, then laser id, as the packets have them; two fire at once.
    order = np.lexsort((laser, ours.column))
    # Blocks from 270 to 90 degrees.
    cdeg_of_blocks = GAPS.theirs.azimuth_cdeg.reshape(-1)
    order = order[(cdeg_of_blocks[ours.column[order]] + 9000) % 36000 <= 18000][: len(theirs)]
    assert len(theirs) == 26_216
    far_m = np.linalg.norm(theirs, axis=1)
    assert np.abs(ours.range_m[order] - far_m).max() < 5e-5
    assert np.abs(ours.xyz[order, 2] - theirs[:, 2]).max() < 5e-5
    # It rotates beams by the step to the next block (the last one has none), and by 2.304 us for
    # each laser, though two fire at once (traps 1 and 2). 0.0036 degrees a us; steps of whole cdeg.
    step_cdeg = np.diff(cdeg_of_blocks, append=0) % 36000
    step_cdeg[11::12] = 0
    number = laser[order]
    their_deg = step_cdeg[ours.column[order]] / 100 * number * 2.304 / 55.296
    own_deg = number // 2 * 2.304 * 0.0036
    off_deg = turned_deg(heading_deg(theirs), heading_deg(ours.xyz[order]))
    assert np.abs(off_deg).max() < 0.16
    assert np.abs(off_deg - (their_deg - own_deg)).max() < 0.03
