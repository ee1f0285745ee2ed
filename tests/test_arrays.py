"""The median is numpy's, and rows of a mask are those that numpy selects."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from mlbatch.arrays import median, rows_of

SHAPES = arrays.array_shapes(min_dims=1, max_dims=2, max_side=40)


@given(arrays.arrays(np.float64, SHAPES))
def test_of_reals(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> None:
    with np.errstate(all="ignore"):
        found = median(values)
    expected = float(np.median(values))
    assert found == expected or (math.isnan(found) and math.isnan(expected))


@given(arrays.arrays(np.int64, SHAPES, elements=st.integers(-(2**63), 2**63 - 1)))
def test_of_whole_numbers(values: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> None:
    assert median(values) == float(np.median(values))


@pytest.mark.parametrize(("values", "expected"), [([3, 1, 2], 2.0), ([4, 1, 3, 2], 2.5)])
def test_by_hand(values: list[int], expected: float) -> None:
    given_values = np.array(values)
    assert median(given_values) == expected
    assert given_values.tolist() == values


def test_of_nothing() -> None:
    assert math.isnan(median(np.empty(0)))


@given(arrays.arrays(np.uint8, arrays.array_shapes(min_dims=2, max_dims=2, max_side=9)), st.data())
def test_rows_of_a_mask(
    values: np.ndarray[tuple[int, ...], np.dtype[np.uint8]], data: st.DataObject
) -> None:
    chosen = data.draw(st.lists(st.booleans(), min_size=len(values), max_size=len(values)))
    expected = [row for row, is_chosen in zip(values.tolist(), chosen, strict=True) if is_chosen]
    assert rows_of(values, np.array(chosen, np.bool_)).tolist() == expected


def test_all_rows_are_not_copied() -> None:
    values = np.arange(6).reshape(3, 2)
    assert rows_of(values, np.ones(3, np.bool_)) is values
