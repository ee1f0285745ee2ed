"""Angles of rotor words by the compiled loops equal those of numpy to the last bit."""

from __future__ import annotations

import numpy as np
import pytest

from mlbatch.arrays import I64Array
from mlbatch.decode import engine
from mlbatch.decode.engine import compiled_angles
from mlbatch.lidar.geometry import rotor_angles

REVOLUTION = 1 << 32
HUNDREDTHS = np.rint(np.arange(36_000) * (REVOLUTION / 36_000)).astype(np.int64)
# Where cosine or sine is next to zero, and where the quarters of a revolution meet.
NEAR_AXES = np.concatenate(
    [np.arange(-3_000, 3_000) + eighth * (REVOLUTION // 8) for eighth in range(8)]
)


def random_words() -> I64Array:
    """Angles, speeds and firing tables of all kinds."""
    rng = np.random.default_rng(1)
    return rng.integers(-(1 << 63), (1 << 63) - 1, 1_000_000)


@pytest.mark.parametrize("words", [random_words(), HUNDREDTHS, NEAR_AXES, HUNDREDTHS[:0]])
def test_angles_equal_those_of_numpy(words: I64Array) -> None:
    for one, other in zip(rotor_angles(words), compiled_angles(words), strict=True):
        assert one.dtype == other.dtype
        assert one.tobytes() == other.tobytes()


def test_numpy_computes_angles_whose_last_bit_is_uncertain(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[I64Array] = []

    def noted(words: I64Array) -> tuple[object, object]:
        asked.append(words)
        return rotor_angles(words)

    monkeypatch.setattr(engine, "rotor_angles", noted)
    compiled_angles(np.array([0, 1 << 28, 1 << 30, 1 << 31]))
    assert [words.tolist() for words in asked] == [[0, 1 << 30, 1 << 31]]
    compiled_angles(random_words())
    # A few in a million.
    assert len(asked[1]) < 100
