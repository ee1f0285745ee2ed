"""Random numbers of faults."""

from __future__ import annotations

import numpy as np

from mlbatch.faults.draws import draw, is_below, stream_state


def test_numbers_are_those_of_splitmix64() -> None:
    """Numbers of the authors' C code for the seed 1234567."""
    drawn = draw(np.full(3, 1234567, np.uint64), np.arange(3))
    assert drawn.tolist() == [6457827717110365317, 3203168211198807973, 9817491932198370423]


def test_probabilities_are_exact_at_their_ends() -> None:
    drawn = np.array([0, 2**63 - 1, 2**63, 2**64 - 1], np.uint64)
    assert is_below(drawn, 0.5).tolist() == [True, True, False, False]
    assert is_below(drawn, 1.0).all()


def test_seeds_faults_and_sensors_have_different_sequences() -> None:
    states = {
        stream_state(seed, fault, name)
        for seed in range(10)
        for fault in range(10)
        for name in ("left", "right", "top")
    }
    assert len(states) == 300
